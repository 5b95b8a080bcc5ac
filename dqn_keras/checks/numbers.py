"""Checks of single values: each returns the value in its own type, or raises an error that names it."""

import math
import os
from collections.abc import Sequence
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

LARGEST_COUNT = 2**31 - 1


def shown(value: Any) -> str:
    """Returns `repr(value)` for an error message, on one line; leaves out the middle of a long text."""
    try:
        with np.printoptions(threshold=20, edgeitems=2):
            text = repr(value)
    except Exception:  # for example, a whole number with more digits than Python converts
        return f"a value of type {type(value).__name__} that cannot be printed"
    if "\n" in text:  # arrays
        text = " ".join(text.split())
    if len(text) <= _LONGEST:
        return text
    shape = f" of shape {value.shape}" if isinstance(value, np.ndarray) else ""
    return f"{text[: _LONGEST - 50]} ... {text[-20:]} ({type(value).__name__}{shape})"


_LONGEST = 200


def check_count(name: str, value: Any, at_least: int = 1) -> int:
    """Returns the whole number `value` as an int; otherwise raises TypeError or ValueError that names it."""
    # For an int, the first test is enough and takes a tenth of the time: `sample_rows` runs at every update.
    is_whole = type(value) is int or (isinstance(value, Integral) and not isinstance(value, bool))
    if is_whole and at_least <= int(value) <= LARGEST_COUNT:
        return int(value)
    message = f"{name} must be a whole number from {at_least} to {LARGEST_COUNT}, got {shown(value)}"
    raise ValueError(message) if is_whole else TypeError(message)


def check_number(
    name: str, value: Any, *, above: float | None = None, at_least: float | None = None, at_most: float | None = None
) -> float:
    """Returns the finite number `value` as a float; otherwise raises TypeError or ValueError that names it."""
    limits = [("above", above), ("at least", at_least), ("at most", at_most)]
    wanted = f"{name} must be a finite number " + ", ".join(f"{word} {x}" for word, x in limits if x is not None)
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise TypeError(f"{wanted.rstrip()}, got {shown(value)}")
    try:
        converted = float(value)
    except OverflowError:  # a whole number too large for a float
        converted = math.inf
    if (
        not math.isfinite(converted)
        or (above is not None and converted <= above)
        or (at_least is not None and converted < at_least)
        or (at_most is not None and converted > at_most)
    ):
        raise ValueError(f"{wanted.rstrip()}, got {shown(value)}")
    return converted


def unwrapped(value: Any) -> Any:
    """Returns the number in an array or tensor without axes; returns any other value unchanged."""
    has_no_axes = hasattr(value, "__array__") and getattr(value, "shape", None) == ()
    return np.asarray(value)[()] if has_no_axes else value


def check_sequence(name: str, values: Any, what: str) -> list:
    """Returns a list, tuple, range or array of one axis as a list; otherwise raises TypeError."""
    if isinstance(values, np.ndarray) and values.ndim == 1:
        return list(values)
    if isinstance(values, str | bytes | bytearray | memoryview) or not isinstance(values, Sequence):
        raise TypeError(f"{name} must be a list or tuple of {what}, got {shown(values)}")
    return list(values)


def check_counts(name: str, values: Any) -> tuple[int, ...]:
    """Returns a sequence of whole numbers above 0 as a tuple of ints; otherwise raises TypeError or ValueError."""
    numbers = check_sequence(name, values, "whole numbers")
    if not numbers:
        raise ValueError(f"{name} must hold at least one whole number, got {shown(values)}")
    return tuple(check_count(f"{name}[{i}]", value) for i, value in enumerate(numbers))


def check_flag(name: str, value: Any) -> bool:
    """Returns True or False as a bool; otherwise raises TypeError."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name} must be True or False, got {shown(value)}")
    return bool(value)


def check_choice(name: str, value: Any, choices: Sequence[str]) -> str:
    """Returns `value` if it is one of the words in `choices`; otherwise raises ValueError."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {shown(value)}")
    return value


def check_instance(name: str, value: Any, kind: Any, what: str) -> None:
    """Raises TypeError unless `value` is of the class `kind`, described by `what`."""
    if not isinstance(value, kind):
        raise TypeError(f"{name} must be {what}, got {shown(value)}")


def check_rng(rng: Any) -> None:
    """Raises TypeError unless `rng` is a NumPy random generator."""
    check_instance("rng", rng, np.random.Generator, "a numpy.random.Generator, such as numpy.random.default_rng(seed)")


def check_path(name: str, value: Any) -> Path:
    """Returns the path of a file or a folder; otherwise raises TypeError or ValueError."""
    text = os.fspath(value) if isinstance(value, str | os.PathLike) else None
    if not isinstance(text, str):
        raise TypeError(f"{name} must be a path, as a string or a pathlib.Path, got {shown(value)}")
    if not text or "\0" in text:
        raise ValueError(f"{name} must be a path that is not empty and has no NUL character, got {shown(value)}")
    return Path(text)


def check_array(name: str, value: Any, num_axes: int | None = None) -> np.ndarray:
    """Returns an array, a tensor or nested lists of real numbers as a NumPy array.

    Raises:
        TypeError: `value` is not an array of real numbers.
        ValueError: it does not have `num_axes` axes (None allows any number).
    """
    try:
        array = np.asarray(value)
    except Exception:  # lists of unequal lengths, or an object of any library
        array = np.asarray(None)
    if array.dtype.kind not in "iuf" or isinstance(value, bytes | bytearray):
        raise TypeError(f"{name} must be an array of numbers, got {shown(value)}")
    if num_axes not in (None, array.ndim):
        axes = "one axis" if num_axes == 1 else f"{num_axes} axes"
        raise ValueError(f"{name} must have {axes}, got shape {array.shape}")
    return array
