"""Compiled programs, shared by all agents of one shape.

TensorFlow traces and XLA compiles a function for the very variables that it names, and neither is ever freed: a second
agent would cost a second of compilation and megabytes that stay. So a program is traced on a *template*, networks
and optimizer of the same configuration, and then called with the variables of any agent like it in their place.
"""

import json
from collections.abc import Callable, Hashable, Sequence
from numbers import Real
from types import FunctionType
from typing import Any, NamedTuple

from dqn_keras._tensorflow import keras, require_xla, tf
from dqn_keras.networks import clone, structure


class Learner(NamedTuple):
    """The three that a learning step changes."""

    q_network: keras.Model
    q_hat_network: keras.Model
    optimizer: keras.Optimizer

    @property
    def variables(self) -> list[keras.Variable]:
        """All that they hold, in an order that their configuration fixes."""
        return [*self.q_network.variables, *self.q_hat_network.variables, *self.optimizer.variables]

    def prepare(self) -> None:
        """Check that the networks belong together, and build the optimizer."""
        q_network, q_hat_network, optimizer = self
        if not isinstance(optimizer, keras.Optimizer):
            raise TypeError(f"optimizer must be a Keras optimizer, got {optimizer!r}")
        if q_network is q_hat_network:
            raise ValueError("q_hat_network must be a second network, got q_network itself")
        shapes, hat_shapes = ([tuple(w.shape) for w in n.weights] for n in (q_network, q_hat_network))
        if shapes != hat_shapes:
            raise ValueError(f"q_hat_network must have weights of q_network's shapes {shapes}, got {hat_shapes}")
        if not optimizer.built:
            optimizer.build(q_network.trainable_variables)
        optimizer._check_variables_are_known(q_network.trainable_variables)  # else ValueError, in Keras' words

    def template(self, jit_compile: bool) -> "Learner":
        """New ones of the same configuration, with variables of their own."""
        clone_layer = _clone_for_xla if jit_compile else None
        q_network, q_hat_network = (clone(network, clone_layer) for network in self[:2])
        optimizer = type(self.optimizer).from_config(self.optimizer.get_config())
        optimizer.build(q_network.trainable_variables)
        return Learner(q_network, q_hat_network, optimizer)

    def configuration(self) -> Hashable:
        """Equal for two learners that one program can serve. Weights and the learning rate are not part of it."""
        optimizer_config = self.optimizer.get_config()
        if isinstance(optimizer_config.get("learning_rate"), Real):
            del optimizer_config["learning_rate"]  # a variable
        del optimizer_config["name"]
        variables = [(tuple(v.shape), v.dtype, v.trainable) for v in self.variables]
        networks = self.q_network, self.q_hat_network
        return (
            *map(structure, networks),
            *(_code(layer) for network in networks for layer in network._flatten_layers(include_self=False)),
            type(self.optimizer),
            json.dumps(optimizer_config, sort_keys=True, default=repr),
            tuple(variables),
        )


def _code(layer: keras.layers.Layer) -> Hashable:
    """A class or function of the reader's own may be defined anew under its name, as in a cell that is run again."""
    activation = getattr(layer, "activation", None)
    return type(layer), activation if isinstance(activation, FunctionType) else None


def _clone_for_xla(layer: keras.layers.Layer) -> keras.layers.Layer:
    is_narrow = type(layer) is keras.layers.Dense and 1 < layer.units <= 4 and layer.compute_dtype == "float32"
    return (_NarrowDense if is_narrow else type(layer)).from_config(layer.get_config())


class _NarrowDense(keras.layers.Dense):
    """Keras' Dense for a few outputs, such as the values of a few actions; only its gradient is written otherwise.

    TensorFlow's gradient is two products with a transposed matrix, for which XLA has only slow loops where the
    matrix is so narrow: a third of a whole learning step of the 4-64-2 network.
    """

    def call(self, inputs: tf.Tensor, training: bool | None = None) -> tf.Tensor:
        if len(inputs.shape) != 2 or inputs.dtype != self.compute_dtype:
            return super().call(inputs, training)
        outputs = _narrow_product(tf.convert_to_tensor(inputs), tf.convert_to_tensor(self.kernel))
        if self.use_bias:
            outputs += self.bias
        return outputs if self.activation is None else self.activation(outputs)


@tf.custom_gradient
def _narrow_product(x: tf.Tensor, kernel: tf.Tensor) -> tuple[tf.Tensor, Callable]:
    """The product of x [B, U] and kernel [U, A], and its gradient as a sum over the A columns."""

    def gradient(dy: tf.Tensor) -> tuple[tf.Tensor, tf.Tensor]:  # [B, A]
        columns = range(kernel.shape[1])
        dx = sum(dy[:, a, None] * kernel[None, :, a] for a in columns)  # [B, U]
        return dx, tf.stack([tf.reduce_sum(x * dy[:, a, None], axis=0) for a in columns], axis=1)

    return x @ kernel, gradient


class _Program(NamedTuple):
    function: Any
    captured: list[int | tf.Tensor]
    """What the function takes beside its arguments: the number of a variable, or a constant."""
    kept_alive: Any


_programs: dict[Hashable, _Program] = {}


def bind(
    key: Hashable,
    make_function: Callable[[Learner, list[tf.Variable]], Callable],
    specs: Sequence[tf.TensorSpec],
    learner: Learner,
    variables: Sequence[tf.Variable] = (),
    *,
    jit_compile: bool,
) -> Callable[..., list[tf.Tensor]]:
    """A compiled function of tensors that reads and changes `learner` and `variables`: tensors -> flat outputs.

    Args:
        key: tells apart the functions that `make_function` can make for one configuration of the learner.
        make_function: the template and its extra variables -> a function of tensors as in `specs`.
        specs: of the arguments.
        learner: the agent's own.
        variables: further tf.Variables that the function changes.
        jit_compile: by XLA.
    """
    key = (key, learner.configuration(), tuple(specs), jit_compile)
    if key not in _programs:
        if jit_compile:
            require_xla()
        template, extra = learner.template(jit_compile), [tf.Variable(tf.zeros_like(v)) for v in variables]
        if [v.shape for v in template.variables] != [v.shape for v in learner.variables]:
            raise ValueError("optimizer must be built for q_network's trainable variables, all of them and no other")
        function = tf.function(make_function(template, extra), jit_compile=jit_compile, autograph=False)
        concrete = function.get_concrete_function(*specs)
        numbers = {id(handle): i for i, handle in enumerate(_handles(template, extra))}
        captured = [numbers.get(id(x), x) for x in concrete.captured_inputs]
        _programs[key] = _Program(concrete.inference_fn, captured, (concrete, template, extra))
    program, handles = _programs[key], _handles(learner, variables)
    captured = [handles[x] if isinstance(x, int) else x for x in program.captured]
    # Calling the ConcreteFunction would first bind its arguments to a signature, which takes half as long as a step.
    call_flat = program.function.call_flat
    return lambda *tensors: call_flat(*tensors, *captured)


def _handles(learner: Learner, variables: Sequence[tf.Variable]) -> list[tf.Tensor]:
    return [*(v.value.handle for v in learner.variables), *(v.handle for v in variables)]
