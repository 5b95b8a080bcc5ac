"""The compiled learning step of `learn`, kept as long as nothing that it was compiled for has changed."""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from dqn_keras._engine.private import all_layers
from dqn_keras._engine.programs import Learner, bind
from dqn_keras._engine.tensorflow import tf
from dqn_keras._engine.watching import Watch
from dqn_keras.checks.formulas import Formulas
from dqn_keras.checks.networks import warn_of_inference_mode


class _Step(NamedTuple):
    """A compiled step, and what it was compiled for."""

    parts: tuple[Any, ...]
    watch: Watch
    call: Callable[..., list[tf.Tensor]]


@dataclasses.dataclass
class _Steps:
    """The compiled steps of one network. The network holds them, so that they go when it goes."""

    kept: list[_Step] = dataclasses.field(default_factory=list)
    num_compiled: int = 0


_MOST_KEPT = 8


def compiled_step(
    make_step: Callable[..., Callable], learner: Learner, formulas: Formulas, jit_compile: bool
) -> Callable[..., list[tf.Tensor]]:
    """The step that `make_step(learner)` is, compiled for these very objects and any size of the batch.

    It is a function of (states, actions, rewards, next_states, terminal_states, gamma, tau), tensors all, and is found
    at once from the second call on, until one of the objects changes.
    """
    parts = (*learner, *formulas, jit_compile)
    steps: _Steps = vars(learner.q_network).setdefault("_dqn_keras_steps", _Steps())
    for step in steps.kept:
        if all(a is b or (isinstance(a, str) and a == b) for a, b in zip(step.parts, parts, strict=True)):
            if step.watch.is_unchanged():
                return step.call
            steps.kept.remove(step)
            break
    formulas.check()
    learner.prepare()
    if not steps.num_compiled:
        warn_of_inference_mode(learner.q_network)
    call = _bind(make_step, learner, formulas, jit_compile)
    watch = Watch(*parts, *all_layers(learner.q_network), *all_layers(learner.q_hat_network))
    steps.kept = [*steps.kept[1 - _MOST_KEPT :], _Step(parts, watch, call)]
    steps.num_compiled += 1
    if steps.num_compiled == _MOST_KEPT:
        warnings.warn(
            f"learn was compiled {_MOST_KEPT} times for {learner.q_network.name!r}, which takes time and memory: pass "
            "the same optimizer, targets and loss at each call, instead of new ones",
            stacklevel=3,
        )
    return call


def _bind(
    make_step: Callable[..., Callable], learner: Learner, formulas: Formulas, jit_compile: bool
) -> Callable[..., list[tf.Tensor]]:
    states = tf.TensorSpec((None, *learner.q_network.input_shape[1:]))  # a batch of any size
    vector, scalar = tf.TensorSpec((None,)), tf.TensorSpec(())
    specs: Sequence[tf.TensorSpec] = (states, tf.TensorSpec((None,), tf.int32), vector, states, vector, scalar, scalar)
    return bind(
        lambda learner, _: make_step(learner),
        specs,
        learner,
        key=("learn", formulas.key),
        has_own_parts=not formulas.are_the_packages,
        jit_compile=jit_compile,
    )
