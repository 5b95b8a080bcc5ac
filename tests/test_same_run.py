"""Which changes make a run another run, so that its checkpoint cannot be resumed, and which do not."""

import dataclasses
import functools
import importlib
from types import SimpleNamespace

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, double_td_targets, td_targets, train
from dqn_keras.environments import CartPole
from dqn_keras.environments import cartpole as cartpole_module
from tests.helpers import parts
from tests.helpers.parts import NETWORKS, dense, sequential

QUICK = Config(num_episodes=5, batch_size=8, max_steps=20, solved_reward=1e6)
BOTH_LOOPS = pytest.mark.parametrize(
    "make_env", [lambda: gym.make("CartPole-v1"), CartPole], ids=["Gymnasium", "compiled"]
)


def weights_of(run):
    return np.concatenate([w.ravel() for n in (run.q_network, run.q_hat_network) for w in n.get_weights()])


def run_in(folder, resume=True, env=None, config=QUICK, **own):
    return train(env or gym.make("CartPole-v1"), config, 0, checkpoint=folder, resume=resume, verbose=0, **own)


FACTOR = 1.0


def scaled_loss(y, q):
    return FACTOR * tf.reduce_mean(tf.square(y - q))


def helper(x):
    return tf.square(x)


def loss_by_helper(y, q):
    return tf.reduce_mean(helper(y - q))


# How a checkpoint identifies parts


def doubled(scale, y, q):
    return scale * tf.reduce_mean(tf.square(y - q))


def own_targets(experiences, gamma, q_network, q_hat_network):
    return td_targets(experiences, gamma, q_network, q_hat_network)


def test_functions_without_an_importable_name_are_refused_for_a_checkpoint(tmp_path, cartpole):
    def local(y, q):
        return tf.reduce_mean(tf.square(y - q))

    for own in (
        {"loss": lambda y, q: tf.reduce_mean(tf.square(y - q))},
        {"loss": local},
        {"loss": functools.partial(local)},
        {"targets": lambda *arguments: td_targets(*arguments)},
        {"q_network": sequential(dense(8, lambda x: tf.sin(x)))},
        {"optimizer": keras.optimizers.SGD(lambda: 0.1)},
    ):
        (name,) = own
        with pytest.raises(ValueError, match=rf"^{name} must have a name that can be imported, .*`def`"):
            train(cartpole, QUICK, seed=0, checkpoint=tmp_path / "run", verbose=0, **own)
    assert not (tmp_path / "run").exists()


SAME_OR_NOT = {
    "loss": [
        "huber",
        "mse",
        scaled_loss,
        keras.losses.Huber(0.5),
        keras.losses.Huber(2.0),
        functools.partial(doubled, 1.0),
        functools.partial(doubled, 2.0),
    ],
    "targets": [td_targets, double_td_targets, own_targets],
    "optimizer": [
        lambda: keras.optimizers.SGD(0.1),
        lambda: keras.optimizers.SGD(0.2),
        lambda: keras.optimizers.SGD(0.1, clipnorm=1.0),
        lambda: keras.optimizers.Adam(keras.optimizers.schedules.ExponentialDecay(0.1, 1, 0.5)),
        lambda: keras.optimizers.Adam(keras.optimizers.schedules.ExponentialDecay(0.1, 1, 0.6)),
        lambda: keras.optimizers.Adam(parts.HalvingSchedule()),
        lambda: parts.SignDescent(1.0),
        lambda: parts.SignDescent(2.0),
        lambda: keras.optimizers.AdamW(0.1),
        parts.excluding,
    ],
    "q_network": [
        NETWORKS["dense"],
        NETWORKS["Normalization, adapted"],
        NETWORKS["Normalization, given"],
        NETWORKS["an activation of one's own"],
        NETWORKS["a layer with an attribute set later"],
        lambda: sequential(dense(8, "relu"), parts.Scaled()),
    ],
}


@pytest.mark.slow
@pytest.mark.parametrize("slot", SAME_OR_NOT)
def test_a_run_is_resumed_only_with_the_same_parts(slot, tmp_path, cartpole):
    def run_in(part, folder, resume=True):
        own = part() if slot in ("optimizer", "q_network") else part
        config = dataclasses.replace(QUICK, jit_compile=False)
        return train(cartpole, config, seed=0, checkpoint=folder, resume=resume, verbose=0, **{slot: own})

    choices = SAME_OR_NOT[slot]
    for i, part in enumerate(choices):
        run_in(part, tmp_path / str(i), resume=False)
        run_in(part, tmp_path / str(i))
        with pytest.raises(ValueError, match=rf"^{slot} is "):
            run_in(choices[i - 1], tmp_path / str(i))


def test_another_source_under_the_same_name_is_noticed(tmp_path, cartpole, monkeypatch):
    module = importlib.import_module(__name__)
    run_in(tmp_path, resume=False, loss=scaled_loss)

    def scaled_again(y, q):
        return 100.0 * tf.reduce_mean(tf.square(y - q))

    scaled_again.__qualname__ = "scaled_loss"
    monkeypatch.setattr(module, "scaled_loss", scaled_again)
    message = (
        r"^loss is 'tests.test_same_run.scaled_loss' in .*npz, got one of that name that computes something else: "
    )
    with pytest.raises(ValueError, match=message):
        run_in(tmp_path, loss=scaled_again)


def test_a_compiled_networks_optimizer_is_part_of_what_must_be_the_same(tmp_path):
    def compiled(optimizer):
        network = NETWORKS["dense"]()
        network.compile(optimizer, loss="mse")
        return network

    run_in(tmp_path, resume=False, q_network=compiled(keras.optimizers.SGD(0.1)))
    run_in(tmp_path, q_network=compiled(keras.optimizers.SGD(0.1)))
    with pytest.raises(ValueError, match=r"^optimizer is .*SGD\(learning_rate=0.1\)' .*SGD\(.*clipnorm=0.001"):
        run_in(tmp_path, q_network=compiled(keras.optimizers.SGD(0.5, clipnorm=1e-3)))


class OwnLoss(keras.losses.Loss):
    def call(self, y, q):
        return FACTOR * tf.reduce_mean(tf.square(y - q), axis=-1)


class Two:
    def first(self, y, q):
        return tf.reduce_mean(tf.square(y - q))

    def second(self, y, q):
        return 1000 * tf.reduce_mean(tf.square(y - q))


class Held(keras.losses.Loss):
    """Holds a loss in a container of any kind."""

    def __init__(self, *held, **by_name):
        super().__init__()
        self.held, self.by_name = held, by_name

    def call(self, y, q):
        return sum(loss(y, q) for loss in (*self.held, *self.by_name.values()))


class Decay(keras.optimizers.schedules.LearningRateSchedule):
    """Holds another schedule, and has no configuration."""

    def __init__(self, inner):
        self.inner = inner

    def __call__(self, step):
        return self.inner(step)


class Penalty(keras.regularizers.Regularizer):
    """Has an empty configuration."""

    def __init__(self, factor):
        self.factor = factor

    def __call__(self, weights):
        return self.factor * tf.reduce_sum(weights**2)

    def get_config(self):
        return {}


class Paying(CartPole):
    """Gives the reward of an object that it holds."""

    def __init__(self, held=None):
        super().__init__()
        self._held = held

    def reward(self, state, action, next_state, rng, params=None):
        return tf.constant(self._held())


def one():
    return 1.0


def two():
    return 2.0


def penalized(factor):
    return sequential(dense(8, kernel_regularizer=Penalty(factor)))


def exponential(rate):
    return keras.optimizers.schedules.ExponentialDecay(rate, 1, 0.5)


GLOBAL_LOSS, GLOBAL_SPACE = keras.losses.Huber(1.0), SimpleNamespace(factor=1.0)


def by_global_loss(y, q):
    return GLOBAL_LOSS(y, q)


def by_global_space(y, q):
    return GLOBAL_SPACE.factor * tf.reduce_mean(y - q)


def by_loss_in(mapping, y, q):
    return mapping["inner"](y, q)


NESTED = {
    "a schedule in a schedule": lambda x: {"optimizer": keras.optimizers.SGD(Decay(exponential((0.1, 0.5)[x])))},
    "a loss in a loss": lambda x: {"loss": Held(keras.losses.Huber((1.0, 0.01)[x]))},
    "a loss in a dictionary": lambda x: {"loss": Held(inner=keras.losses.Huber((1.0, 0.01)[x]))},
    "a function in a loss": lambda x: {"loss": Held((scaled_loss, loss_by_helper)[x])},
    "a loss in a partial": lambda x: {
        "loss": functools.partial(by_loss_in, {"inner": keras.losses.Huber((1.0, 0.01)[x])})
    },
    "a regularizer without a configuration": lambda x: {"q_network": penalized((1.0, 2.0)[x])},
    "a function in an environment": lambda x: {"env": Paying((one, two)[x])},
    "an inner optimizer": lambda x: {
        "optimizer": keras.optimizers.LossScaleOptimizer(keras.optimizers.SGD((0.1, 0.2)[x]))
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("part", NESTED)
def test_parts_differ_if_anything_that_they_hold_differs(part, tmp_path):
    make = NESTED[part]
    (name,) = make(0)
    run_in(tmp_path, resume=False, **make(0))
    run_in(tmp_path, **make(0))
    with pytest.raises(ValueError, match=rf"^{name} is "):
        run_in(tmp_path, **make(1))


CHANGED = {
    "a global": (scaled_loss, "FACTOR", 100.0),
    "a function": (loss_by_helper, "helper", tf.abs),
    "a global loss of Keras": (by_global_loss, "GLOBAL_LOSS", keras.losses.Huber(0.01)),
    "an object": (by_global_space, "GLOBAL_SPACE", SimpleNamespace(factor=2.0)),
}


@pytest.mark.slow
@pytest.mark.parametrize("changed", CHANGED)
def test_functions_differ_if_anything_that_they_read_differs(changed, tmp_path, monkeypatch):
    loss, name, value = CHANGED[changed]
    run_in(tmp_path, resume=False, loss=loss)
    run_in(tmp_path, loss=loss)
    monkeypatch.setattr(importlib.import_module(__name__), name, value)
    with pytest.raises(
        ValueError, match=rf"^loss is 'tests.test_same_run.{loss.__name__}' .* computes something else: "
    ):
        run_in(tmp_path, loss=loss)


def test_another_gravity_of_the_packages_cartpole_is_another_run(tmp_path, monkeypatch):
    run_in(tmp_path, resume=False, env=CartPole())
    monkeypatch.setattr(cartpole_module, "GRAVITY", np.float32(20.0))
    with pytest.raises(ValueError, match=r"^env is .* computes something else: "):
        run_in(tmp_path, env=CartPole())


def test_a_method_is_identified_by_its_name(tmp_path):
    class_ = Two()
    run_in(tmp_path, resume=False, loss=class_.first)
    with pytest.raises(
        ValueError, match=r"^loss is 'tests.test_same_run.Two.first' .*, got 'tests.test_same_run.Two.second'"
    ):
        run_in(tmp_path, loss=class_.second)


def test_a_wrapped_name_of_the_packages_does_not_hide_a_function(tmp_path, monkeypatch):
    module = importlib.import_module(__name__)

    @functools.wraps(td_targets)
    def wrapped(*arguments):
        return FACTOR * td_targets(*arguments)

    wrapped.__module__, wrapped.__qualname__ = __name__, "own_targets"
    monkeypatch.setattr(module, "own_targets", wrapped)
    run_in(tmp_path, resume=False, targets=wrapped)
    monkeypatch.setattr(module, "FACTOR", 2.0)
    with pytest.raises(ValueError, match=r"^targets is .* computes something else: "):
        run_in(tmp_path, targets=wrapped)


def test_what_was_saved_by_another_version_is_compared_by_its_source(tmp_path, monkeypatch):
    run_in(tmp_path, resume=False, loss=scaled_loss)
    identity = importlib.import_module("dqn_keras.storage.identity")
    versions = {**identity.versions(), "keras": "99.0"}
    monkeypatch.setattr(identity, "versions", lambda: versions)
    monkeypatch.setattr(importlib.import_module(__name__), "FACTOR", 1.5)  # the source does not show this change
    with pytest.warns(UserWarning, match="was saved with keras"):
        run_in(tmp_path, loss=scaled_loss)
    monkeypatch.setattr(importlib.import_module("dqn_keras.storage.parts").inspect, "getsource", lambda code: "another")
    with pytest.raises(ValueError, match=r"^loss is .*scaled_loss' in .*, got one of that name with another source$"):
        run_in(tmp_path, loss=scaled_loss)


def used_network():
    network = NETWORKS["dense"]()
    network.compile("adam", "mse")
    network.fit(np.ones((8, 4)), np.ones((8, 2)), verbose=0)
    return network


@pytest.mark.slow
def test_an_optimizer_that_was_built_or_used_is_the_same_run(tmp_path):
    def built():
        network, optimizer = NETWORKS["dense"](), keras.optimizers.AdamW(0.01)
        optimizer.build(network.trainable_variables)
        return {"q_network": network, "optimizer": optimizer}

    own = {"q_network": NETWORKS["dense"](), "optimizer": keras.optimizers.AdamW(0.01)}
    longer = Config(**{**vars(QUICK), "num_episodes": 9})
    run_in(tmp_path, resume=False, **own)
    ours = weights_of(run_in(tmp_path, config=longer, **own))  # the same cell again
    whole = train(gym.make("CartPole-v1"), longer, 0, verbose=0, **built())
    np.testing.assert_array_equal(ours, weights_of(whole))
    np.testing.assert_array_equal(ours, weights_of(run_in(tmp_path, config=longer, **built())))

    network = used_network()
    network.save(tmp_path / "used.keras")
    run_in(tmp_path / "used", resume=False, q_network=network)
    run_in(tmp_path / "used", q_network=keras.saving.load_model(tmp_path / "used.keras"))


MEAN = tf.Variable(0.0)


def centred(y, q):
    MEAN.assign_add(0.1 * (tf.reduce_mean(y) - MEAN))
    return tf.reduce_mean(tf.square(y - q)) + 5 * MEAN * tf.reduce_mean(q)


class Counting(keras.layers.Layer):
    """Changes a variable that Keras does not know, whenever the network acts or learns."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.num_calls = tf.Variable(0.0)

    def call(self, inputs):
        self.num_calls.assign_add(1.0)
        return inputs * (1 + 0.001 * self.num_calls)


@pytest.mark.slow
@BOTH_LOOPS
def test_variables_of_the_users_are_part_of_a_checkpoint(make_env, tmp_path):
    def run(num_episodes, **more):
        MEAN.assign(0.0)
        config = Config(num_episodes=num_episodes, batch_size=8, solved_reward=1e6)
        own = {"q_network": sequential(dense(8), Counting()), "loss": centred}
        return weights_of(train(make_env(), config, 0, verbose=0, **own, **more))

    whole = run(12)
    run(5, checkpoint=tmp_path)
    np.testing.assert_array_equal(whole, run(12, checkpoint=tmp_path, resume=True))


@pytest.mark.slow
@BOTH_LOOPS
def test_a_run_with_own_parts_is_resumed_bit_for_bit(make_env, tmp_path):
    def run(num_episodes, **more):
        config = Config(num_episodes=num_episodes, batch_size=8, solved_reward=1e6)
        optimizer = keras.optimizers.AdamW(
            keras.optimizers.schedules.ExponentialDecay(0.01, 10, 0.9), use_ema=True, ema_overwrite_frequency=7
        )
        own = {"q_network": NETWORKS["Normalization, adapted"](), "optimizer": optimizer, "targets": own_targets}
        return weights_of(train(make_env(), config, 0, loss=keras.losses.Huber(), verbose=0, **own, **more))

    whole = run(12)
    run(5, checkpoint=tmp_path)
    np.testing.assert_array_equal(whole, run(12, checkpoint=tmp_path, resume=True))
