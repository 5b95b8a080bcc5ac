import gymnasium as gym
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import environments

PAIRS = {"CartPole": "CartPole-v1", "Acrobot": "Acrobot-v1", "MountainCar": "MountainCar-v0"}
RNG = tf.constant([0, 0], tf.int64)


def random_states(name, rng, count):
    """Returns states all over the space, including ends of episodes."""
    if name == "CartPole":
        return rng.uniform([-2.5, -3, -0.25, -3], [2.5, 3, 0.25, 3], (count, 4))
    if name == "Acrobot":
        return rng.uniform([-np.pi, -np.pi, -12, -28], [np.pi, np.pi, 12, 28], (count, 4))
    states = rng.uniform([-1.2, -0.07], [0.6, 0.07], (count, 2))
    states[: count // 10, 0] = rng.uniform(-1.2, -1.19, count // 10)  # at the wall
    return states


@pytest.mark.slow
@pytest.mark.parametrize(("name", "registered"), PAIRS.items())
def test_ten_thousand_transitions_agree_with_gymnasiums(name, registered, rng):
    env, theirs = getattr(environments, name)(), gym.make(registered).unwrapped
    theirs.reset(seed=0)
    count = 10_000
    states, actions = random_states(name, rng, count), rng.integers(env.action_space.n, size=count)

    def one(pair):
        state, action = pair
        next_state = env.transition(state, action, RNG)
        reward = tf.cast(env.reward(state, action, next_state, RNG), tf.float32)
        return env.observation(next_state, RNG), reward, env.terminal(next_state, RNG)

    signature = (tf.float32, tf.float32, tf.bool)
    compiled = tf.function(lambda *pair: tf.map_fn(one, pair, fn_output_signature=signature), jit_compile=True)
    observations, rewards, terminated = (x.numpy() for x in compiled(states, actions.astype(np.int32)))

    for i in range(count):
        theirs.state = states[i].copy()
        theirs.steps_beyond_terminated = None
        observation, reward, end, _, _ = theirs.step(int(actions[i]))
        np.testing.assert_allclose(observations[i], observation, rtol=2e-6, atol=2e-6)
        assert (rewards[i], terminated[i]) == (reward, end)
    assert 0 < terminated.sum() < count


@pytest.mark.parametrize(("name", "registered"), PAIRS.items())
def test_spaces_and_limits_are_gymnasiums(name, registered):
    env, theirs = getattr(environments, name), gym.make(registered)
    assert env.observation_space == theirs.observation_space
    assert env.action_space == theirs.action_space
    assert env.max_episode_steps == theirs.spec.max_episode_steps


@pytest.mark.slow
@pytest.mark.parametrize(("name", "registered"), PAIRS.items())
def test_starts_are_spread_as_gymnasiums(name, registered):
    env, theirs = getattr(environments, name)(), gym.make(registered).unwrapped
    ours = np.array([env.observation(env.initial(tf.constant([1, k])), RNG) for k in range(500)])
    other = np.array([theirs.reset(seed=k)[0] for k in range(500)])
    np.testing.assert_allclose(ours.min(0), other.min(0), atol=0.01)
    np.testing.assert_allclose(ours.max(0), other.max(0), atol=0.01)
    np.testing.assert_allclose(ours.std(0), other.std(0), rtol=0.15, atol=1e-9)
