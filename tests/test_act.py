"""`Run.act`: the greedy action in one state."""

import pickle

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, evaluate, train
from dqn_keras.environments import CartPole
from dqn_keras.seeding import evaluation_seed
from tests.helpers.environments import Corridor

QUICK = Config(num_episodes=4, batch_size=8)
IMAGES = gym.spaces.Box(0, 255, (4, 4, 1), np.uint8)


def dense(activation):
    initializer = keras.initializers.GlorotUniform(seed=1)
    hidden = keras.layers.Dense(8, activation, kernel_initializer=initializer)
    return keras.Sequential([keras.Input((4,)), hidden, keras.layers.Dense(2, kernel_initializer=initializer)])


def functional():
    inputs = keras.Input((4,))
    hidden = keras.layers.Dense(8, "tanh", kernel_initializer=keras.initializers.GlorotUniform(seed=1))(inputs)
    both = keras.layers.Concatenate()([hidden, inputs])
    return keras.Model({"x": inputs}, keras.layers.Dense(2, kernel_initializer="ones")(both))


def pictures(**arguments):
    observe = lambda position, t: np.full((4, 4, 1), 50 * (t % 5), np.uint8)  # noqa: E731
    return Corridor(limit=5, observation_space=IMAGES, observe=observe, **arguments)


def convolutional():
    layers = [keras.layers.Conv2D(2, 2), keras.layers.Flatten(), keras.layers.Dense(2)]
    return keras.Sequential([keras.Input((4, 4, 1), dtype="uint8"), keras.layers.Rescaling(1 / 255), *layers])


@pytest.mark.parametrize(
    "network",
    [lambda: None, lambda: dense("relu"), lambda: dense("tanh"), functional],
    ids=["the default network", "ReLU", "tanh", "a dictionary of inputs"],
)
def test_acting_greedily_plays_the_episode_of_evaluate(cartpole, network):
    run = train(cartpole, QUICK, seed=0, q_network=network(), verbose=0)
    total, is_over, (state, _) = 0.0, False, cartpole.reset(seed=evaluation_seed(3, 0))
    while not is_over:
        action = run.act(state)
        assert type(action) is int
        state, reward, terminated, truncated, _ = cartpole.step(action)
        total, is_over = total + float(reward), terminated or truncated
    assert total == evaluate(cartpole, run.q_network, 1, seed=3)[0]


def prefer(action, q_network):
    """Sets its weights so that it prefers this action in every state."""
    q_network.set_weights([*[np.zeros_like(w) for w in q_network.get_weights()[:-1]], np.eye(2)[action]])


@pytest.mark.parametrize("network", [lambda: None, lambda: dense("tanh")])
def test_act_uses_the_weights_that_the_network_has_now(cartpole, network):
    run = train(cartpole, QUICK, seed=0, q_network=network(), verbose=0)
    for action in (0, 1, 0):
        prefer(action, run.q_network)
        assert run.act(np.ones(4)) == action


def test_actions_are_numbered_as_the_environment_numbers_them():
    class From1(CartPole):
        action_space = gym.spaces.Discrete(2, start=1)

        def transition(self, state, action, rng, params=None):
            return super().transition(state, action - 1, rng, params)

    for env in (Corridor(action_space=gym.spaces.Discrete(2, start=-3), limit=5), From1()):
        run = train(env, QUICK, seed=0, verbose=0)
        prefer(1, run.q_network)
        assert run.act(np.zeros(env.observation_space.shape)) == env.action_space.start + 1


def test_images_stay_uint8():
    run = train(pictures(), QUICK, seed=0, q_network=convolutional(), verbose=0)
    picture = np.full((4, 4, 1), 200, np.uint8)
    assert run.act(picture) == int(run.q_network(picture[None]).numpy().argmax())
    with pytest.raises(ValueError, match=r"^state must be of dtype uint8, as the observations of env, got float64"):
        run.act(picture / 255)


@pytest.mark.slow
def test_a_run_that_was_pickled_acts(cartpole):
    for network in (None, dense("tanh")):
        run = train(cartpole, QUICK, seed=0, q_network=network, verbose=0)
        states = np.random.default_rng(0).normal(size=(20, 4))
        actions = [run.act(state) for state in states]
        assert [pickle.loads(pickle.dumps(run)).act(state) for state in states] == actions


def test_what_is_not_a_state_is_an_error_that_names_it(cartpole):
    run = train(cartpole, QUICK, seed=0, verbose=0)
    assert run.act([0, 0, 0, 0]) == run.act(tf.zeros(4)) == run.act(np.zeros(4))
    for error, state, message in [
        (ValueError, np.zeros((1, 4)), r"state must have shape \(4,\), got \(1, 4\)"),
        (ValueError, 0.5, r"state must have shape \(4,\), got \(\)"),
        (ValueError, [0, 0, 0, np.nan], "state must be finite in float32, got"),
        (ValueError, [0, 0, 0, 1e39], "state must be finite in float32, got"),
        (TypeError, cartpole.reset(), r"state must be an array of numbers, got \(array"),
        (TypeError, "abcd", "state must be an array of numbers, got 'abcd'"),
    ]:
        with pytest.raises(error, match=f"^{message}"):
            run.act(state)
