"""`learn` sees any change of its parts between two calls, and compiles again only for such changes."""

import argparse
import functools
import importlib.util
import sys
from collections import UserDict, deque
from types import SimpleNamespace

import keras
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import learn, make_networks, td_targets


class Learning:
    """Learns from one batch, with the same weights at the start of each call."""

    def __init__(self, batch, jit_compile=False):
        self.networks, self.optimizer = make_networks(4, 2, (8,), seed=0), keras.optimizers.SGD(0.1)
        self.batch, self.jit_compile = batch, jit_compile
        self._weights = [n.get_weights() for n in self.networks]

    def __call__(self, **own):
        for network, weights in zip(self.networks, self._weights, strict=True):
            network.set_weights(weights)
        learn(self.batch, 0.9, *self.networks, self.optimizer, jit_compile=self.jit_compile, **own)
        return self.networks[0].get_weights()

    @property
    def num_compiled(self):
        return vars(self.networks[0])["_dqn_keras_steps"].num_compiled


@pytest.fixture
def learning(random_batch):
    return Learning(random_batch(8))


def check_is_seen(learning, change, **own):
    """`change` makes the factor of the own part three times as large."""
    before, again = learning(**own), learning(**own)
    assert all(map(np.array_equal, before, again))
    assert learning.num_compiled == 1
    change()
    assert not all(map(np.array_equal, before, learning(**own)))


def test_an_item_that_changes_in_an_attribute_of_a_keras_layer_is_seen(random_batch):
    scale = keras.layers.Lambda(lambda x, factor: factor * x, arguments={"factor": 1.0}, output_shape=(2,))
    q_network = keras.Sequential([keras.Input((4,)), keras.layers.Dense(2), scale])
    q_hat_network = keras.Sequential([keras.Input((4,)), keras.layers.Dense(2)])
    optimizer, batch = keras.optimizers.SGD(0.0), random_batch(8)
    losses = [float(learn(batch, 0.9, q_network, q_hat_network, optimizer, tau=0.0)) for _ in range(2)]
    scale.arguments["factor"] = 3.0
    assert losses[0] == losses[1] != float(learn(batch, 0.9, q_network, q_hat_network, optimizer, tau=0.0))


class Slotted:
    __slots__ = ("factor",)

    def __init__(self, factor):
        self.factor = factor


HOLDERS = {
    "argparse.Namespace": (argparse.Namespace(factor=1.0), lambda x: x.factor, lambda x: setattr(x, "factor", 3.0)),
    "SimpleNamespace": (SimpleNamespace(factor=1.0), lambda x: x.factor, lambda x: setattr(x, "factor", 3.0)),
    "UserDict": (UserDict(factor=1.0), lambda x: x["factor"], lambda x: x.update(factor=3.0)),
    "deque": (deque([1.0]), lambda x: x[0], lambda x: x.appendleft(3.0)),
    "__slots__": (Slotted(1.0), lambda x: x.factor, lambda x: setattr(x, "factor", 3.0)),
    "a dict in a list": ([{"factor": 1.0}], lambda x: x[0]["factor"], lambda x: x[0].update(factor=3.0)),
}


@pytest.mark.parametrize("holder", HOLDERS)
def test_a_change_in_whatever_holds_a_number(holder, learning):
    held, read, change = HOLDERS[holder]
    check_is_seen(learning, lambda: change(held), loss=lambda y, q: read(held) * tf.reduce_mean(tf.square(y - q)))


SOURCES = {
    "a module's module": "import pkg\ndef loss(y, q):\n    return pkg.settings.K * tf.reduce_mean(tf.square(y - q))",
    "a name imported within": "def loss(y, q):\n    from pkg.settings import K\n    return K * (y - q) ** 2",
    "a module imported within": "def loss(y, q):\n    import pkg.settings\n    return pkg.settings.K * (y - q) ** 2",
}


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Makes a user's package without an __init__.py, whose settings.K is 1."""
    (tmp_path / "pkg").mkdir()
    (tmp_path / "pkg" / "settings.py").write_text("K = 1.0\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield importlib.import_module("pkg.settings")
    for name in ("pkg", "pkg.settings", "pkg.losses"):
        sys.modules.pop(name, None)


@pytest.mark.parametrize("source", SOURCES)
def test_a_change_in_a_module_of_the_users(source, learning, package):
    made = {"tf": tf, "__name__": "made", "__package__": ""}
    exec(SOURCES[source], made)
    check_is_seen(learning, lambda: setattr(package, "K", 3.0), loss=made["loss"])


def test_a_change_in_a_module_without_a_file_or_a_place(learning, package, tmp_path):
    file = tmp_path / "pkg" / "losses.py"
    source = "import tensorflow as tf\nK = 1.0\ndef loss(y, q):\n    return K * tf.reduce_mean(tf.square(y - q))\n"
    file.write_text(source)
    spaces = [importlib.import_module("pkg.losses")]
    spec = importlib.util.spec_from_file_location("found", file)
    spaces.append(importlib.util.module_from_spec(spec))
    spec.loader.exec_module(spaces[-1])
    made = {}
    exec(source, made)
    for space in [vars(x) for x in spaces] + [made]:
        check_is_seen(Learning(learning.batch), lambda space=space: space.update(K=3.0), loss=space["loss"])


@pytest.mark.parametrize("wrapped", [td_targets, keras.losses.huber])
def test_a_change_in_a_function_with_the_name_of_a_library_function(wrapped, learning):
    held = {"factor": 1.0}

    @functools.wraps(wrapped)
    def targets(*arguments):
        return held["factor"] * td_targets(*arguments)

    check_is_seen(learning, lambda: held.update(factor=3.0), targets=targets)


def test_a_change_in_what_a_decorated_function_reads(learning):
    held = {"factor": 1.0}

    @tf.custom_gradient
    def bent(x):
        return x * held["factor"], lambda dy: dy * held["factor"]

    check_is_seen(learning, lambda: held.update(factor=3.0), loss=lambda y, q: tf.reduce_mean(bent(y - q) ** 2))


class Trainer:
    """A typical class of a script: its loss is a method, and it keeps what `learn` returns."""

    def __init__(self, factor):
        self.factor, self.losses, self.num_calls = factor, [], 0

    def scaled(self, error):
        return self.factor * error

    def loss(self, y, q):
        return tf.reduce_mean(tf.square(self.scaled(y - q)))

    def step(self, learning):
        self.num_calls += 1
        self.losses.append(learning(loss=self.loss))


def test_a_method_is_compiled_once_whatever_else_its_object_keeps(learning):
    trainer = Trainer(1.0)
    for _ in range(3):
        trainer.step(learning)
    assert learning.num_compiled == 1
    check_is_seen(learning, lambda: setattr(trainer, "factor", 3.0), loss=trainer.loss)


reward = 0


def test_a_global_with_the_name_of_an_attribute_does_not_compile_again(learning, monkeypatch):
    def targets(experiences, gamma, q_network, q_hat_network):
        return experiences.reward + 0.0 * gamma

    for number in range(3):
        monkeypatch.setattr(sys.modules[__name__], "reward", number)
        learning(targets=targets)
    assert learning.num_compiled == 1


def test_fit_predict_and_save_between_two_calls_do_not_compile_again(learning, tmp_path):
    network = learning.networks[0]
    learning()
    network.compile("sgd", "mse")
    for _ in range(2):
        network.fit(learning.batch[0], np.zeros((8, 2)), verbose=0)
        network.predict(learning.batch[0], verbose=0)
        network.save(tmp_path / "network.keras")
        learning()
    assert learning.num_compiled == 1


@pytest.mark.slow
def test_the_warning_of_many_compilations_says_what_has_changed(learning):
    held = SimpleNamespace(num_calls=0)

    def loss(y, q):
        return held.num_calls + tf.reduce_mean(tf.square(y - q))

    for held.num_calls in range(7):
        learning(loss=loss)
    held.num_calls = 7
    with pytest.warns(
        UserWarning, match=r"compiled 8 times .*, the last time because of num_calls of SimpleNamespace, which"
    ):
        learning(loss=loss)


WRONG_SHAPES = {
    "one target for all": (
        {"targets": lambda batch, *_: batch.reward[:1]},
        r"targets must return .*\(8,\), got .*\(1,\)",
    ),
    "three losses": (
        {"loss": lambda y, q: (y - q)[:3]},
        r"loss must return a scalar tensor, or one .*, got shape \(3,\)",
    ),
}


@pytest.mark.parametrize("case", WRONG_SHAPES)
def test_a_formula_that_returns_another_size_than_the_batch_is_refused(case, learning):
    own, message = WRONG_SHAPES[case]
    with pytest.raises(ValueError, match=message):
        learning(**own)
