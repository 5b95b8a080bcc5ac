"""Checks of single numbers: each returns the number in its own type, or raises an error that names it."""

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

LARGEST_COUNT = 2**31 - 1


def check_count(name: str, value: Any, at_least: int = 1) -> int:
    """Returns the whole number `value` as an int; otherwise raises TypeError or ValueError that names it."""
    wanted = f"{name} must be a whole number from {at_least} to {LARGEST_COUNT}"
    if isinstance(value, bool | np.bool_) or not isinstance(value, Integral):
        raise TypeError(f"{wanted}, got {value!r}")
    if not at_least <= int(value) <= LARGEST_COUNT:
        raise ValueError(f"{wanted}, got {value!r}")
    return int(value)


def check_number(
    name: str, value: Any, *, above: float | None = None, at_least: float | None = None, at_most: float | None = None
) -> float:
    """Returns the finite number `value` as a float; otherwise raises TypeError or ValueError that names it."""
    limits = [("above", above), ("at least", at_least), ("at most", at_most)]
    wanted = f"{name} must be a finite number " + ", ".join(f"{word} {x}" for word, x in limits if x is not None)
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real):
        raise TypeError(f"{wanted.rstrip()}, got {value!r}")
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
        raise ValueError(f"{wanted.rstrip()}, got {value!r}")
    return converted


def check_counts(name: str, values: Any) -> tuple[int, ...]:
    """Returns a sequence of whole numbers above 0 as a tuple of ints; otherwise raises TypeError or ValueError."""
    if isinstance(values, np.ndarray) and values.ndim == 1:
        values = list(values)
    if isinstance(values, str | bytes) or not isinstance(values, Sequence):
        raise TypeError(f"{name} must be a tuple of whole numbers, got {values!r}")
    if not values:
        raise ValueError(f"{name} must hold at least one whole number, got {values!r}")
    return tuple(check_count(f"{name}[{i}]", value) for i, value in enumerate(values))
