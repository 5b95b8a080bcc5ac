"""Every network, optimizer and loss of Keras computes here the same as in an eager Keras step."""

import keras
import numpy as np
import pytest

from dqn_keras import learn
from tests.helpers.parts import ALL_NETWORKS, LOSSES, NETWORKS, OPTIMIZERS, eager_step

GAMMA, TAU, NUM_STEPS = 0.9, 0.2, 5
JIT = True, False

pytestmark = pytest.mark.slow


def compare_with_eager_steps(make_network, make_optimizer, loss, random_batch):
    """Compares five steps of `learn`, with XLA and without it, with five eager steps of Keras."""
    theirs, *ours = (make_network() for _ in range(3))
    their_hat, *our_hats = (make_network() for _ in range(3))
    start = theirs.get_weights()
    for network in ours:
        network.set_weights(start)
    for hat in (their_hat, *our_hats):
        hat.set_weights([0.9 * w if w.dtype == np.float32 else w for w in start])
    their_optimizer, *our_optimizers = (make_optimizer() for _ in range(3))
    for _ in range(NUM_STEPS):
        batch = random_batch(16)
        expected = eager_step(batch, GAMMA, TAU, theirs, their_hat, their_optimizer, loss)
        for jit_compile, network, hat, optimizer in zip(JIT, ours, our_hats, our_optimizers, strict=True):
            value = learn(batch, GAMMA, network, hat, optimizer, tau=TAU, loss=loss, jit_compile=jit_compile)
            assert float(value) == pytest.approx(expected, rel=2e-3, abs=1e-5)
    for jit_compile, network, hat in zip(JIT, ours, our_hats, strict=True):
        for a, b in zip(
            network.get_weights() + hat.get_weights(), theirs.get_weights() + their_hat.get_weights(), strict=True
        ):
            np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-5, err_msg=f"{jit_compile=}")
    assert not all(map(np.array_equal, start, theirs.get_weights()))


@pytest.mark.parametrize("name", ALL_NETWORKS)
@pytest.mark.filterwarnings("ignore:q_network is called in inference mode")
def test_a_network_learns_as_in_an_eager_keras_step(name, random_batch):
    compare_with_eager_steps(ALL_NETWORKS[name], lambda: keras.optimizers.SGD(0.02), "mse", random_batch)


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_an_optimizer_learns_as_in_an_eager_keras_step(name, random_batch):
    compare_with_eager_steps(NETWORKS["dense"], OPTIMIZERS[name], "mse", random_batch)


@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_is_the_one_that_keras_compiles(name, random_batch):
    compare_with_eager_steps(NETWORKS["dense"], lambda: keras.optimizers.SGD(0.02), LOSSES[name], random_batch)
