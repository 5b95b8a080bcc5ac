"""The compiled learning step of `learn`, kept until something that it was compiled for changes."""

import dataclasses
import warnings
from collections.abc import Callable, Hashable
from types import MethodType
from typing import Any, NamedTuple

from dqn_keras._engine.private import all_layers
from dqn_keras._engine.programs import Learner, bind
from dqn_keras._engine.tensorflow import tf
from dqn_keras._engine.watching import ChangeWatch
from dqn_keras.checks.formulas import Formulas
from dqn_keras.checks.networks import warn_of_inference_mode


class _Step(NamedTuple):
    """A compiled step and the objects that it was compiled for."""

    parts: tuple[Any, ...]
    watch: ChangeWatch
    call: Callable[..., list[tf.Tensor]]


@dataclasses.dataclass
class _Steps:
    """The compiled steps of one network. The network holds them, so that they are freed with it."""

    kept: list[_Step] = dataclasses.field(default_factory=list)
    num_compiled: int = 0


_MOST_KEPT = 8


def compiled_step(
    make_step: Callable[..., Callable], learner: Learner, formulas: Formulas, key: Hashable, batch_size: int, jit: bool
) -> Callable[..., list[tf.Tensor]]:
    """Returns `make_step(learner)`, compiled for these objects; the compiled step is kept until one of them changes.

    The step takes seven tensors: states, actions, rewards, next_states, terminal_states, gamma and tau. For the user's
    formulas, `key` is None and the step takes only batches of `batch_size`, so that the shapes that the formulas return
    can be checked. Otherwise `key` identifies the package's formulas, and the step takes batches of any size.
    """
    size = batch_size if key is None else None
    parts = (*learner, *formulas, size, jit)
    steps: _Steps = vars(learner.q_network).setdefault("_dqn_keras_steps", _Steps())
    why = "a new part or batch size"
    for step in steps.kept:
        if all(map(_is_the_same, step.parts, parts)):
            if step.watch.is_unchanged():
                return step.call
            why = f"{step.watch.what_changed()}, which has changed"
            steps.kept.remove(step)
            break
    formulas.check()
    learner.prepare()
    if not steps.num_compiled:
        warn_of_inference_mode(learner.q_network)
    call = _bind(make_step, learner, key, size, jit)
    watch = ChangeWatch(*parts, *all_layers(learner.q_network), *all_layers(learner.q_hat_network))
    steps.kept = [*steps.kept[1 - _MOST_KEPT :], _Step(parts, watch, call)]
    steps.num_compiled += 1
    if steps.num_compiled == _MOST_KEPT:
        warnings.warn(
            f"learn was compiled {_MOST_KEPT} times for {learner.q_network.name!r}, the last time because of {why}. "
            "That takes time and memory: pass the same objects at each call, and do not change them",
            stacklevel=3,
        )
    return call


def _is_the_same(a: Any, b: Any) -> bool:
    """Returns whether two parts are one object; methods, strings and numbers are compared by value."""
    return a is b or (isinstance(a, str | MethodType | int) and type(a) is type(b) and a == b)


def _bind(
    make_step: Callable[..., Callable], learner: Learner, key: Hashable, size: int | None, jit: bool
) -> Callable[..., list[tf.Tensor]]:
    states, vector, scalar = (tf.TensorSpec(x) for x in ((size, *learner.q_network.input_shape[1:]), (size,), ()))
    return bind(
        lambda learner, _: make_step(learner),
        (states, tf.TensorSpec((size,), tf.int32), vector, states, vector, scalar, scalar),
        learner,
        key=("learn", key),
        has_own_parts=key is None,
        jit_compile=jit,
    )
