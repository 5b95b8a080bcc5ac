"""A change of an environment between two runs is seen."""

import gymnasium as gym
import numpy as np
import pytest
import tensorflow as tf
from gymnasium.experimental.functional import FuncEnv

from dqn_keras import train
from dqn_keras.environments import CartPole
from dqn_keras.environments import cartpole as cartpole_module
from tests.helpers.short_runs import QUICK


class Drift(FuncEnv):
    """Grows a number by the sum of a class attribute, an attribute, and an attribute of an object that it holds."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(2)
    speed = 1.0

    def __init__(self, offset=0.0, held=None):
        super().__init__()
        self.offset, self.held = offset, held or {"bonus": 0.0}

    def initial(self, rng, params=None):
        return tf.constant(0.0)

    def transition(self, state, action, rng, params=None):
        return state + self.speed

    def observation(self, state, rng, params=None):
        return (state + self.offset)[None]

    def reward(self, state, action, next_state, rng, params=None):
        return 1.0 + self.held["bonus"] + 1 / 2 * 0 + (7 // tf.constant(2, tf.float32)) * 0

    def terminal(self, state, rng, params=None):
        return state > 8.0


@pytest.mark.slow
def test_train_sees_changes_of_a_functional_environment(monkeypatch):
    env = Drift()

    def rewards_and_observations():
        run = train(env, QUICK, seed=0, verbose=0)
        return run.rewards[0], run.agent.memory.rows[0, 0], run.episodes[0].steps

    assert rewards_and_observations() == (9.0, 0.0, 9)
    monkeypatch.setattr(Drift, "speed", 2.0)
    assert rewards_and_observations() == (5.0, 0.0, 5)
    env.held["bonus"] = 1.0
    assert rewards_and_observations() == (10.0, 0.0, 5)
    env.offset = 3.0
    assert rewards_and_observations() == (10.0, 3.0, 5)


class Typed(Drift):
    """Divides by an attribute, whole or not."""

    step = 2.0

    def transition(self, state, action, rng, params=None):
        return state + float(7 // self.step if isinstance(self.step, int) else 7 / self.step)


@pytest.mark.slow
def test_a_whole_number_in_the_place_of_an_equal_float_is_another_environment(monkeypatch):
    next_states = [train(Typed(), QUICK, seed=0, verbose=0).agent.memory.rows[0, 1]]
    monkeypatch.setattr(Typed, "step", 2)
    next_states.append(train(Typed(), QUICK, seed=0, verbose=0).agent.memory.rows[0, 1])
    assert next_states == [3.5, 3.0]


@pytest.mark.slow
def test_another_gravity_is_seen_in_the_packages_own_cartpole(monkeypatch):
    before = train(CartPole(), QUICK, seed=0, verbose=0).agent.memory.rows.copy()
    monkeypatch.setattr(cartpole_module, "GRAVITY", 50.0)
    assert not np.array_equal(before, train(CartPole(), QUICK, seed=0, verbose=0).agent.memory.rows)


@pytest.mark.slow
def test_another_reward_of_the_packages_cartpole_is_seen(monkeypatch):
    before = train(CartPole(), QUICK, seed=0, verbose=0).rewards
    monkeypatch.setattr(CartPole, "reward", lambda *_: tf.constant(7.0))
    np.testing.assert_array_equal(train(CartPole(), QUICK, seed=0, verbose=0).rewards, 7 * before)
