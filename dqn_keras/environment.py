"""The door between a gymnasium.Env and the rest: what comes through it is of the right kind, and finite."""

import math
from typing import Any

import gymnasium as gym
import numpy as np

from dqn_keras.agent import episode_seed


class CheckedEnv:
    """A gymnasium.Env with a Box observation of one axis and Discrete actions, its words checked.

    States come out as float32 copies [F] (an environment may reuse its buffer), actions go in as indices from 0.
    Whatever else comes raises ValueError with the environment's name, the episode and the step.
    """

    def __init__(self, env: gym.Env) -> None:
        if not isinstance(env, gym.Env):
            raise TypeError(f"env must be a gymnasium.Env, got {env!r}")
        self.name = env.spec.id if env.spec else type(env.unwrapped).__name__
        observations, actions = env.observation_space, env.action_space
        if not isinstance(observations, gym.spaces.Box) or len(observations.shape) != 1 or not observations.shape[0]:
            raise ValueError(
                f"env {self.name} has the observation space {observations}; supported is a Box of one axis "
                "(gymnasium.wrappers.FlattenObservation makes one of most spaces)"
            )
        if not isinstance(actions, gym.spaces.Discrete):
            raise ValueError(f"env {self.name} has the action space {actions}; supported is Discrete")
        self._env = env
        self._shape = observations.shape
        self._first_action = int(actions.start)
        self.num_features = observations.shape[0]
        self.num_actions = int(actions.n)

    def reset(self, seed: int, episode: int) -> np.ndarray:
        """Begin an episode, with the environment seeded from (seed, episode): its first state."""
        self._episode, self._step = episode, -1
        result = self._env.reset(seed=episode_seed(seed, episode))
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._error("reset() must return (observation, info)", result)
        return self._checked_state(result[0])

    def step(self, a: int) -> tuple[np.ndarray, float, bool, bool]:
        """Next state, reward, terminated, truncated after the action of index `a`."""
        self._step += 1
        result = self._env.step(self._first_action + a)
        try:
            observation, reward, terminated, truncated, _ = result
        except (TypeError, ValueError):
            wanted = "step() must return (observation, reward, terminated, truncated, info)"
            raise self._error(wanted, result) from None
        try:
            reward = float(reward)
        except (TypeError, ValueError):
            raise self._error("the reward must be a number", reward) from None
        if not abs(reward) <= _LARGEST:
            raise self._error("the reward must be finite in float32", reward)
        return self._checked_state(observation), reward, bool(terminated), bool(truncated)

    def _checked_state(self, observation: Any) -> np.ndarray:
        try:
            state = np.array(observation, np.float32)
        except (TypeError, ValueError):
            raise self._error("the observation must be an array of numbers", observation) from None
        if state.shape != self._shape:
            raise self._error(f"the observation must have shape {self._shape}", observation)
        if not math.isfinite(sum(state.tolist())):  # in float64, where float32 numbers cannot overflow
            raise self._error("the observation must be finite in float32", observation)
        return state

    def _error(self, wanted: str, got: Any) -> ValueError:
        where = "at the reset" if self._step < 0 else f"step {self._step}"
        return ValueError(f"env {self.name}: {wanted}, got {got!r} in episode {self._episode}, {where}")


_LARGEST = float(np.finfo(np.float32).max)
