"""Digests of what a traced function computes, independent of the names in it."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

from dqn_keras._engine.private import handle, traced
from dqn_keras._engine.tensorflow import tf


class Computation(NamedTuple):
    """The computation of a function, in a form that another process can compare."""

    digest: str
    """Digest that is equal for functions that compute the same; empty if the graph calls Python code."""
    other_variables: list[tf.Variable]
    """Variables that the function reads or changes, other than those given to `computation`."""


def computation(
    function: Callable, specs: Sequence[tf.TensorSpec], variables: Sequence[tf.Variable] = ()
) -> Computation:
    """Returns the computation of `function` for tensors as in `specs`; `variables` are the ones that it may use."""
    concrete = traced(function, specs)
    numbers: dict[int, Any] = {id(handle(x)): (i, tuple(x.shape)) for i, x in enumerate(variables)}
    others = [x for x in concrete.variables if id(x.handle) not in numbers]
    numbers |= {id(x.handle): ("other", i, tuple(x.shape)) for i, x in enumerate(others)}
    captured = [
        numbers.get(id(x), x.dtype.name if x.dtype == tf.resource else (x.dtype.name, x.numpy().tobytes()))
        for x in concrete.captured_inputs
    ]
    calls_python = any("PyFunc" in node.op for function in _functions(concrete) for node in function.node_def)
    digest = hashlib.sha256(repr((fingerprint(concrete), captured)).encode()).hexdigest()[:12]
    return Computation("" if calls_python else digest, others)


def fingerprint(concrete: Any) -> str:
    """Returns a digest of the graph, constants and inner functions of a ConcreteFunction, without names.

    TensorFlow numbers nodes and functions across a process, and Keras numbers layers. The same code traced twice
    therefore gives graphs that differ only in names. Two functions with the same fingerprint compute the same.
    """
    first, *others = _functions(concrete)
    library = {function.signature.name: function for function in others}
    functions = [first]
    numbers: dict[str, int] = {}  # of the inner functions, in the order of first use
    digest = hashlib.sha256()
    for function in functions:  # the list grows inside the loop
        for part in _parts(function, numbers):
            digest.update(repr(part).encode())
        functions += [library[name] for name in list(numbers)[len(functions) - 1 :]]
    return digest.hexdigest()


def _functions(concrete: Any) -> list[Any]:
    """Returns the FunctionDefs of the function and of all functions that it may call."""
    return [concrete.function_def, *concrete.graph.as_graph_def().library.function]


def _parts(function: Any, numbers: dict[str, int]) -> Iterator[Any]:
    """Yields the contents of a FunctionDef, with numbers in place of the names of arguments and nodes."""
    names = {x.name: i for i, x in enumerate([*function.signature.input_arg, *function.node_def])}

    def reference(text: str) -> Any:  # "NAME", "NAME:OUTPUT:INDEX", or "^NAME"
        name, *output = text.lstrip("^").split(":")
        return text[0] == "^", names[name], output

    for argument in (*function.signature.input_arg, *function.signature.output_arg):
        yield argument.type, argument.type_list_attr, argument.number_attr
    for node in function.node_def:
        yield node.op, node.device, [reference(x) for x in node.input], list(_attributes(node.attr, numbers))
    for argument in function.signature.output_arg:
        yield reference(function.ret[argument.name])
    yield sorted(map(reference, function.control_ret.values()))
    yield list(_attributes(function.attr, numbers))


def _attributes(attributes: Any, numbers: dict[str, int]) -> Iterator[Any]:
    for name in sorted(attributes):
        value = attributes[name]
        functions = [value.func] if value.HasField("func") else list(value.list.func)
        if functions:
            yield (
                name,
                [(numbers.setdefault(f.name, len(numbers)), list(_attributes(f.attr, numbers))) for f in functions],
            )
        elif name not in ("_gradient_op_type", "_class"):  # the names of the op's gradient, and of ops beside it
            yield name, value.SerializeToString(deterministic=True)
