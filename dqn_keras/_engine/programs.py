"""Compiled programs, which agents with the package's own networks and a plain Adam share.

TensorFlow traces a function for particular variables, and the code that XLA compiles for a trace is never freed: a
second agent would cost seconds of compilation and megabytes of memory. Therefore a program for networks that the
package made is traced once, on a *stand-in* of the same sizes, and then called with the variables of any agent. A
network or optimizer of the user is never rebuilt: its program is traced on the objects themselves. In a study, seeds
share it if the package made their networks and their optimizers are Keras' own with equal settings.
"""

import contextlib
import re
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, NamedTuple

from dqn_keras._engine.graphs import fingerprint, renamed
from dqn_keras._engine.layers import FewInputsDense, FewOutputsDense
from dqn_keras._engine.made_here import units_if_made_here
from dqn_keras._engine.private import (
    caller,
    can_swap_variables,
    forget_kernels_now_and_then,
    handle,
    is_built_for,
    is_plain_adam,
    settings_of,
    traced,
)
from dqn_keras._engine.tensorflow import keras, require_xla, tf
from dqn_keras.checks.networks import check_optimizer, check_pair
from dqn_keras.networks import make_q_network


class Learner(NamedTuple):
    """The three objects that a learning step changes."""

    q_network: keras.Model
    q_hat_network: keras.Model
    optimizer: keras.Optimizer

    @property
    def variables(self) -> list[keras.Variable]:
        """All variables of the three objects, in an order that depends only on how they were made."""
        return [*self.q_network.variables, *self.q_hat_network.variables, *self.optimizer.variables]

    def prepare(self) -> None:
        """Checks that the three belong together, and builds the optimizer."""
        q_network, q_hat_network, optimizer = self
        check_optimizer(optimizer)
        check_pair(q_network, q_hat_network)
        if not q_network.trainable_variables:
            raise ValueError("q_network must have weights that can be trained, got none")
        if not optimizer.built:
            forget_kernels_now_and_then()
            optimizer.build(q_network.trainable_variables)
        if not is_built_for(optimizer, q_network.trainable_variables):
            raise ValueError(
                f"optimizer must be new or built for this q_network, got {optimizer.name!r}, which was built for other "
                "variables"
            )

    def sizes(self) -> tuple[int, ...] | None:
        """Returns the layer sizes if the package made the networks and the optimizer is a plain Adam; else None."""
        units = units_if_made_here(self.q_network)
        if units is None or units != units_if_made_here(self.q_hat_network):
            return None
        return units if is_plain_adam(self.optimizer, self.q_network.trainable_variables) else None

    def kind(self) -> Hashable | None:
        """Returns a key that is equal for learners that compute the same.

        None if that is not known, because a network or the class of the optimizer is the user's.
        """
        units = units_if_made_here(self.q_network)
        settings = settings_of(self.optimizer, self.q_network.trainable_variables)
        if units is None or units != units_if_made_here(self.q_hat_network) or settings is None:
            return None
        return units, settings


class Actor(NamedTuple):
    """A network that acts and does not learn."""

    q_network: keras.Model

    @property
    def variables(self) -> list[keras.Variable]:
        """The network's variables."""
        return self.q_network.variables

    def sizes(self) -> tuple[int, ...] | None:
        """Returns the layer sizes if the package made the network; else None."""
        return units_if_made_here(self.q_network)

    def kind(self) -> Hashable | None:
        """Returns the same."""
        return self.sizes()


def stand_in(units: Sequence[int], jit_compile: bool) -> Learner:
    """Returns two new networks with these layer sizes, from states to actions, and a new Adam."""
    num_features, *hidden_units, num_actions = units

    def make() -> keras.Sequential:
        network = make_q_network(num_features, num_actions, hidden_units, seed=0)
        layers = network.layers
        if jit_compile and hidden_units and num_features <= _FEW_INPUTS:
            layers[0] = FewInputsDense.from_config(layers[0].get_config())
        if jit_compile and 1 < num_actions <= _FEW_OUTPUTS:
            layers[-1] = FewOutputsDense.from_config(layers[-1].get_config())
        return keras.Sequential([keras.Input((num_features,)), *layers])

    learner = Learner(make(), make(), keras.optimizers.Adam())
    learner.prepare()
    return learner


_FEW_INPUTS = _FEW_OUTPUTS = 4


class _Program(NamedTuple):
    function: Callable[..., list[tf.Tensor]]
    """The compiled function, called with its arguments followed by `captured`."""
    captured: list[int | tf.Tensor]
    """Inputs that follow the arguments: each is the number of a variable, or a constant."""


_shared: dict[Hashable, _Program] = {}


_of_this_study: dict[Hashable, _Program] | None = None


_compiled: dict[Hashable, Callable[..., list[tf.Tensor]]] = {}
"""All traced functions, by fingerprint: the code that XLA compiled for them stays in memory anyway."""


@contextlib.contextmanager
def shared_in(programs: dict) -> Iterator[None]:
    """Shares programs with parts of the user through `programs` in the block, for runs that differ only in the seed."""
    global _of_this_study
    before, _of_this_study = _of_this_study, programs
    try:
        yield
    finally:
        _of_this_study = before


def bind(
    make_function: Callable[[Any, Sequence[tf.Variable]], Callable],
    specs: Sequence[tf.TensorSpec],
    learner: Learner | Actor,
    variables: Sequence[tf.Variable] = (),
    *,
    key: Hashable,
    has_own_parts: bool,
    jit_compile: bool,
) -> Callable[..., list[tf.Tensor]]:
    """Returns a compiled function that reads and changes `learner` and `variables`: tensors -> list of outputs.

    Args:
        make_function: returns a function of tensors as in `specs`, given a learner and further variables.
        specs: shapes and dtypes of the arguments.
        learner: the agent's networks and optimizer, or only a network that acts.
        variables: further tf.Variables that the function changes.
        key: distinguishes the functions that `make_function` can make for learners of the same sizes.
        has_own_parts: whether the function calls code of the user other than the learner. If so, it is traced again
            at each call of `bind`; in a study, once.
        jit_compile: whether XLA compiles the function.
    """
    if jit_compile:
        require_xla()
    if not can_swap_variables():
        return _trace_the_public_way(make_function, specs, learner, variables, jit_compile)
    sizes = learner.sizes()
    kind = sizes or learner.kind()
    if kind is None:
        program = _trace(make_function, specs, learner, variables, jit_compile)
    else:
        programs = _shared if sizes and not has_own_parts else {} if _of_this_study is None else _of_this_study
        key = (key, kind, tuple(specs), tuple((v.shape, v.dtype) for v in variables), jit_compile)
        if key not in programs:
            model, extra = learner, variables
            if sizes:
                extra = [tf.Variable(tf.zeros_like(v)) for v in variables]
                model = stand_in(sizes, jit_compile)
                model = model if isinstance(learner, Learner) else Actor(model.q_network)
            programs[key] = _trace(make_function, specs, model, extra, jit_compile)
        program = programs[key]
    handles = _handles(learner, variables)
    captured = [handles[x] if isinstance(x, int) else x for x in program.captured]
    call = lambda *tensors, _kept=program: program.function(*tensors, *captured)  # noqa: E731
    return call if sizes is not None else _naming_unsupported_operations(call)


def _trace_the_public_way(
    make_function: Callable,
    specs: Sequence,
    learner: Learner | Actor,
    variables: Sequence[tf.Variable],
    jit_compile: bool,
) -> Callable[..., list[tf.Tensor]]:
    concrete = _traced(make_function(learner, variables), specs, jit_compile)
    return _naming_unsupported_operations(lambda *tensors: tf.nest.flatten(concrete(*tensors)))


def _naming_unsupported_operations(call: Callable) -> Callable:
    def checked(*tensors: tf.Tensor) -> list[tf.Tensor]:
        try:
            return call(*tensors)
        except tf.errors.OpError as error:  # the first call compiles
            if "unsupported operations" not in error.message:
                raise
            operations = ", ".join(sorted(set(re.findall(r"No registered '(\w+)'", error.message))))
            raise ValueError(
                "jit_compile must be False for this network, optimizer, targets or loss: XLA cannot compile "
                f"{operations}"
            ) from error

    return checked


def _trace(
    make_function: Callable,
    specs: Sequence,
    learner: Learner | Actor,
    variables: Sequence[tf.Variable],
    jit_compile: bool,
) -> _Program:
    """Traces the program on exactly these objects. If an equal program was compiled before, that one is used."""
    concrete = _traced(make_function(learner, variables), specs, jit_compile)
    numbers = {id(handle): i for i, handle in enumerate(_handles(learner, variables))}
    captured = [numbers.get(id(x), x) for x in concrete.captured_inputs]
    digest = fingerprint(concrete)
    if (digest, jit_compile) not in _compiled:
        functions = renamed(concrete, f"dqn_keras_{digest}") if jit_compile else ()
        _compiled[digest, jit_compile] = caller(concrete, functions)
    return _Program(_compiled[digest, jit_compile], captured)


def _traced(function: Callable, specs: Sequence, jit_compile: bool) -> Any:
    try:
        return traced(function, specs, jit_compile)
    except ValueError as error:
        if "No gradients provided" not in str(error):
            raise
        raise ValueError(
            "loss must depend on q through operations that TensorFlow can differentiate: q_network gets no gradient"
        ) from error


def _handles(learner: Learner | Actor, variables: Sequence[tf.Variable]) -> list[tf.Tensor]:
    return [handle(variable) for variable in (*learner.variables, *variables)]
