"""A change between two calls is always seen, and equal parts compile only once."""

import functools
import gc
import os

import keras
import numpy as np
import psutil
import pytest
import tensorflow as tf

from dqn_keras import Config, learn
from dqn_keras._engine.programs import _compiled, _shared
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import check_spaces
from dqn_keras.environments import CartPole
from dqn_keras.loops.compiled import episodes
from tests.helpers import parts
from tests.helpers.parts import dense, sequential
from tests.helpers.short_runs import BOTH_LOOPS, QUICK, Settings, fresh, learned, sgd, trained, weights_of

# A change between two calls is seen


FACTOR = 1.0


def scaled_loss(y, q):
    return FACTOR * tf.reduce_mean(tf.square(y - q))


def loss_by_attribute(y, q):
    return Settings.factor * tf.reduce_mean(tf.square(y - q))


def helper(x):
    return tf.square(x)


def loss_by_helper(y, q):
    return tf.reduce_mean(helper(y - q))


BENT = 1.0


def bent(x):
    return tf.sin(BENT * x)


def changed_global(monkeypatch):
    monkeypatch.setattr(__import__(__name__, fromlist="_"), "FACTOR", 3.0)


def changed_attribute(monkeypatch):
    monkeypatch.setattr(Settings, "factor", 3.0)


def changed_helper(monkeypatch):
    monkeypatch.setattr(__import__(__name__, fromlist="_"), "helper", tf.abs)


LOSS_CHANGES = {
    "a global": (scaled_loss, changed_global),
    "an attribute of a class": (loss_by_attribute, changed_attribute),
    "a function that it calls": (loss_by_helper, changed_helper),
}


@pytest.mark.slow
@BOTH_LOOPS
@pytest.mark.parametrize("change", LOSS_CHANGES)
def test_train_sees_a_change_in_what_the_loss_reads(make_env, change, monkeypatch):
    loss, apply = LOSS_CHANGES[change]
    before = trained(make_env, optimizer=sgd(), loss=loss)
    np.testing.assert_array_equal(before, trained(make_env, optimizer=sgd(), loss=loss))
    apply(monkeypatch)
    assert not np.array_equal(before, trained(make_env, optimizer=sgd(), loss=loss))


@pytest.mark.parametrize("change", LOSS_CHANGES)
def test_learn_sees_a_change_in_what_the_loss_reads(change, monkeypatch, random_batch):
    loss, apply = LOSS_CHANGES[change]
    networks, optimizer, batch = fresh(), sgd(), random_batch(8)
    learn(batch, 0.9, *networks, optimizer, loss=loss)
    start, hat = networks[0].get_weights(), networks[1].get_weights()
    unchanged = learned(batch, networks, optimizer, loss=loss)
    networks[0].set_weights(start)
    networks[1].set_weights(hat)
    apply(monkeypatch)
    assert not all(map(np.array_equal, unchanged, learned(batch, networks, optimizer, loss=loss)))


def set_clipnorm(networks, optimizer):
    optimizer.clipnorm = 1e-3


def set_schedule(networks, optimizer):
    optimizer.learning_rate = keras.optimizers.schedules.ExponentialDecay(1e-3, 1, 0.5)


def set_activation(networks, optimizer):
    networks[0].layers[0].activation = keras.activations.tanh


def set_regularizer(networks, optimizer):
    networks[0].layers[0].activity_regularizer = keras.regularizers.L2(10.0)


def exclude(networks, optimizer):
    optimizer.exclude_from_weight_decay(var_names=["kernel", "bias"])


def set_inner_clipnorm(networks, optimizer):
    optimizer.inner_optimizer.clipnorm = 1e-3


OBJECT_CHANGES = {
    "clipnorm": (sgd, set_clipnorm),
    "a learning-rate schedule": (sgd, set_schedule),
    "an activation": (sgd, set_activation),
    "a regularizer": (sgd, set_regularizer),
    "exclusions from weight decay": (lambda: keras.optimizers.AdamW(0.01, weight_decay=5.0), exclude),
    "an inner optimizer's clipnorm": (lambda: keras.optimizers.LossScaleOptimizer(sgd()), set_inner_clipnorm),
}


@pytest.mark.slow
@pytest.mark.parametrize("jit_compile", [True, False], ids=["jit", "no jit"])
@pytest.mark.parametrize("change", OBJECT_CHANGES)
def test_learn_sees_what_is_set_on_an_optimizer_or_a_layer(change, jit_compile, random_batch):
    make_optimizer, apply = OBJECT_CHANGES[change]
    batch, results = random_batch(8), []
    for changes in (False, True):
        networks, optimizer = fresh(), make_optimizer()
        learn(batch, 0.9, *networks, optimizer, jit_compile=jit_compile)
        if changes:
            apply(networks, optimizer)
        results.append(learned(batch, networks, optimizer, jit_compile=jit_compile))
    assert not all(map(np.array_equal, *results))


@pytest.mark.slow
def test_learn_sees_a_function_put_into_a_lambda_layer_and_a_recurrent_activation(random_batch):
    def with_lambda():
        return sequential(dense(8), keras.layers.Lambda(tf.sin))

    def with_gru():
        cell = keras.layers.GRUCell(4, kernel_initializer="ones", recurrent_initializer="ones")
        return sequential(keras.layers.Reshape((4, 1)), keras.layers.RNN(cell))

    def change_lambda(network):
        network.layers[1].function = tf.cos

    def change_gru(network):
        network.layers[1].cell.recurrent_activation = tf.sin

    for make, change in ((with_lambda, change_lambda), (with_gru, change_gru)):
        networks, optimizer, batch = (make(), make()), sgd(), random_batch(8)
        learn(batch, 0.9, *networks, optimizer)
        change(networks[0])
        theirs, their_hat = make(), make()
        theirs.set_weights(networks[0].get_weights())
        their_hat.set_weights(networks[1].get_weights())
        change(theirs)
        value = float(learn(batch, 0.9, *networks, optimizer))
        assert value == pytest.approx(parts.eager_step(batch, 0.9, 0.01, theirs, their_hat, sgd()), rel=1e-4)


@pytest.mark.slow
@BOTH_LOOPS
def test_train_sees_a_global_that_an_activation_reads(make_env, monkeypatch):
    def run():
        network = sequential(dense(8, bent))
        return trained(make_env, q_network=network)

    before = run()
    np.testing.assert_array_equal(before, run())
    monkeypatch.setattr(__import__(__name__, fromlist="_"), "BENT", 5.0)
    assert not np.array_equal(before, run())


class Base:
    factor = 1.0

    def of(self, error):
        return self.factor * tf.square(error)


class Derived(Base):
    def __call__(self, y, q):
        return tf.reduce_mean(self.of(y - q))


def scaled_error(scale, y, q):
    return scale * FACTOR * tf.reduce_mean(tf.square(y - q))


ARRAY = np.ones(1, np.float32)


def loss_by_array(y, q):
    return ARRAY[0] * tf.reduce_mean(tf.square(y - q))


DEEPER_CHANGES = {
    "an attribute of a base class": (Derived(), lambda patch: patch.setattr(Base, "factor", 3.0)),
    "a method of a base class": (Derived(), lambda patch: patch.setattr(Base, "of", lambda self, error: 9 * error**2)),
    "a global that a partial reads": (functools.partial(scaled_error, 1.0), changed_global),
    "an array changed in place": (loss_by_array, lambda patch: ARRAY.fill(3.0)),
}


@pytest.mark.parametrize("change", DEEPER_CHANGES)
def test_learn_sees_deeper_changes(change, monkeypatch, random_batch):
    loss, apply = DEEPER_CHANGES[change]
    networks, batch = fresh(), random_batch(8)
    first = float(learn(batch, 0.9, *networks, keras.optimizers.SGD(0.0), loss=loss))
    apply(monkeypatch)
    assert float(learn(batch, 0.9, *networks, keras.optimizers.SGD(0.0), loss=loss)) > 2 * first
    optimizer = keras.optimizers.SGD(0.0)
    monkeypatch.undo()
    ARRAY.fill(1.0)
    learn(batch, 0.9, *networks, optimizer, loss=loss)
    apply(monkeypatch)
    assert float(learn(batch, 0.9, *networks, optimizer, loss=loss)) > 2 * first
    ARRAY.fill(1.0)


def test_what_is_set_on_a_weight_of_the_packages_network_counts(random_batch):
    for change in ("trainable", "constraint"):
        (q_network, q_hat_network), optimizer = fresh(), keras.optimizers.Adam(0.01)
        before = q_network.get_weights()[0]
        setattr(q_network.layers[0].kernel, change, False if change == "trainable" else keras.constraints.NonNeg())
        learn(random_batch(8), 0.9, q_network, q_hat_network, optimizer)
        after = q_network.get_weights()[0]
        assert np.array_equal(before, after) if change == "trainable" else (after >= 0).all()


# Numbers compile nothing, equal parts compile once


NUMBERS = [
    {"gamma": 0.9},
    {"tau": 0.05},
    {"alpha": 0.01},
    {"epsilon": 0.5, "decay": 0.9},
    {"epsilon_min": 0.2},
    {"solved_reward": 50.0},
    {"num_episodes": 7},
    {"max_steps": 9},
]


@pytest.mark.slow
@BOTH_LOOPS
def test_another_number_compiles_nothing_and_counts(make_env):
    first = trained(make_env)
    num_programs = len(_shared), len(_compiled)
    for number in NUMBERS:
        other = trained(make_env, config=Config(**{**vars(QUICK), **number}))
        assert number.keys() & {"solved_reward", "epsilon_min"} or not np.array_equal(first, other), number
    np.testing.assert_array_equal(first, trained(make_env))
    assert (len(_shared), len(_compiled)) == num_programs


@pytest.mark.slow
@BOTH_LOOPS
def test_runs_with_an_equal_loss_compile_once_and_leave_no_memory_behind(make_env):
    def run():
        trained(make_env, loss=lambda y, q: tf.reduce_mean(tf.abs(y - q)))
        gc.collect()
        return psutil.Process(os.getpid()).memory_info().rss / 1e6

    for _ in range(2):
        run()
    num_compiled, before = len(_compiled), run()
    for _ in range(4):
        after = run()
    assert len(_compiled) == num_compiled
    assert after - before < 18  # MB; a further program of the compiled loop takes about 40


def test_new_functions_at_each_call_of_learn_are_warned_of(random_batch):
    networks, optimizer, batch = fresh(), sgd(), random_batch(8)

    def learn_with_a_new_function():
        learn(batch, 0.9, *networks, optimizer, loss=lambda y, q: tf.reduce_mean(y - q), jit_compile=False)

    for _ in range(7):
        learn_with_a_new_function()
    with pytest.warns(UserWarning, match=r"learn was compiled 8 times for 'q_network'"):
        learn_with_a_new_function()


def test_transitions_are_counted_beyond_32_bits():
    spaces = check_spaces("CartPole", CartPole.observation_space, CartPole.action_space)
    prints = []
    for num_before in (50_000, 50_000 * 50_000):  # a full memory, at the same index of its ring
        agent = make_agent((4,), 2, QUICK, 0)
        agent.memory.rows[:] = np.random.default_rng(0).normal(size=agent.memory.rows.shape)
        agent.memory.rows[:, 8] = agent.memory.rows[:, 10] = 0
        agent.memory.num_appended = num_before
        played = list(episodes(CartPole(), spaces, agent, QUICK))
        assert agent.memory.num_appended == num_before + sum(e.steps for e in played)
        prints.append(weights_of(agent.q_network, agent.q_hat_network))
        assert agent.num_updates > 0
    np.testing.assert_array_equal(*prints)
