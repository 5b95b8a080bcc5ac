"""A network of any Keras layers acts with exactly the function that it computes, and all its layers are found."""

import warnings

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import Config, evaluate, learn, train
from dqn_keras._engine.private import all_layers, walk
from tests.helpers.parts import ALL_NETWORKS, INFERENCE_ONLY, two_of

pytestmark = pytest.mark.slow


class Recorded(gym.Wrapper):
    """Records every state and action."""

    def __init__(self):
        super().__init__(gym.make("CartPole-v1"))
        self.states, self.actions = [], []

    def reset(self, **kwargs):
        state, info = self.env.reset(**kwargs)
        self.state = state
        return state, info

    def step(self, action):
        self.states.append(self.state)
        self.actions.append(int(action))
        self.state, *others = self.env.step(action)
        return self.state, *others


@pytest.mark.parametrize("name", ALL_NETWORKS)
@pytest.mark.filterwarnings("ignore:q_network is called in inference mode", "ignore:train ended without an update")
def test_acting_q_hat_and_evaluate_play_the_function_that_the_network_is(name):
    network, env = ALL_NETWORKS[name](), Recorded()
    greedy = Config(num_episodes=3, max_steps=10, batch_size=30, memory_size=30, epsilon=0.0, epsilon_min=0.0)
    run = train(env, greedy, seed=0, q_network=network, verbose=0)
    evaluate(env, network, num_episodes=3, seed=0, max_steps=10)
    states = np.array(env.states)
    values = network(states).numpy()
    chosen = values[np.arange(len(states)), env.actions]
    np.testing.assert_allclose(chosen, values.max(axis=1), rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(run.q_hat_network(states), values, rtol=1e-5, atol=1e-5)
    network.set_weights([0 * w for w in network.get_weights()])
    np.testing.assert_allclose(run.q_hat_network(states), values, rtol=1e-5, atol=1e-5)  # Q-hat has its own weights


@pytest.mark.parametrize("name", ALL_NETWORKS)
def test_the_public_way_to_all_layers_finds_the_same_layers(name):
    network = ALL_NETWORKS[name]()

    def found(layers):
        containers = keras.Model | keras.layers.InputLayer
        return {id(x) for x in layers if x.weights and not isinstance(x, containers)}

    of_attention = {id(x) for x in walk(network) if isinstance(x, keras.layers.MultiHeadAttention)}
    assert found(walk(network)) <= found(all_layers(network))
    assert of_attention or found(walk(network)) == found(all_layers(network))


@pytest.mark.parametrize("name", ALL_NETWORKS)
def test_a_layer_that_differs_in_training_is_one_warning_and_no_other_layer_is(name, random_batch):
    q_network, q_hat_network = two_of(ALL_NETWORKS[name])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            learn(random_batch(), 0.9, q_network, q_hat_network, keras.optimizers.SGD(0.01), jit_compile=False)
    messages = [str(w.message) for w in caught if "inference mode" in str(w.message)]
    assert len(messages) == (name in INFERENCE_ONLY)
