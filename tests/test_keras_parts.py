"""Every network, optimizer and loss of Keras computes here the same as in an eager Keras step."""

import keras
import numpy as np
import pytest

from dqn_keras import learn
from tests.helpers.parts import ALL_NETWORKS, LOSSES, NETWORKS, OPTIMIZERS, eager_step, two_of

GAMMA, TAU, NUM_STEPS = 0.9, 0.2, 5

pytestmark = pytest.mark.slow


def compare_with_eager_steps(make_network, make_optimizer, loss, random_batch, jit_compile):
    ours, theirs = two_of(make_network)
    our_hat, their_hat = two_of(make_network)
    for hat in (our_hat, their_hat):
        hat.set_weights([0.9 * w if w.dtype == np.float32 else w for w in ours.get_weights()])
    our_optimizer, their_optimizer = make_optimizer(), make_optimizer()
    start = ours.get_weights()
    for _ in range(NUM_STEPS):
        batch = random_batch(16)
        value = learn(batch, GAMMA, ours, our_hat, our_optimizer, tau=TAU, loss=loss, jit_compile=jit_compile)
        assert float(value) == pytest.approx(
            eager_step(batch, GAMMA, TAU, theirs, their_hat, their_optimizer, loss), rel=2e-3, abs=1e-5
        )
    for a, b in zip(
        ours.get_weights() + our_hat.get_weights(), theirs.get_weights() + their_hat.get_weights(), strict=True
    ):
        np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-5)
    assert not all(map(np.array_equal, start, ours.get_weights()))


@pytest.mark.parametrize("jit_compile", [True, False], ids=["jit", "no jit"])
@pytest.mark.parametrize("name", ALL_NETWORKS)
@pytest.mark.filterwarnings("ignore:q_network is called in inference mode")
def test_a_network_learns_as_in_an_eager_keras_step(name, jit_compile, random_batch):
    compare_with_eager_steps(ALL_NETWORKS[name], lambda: keras.optimizers.SGD(0.02), "mse", random_batch, jit_compile)


@pytest.mark.parametrize("jit_compile", [True, False], ids=["jit", "no jit"])
@pytest.mark.parametrize("name", OPTIMIZERS)
def test_an_optimizer_learns_as_in_an_eager_keras_step(name, jit_compile, random_batch):
    compare_with_eager_steps(NETWORKS["dense"], OPTIMIZERS[name], "mse", random_batch, jit_compile)


@pytest.mark.parametrize("jit_compile", [True, False], ids=["jit", "no jit"])
@pytest.mark.parametrize("name", LOSSES)
def test_a_loss_is_the_one_that_keras_compiles(name, jit_compile, random_batch):
    make_optimizer = lambda: keras.optimizers.SGD(0.02)  # noqa: E731
    compare_with_eager_steps(NETWORKS["dense"], make_optimizer, LOSSES[name], random_batch, jit_compile)
