"""All uses of private API of TensorFlow and Keras. Each has a public fallback for versions without that API."""

import functools
import itertools
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import numpy as np

from dqn_keras._engine.tensorflow import keras, tf


@functools.cache
def can_swap_variables() -> bool:
    """Returns whether a traced function can be called with other variables than the traced ones.

    If not, a program is traced for each agent and called through the public API: slower, with the same results.
    """
    try:
        first, second = tf.Variable(1.0), tf.Variable(2.0)
        concrete = tf.function(lambda x: x * first, autograph=False).get_concrete_function(tf.TensorSpec(()))
        index = [id(x) for x in concrete.captured_inputs].index(id(first.handle))
        captured = list(concrete.captured_inputs)
        captured[index] = second.handle
        return caller(concrete)(tf.constant(3.0), *captured)[0].numpy() == 6.0
    except Exception:  # another version can raise anything
        return False


def caller(concrete: Any, functions: Sequence[Any] = ()) -> Callable[..., list[tf.Tensor]]:
    """Returns a ConcreteFunction as a function of its arguments and of all its captured tensors.

    A call of the ConcreteFunction itself first binds the arguments to a signature, which takes half as long as a
    learning step. Its `call_flat` reads TensorFlow's options at each call, which takes another fifth.

    Args:
        concrete: the function.
        functions: FunctionDefs that compute the same and are called instead: the first is the function, the others are
            those that it calls. They are never freed.
    """
    function = concrete.inference_fn
    try:
        from tensorflow.python.eager import context, execute

        eager = context.context()
        for definition in functions:
            eager.add_function_def(definition)
        options = tuple(itertools.chain(*eager.function_call_options.as_attrs().items()))
        name = functions[0].signature.name if functions else function.name.decode()
        num_outputs = len(function.function_type.flat_outputs)
        run = execute.execute
    except (ImportError, AttributeError):
        return function.call_flat
    # TensorFlow frees a traced function with its last reference; `_kept` holds one.
    kept = None if functions else function
    return lambda *tensors, _kept=kept: run(name, num_outputs, list(tensors), options, eager)


def tensor_maker() -> Callable[[np.ndarray], tf.Tensor]:
    """Returns a faster `tf.constant`, for arrays that never change: a tensor may share the memory of its array."""
    try:
        from tensorflow.python.framework.ops import EagerTensor

        if np.array_equal(EagerTensor(np.ones(2, np.float32), None, None), [1, 1]):
            return lambda array: EagerTensor(array, None, None)  # the first None: in the CPU's memory
    except Exception:  # another version can raise anything
        pass
    return tf.constant


def handle(variable: Any) -> tf.Tensor:
    """Returns the tensor with which a traced function captures a Keras or TensorFlow variable."""
    return (variable.value if isinstance(variable, keras.Variable) else variable).handle


def traced(function: Callable, specs: Sequence[tf.TensorSpec], jit_compile: bool | None = None) -> Any:
    """Traces `function` for tensors as in `specs` to a ConcreteFunction that can be freed completely.

    TensorFlow registers the gradient of every tf.custom_gradient forever, and each one keeps a whole graph alive. The
    package needs none of them again, so they are removed. Gradients in a tf.function that `function` calls stay: its
    owner may still need them.
    """
    try:
        from tensorflow.python.framework.ops import gradient_registry

        registry = gradient_registry._registry
    except (ImportError, AttributeError):  # the gradients then stay registered
        registry = {}
    before = set(registry)
    concrete = tf.function(function, jit_compile=jit_compile, autograph=False).get_concrete_function(*specs)
    if new := set(registry) - before:
        for name in new - _gradients_of_functions_called(concrete):
            del registry[name]
    return concrete


def _gradients_of_functions_called(concrete: Any) -> set[str]:
    """Returns the names of the custom gradients in the functions that a graph calls, except those in its own loops."""
    library = {function.signature.name: function for function in concrete.graph.as_graph_def().library.function}
    called, names = set(), set()
    to_do = [(concrete.function_def, False), *((function, False) for function in library.values())]
    while to_do:
        function, is_called = to_do.pop()
        for node in function.node_def:
            if is_called and "_gradient_op_type" in node.attr:
                names.add(node.attr["_gradient_op_type"].s.decode())
            if is_called or "PartitionedCall" in node.op:
                inner = [f.name for x in node.attr.values() for f in (x.func, *x.list.func) if f.name in library]
                to_do += [(library[name], True) for name in inner if name not in called]
                called.update(inner)
    return names


_prepared = itertools.count(1)


def forget_kernels_now_and_then() -> None:
    """Frees, at each 32nd call, the memory that TensorFlow keeps for deleted variables.

    TensorFlow keeps a kernel of 0.04 MB for each name that a variable has ever had, and Keras gives each new optimizer
    another name. TensorFlow makes the kernels of existing variables again when it needs them.
    """
    if next(_prepared) % 32 == 0:
        try:
            from tensorflow.python.eager import context

            context.context().clear_kernel_cache()
        except (ImportError, AttributeError):  # the kernels then stay
            pass


def all_layers(network: keras.Model) -> list[keras.layers.Layer]:
    """Returns the layers of the network, including those in nested models and in wrappers."""
    if hasattr(network, "_flatten_layers"):
        return network._flatten_layers(include_self=False)
    return walk(network)


def walk(network: keras.Model) -> list[keras.layers.Layer]:
    """Returns the same layers as `all_layers`, using only the public API."""
    layers: list[keras.layers.Layer] = []
    to_do = list(network.layers)
    while to_do:
        layer = to_do.pop(0)
        if not any(layer is x for x in layers):
            layers.append(layer)
            inner = [getattr(layer, name, None) for name in ("layer", "cell", "forward_layer", "backward_layer")]
            to_do += [*getattr(layer, "layers", []), *(x for x in inner if isinstance(x, keras.layers.Layer))]
    return layers


def is_built_for(optimizer: keras.Optimizer, variables: Sequence[keras.Variable]) -> bool:
    """Returns whether a built optimizer knows these variables; True if unknown, because Keras raises an error later."""
    try:
        optimizer._check_variables_are_known(variables)
    except ValueError:
        return False
    except AttributeError:
        pass
    return True


def is_plain_adam(optimizer: keras.Optimizer, variables: Sequence[keras.Variable]) -> bool:
    """Returns whether it is an Adam built for exactly these variables, with defaults except for the learning rate."""
    if type(optimizer) is not keras.optimizers.Adam:
        return False
    rate, built_for = getattr(optimizer, "_learning_rate", None), getattr(optimizer, "_trainable_variables", [])
    return (
        isinstance(rate, keras.Variable)
        and all(getattr(optimizer, name) == value for name, value in _PLAIN_ADAM.items())
        and not vars(optimizer).keys() & {"apply", "apply_gradients", "scale_loss", "update_step"}
        and len(built_for) == len(variables)
        and all(a is b for a, b in zip(built_for, variables, strict=True))
    )


_PLAIN_ADAM = {
    "beta_1": 0.9,
    "beta_2": 0.999,
    "epsilon": 1e-7,
    "amsgrad": False,
    "weight_decay": None,
    "clipnorm": None,
    "clipvalue": None,
    "global_clipnorm": None,
    "use_ema": False,
    "loss_scale_factor": None,
    "gradient_accumulation_steps": None,
}


def settings_of(optimizer: keras.Optimizer, variables: Sequence[keras.Variable]) -> Hashable | None:
    """Returns a key that is equal for optimizers of one of Keras' classes with the same settings.

    None if the class is not Keras' own, if an attribute is neither a setting nor Keras' own record of the variables, or
    if the optimizer was built for other variables.
    """
    built_for = getattr(optimizer, "_trainable_variables", [])
    if len(built_for) != len(variables) or any(a is not b for a, b in zip(built_for, variables, strict=True)):
        return None
    return _settings(optimizer)


def _settings(value: Any) -> Hashable | None:
    """Returns a setting with its type; None if it is not known that equal ones do the same."""
    if value is None or type(value) in (bool, int, float, str):
        return type(value), value
    if isinstance(value, keras.Variable):  # its value is an input of the program
        return tuple(value.shape), value.dtype
    if isinstance(value, list | tuple):
        items = tuple(map(_settings, value))
        return None if None in items else items
    kinds = keras.optimizers.Optimizer, keras.optimizers.schedules.LearningRateSchedule
    if not isinstance(value, kinds) or not type(value).__module__.startswith("keras."):
        return None
    names = [name for name in sorted(vars(value)) if not name.startswith("_self_") and name not in _RECORDS]
    items = tuple(_settings(vars(value)[name]) for name in names)
    return None if None in items else (type(value), tuple(names), items)


_RECORDS = {
    "name",
    "_distribution_strategy",
    "_tracker",
    "_trainable_variables",
    "_trainable_variables_indices",
    "_variables",
}


def arguments_of_compile(network: keras.Model) -> dict[str, Any]:
    """Returns the arguments of `network.compile`; empty if they are unknown."""
    return getattr(getattr(network, "_compile_config", None), "config", {})


def output_shape_of_lambda(layer: keras.layers.Lambda) -> Any:
    """Returns the output shape that a Lambda layer was given; None if it is unknown, so that Keras computes it."""
    return getattr(layer, "_output_shape", None)
