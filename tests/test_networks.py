import keras
import numpy as np
import pytest

from dqn_keras import make_networks, make_q_network
from dqn_keras._engine.numpy_acting import q_function, q_values
from dqn_keras.checks.networks import check_fits


def test_the_network_is_the_originals():
    network = make_q_network(4, np.int64(2))
    assert isinstance(network, keras.Sequential)
    assert [(layer.units, layer.activation.__name__) for layer in network.layers] == [(64, "relu"), (2, "linear")]
    assert network.input_shape == (None, 4)


def test_q_hat_starts_equal_to_q_and_shares_nothing_with_it():
    q_network, q_hat_network = make_networks(4, 2, seed=0)
    for q, q_hat in zip(q_network.weights, q_hat_network.weights, strict=True):
        np.testing.assert_array_equal(q.numpy(), q_hat.numpy())
        assert q is not q_hat
    q_network.weights[0].assign_add(np.ones((4, 64)))
    assert not np.array_equal(q_network.weights[0].numpy(), q_hat_network.weights[0].numpy())


def test_weights_follow_from_the_seed_alone():
    keras.utils.set_random_seed(1)
    first = make_q_network(4, 2, seed=7).get_weights()
    keras.utils.set_random_seed(2)
    again, other = make_q_network(4, 2, seed=7).get_weights(), make_q_network(4, 2, seed=8).get_weights()
    assert all(map(np.array_equal, first, again))
    assert not np.array_equal(first[0], other[0])


def test_making_networks_leaves_the_global_random_state_alone():
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    make_networks(4, 2, seed=None)
    np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002


@pytest.mark.parametrize("hidden_units", [(64,), (8, 16, 4)])
def test_the_numpy_forward_pass_is_the_networks(hidden_units, rng):
    network = make_q_network(5, 3, hidden_units, seed=0)
    network.set_weights([rng.normal(size=w.shape) for w in network.weights])
    states = rng.normal(size=(100, 5)).astype(np.float32)
    expected = network(states).numpy()
    np.testing.assert_allclose(q_values(network.get_weights(), states), expected, rtol=1e-4, atol=1e-4)
    for state, row in zip(states, expected, strict=True):
        np.testing.assert_allclose(q_function(network)(state), row, rtol=1e-4, atol=1e-4)


def test_q_function_takes_any_network(rng):
    network = keras.Sequential([keras.Input((4,)), keras.layers.Dense(8, activation="tanh"), keras.layers.Dense(2)])
    state = rng.normal(size=4).astype(np.float32)
    np.testing.assert_allclose(q_function(network)(state), network(state[None]).numpy()[0], rtol=1e-5)


def test_a_network_that_does_not_fit_is_an_error():
    with pytest.raises(ValueError, match=r"states of shape \(4,\) to 2 actions, got input \(4,\) and output \(3,\)"):
        check_fits(make_q_network(4, 3), (4,), 2)
