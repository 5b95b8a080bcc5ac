"""What a traced function computes, independent of the names that TensorFlow and Keras gave to its parts."""

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


def renamed(concrete: Any, name: str) -> list[Any]:
    """Returns the FunctionDefs of a ConcreteFunction and of the functions that it calls, with names of our own.

    The first is called `name`, and the others get a number in the order of first use. So the same code traced in
    another process gives the same FunctionDefs, and XLA's cache on disk, which includes the names, has its program.
    """
    library = {function.signature.name: function for function in _functions(concrete)}
    numbers = {concrete.function_def.signature.name: 0}
    functions: list[Any] = []
    while len(functions) < len(numbers):  # the dict grows inside the loop
        functions.append(_renamed(library[list(numbers)[len(functions)]], numbers, name))
    return functions


def _renamed(function: Any, numbers: dict[str, int], prefix: str) -> Any:
    new = type(function)()
    new.CopyFrom(function)
    names = {x.name: f"argument_{i}" for i, x in enumerate(new.signature.input_arg)}
    names |= {x.name: f"{x.op}_{i}" for i, x in enumerate(new.node_def)}
    outputs = {x.name: f"output_{i}" for i, x in enumerate(new.signature.output_arg)}

    def reference(text: str) -> str:  # "NAME", "NAME:OUTPUT:INDEX", or "^NAME"
        caret = text[: text.startswith("^")]
        name, colon, output = text[len(caret) :].partition(":")
        return caret + names[name] + colon + output

    def rename_in(attributes: Any) -> None:
        for key in sorted(attributes):
            if key in _NAMES:
                del attributes[key]
                continue
            for called in _called(attributes[key]):
                called.name = numbered(called.name)
                rename_in(called.attr)

    def numbered(name: str) -> str:
        number = numbers.setdefault(name, len(numbers))
        return f"{prefix}_{number}" if number else prefix

    new.signature.name = numbered(new.signature.name)
    for x in (*new.signature.input_arg, *new.node_def):
        x.name = names[x.name]
    for x in new.signature.output_arg:
        x.name = outputs[x.name]
    for node in new.node_def:
        node.input[:] = map(reference, node.input)
        node.ClearField("experimental_debug_info")
    for attributes in (*(node.attr for node in new.node_def), *(x.attr for x in new.arg_attr.values()), new.attr):
        rename_in(attributes)
    new.ret.clear()
    new.ret.update({outputs[key]: reference(value) for key, value in function.ret.items()})
    new.control_ret.clear()
    new.control_ret.update({names[x]: names[x] for x in function.control_ret.values()})
    new.signature.control_output[:] = sorted(new.control_ret)
    return new


_NAMES = ("_gradient_op_type", "_class", "_user_specified_name")
"""Attributes that hold names: of an operation's gradient, of operations beside it, and of an argument."""


def _called(attribute: Any) -> list[Any]:
    """Returns the functions that an attribute names."""
    return [attribute.func] if attribute.HasField("func") else list(attribute.list.func)


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
        if functions := _called(attributes[name]):
            yield (
                name,
                [(numbers.setdefault(f.name, len(numbers)), list(_attributes(f.attr, numbers))) for f in functions],
            )
        elif name not in _NAMES:
            yield name, attributes[name].SerializeToString(deterministic=True)
