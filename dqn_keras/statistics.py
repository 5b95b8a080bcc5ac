"""Statistics of many seeds, with intervals."""

import functools
from typing import Any, NamedTuple

import numpy as np
import scipy

from dqn_keras.study import Study


class Estimate(NamedTuple):
    """A number with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        digits = 1 if abs(self.value) >= 10 else 3
        if np.isnan(self.low):  # nothing to tell an interval from
            return f"{self.value:.{digits}f}"
        return f"{self.value:.{digits}f} ({self.low:.{digits}f} to {self.high:.{digits}f})"


class Summary(NamedTuple):
    """What a study says of its configuration. A seed that was not solved counts with the episodes it had."""

    share_solved: Estimate
    """Of the seeds, within `num_episodes`; Wilson interval."""
    median: Estimate
    """Episodes to solved; bootstrap interval. Not touched by how late the latest are, if most are solved."""
    interquartile_mean: Estimate
    """Episodes to solved, mean of the middle half; bootstrap interval."""


def summarize(study: Study) -> Summary:
    """Share of seeds solved, median and interquartile mean of the episodes to solved."""
    if not study.outcomes:
        raise ValueError("study must have at least one seed, got none")
    episodes, num_solved = study.episodes_to_solved, int(np.isfinite(study.solved_at).sum())
    share = scipy.stats.binomtest(num_solved, len(episodes)).proportion_ci(method="wilson")
    return Summary(
        Estimate(num_solved / len(episodes), float(share.low), float(share.high)),
        _bootstrap(np.median, episodes),
        _bootstrap(functools.partial(scipy.stats.trim_mean, proportiontocut=0.25), episodes),
    )


class Comparison(NamedTuple):
    """Of two studies."""

    difference: Estimate
    """Median episodes to solved of the second minus those of the first."""
    probability_of_improvement: Estimate
    """That a run of the second is solved earlier than one of the first; ties count half (Agarwal et al. 2021)."""


def compare(first: Study, second: Study) -> Comparison:
    """How two configurations differ in the episodes they need; bootstrap intervals."""
    samples = first.episodes_to_solved, second.episodes_to_solved
    return Comparison(_bootstrap(_difference, *samples), _bootstrap(_probability_of_improvement, *samples))


def _difference(first: np.ndarray, second: np.ndarray, axis: int = -1) -> np.ndarray:
    return np.median(second, axis=axis) - np.median(first, axis=axis)


def _probability_of_improvement(first: np.ndarray, second: np.ndarray, axis: int = -1) -> np.ndarray:
    u = scipy.stats.mannwhitneyu(first, second, axis=axis, method="asymptotic").statistic
    return u / (first.shape[axis] * second.shape[axis])


def _bootstrap(statistic: Any, *samples: np.ndarray) -> Estimate:
    value = float(statistic(*samples))
    if all(len(np.unique(sample)) == 1 for sample in samples):  # as in a study of one seed: nothing to resample
        return Estimate(value, np.nan, np.nan)
    interval = scipy.stats.bootstrap(
        samples, statistic, n_resamples=2_000, method="percentile", rng=np.random.default_rng(0), batch=200
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))
