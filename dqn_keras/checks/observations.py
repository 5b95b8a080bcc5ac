"""Observations and rewards as numbers: conversions, and warnings of likely mistakes."""

import inspect
import warnings
from collections.abc import Generator, Iterator
from typing import Any, SupportsFloat

import numpy as np

from dqn_keras.agent import Agent, DivergedError
from dqn_keras.checks.numbers import shown
from dqn_keras.config import Config
from dqn_keras.metrics import Episode


def as_numbers(value: Any) -> np.ndarray | None:
    """Returns `value` as an array of real numbers; None for text, dates, objects and partly masked arrays."""
    if isinstance(value, np.ma.MaskedArray) and np.ma.is_masked(value):
        return None
    try:
        array = np.asarray(value)
    except Exception:  # whatever the array's own library raises
        return None
    return array if np.can_cast(array.dtype, np.float32, "same_kind") else None


def check_state(name: str, value: Any, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Returns one state as an array of this shape and dtype (float32 or uint8).

    Raises:
        TypeError: `value` is not an array of numbers.
        ValueError: it has another shape, a value that is not finite in float32, or another dtype than uint8 where the
            states are uint8.
    """
    numbers = as_numbers(value)
    if numbers is None:
        raise TypeError(f"{name} must be an array of numbers, got {shown(value)}")
    if numbers.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {numbers.shape}")
    if dtype == np.uint8 != numbers.dtype:
        raise ValueError(f"{name} must be of dtype uint8, as the observations of env, got {numbers.dtype}")
    with np.errstate(over="ignore"):
        state = numbers.astype(dtype)
    if not np.isfinite(state).all():
        raise ValueError(f"{name} must be finite in float32, got {shown(value)}")
    return state


def as_float(value: Any) -> float | None:
    """Returns a single number, also one in an array without axes, as a float; None for any other value."""
    if type(value) not in _NUMBERS:
        if hasattr(value, "dtype"):
            array = as_numbers(value)
            if array is None or array.shape:
                return None
        elif not isinstance(value, SupportsFloat):
            return None
    try:
        return float(value)
    except OverflowError:  # a whole number too large for a float
        return np.inf
    except ValueError:  # for example, a signaling NaN of decimal
        return np.nan


_NUMBERS = frozenset({float, int, bool, np.float64, np.float32, np.int64, np.int32})


def feature_name(state_shape: tuple[int, ...], i: int) -> str:
    """Returns the name of entry `i` of a flat state: "feature 3", or "feature (0, 3)" if states have several axes."""
    index = tuple(map(int, np.unravel_index(i, state_shape)))
    return f"feature {index[0] if len(index) == 1 else index}"


class StateWatch:
    """Looks at the first 1,000 states of a run, and warns once of each likely mistake in them.

    Args:
        name: the environment's name.
        space: its observation space, a Box.
        is_default_network: whether the package made the network; a network of the user may scale its input.
    """

    def __init__(self, name: str, space: Any, is_default_network: bool) -> None:
        self._name, self._space, self._is_default_network = name, space, is_default_network
        self._num_to_see, self._has_warned_of_mask = _NUM_STATES, False
        self._precise: list[np.ndarray] = []  # observations that float32 may round
        self._num_precise = min(_NUM_STATES, _MOST_NUMBERS // space.low.size)

    def see(self, observation: np.ndarray, info: Any) -> bool:
        """Looks at one observation, not yet rounded to float32, and its info; returns whether it wants the next one."""
        if not self._has_warned_of_mask and isinstance(info, dict) and "action_mask" in info:
            self._has_warned_of_mask = True
            self._warn("info['action_mask'] is ignored: any action may be taken in any state")
        if len(self._precise) < self._num_precise and not np.can_cast(observation.dtype, np.float32):
            self._precise.append(np.array(observation, np.float64).ravel())
        self._num_to_see -= 1
        return self._num_to_see > 0

    def over(self, episodes: Iterator[Episode], agent: Agent, config: Config) -> Generator[Episode, None, None]:
        """Yields the same episodes, and looks at the agent's memory once: after 1,000 states, or at the end."""
        before, is_done = agent.memory.num_appended, False
        try:
            for episode in episodes:
                if not is_done and (agent.memory.num_appended - before >= _NUM_STATES or agent.is_done(config)):
                    is_done = True
                    self._look(agent)
                yield episode
        except DivergedError:
            if not is_done:
                self._look(agent)
            raise

    def _look(self, agent: Agent) -> None:
        rows, size = agent.memory.rows[: min(len(agent.memory), _NUM_STATES)], self._space.low.size
        both = rows[:, : 2 * size]  # each state and the next
        lowest, highest = (x.reshape(2, size).astype(np.float64) for x in (both.min(axis=0), both.max(axis=0)))
        self._warn_of_bounds(lowest.min(axis=0), highest.max(axis=0))
        if self._is_default_network:
            self._warn_of_scale(np.abs([lowest, highest]).max(axis=(0, 1)), rows.dtype == np.uint8)
        if len(self._precise) > 1:
            self._warn_of_rounding(np.stack(self._precise))

    def _warn_of_bounds(self, lowest: np.ndarray, highest: np.ndarray) -> None:
        """Warns of a feature that is outside its bounds by more than ten times the distance between them.

        With only one bound, the limit is ten times its size, or 10 if that is more. Gymnasium's own environments exceed
        their bounds by less: LunarLander-v3 by up to six times the distance.
        """
        low, high = (x.astype(np.float64).ravel() for x in (self._space.low, self._space.high))
        one = 10 * np.maximum(1, np.minimum(np.abs(low), np.abs(high)))
        with np.errstate(over="ignore", invalid="ignore"):
            far = np.where(np.isfinite(high - low) & (high > low), 10 * (high - low), one)
            beyond = np.nan_to_num(np.maximum(low - lowest, highest - high) / far)
        i = int(beyond.argmax())
        if beyond[i] > 1:
            value = lowest[i] if low[i] - lowest[i] > highest[i] - high[i] else highest[i]
            self._warn(
                f"{self._feature(i)} was {value:g} in an observation, far outside the bounds {low[i]:g} and "
                f"{high[i]:g} of env.observation_space: one of the two is wrong"
            )

    def _warn_of_scale(self, largest: np.ndarray, is_uint8: bool) -> None:
        """Warns of inputs to the default network that are much larger than 1."""
        features = np.flatnonzero(largest > (1 if is_uint8 else _LARGE))
        if not len(features):
            return
        names = ", ".join(self._feature(i) for i in features[:3]) + (", ..." if len(features) > 3 else "")
        self._warn(
            f"observations are {'uint8' if is_uint8 else f'beyond {_LARGE} in size'} ({names}), but the default "
            "network learns well only from inputs of about the size of 1: scale them with keras.layers.Rescaling or "
            "keras.layers.Normalization in a q_network of your own, or with gymnasium.wrappers.RescaleObservation or "
            "TransformObservation"
        )

    def _warn_of_rounding(self, precise: np.ndarray) -> None:
        """Warns of a feature that float32 rounds to too few different numbers.

        This is the case if its range has fewer than 1,000 steps of float32, and float32 loses a tenth of its changes
        from one state to the next. A range as small as the rounding of float64 does not count.
        """
        span, size = np.ptp(precise, axis=0), np.abs(precise).max(axis=0)
        is_coarse = (span > 1e-12 * size) & (span < 1_000 * np.spacing(size.astype(np.float32)))
        is_change = np.diff(precise, axis=0) != 0
        is_lost = is_change & (np.diff(precise.astype(np.float32), axis=0) == 0)
        features = np.flatnonzero(is_coarse & (is_lost.sum(axis=0) > is_change.sum(axis=0) / 10))
        if len(features):
            i = int(features[0])
            self._warn(
                f"{self._feature(i)} of the observations changes in steps that are lost in float32, the dtype of "
                f"stored states (it is about {size[i]:.1e}): subtract an offset from it, and then scale it, in a "
                "gymnasium.wrappers.TransformObservation"
            )

    def _feature(self, i: int) -> str:
        return feature_name(self._space.shape, i)

    def _warn(self, message: str) -> None:
        """Warns at the line of code outside this package that started the run."""
        frame, level = inspect.currentframe(), 1
        while frame is not None and frame.f_globals.get("__name__", "").partition(".")[0] == "dqn_keras":
            frame, level = frame.f_back, level + 1
        warnings.warn(f"env {self._name}: {message}", stacklevel=level)


_NUM_STATES = 1_000


_MOST_NUMBERS = 1_000_000


_LARGE = 100
