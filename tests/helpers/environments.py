"""Small environments for tests of the loop."""

import gymnasium as gym
import numpy as np


class Corridor(gym.Env):
    """Walks right from 0 to the end; every step gives 1, the end terminates. Keyword arguments replace its parts."""

    def __init__(
        self, length=5, limit=None, action_space=None, observation_space=None, observe=None, reward=None, end=None
    ):
        self.length, self.limit = length, limit
        self.action_space = action_space or gym.spaces.Discrete(2)
        self.observation_space = observation_space or gym.spaces.Box(-100, 100, (2,), np.float32)
        self._observe = observe or (lambda position, t: np.array([position, t], np.float32))
        self._reward = reward or (lambda t: 1.0)
        self._end = end
        self.actions, self.reset_seeds = [], []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.reset_seeds.append(seed)
        self.position = self.t = 0
        return self._observe(0, 0), {}

    def step(self, action):
        self.actions.append(action)
        self.t += 1
        self.position += action - self.action_space.start
        terminated = self._end(self.t) if self._end else self.position >= self.length
        truncated = self.limit is not None and self.t >= self.limit
        return self._observe(self.position, self.t), self._reward(self.t - 1), terminated, truncated, {}


class OldReset(Corridor):
    """Returns no info from `reset`."""

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed)[0]


class OldStep(Corridor):
    """Returns `done` from `step`, as in old versions of Gym."""

    def step(self, action):
        observation, reward, terminated, _, info = super().step(action)
        return observation, reward, terminated, info
