"""Checks of one transition before it is stored."""

from numbers import Real
from typing import Any

import numpy as np

from dqn_keras.checks.numbers import check_array, check_count, check_number, shown, unwrapped


def check_transition(experience: Any, state_shape: tuple[int, ...], dtype: np.dtype) -> tuple[Any, ...]:
    """Returns the five fields of a transition; raises TypeError or ValueError that names a wrong field."""
    if not isinstance(experience, list | tuple) or len(experience) != 5:
        raise TypeError(f"experience must be an Experience, or its five fields, got {shown(experience)}")
    state, action, reward, next_state, terminal_state = experience
    return (
        _check_state("state", state, state_shape, dtype),
        check_count("action", unwrapped(action), at_least=0),
        _check_reward(unwrapped(reward)),
        _check_state("next_state", next_state, state_shape, dtype),
        _check_terminal_state(unwrapped(terminal_state)),
    )


_LARGEST = float(np.finfo(np.float32).max)


def _check_state(name: str, value: Any, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    array = check_array(name, value, num_axes=len(shape))
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    with np.errstate(all="ignore"):
        state = array.astype(dtype)
    if not (np.array_equal(state, array) if dtype == np.uint8 else np.isfinite(state).all()):
        wanted = "whole numbers from 0 to 255" if dtype == np.uint8 else "finite in float32"
        raise ValueError(f"{name} must be {wanted}, got {shown(value)}")
    return state


def _check_reward(value: Any) -> float:
    reward = check_number("reward", value)
    if abs(reward) > _LARGEST:
        raise ValueError(f"reward must be finite in float32, got {shown(value)}")
    return reward


def _check_terminal_state(value: Any) -> Any:
    if not isinstance(value, Real | np.bool_) or value not in (0, 1):
        raise ValueError(f"terminal_state must be 0 or 1, or a bool, got {shown(value)}")
    return value
