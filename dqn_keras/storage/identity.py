"""The identity of a run: everything that must be equal for two runs to count as the same, as JSON values."""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.graphs import computation
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.agent import Agent
from dqn_keras.checks.formulas import Formulas
from dqn_keras.config import Config
from dqn_keras.learn import DEFAULT_FORMULAS, known_formulas
from dqn_keras.replay import Experience
from dqn_keras.storage.parts import Part, check_can_be_imported, describe, source_of, words_for
from dqn_keras.storage.versions import versions


class Identity(NamedTuple):
    """Everything that must be the same when a saved run is resumed."""

    facts: dict[str, Any]
    """The identity as JSON values."""
    other_variables: list[tf.Variable]
    """Variables outside the agent that the user's parts read or change. They belong to the state of a run."""


def identity(
    env: gym.Env | FuncEnv,
    config: Config,
    agent: Agent,
    formulas: Formulas = DEFAULT_FORMULAS,
    q_network: keras.Model | None = None,
    optimizer: keras.Optimizer | None = None,
) -> Identity:
    """Returns everything that must be the same when a saved run is resumed; only versions may differ.

    Args:
        env: the environment.
        config: the parameters.
        agent: a new agent.
        formulas: the targets and the loss.
        q_network: the user's network; None for the default.
        optimizer: the user's optimizer; None for the default.

    Raises:
        ValueError: a function or class of the user has no name that can be imported.
    """
    given = {"q_network": q_network, "optimizer": optimizer}
    if not known_formulas(formulas):
        given |= formulas._asdict()
    for name, part in given.items():
        check_can_be_imported(name, part)
    environment, *computations = describe(env)
    parts = {"env": environment}
    for name, (function, specs) in _traceable(agent, config, formulas).items():
        part = given.get(name, formulas._asdict().get(name))
        if (part is not None and name in given) or (name == "optimizer" and q_network is not None):
            computations.append(computation(function, specs, agent.learner.variables))
            parts[name] = Part(words_for(part), source_of(part), computations[-1].digest)
        else:
            parts[name] = Part(words_for(part))
    others = {id(variable): variable for x in computations for variable in x.other_variables}
    return Identity(_facts(config, **parts), list(others.values()))


def identity_with(facts: dict[str, Any], **parts: Part) -> dict[str, Any]:
    """Returns an identity's facts with further parts."""
    return {**facts, "parts": facts["parts"] | json.loads(json.dumps({k: x._asdict() for k, x in parts.items()}))}


def _facts(config: Config, **parts: Part) -> dict[str, Any]:
    facts = {"config": dataclasses.asdict(config), "parts": {k: x._asdict() for k, x in parts.items()}}
    return json.loads(json.dumps({**facts, "versions": versions()}))  # tuples become lists


def _traceable(agent: Agent, config: Config, formulas: Formulas) -> dict[str, tuple[Callable, list[tf.TensorSpec]]]:
    """Returns, for each part, a function that computes its results and gradients, and the specs of its arguments."""
    q_network, q_hat_network, optimizer = agent.learner
    weights = q_network.trainable_variables
    scalar, vector = tf.TensorSpec(()), tf.TensorSpec((config.batch_size,))
    states = tf.TensorSpec((config.batch_size, *agent.memory.state_shape), agent.memory.rows.dtype)
    actions = tf.TensorSpec((config.batch_size,), tf.int32)

    def play(states: tf.Tensor) -> list[Any]:
        with tf.GradientTape() as tape:
            q_values = q_network(states)
            total = tf.reduce_sum(q_values) + sum(tf.cast(x, tf.float32) for x in q_network.losses)
        gradients = tape.gradient(total, weights)
        return [q_values, total, *(x for x in gradients if x is not None)]

    def update(loss: tf.Tensor, *gradients: tf.Tensor) -> tf.Tensor:
        optimizer.apply_gradients(zip(gradients, weights, strict=True))
        return optimizer.scale_loss(loss)

    def targets(*tensors: tf.Tensor) -> tf.Tensor:
        *batch, gamma = tensors
        return formulas.y(Experience(*batch), gamma, q_network, q_hat_network)

    def loss(y: tf.Tensor, q: tf.Tensor) -> list[Any]:
        with tf.GradientTape() as tape:
            tape.watch(q)
            value = formulas.loss_of(y, q)
        gradient = tape.gradient(value, q)
        return [value] if gradient is None else [value, gradient]

    return {
        "q_network": (play, [states]),
        "optimizer": (update, [scalar, *(tf.TensorSpec(w.shape) for w in weights)]),
        "targets": (targets, [states, actions, vector, states, vector, scalar]),
        "loss": (loss, [vector, vector]),
    }


MAY_CHANGE_ON_RESUME = ("num_episodes",)
"""The fields of Config that may differ when a run is resumed. Never compared: callbacks, checkpoint_every, verbose."""


def check_is_same(
    path: Path | str, theirs: dict[str, Any], ours: dict[str, Any], may_change: Sequence[str] = ()
) -> None:
    """Raises ValueError if `path` is from another run; the message begins with the argument or field that differs.

    The seeds are compared if `ours` has one.
    """
    numbers, our_numbers = ({**x["config"], "seed": x.get("seed")} for x in (theirs, ours))
    may_change = may_change if our_numbers["seed"] is not None else (*may_change, "seed")
    for name in [name for name in our_numbers if name not in may_change]:
        if name not in numbers or numbers[name] != our_numbers[name]:
            raise ValueError(f"{name} is {numbers.get(name)!r} in {path}, got {our_numbers[name]!r}")
    can_compare = all(theirs["versions"].get(x) == ours["versions"][x] for x in ("dqn_keras", "tensorflow", "keras"))
    for name, our_part in ours["parts"].items():
        saved, here = (Part(**x) for x in (theirs["parts"].get(name, {"words": None}), our_part))
        if saved.words != here.words:
            raise ValueError(f"{name} is {saved.words!r} in {path}, got {here.words!r}")
        if can_compare and saved.computes and here.computes:
            if saved.computes != here.computes:
                raise ValueError(
                    f"{name} is {saved.words!r} in {path}, got one of that name that computes something else: "
                    "its code, or a value that it reads, has changed"
                )
        elif saved.source != here.source:
            raise ValueError(f"{name} is {saved.words!r} in {path}, got one of that name with another source")
