"""Checks of an environment's spaces and of a gymnasium.Env's return values (compiled: `loops/compiled.py`, `_step`)."""

import math
from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.tensorflow import keras, require_xla, tf
from dqn_keras.checks.networks import check_fits
from dqn_keras.checks.numbers import shown
from dqn_keras.checks.observations import StateWatch, as_float, as_numbers, feature_name
from dqn_keras.environments import key_of_twin


class CheckedEnv:
    """Plays a gymnasium.Env with Box observations and Discrete actions, and checks every value that it returns.

    States are returned as copies [*S], because an environment may reuse its buffer. Actions are indices from 0.
    A wrong return value raises ValueError with the environment's name, the episode and the step. `watch`, if given,
    also sees the first states of a run.
    """

    def __init__(self, env: gym.Env, watch: StateWatch | None = None) -> None:
        if not isinstance(env, gym.Env):
            raise TypeError(f"env must be a gymnasium.Env, got {not_an_env(env)}")
        self.name = env_name(env)
        self.spaces = spaces_of(env)
        self._env, self._watch = env, watch
        self._is_uint8 = self.spaces.state_dtype == np.uint8

    def reset(self, seed: int, episode: int) -> np.ndarray:
        """Begins an episode with this seed and returns its first state. `episode` is its number, for messages."""
        self._episode, self._step = episode, -1
        result = self._call(self._env.reset, seed=seed)
        if not (isinstance(result, tuple) and len(result) == 2):
            raise self._error("reset() must return (observation, info)", result)
        return self._checked_state(*result)

    def step(self, a: int) -> tuple[np.ndarray, float, bool, bool]:
        """Takes the action with index `a` and returns next state, reward, terminated, truncated."""
        self._step += 1
        result = self._call(self._env.step, self.spaces.first_action + a)
        try:
            observation, reward, terminated, truncated, info = result
        except (TypeError, ValueError):
            wanted = "step() must return (observation, reward, terminated, truncated, info)"
            raise self._error(wanted, result) from None
        if type(reward) is not float:
            number = as_float(reward)
            if number is None:
                raise self._error("the reward must be a number", reward)
            reward = number
        if not abs(reward) <= _LARGEST:
            raise self._error("the reward must be finite in float32", reward)
        if not isinstance(terminated, _BOOLS) or not isinstance(truncated, _BOOLS):
            raise self._error("terminated and truncated must be booleans", (terminated, truncated))
        return self._checked_state(observation, info), reward, bool(terminated), bool(truncated)

    def _checked_state(self, observation: Any, info: Any) -> np.ndarray:
        numbers = observation
        if type(numbers) is not np.ndarray or numbers.dtype.kind not in "fiub":
            numbers = as_numbers(observation)
            if numbers is None:
                raise self._error("the observation must be an array of numbers", observation)
        state = np.array(numbers, None if self._is_uint8 else np.float32)
        if state.shape != self.spaces.state_shape:
            wanted = f"the observation must have shape {self.spaces.state_shape}, not {state.shape}"
            raise self._error(wanted, observation)
        if self._is_uint8:
            if state.dtype != np.uint8:
                raise self._error("the observation must be of dtype uint8, as its space says", state.dtype)
        elif not (math.isfinite(sum(state.tolist())) if state.ndim == 1 else np.isfinite(state).all()):
            feature = feature_name(state.shape, int(np.isfinite(state).argmin()))
            raise self._error(f"the observation must be finite in float32 ({feature} is not)", observation)
        if self._watch is not None and not self._watch.see(numbers, info):
            self._watch = None
        return state

    def _call(self, method: Callable, *args: Any, **kwargs: Any) -> Any:
        try:
            return method(*args, **kwargs)
        except Exception as error:
            error.add_note(f"raised by env {self.name} {self._where()}")
            raise

    def _where(self) -> str:
        return f"in episode {self._episode}, {'at the reset' if self._step < 0 else f'step {self._step}'}"

    def _error(self, wanted: str, got: Any) -> ValueError:
        return ValueError(f"env {self.name}: {wanted}, got {shown(got)} {self._where()}")


def env_name(env: gym.Env | FuncEnv) -> str:
    """Returns the name of an environment for messages: its registered id, or else its class."""
    if isinstance(env, FuncEnv):
        return type(env).__name__
    return env.spec.id if env.spec else type(env.unwrapped).__name__


def not_an_env(thing: Any) -> str:
    """Returns the end of a message about something that is not an environment: what it is, and what to use instead."""
    if isinstance(thing, str):
        return f'{thing!r}; use gymnasium.make("{thing}")'
    if isinstance(thing, gym.envs.registration.EnvSpec):
        return f"the EnvSpec of {thing.id}; use gymnasium.make(spec)"
    if isinstance(thing, type) and issubclass(thing, gym.Env | FuncEnv):
        return f"the class {thing.__name__}; use {thing.__name__}()"
    if isinstance(thing, gym.vector.VectorEnv):
        return f"the vector environment {shown(thing)}; use gymnasium.make: only one environment is played at a time"
    return shown(thing)


class Spaces(NamedTuple):
    """The sizes and types of an environment's states and actions."""

    state_shape: tuple[int, ...]
    state_dtype: np.dtype
    """uint8 if the observations are uint8, such as images; otherwise float32."""
    num_actions: int
    first_action: int
    """The environment's number for the action of index 0."""


def some_states(space: Any, dtype: np.dtype, num_states: int = 8) -> np.ndarray:
    """Returns states within a space's bounds to test a network with, [num_states, *S]; always the same ones."""
    rng = np.random.default_rng(0)
    normal, uniform = rng.normal(size=(num_states, *space.shape)), rng.random((num_states, *space.shape))
    low, high = space.low.astype(np.float64), space.high.astype(np.float64)
    is_bounded = (low > -1e6) & (high < 1e6)  # a huge number may mean that there is no bound
    within = np.where(is_bounded, low, 0) + np.where(is_bounded, high - low, 0) * uniform
    return np.where(is_bounded, within, np.clip(normal, low, high)).astype(dtype)


def spaces_of(env: gym.Env | FuncEnv) -> Spaces:
    """Returns the sizes of an environment's spaces; raises ValueError if they are missing or not supported."""
    observations, actions = getattr(env, "observation_space", None), getattr(env, "action_space", None)
    if not (isinstance(observations, gym.Space) and isinstance(actions, gym.Space)):
        got = f"{shown(observations)} and {shown(actions)}"
        raise ValueError(f"env {env_name(env)} must have an observation_space and an action_space, got {got}")
    return check_spaces(env_name(env), observations, actions)


def check_spaces(name: str, observations: gym.Space, actions: gym.Space) -> Spaces:
    """Returns the sizes of the two spaces; raises ValueError if they are not supported."""
    if not isinstance(observations, gym.spaces.Box) or not observations.shape or 0 in observations.shape:
        raise ValueError(
            f"env {name} has the observation space {observations}; it must be a Box with at least one axis "
            f"({way_to_a_box(observations)})"
        )
    if not isinstance(actions, gym.spaces.Discrete):
        raise ValueError(f"env {name} has the action space {actions}; it must be Discrete")
    dtype = np.dtype(np.uint8 if observations.dtype == np.uint8 else np.float32)
    return Spaces(observations.shape, dtype, int(actions.n), int(actions.start))


def check_same_sizes(wish: str, wanted: Spaces, got: Spaces) -> None:
    """Raises ValueError, beginning with `wish`, unless two environments have the same states and actions."""
    shown_sizes = [
        f"with {x.state_dtype} states of shape {x.state_shape} and {x.num_actions} actions" for x in (wanted, got)
    ]
    if shown_sizes[0] != shown_sizes[1]:
        raise ValueError(f"{wish}, {shown_sizes[0]}, got {shown_sizes[1]}")


def way_to_a_box(space: gym.Space) -> str:
    """Returns the end of a message about an observation space: which wrappers convert it to a Box."""
    parts: dict[Any, gym.Space] = {}
    if isinstance(space, gym.spaces.Dict | gym.spaces.Tuple):
        parts = dict(space.items() if isinstance(space, gym.spaces.Dict) else enumerate(space))
    keys = [key for key, part in parts.items() if can_flatten(part) and not isinstance(part, gym.spaces.Text)]
    if keys and len(keys) < len(parts):
        wrapped = f"gymnasium.wrappers.FilterObservation(env, {keys})"
        return f"use gymnasium.wrappers.FlattenObservation({wrapped}) for a part of it"
    if can_flatten(space):
        return "use gymnasium.wrappers.FlattenObservation(env)"
    return "no wrapper of Gymnasium can convert it, but a gymnasium.ObservationWrapper of your own can"


def can_flatten(space: gym.Space) -> bool:
    """Returns whether Gymnasium's FlattenObservation makes a vector of this space that is neither empty nor huge."""
    try:
        return 0 < gym.spaces.flatdim(space) <= _LARGEST_VECTOR
    except (NotImplementedError, ValueError):  # the user's own space, or one without a fixed size (Sequence, Graph)
        return False


_LARGEST_VECTOR = 10**6


_BOOLS = (bool, np.bool_)


_LARGEST = float(np.finfo(np.float32).max)


def check_functional(env: FuncEnv) -> Spaces:
    """Returns the sizes of the environment's spaces; raises ValueError if the compiled loop cannot play it."""
    require_xla()
    key = key_of_twin(env)
    spaces = _spaces_of_twins.get(key) or _check_functions(env)
    if key is not None:
        _spaces_of_twins[key] = spaces
    return spaces


_spaces_of_twins: dict[Hashable, Spaces] = {}


def _check_functions(env: FuncEnv) -> Spaces:
    name = env_name(env)
    spaces = spaces_of(env)
    rng = tf.constant([0, 0], tf.int64)
    state = env.initial(rng)
    next_state = env.transition(state, tf.constant(spaces.first_action), rng)
    specs = [
        tf.nest.map_structure(lambda x: (tf.shape(x).numpy().tolist(), x.dtype.name), s) for s in (state, next_state)
    ]
    if specs[0] != specs[1]:
        raise ValueError(f"env {name}: transition must return a state like initial's, {specs[0]}, got {specs[1]}")
    for part, value, shape in [
        ("observation", env.observation(state, rng), spaces.state_shape),
        ("reward", env.reward(state, tf.constant(spaces.first_action), next_state, rng), ()),
        ("terminal", env.terminal(state, rng), ()),
    ]:
        if tuple(tf.shape(value)) != shape:
            raise ValueError(f"env {name}: {part} must have shape {shape}, got {tuple(tf.shape(value).numpy())}")
        dtype = tf.convert_to_tensor(value).dtype
        if not (dtype.is_floating or dtype.is_integer or dtype.is_bool):
            raise ValueError(f"env {name}: {part} must be of numbers, got {dtype.name}")
        if part == "observation" and spaces.state_dtype == np.uint8 != dtype:
            raise ValueError(f"env {name}: observation must be of dtype uint8, as its space says, got {dtype.name}")
    return spaces


def check_environment(env: gym.Env | FuncEnv, q_network: keras.Model | None = None) -> Spaces:
    """Returns the sizes of the environment's spaces.

    Raises:
        ValueError: the spaces are not supported, or do not fit `q_network` (None: the default network).
    """
    spaces = check_functional(env) if isinstance(env, FuncEnv) else CheckedEnv(env).spaces
    if q_network is not None:
        check_fits(q_network, spaces.state_shape, spaces.num_actions)
    elif len(spaces.state_shape) != 1:
        raise ValueError(
            f"env {env_name(env)} has observations of shape {spaces.state_shape}, the default network takes one axis: "
            "q_network must be a network of your own, got None (or wrap env in gymnasium.wrappers.FlattenObservation)"
        )
    return spaces
