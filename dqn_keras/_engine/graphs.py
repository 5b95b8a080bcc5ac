"""What a traced function computes, apart from the names in it."""

import hashlib
from collections.abc import Iterator
from typing import Any


def fingerprint(concrete: Any) -> str:
    """A digest of a ConcreteFunction: its graph, constants and inner functions included, but no names.

    TensorFlow numbers the names of nodes and functions through a process, and Keras those of layers, so that the same
    code traced twice gives graphs that differ in names alone. Two functions of one fingerprint compute the same.
    """
    library = {function.signature.name: function for function in concrete.graph.as_graph_def().library.function}
    functions = [concrete.function_def]
    numbers: dict[str, int] = {}  # of the inner functions, in the order in which they are met
    digest = hashlib.sha256()
    for function in functions:  # which grows on the way
        for part in _parts(function, numbers):
            digest.update(repr(part).encode())
        functions += [library[name] for name in list(numbers)[len(functions) - 1 :]]
    return digest.hexdigest()


def _parts(function: Any, numbers: dict[str, int]) -> Iterator[Any]:
    """All that a FunctionDef says, its arguments and nodes numbered."""
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
        elif name not in ("_gradient_op_type", "_class"):  # the names of the op's gradient, and of its neighbours
            yield name, value.SerializeToString(deterministic=True)
