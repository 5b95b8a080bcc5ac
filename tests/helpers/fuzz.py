"""Calls every public function with one bad argument: which errors name it, which do not, and what is accepted.

`DOORS` holds each function with arguments that are right, and for each argument a claim: which other values are right,
too. `POOL` holds values that are wrong almost everywhere. `fuzz` puts values of the pool in place of the arguments.
"""

import collections
import contextlib
import dataclasses
import decimal
import fractions
import functools
import io
import random
import re
import tempfile
import warnings
from collections.abc import Callable, Iterator
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import keras
import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
import tensorflow as tf
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import dqn_keras
from dqn_keras import Config, Experience, ReplayMemory
from dqn_keras.environments import CartPole
from tests.helpers.environments import Corridor

NAN, INF = float("nan"), float("inf")


class Rendered(Corridor):
    """A corridor that can be seen."""

    render_mode = "rgb_array"

    def render(self):
        return np.zeros((4, 6, 3), np.uint8)


class Unprintable:
    """An object whose repr, length, truth, comparison and conversions fail."""

    def _fail(self, *_):
        raise RuntimeError("this object can do nothing")

    __repr__ = __len__ = __bool__ = __eq__ = __iter__ = __float__ = __int__ = __index__ = __array__ = _fail
    __hash__ = object.__hash__


QUICK = Config(num_episodes=2, max_steps=3, batch_size=1, memory_size=8, solved_window=1, hidden_units=(2,))


def networks(seed: int = 0) -> tuple[keras.Model, keras.Model]:
    return dqn_keras.make_networks(2, 2, (2,), seed)


@functools.cache
def shared() -> dict[str, Any]:
    """Returns what many calls can share, because only a call with right arguments changes it."""
    q_network, q_hat_network = networks()
    return {
        "q": q_network,
        "q_hat": q_hat_network,
        "adam": keras.optimizers.Adam(),
        "run": dqn_keras.train(Corridor(3, 3), QUICK, 0, verbose=0),
        "study": dqn_keras.study(Corridor(3, 3), QUICK, range(2), num_workers=1, verbose=0),
        "sweep": dqn_keras.sweep(Corridor(3, 3), {"a": QUICK}, range(2), num_workers=1, verbose=0),
    }


def batch() -> list[Any]:
    return [np.zeros((3, 2)), np.zeros(3, int), np.zeros(3), np.zeros((3, 2)), np.zeros(3)]


def memory(num_appended: int = 3) -> ReplayMemory:
    kept = ReplayMemory(4, (2,))
    for _ in range(num_appended):
        kept.append(transition())
    return kept


def transition() -> Experience:
    return Experience(np.zeros(2, np.float32), 1, 0.5, np.zeros(2, np.float32), False)


def frames() -> list[np.ndarray]:
    return [np.zeros((4, 6, 3), np.uint8) for _ in range(3)]


def functional(inputs: Any, outputs: Callable = lambda x: x) -> keras.Model:
    tensors = inputs if isinstance(inputs, list) else list(inputs.values()) if isinstance(inputs, dict) else [inputs]
    x = keras.layers.Concatenate()(tensors) if len(tensors) > 1 else tensors[0]
    return keras.Model(inputs, outputs(keras.layers.Dense(2)(x)))


UNUSUAL = ("a network with a dictionary of inputs", "a network without weights")
"""Networks that map states to Q-values, although they look wrong."""

MODELS = {
    "an unbuilt network": lambda: keras.Sequential([keras.layers.Dense(2)]),
    "an empty network": lambda: keras.Sequential(),
    "a network for other states": lambda: dqn_keras.make_q_network(3, 2, (2,)),
    "a network for other actions": lambda: dqn_keras.make_q_network(2, 3, (2,)),
    "a network of two inputs": lambda: functional([keras.Input((2,)), keras.Input((2,))]),
    "a network with a dictionary of inputs": lambda: functional({"x": keras.Input((2,))}),
    "a network with a list of outputs": lambda: functional(keras.Input((2,)), lambda q: [q]),
    "a network of float16": lambda: keras.Sequential([keras.Input((2,)), keras.layers.Dense(2, dtype="float16")]),
    "a network of one axis more": lambda: keras.Sequential([keras.Input((5, 2)), keras.layers.Dense(2)]),
    "a network without weights": lambda: keras.Sequential([keras.Input((2,)), keras.layers.ReLU()]),
}


POOL: dict[str, Callable[[], Any]] = {
    **{repr(x): (lambda x=x: x) for x in (None, True, False, NAN, INF, -INF, -1, 0, 1, 3, 0.5, 1.5, -0.5, 1e39, 2**31)},
    **{repr(x): (lambda x=x: x) for x in ("", "x", "yes", "x\0", "nan", "1", b"", b"x", bytearray(b"x"), 1j, range(0))},
    **{
        repr(x): (lambda x=x: x)
        for x in ((), {}, {"x": 1}, [None], [[1], [1, 2]], [[1, 2], [3, 4]], ["x"], [0.5], [1, 2])
    },
    "10**400": lambda: 10**400,
    "10**5000": lambda: 10**5000,
    "a set": lambda: {1, 2},
    "an iterator": lambda: iter([1]),
    "a list that holds itself": lambda: (x := []).append(x) or x,
    "[0.5] * 100_000": lambda: [0.5] * 100_000,
    "an object": object,
    "an unprintable object": Unprintable,
    "int": lambda: int,
    "dict": lambda: dict,
    "a class": lambda: Corridor,
    "a function of nothing": lambda: lambda: 0,
    "a function of anything": lambda: lambda *_, **__: None,
    "len": lambda: len,
    "print": lambda: print,
    "NotImplemented": lambda: NotImplemented,
    "a module": lambda: np.random,
    "Decimal": lambda: decimal.Decimal("0.5"),
    "Fraction": lambda: fractions.Fraction(1, 2),
    "random.Random": lambda: random.Random(0),
    "RandomState": lambda: np.random.RandomState(0),
    "default_rng itself": lambda: np.random.default_rng,
    "a Generator": lambda: np.random.default_rng(0),
    "a SeedSequence": lambda: np.random.SeedSequence(0),
    "a path": lambda: Path("folder/x"),
    "an empty path": lambda: Path(""),
    "a text file": io.StringIO,
    "float32(0.5)": lambda: np.float32(0.5),
    "float64 NaN": lambda: np.float64("nan"),
    "int64(-1)": lambda: np.int64(-1),
    "int64(2)": lambda: np.int64(2),
    "np.True_": lambda: np.True_,
    "longdouble": lambda: np.longdouble(0.5),
    "datetime64": lambda: np.datetime64("2015-02-26"),
    "str_": lambda: np.str_("x"),
    "zeros(())": lambda: np.zeros(()),
    "zeros(0)": lambda: np.zeros(0),
    "zeros(2)": lambda: np.zeros(2),
    "zeros(3)": lambda: np.zeros(3),
    "zeros((3, 1))": lambda: np.zeros((3, 1)),
    "zeros((2, 2, 2))": lambda: np.zeros((2, 2, 2)),
    "zeros(100_000)": lambda: np.zeros(100_000),
    "NaNs": lambda: np.full(2, NAN),
    "NaNs [3]": lambda: np.full(3, NAN),
    "NaNs [3, 2]": lambda: np.full((3, 2), NAN),
    "infinities [3]": lambda: np.full(3, INF),
    "an array of strings": lambda: np.array(["1", "2"]),
    "an array of objects": lambda: np.array([object(), None]),
    "an array of complex numbers": lambda: np.zeros(3, complex),
    "an array of booleans": lambda: np.array([True, False]),
    "an array of dates": lambda: np.zeros(3, "datetime64[s]"),
    "an array of longdoubles": lambda: np.zeros(3, np.longdouble),
    "a structured array": lambda: np.zeros(3, [("x", "f4")]),
    "a tensor": lambda: tf.constant(0.5),
    "a tensor of NaN": lambda: tf.constant(NAN),
    "a tensor of strings": lambda: tf.constant(["x", "y", "z"]),
    "a tensor of a string": lambda: tf.constant("x"),
    "a tensor of complex numbers": lambda: tf.zeros([3], tf.complex64),
    "a tensor [2]": lambda: tf.zeros([2]),
    "a ragged tensor": lambda: tf.ragged.constant([[1.0], [1.0, 2.0]]),
    "a sparse tensor": lambda: tf.sparse.from_dense([1.0, 0.0, 0.0]),
    "a variable": lambda: tf.Variable(0.5),
    "a symbolic tensor": lambda: keras.Input((2,)),
    "a layer": lambda: keras.layers.Dense(1),
    "a loss": lambda: keras.losses.Huber(),
    "a loss's class": lambda: keras.losses.Huber,
    "a metric": lambda: keras.metrics.MeanSquaredError(),
    "an initializer": lambda: keras.initializers.Zeros(),
    "an optimizer": lambda: keras.optimizers.Adam(),
    "an optimizer's class": lambda: keras.optimizers.Adam,
    "an optimizer of other variables": lambda: (o := keras.optimizers.Adam()).build([keras.Variable(1.0)]) or o,
    "a schedule": lambda: keras.optimizers.schedules.CosineDecay(1e-3, 10),
    "a callback": lambda: keras.callbacks.Callback(),
    "a callback's class": lambda: keras.callbacks.Callback,
    "callbacks, one of them a class": lambda: [keras.callbacks.Callback(), keras.callbacks.Callback],
    **{name: functools.cache(make) for name, make in MODELS.items()},
    "a right network": lambda: networks(1)[0],
    "an environment": lambda: Corridor(3, 3),
    "an environment's class": lambda: CartPole,
    "an environment without spaces": gym.Env,
    "a functional environment": lambda: CartPole(),
    "an environment's name": lambda: "CartPole-v1",
    "a Config": lambda: QUICK,
    "the class Config": lambda: Config,
    "a Config as a dictionary": lambda: dataclasses.asdict(QUICK),
    "a Run": lambda: shared()["run"],
    "a Study": lambda: shared()["study"],
    "a Sweep": lambda: shared()["sweep"],
    "a Study of no seeds": lambda: dqn_keras.Study(QUICK, []),
    "an Experience of None": lambda: Experience(*[None] * 5),
    "five strings": lambda: ["x"] * 5,
    "a transition": transition,
    "a batch": batch,
    "four fields": lambda: batch()[:4],
    "frames": frames,
    "frames of two sizes": lambda: [*frames(), np.zeros((4, 8, 3), np.uint8)],
    "frames of floats": lambda: [np.zeros((4, 6, 3))],
    "frames of no pixels": lambda: [np.zeros((0, 6, 3), np.uint8)],
    "an Axes": lambda: plt.subplots()[1],
    "three Axes": lambda: plt.subplots(1, 3)[1],
    "two Axes": lambda: plt.subplots(1, 2)[1],
    "a Figure": plt.figure,
}
"""The values by name. Each is made again for each case, because an earlier case could have changed it."""

Claim = Callable[[Any], bool]
"""Returns whether a value, from `POOL`, is right, so that the function must accept it."""


def nothing(value: Any) -> bool:
    return False


def one_of(*claims: Claim) -> Claim:
    return lambda value: any(claim(value) for claim in claims)


def named(*names: str) -> Claim:
    """Claims the values of these names, which the case is known by."""
    assert set(names) <= set(POOL), names
    claim = lambda value: False  # noqa: E731
    claim.names = names
    return claim


def no_value(value: Any) -> bool:
    return value is None


def count(at_least: int = 1, at_most: int = 2**31 - 1) -> Claim:
    is_whole = lambda x: isinstance(x, Integral) and not isinstance(x, bool | np.bool_)  # noqa: E731
    return lambda x: is_whole(x) and at_least <= x <= at_most


def number(low: float, high: float, above: bool = False) -> Claim:
    """Claims real numbers from low (with `above`: above it) to high."""
    is_real = lambda x: isinstance(x, Real) and not isinstance(x, bool | np.bool_)  # noqa: E731
    return lambda x: is_real(x) and abs(x) < 10**100 and (low < x if above else low <= x) and x <= high


def share(value: Any) -> bool:
    """A number in [0, 1], or a scalar tensor of one."""
    if isinstance(value, tf.Tensor | tf.Variable | np.ndarray) and value.shape == () and value.dtype != tf.string:
        value = np.asarray(value)[()]
    return number(0, 1)(value)


def flag(value: Any) -> bool:
    return isinstance(value, bool | np.bool_)


def text(value: Any) -> bool:
    return isinstance(value, str) and value != ""


def path(value: Any) -> bool:
    return isinstance(value, Path) or (text(value) and "\0" not in value)


def is_a(*types: type) -> Claim:
    return lambda value: isinstance(value, types)


def counts(at_least: int = 1) -> Claim:
    return lambda xs: isinstance(xs, list | tuple | range) and len(xs) > 0 and all(map(count(at_least), xs))


seed = one_of(no_value, count(0))


class Door(NamedTuple):
    call: Callable[..., Any]
    arguments: Callable[[], dict[str, Any]]
    """Makes arguments that are right."""
    claims: dict[str, Claim]
    """For each argument to try, which values are right."""
    also_named: dict[str, str] = {}  # noqa: RUF012
    """Further words that a message about an argument may begin with: its parts."""


FIELDS = ("states", "actions", "rewards", "next_states", "terminal_states")


def with_field(function: Callable, number: int) -> Callable:
    """Returns the function of a batch, with one field of the batch as an argument of its own."""

    def call(**arguments: Any) -> Any:
        field = arguments.pop(FIELDS[number])
        experiences = [field if i == number else x for i, x in enumerate(arguments.pop("experiences"))]
        return function(experiences=experiences, **arguments)

    return call


def formula_doors() -> Iterator[tuple[str, Door]]:
    right = named("a right network", *UNUSUAL)
    for function in (dqn_keras.td_targets, dqn_keras.double_td_targets, dqn_keras.loss_values, dqn_keras.learn):

        def arguments(is_learn: bool = function is dqn_keras.learn) -> dict[str, Any]:
            given = {"experiences": batch(), "gamma": 0.9, "q_network": shared()["q"]}
            return given | {"q_hat_network": shared()["q_hat"]} | ({"optimizer": shared()["adam"]} if is_learn else {})

        claims = {"experiences": named("a batch"), "gamma": share, "q_network": right, "q_hat_network": right}
        if function is dqn_keras.learn:
            claims |= {"q_network": nothing, "q_hat_network": named("a right network")}  # `adam` is built for another
            claims |= {
                "optimizer": named("an optimizer"),
                "tau": share,
                "targets": nothing,
                "loss": named("a loss"),
                "jit_compile": flag,
            }
        also = {"experiences": "states actions rewards next_states terminal_states"}
        also |= {"q_network": "q_hat_network states optimizer", "q_hat_network": "q_network"}
        yield function.__name__, Door(function, arguments, claims, also)
        for i, name in enumerate(FIELDS):

            def with_it(make: Callable = arguments, i: int = i) -> dict[str, Any]:
                given = make()
                return given | {FIELDS[i]: given["experiences"][i]}

            claim = named("zeros(3)") if i in (2, 4) else nothing
            also = {name: "actions"} if name == "states" else {}
            yield f"{function.__name__} of {name}", Door(with_field(function, i), with_it, {name: claim}, also)


def memory_doors() -> Iterator[tuple[str, Door]]:
    def append(**fields: Any) -> None:
        memory().append(Experience(**fields))

    def append_whole(experience: Any) -> None:
        memory().append(experience)

    def sample(batch_size: Any, rng: Any) -> None:
        memory().sample(batch_size, rng)

    def sample_rows(batch_size: Any, rng: Any) -> None:
        memory().sample_rows(batch_size, rng)

    sizes = {"memory_size": 4, "state_shape": (2,), "dtype": np.uint8}
    yield (
        "ReplayMemory",
        Door(
            ReplayMemory,
            lambda: dict(sizes),
            {"memory_size": count(), "state_shape": counts(), "dtype": nothing},
        ),
    )
    yield (
        "ReplayMemory.append",
        Door(
            append_whole,
            lambda: {"experience": transition()},
            {"experience": named("a transition")},
            {"experience": "state action reward next_state terminal_state"},
        ),
    )
    finite = named("0", "1", "3", "0.5", "1.5", "-0.5", "-1", "Fraction", "float32(0.5)", "int64(-1)", "int64(2)")
    scalars = named("zeros(())", "longdouble", "a tensor", "a variable")
    states = named("zeros(2)", "a tensor [2]", "[1, 2]")
    claims = {
        "state": states,
        "action": named("0", "1", "3", "int64(2)"),
        "reward": one_of_named(finite, scalars, named("2147483648")),
        "next_state": states,
        "terminal_state": named("True", "False", "0", "1", "np.True_", "zeros(())"),
    }
    yield "ReplayMemory.append of fields", Door(append, lambda: transition()._asdict(), claims)
    arguments = lambda: {"batch_size": 2, "rng": np.random.default_rng(0)}  # noqa: E731
    claims = {"batch_size": count(1, 3), "rng": is_a(np.random.Generator)}
    yield "ReplayMemory.sample", Door(sample, arguments, claims)
    yield "ReplayMemory.sample_rows", Door(sample_rows, arguments, claims)


def one_of_named(*claims: Claim) -> Claim:
    return named(*(name for claim in claims for name in claim.names))


def network_doors() -> Iterator[tuple[str, Door]]:
    sizes = {"num_features": 2, "num_actions": 2, "hidden_units": (2,), "seed": 0}
    claims = {
        "num_features": count(),
        "num_actions": count(),
        "hidden_units": counts(),
        "seed": one_of(seed, is_a(np.random.SeedSequence)),
    }
    yield "make_networks", Door(dqn_keras.make_networks, lambda: dict(sizes), claims)
    named_sizes = lambda: {**sizes, "name": "q"}  # noqa: E731
    yield "make_q_network", Door(dqn_keras.make_q_network, named_sizes, {**claims, "name": text})
    yield (
        "update_q_hat",
        Door(
            dqn_keras.update_q_hat,
            lambda: {"q_network": shared()["q"], "q_hat_network": shared()["q_hat"], "tau": 0.1},
            {"q_network": named("a right network"), "q_hat_network": named("a right network"), "tau": share},
            {"q_network": "q_hat_network"},
        ),
    )


def evaluation_at_the_start(**arguments: Any) -> None:
    evaluation = dqn_keras.Evaluation(**arguments)
    evaluation.set_model(shared()["q"])
    evaluation.on_train_begin()


def act(state: Any) -> None:
    shared()["run"].act(state)


def acting_doors() -> Iterator[tuple[str, Door]]:
    yield (
        "action",
        Door(
            dqn_keras.action,
            lambda: {"q_values": np.array([1.0, 2.0]), "epsilon": 0.5, "rng": np.random.default_rng(0)},
            {
                "q_values": named(
                    *("zeros(2)", "zeros(3)", "zeros(100_000)", "a tensor [2]", "[0.5]", "infinities [3]"),
                    *("an array of longdoubles", "[0.5] * 100_000", "[1, 2]"),
                ),
                "epsilon": number(0, 1),
                "rng": is_a(np.random.Generator),
            },
        ),
    )
    yield (
        "decay_epsilon",
        Door(
            dqn_keras.decay_epsilon,
            lambda: {"epsilon": 0.5, "config": QUICK},
            {"epsilon": number(0, 1), "config": is_a(Config)},
        ),
    )
    yield (
        "episode_seed",
        Door(dqn_keras.episode_seed, lambda: {"seed": 0, "episode": 0}, {"seed": count(0), "episode": count(0)}),
    )
    arguments = {"num_episodes": 1, "seed": 0, "max_steps": 3}
    claims = {"env": is_a(Corridor), "seed": seed, "max_steps": count()}
    right = {"q_network": named("a right network", *UNUSUAL)}
    yield (
        "evaluate",
        Door(
            dqn_keras.evaluate,
            lambda: {"env": Corridor(3, 3), "q_network": shared()["q"], **arguments},
            {**claims, **right, "num_episodes": count()},
            {"env": "q_network"},  # which may not fit it
        ),
    )
    yield (
        "Evaluation",
        Door(
            evaluation_at_the_start,
            lambda: {"env": Corridor(3, 3), "every_steps": 5, "best": "x.keras", **arguments},
            {**claims, "every_steps": count(), "best": no_value, "num_episodes": count()},
            {"env": "q_network"},  # which may not fit it
        ),
    )
    states = named("zeros(2)", "a tensor [2]", "[1, 2]", "an array of booleans")
    yield "Run.act", Door(act, lambda: {"state": np.zeros(2)}, {"state": states})
    yield (
        "record_episode",
        Door(
            dqn_keras.record_episode,
            lambda: {"env": Rendered(3, 3), "q_network": shared()["q"], "seed": 0, "max_steps": 3},
            {**claims, **right, "env": nothing},
        ),
    )


def picture_doors() -> Iterator[tuple[str, Door]]:
    pictures = named("frames")
    sizes = {"fps": count(), "width": count(1, 2_000)}
    yield (
        "save_animation",
        Door(
            dqn_keras.save_animation,
            lambda: {"frames": frames(), "file": "x.gif", "fps": 50, "width": 6, "format": None},
            {"frames": pictures, "file": nothing, **sizes, "format": no_value},
        ),
    )
    yield (
        "animate",
        Door(
            dqn_keras.animate,
            lambda: {"frames": frames(), "fps": 50, "width": 6},
            {"frames": pictures, **sizes},
        ),
    )
    rewards = named(
        *("()", "range(0, 0)", "[0.5]", "zeros(0)", "zeros(2)", "zeros(3)", "zeros(100_000)", "[0.5] * 100_000"),
        *("NaNs", "NaNs [3]", "infinities [3]", "an array of longdoubles", "a tensor [2]", "[1, 2]"),
    )
    yield (
        "plot_rewards",
        Door(
            dqn_keras.plot_rewards,
            lambda: {"rewards": [1.0, 2.0], "ax": None, "window": 2},
            {"rewards": rewards, "ax": named("an Axes", "None"), "window": count()},
        ),
    )
    yield (
        "plot_run",
        Door(
            dqn_keras.plot_run,
            lambda: {"run": shared()["run"], "speed": False},
            {"run": named("a Run"), "speed": flag},
        ),
    )
    yield (
        "plot_q",
        Door(
            dqn_keras.plot_q,
            lambda: {
                "q_network": shared()["q"],
                "x": (0, 0, 1),
                "y": (1, 0, 1),
                "state": None,
                "ax": None,
                "limits": None,
            },
            {
                "q_network": named(
                    "a right network", *UNUSUAL, "a network for other states", "a network for other actions"
                ),
                "x": nothing,
                "y": nothing,
                "state": named("None", "zeros(2)", "a tensor [2]", "[1, 2]"),
                "ax": named("an Axes", "None"),
                "limits": named("None", "[1, 2]"),
            },
        ),
    )
    yield (
        "plot_study",
        Door(
            dqn_keras.plot_study,
            lambda: {"study": shared()["study"], "axes": None, "published": 2, "x": "episodes"},
            {
                "study": named("a Study"),
                "axes": named("None", "three Axes"),
                "published": one_of(no_value, number(0, 1e100)),
                "x": nothing,
            },
        ),
    )
    sweep = {"sweep": named("a Sweep"), "late_after": count()}
    for function in (dqn_keras.plot_sweep, dqn_keras.sweep_table):
        yield function.__name__, Door(function, lambda: {"sweep": shared()["sweep"], "late_after": 9}, sweep)


def many_seeds_doors() -> Iterator[tuple[str, Door]]:
    yield (
        "summarize",
        Door(
            dqn_keras.summarize,
            lambda: {"study": shared()["study"], "late_after": 9},
            {"study": named("a Study"), "late_after": count()},
        ),
    )
    yield (
        "compare",
        Door(
            dqn_keras.compare,
            lambda: {"first": shared()["study"], "second": shared()["study"]},
            {"first": named("a Study"), "second": named("a Study")},
        ),
    )
    how = {"seeds": range(1), "file": None, "engine": "joblib", "num_workers": 1, "verbose": 0, "evaluate_on": None}
    claims = {
        "env": is_a(Corridor, CartPole),
        "seeds": named("()", "range(0, 0)", "zeros(0)", "[1, 2]"),
        "file": one_of(no_value, lambda x: path(x) and x != Path("")),
        "engine": nothing,
        "num_workers": one_of(no_value, count()),
        "verbose": named("0", "1", "True", "False", "int64(2)", "np.True_"),
        "evaluate_on": one_of(no_value, is_a(Corridor)),
    }
    own = {"q_network": None, "optimizer": None, "loss": None}
    parts = {"q_network": no_value, "targets": nothing, "loss": named("None", "a loss")}
    parts["optimizer"] = named("None", "an optimizer's class")
    also = {"evaluate_on": "env"}
    yield (
        "study",
        Door(
            dqn_keras.study,
            lambda: {"env": Corridor(3, 3), "config": QUICK, **how, **own},
            {**claims, **parts, "config": is_a(Config)},
            also,
        ),
    )
    yield (
        "sweep",
        Door(
            dqn_keras.sweep,
            lambda: {"env": Corridor(3, 3), "settings": {"a": QUICK}, **how},
            {**claims, "settings": nothing},
            also,
        ),
    )


def file_doors() -> Iterator[tuple[str, Door]]:
    def save(path: Any) -> None:
        shared()["run"].save(path)

    yield (
        "load_q_network",
        Door(dqn_keras.load_q_network, lambda: {"path": "../network.keras"}, {"path": nothing}),
    )
    yield "load_study", Door(dqn_keras.load_study, lambda: {"path": "../study.npz"}, {"path": nothing})
    yield "load_sweep", Door(dqn_keras.load_sweep, lambda: {"path": "../study.npz"}, {"path": nothing})
    yield "Run.save", Door(save, lambda: {"path": "x.keras"}, {"path": nothing})


def train_doors() -> Iterator[tuple[str, Door]]:
    defaults = {"q_network": None, "optimizer": None, "loss": None, "callbacks": (), "checkpoint": None}
    claims = {
        "env": is_a(Corridor, CartPole),
        "config": is_a(Config),
        "seed": seed,
        "q_network": named("None", "a right network", "a network with a dictionary of inputs"),
        "optimizer": named("None", "an optimizer"),
        "targets": nothing,
        "loss": named("None", "a loss"),
        "callbacks": named("None", "()", "a callback"),
        "checkpoint": one_of(no_value, path),
        "checkpoint_every": count(),
        "resume": named("False"),
        "verbose": named("0", "1", "True", "False", "int64(2)", "np.True_"),
    }
    arguments = lambda: {"env": Corridor(3, 3), "config": QUICK, "seed": 0, **defaults, "verbose": 0}  # noqa: E731
    yield "train", Door(dqn_keras.train, arguments, claims, {"resume": "checkpoint"})


def config_doors() -> Iterator[tuple[str, Door]]:
    names = ("memory_size", "steps_per_update", "batch_size", "num_episodes", "max_steps", "solved_window")
    claims = {name: count() for name in (*names, "gradient_steps", "gradient_steps_per_target")}
    claims |= {name: one_of(no_value, count()) for name in ("num_steps", "epsilon_steps")}
    claims |= {"learning_starts": count(0), "steps_count_from": nothing}
    claims |= {name: number(0, 1, above=True) for name in ("alpha", "tau", "decay")}
    claims |= {name: number(0, 1) for name in ("gamma", "epsilon", "epsilon_min")}
    claims |= {"solved_reward": one_of(no_value, number(-INF, INF)), "hidden_units": counts(), "jit_compile": flag}
    also = dict.fromkeys(claims, "batch_size epsilon_min")
    arguments = lambda: {"memory_size": 4, "batch_size": 1, "max_steps": 3, "epsilon_min": 0.0}  # noqa: E731
    yield "Config", Door(Config, arguments, claims, also)


DOORS = dict(
    door
    for doors in (
        *(config_doors, acting_doors, network_doors, formula_doors, memory_doors),
        *(many_seeds_doors, picture_doors, file_doors, train_doors),
    )
    for door in doors()
)

CASES = [(door, argument, name) for door in DOORS for argument in DOORS[door].claims for name in POOL]


@contextlib.contextmanager
def quiet_folder() -> Iterator[None]:
    """Moves to an empty folder with a network and a study in it; nothing is printed, shown or warned of."""
    before = mpl.get_backend()
    mpl.use("Agg")
    with (
        tempfile.TemporaryDirectory() as folder,
        contextlib.chdir(folder),
        contextlib.redirect_stdout(io.StringIO()),
        contextlib.redirect_stderr(io.StringIO()),
        warnings.catch_warnings(action="ignore"),
    ):
        shared()["run"].save("network.keras")
        dqn_keras.study(Corridor(3, 3), QUICK, range(2), file="study.npz", num_workers=1, verbose=0)
        yield
    mpl.use(before)


@contextlib.contextmanager
def in_its_own_folder() -> Iterator[None]:
    """Moves to an empty folder in the present one, so that no call finds the files of another."""
    with tempfile.TemporaryDirectory(dir=".") as folder, contextlib.chdir(folder):
        yield


def outcome(door: Door, argument: str, name: str) -> tuple[str, str]:
    """Returns the kind of what happens with this value as the argument, and the message of the error if there is one.

    A right value is accepted or refused. A wrong one is nonsense if it is accepted; its error is clear or foreign.
    """
    value, claim = POOL[name](), door.claims[argument]
    is_right = name in claim.names if hasattr(claim, "names") else claim(value)
    try:
        with in_its_own_folder():
            door.call(**{**door.arguments(), argument: value})
    except Exception as error:
        names = {argument, *door.also_named.get(argument, "").split()}
        kind = "refused" if is_right else "clear" if is_clear(error, argument, names, value) else "foreign"
        return kind, f"{type(error).__name__}: {error}"
    finally:
        plt.close("all")
    return "accepted" if is_right else "nonsense", ""


def is_clear(error: Exception, argument: str, names: set[str], value: Any) -> bool:
    """Returns whether the error names the argument first, and shows the value, in at most 1,000 characters."""
    message = str(error)
    if isinstance(error, OSError):  # the operating system's word on a path
        return argument in ("path", "file", "checkpoint") and error.filename is not None
    if any(re.match(rf"raised by {argument}\b", note) for note in getattr(error, "__notes__", ())):
        return True  # an error in the user's own function
    first = re.match(r"\w+", message)
    is_named = first is not None and first[0] in names and len(message) <= 1_000
    is_shown = "got " in message or (isinstance(value, str | Path) and str(value) in message)
    return isinstance(error, TypeError | ValueError) and is_named and is_shown


def fuzz(num_cases: int) -> dict[str, Any]:
    """Tries so many cases, or all there are; returns how many were right, and a line for each that was not."""
    counts: collections.Counter[str] = collections.Counter()
    failures: dict[str, list[str]] = {"foreign": [], "nonsense": [], "refused": []}

    @settings(
        max_examples=num_cases, deadline=None, database=None, derandomize=True, suppress_health_check=list(HealthCheck)
    )
    @given(st.sampled_from(CASES))
    def try_it(case: tuple[str, str, str]) -> None:
        door, argument, name = case
        kind, message = outcome(DOORS[door], argument, name)
        counts[kind] += 1
        if kind in failures:
            failures[kind].append(f"{door}({argument}={name}): {message or 'accepted'}")

    with quiet_folder():
        try_it()
    return {"clear": counts["clear"], "accepted": counts["accepted"], **failures}
