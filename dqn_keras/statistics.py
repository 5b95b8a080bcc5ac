"""Statistics over many seeds, with 95 % intervals."""

import functools
from typing import Any, NamedTuple

import numpy as np
import scipy

from dqn_keras.checks.numbers import check_instance
from dqn_keras.study import Study


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        digits = 1 if abs(self.value) >= 10 else 3
        if np.isnan(self.low):  # there is no interval
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} ({self.low:.{digits}f} to {self.high:.{digits}f})"


class Summary(NamedTuple):
    """The statistics of a study. A seed that was not solved counts with `num_episodes` episodes."""

    share_solved: Estimate
    """Share of the seeds that are solved within `num_episodes`; Wilson interval."""
    median: Estimate
    """Median of the episodes to solved; bootstrap interval. If most seeds are solved, the slowest do not change it."""
    interquartile_mean: Estimate
    """Mean of the middle half of the episodes to solved; bootstrap interval."""


def summarize(study: Study) -> Summary:
    """Returns the share of seeds solved, and the median and interquartile mean of the episodes to solved."""
    _check_study("study", study)
    episodes, num_solved = study.episodes_to_solved, int(np.isfinite(study.solved_at).sum())
    share = scipy.stats.binomtest(num_solved, len(episodes)).proportion_ci(method="wilson")
    return Summary(
        Estimate(num_solved / len(episodes), float(share.low), float(share.high)),
        _bootstrap(np.median, episodes),
        _bootstrap(functools.partial(scipy.stats.trim_mean, proportiontocut=0.25), episodes),
    )


class Comparison(NamedTuple):
    """The comparison of two studies."""

    difference: Estimate
    """Median of the episodes to solved in the second study, minus the median in the first."""
    probability_of_improvement: Estimate
    """Probability that a run of the second study is solved earlier than a run of the first; ties count half (Agarwal et
    al. 2021)."""


def compare(first: Study, second: Study) -> Comparison:
    """Compares the episodes that two configurations need until they are solved; bootstrap intervals."""
    _check_study("first", first)
    _check_study("second", second)
    samples = first.episodes_to_solved, second.episodes_to_solved
    return Comparison(_bootstrap(_difference, *samples), _bootstrap(_probability_of_improvement, *samples))


def _check_study(name: str, study: Study) -> None:
    check_instance(name, study, Study, "a Study")
    if not study.outcomes:
        raise ValueError(f"{name} must have at least one seed, got none")


def _difference(first: np.ndarray, second: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.median(second, axis=axis) - np.median(first, axis=axis)


def _probability_of_improvement(first: np.ndarray, second: np.ndarray, axis: int = -1) -> np.ndarray:
    u = scipy.stats.mannwhitneyu(first, second, axis=axis, method="asymptotic").statistic
    return u / (first.shape[axis] * second.shape[axis])


def _bootstrap(statistic: Any, *samples: np.ndarray) -> Estimate:
    value = float(statistic(*samples))
    if all(len(np.unique(sample)) == 1 for sample in samples):  # for example, one seed: nothing to resample
        return Estimate(value, np.nan, np.nan)
    interval = scipy.stats.bootstrap(
        samples, statistic, n_resamples=2_000, method="percentile", rng=np.random.default_rng(0), batch=200
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))
