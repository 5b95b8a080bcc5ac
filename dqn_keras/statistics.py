"""Statistics over many seeds, with 95 % intervals."""

import functools
from typing import Any, NamedTuple

import numpy as np
import scipy

from dqn_keras.checks.numbers import check_count, check_instance
from dqn_keras.study import Study, Sweep


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

    def as_percent(self) -> str:
        """Returns a share in percent, with its interval."""
        return f"{100 * self.value:.1f} % ({100 * self.low:.1f} to {100 * self.high:.1f})"


class Summary(NamedTuple):
    """The statistics of a study. A seed that was not solved counts with `num_episodes` episodes."""

    share_solved: Estimate
    """Share of the seeds that are solved within `num_episodes`; Wilson interval."""
    median: Estimate
    """Median of the episodes to solved; bootstrap interval. The slowest seeds do not change it, if most are solved."""
    interquartile_mean: Estimate
    """Mean of the middle half of the episodes to solved; bootstrap interval."""
    share_late: Estimate
    """Share of the seeds that need more than `late_after` episodes or are never solved; Wilson interval."""
    median_env_steps: Estimate
    """Median of the environment steps to solved; bootstrap interval."""
    greedy_return: Estimate
    """Mean over the seeds of the greedy return after the run; bootstrap interval; NaN without `evaluate_on`."""


def summarize(study: Study, late_after: int = 500) -> Summary:
    """Returns the share of seeds solved, the episodes and steps that they need, and their greedy return.

    Args:
        study: a study with at least one seed.
        late_after: number of episodes after which a seed counts as late.
    """
    _check_study("study", study)
    late_after = check_count("late_after", late_after)
    episodes = study.episodes_to_solved
    is_solved = np.isfinite(study.solved_at)
    return Summary(
        _share(is_solved),
        _bootstrap(np.median, episodes),
        _bootstrap(functools.partial(scipy.stats.trim_mean, proportiontocut=0.25), episodes),
        _share(~is_solved | (episodes > late_after)),
        _bootstrap(np.median, study.env_steps_to_solved),
        _bootstrap(np.mean, study.greedy_returns),
    )


def sweep_table(sweep: Sweep, late_after: int = 500) -> str:
    """Returns the statistics of `summarize` for each setting of a sweep, as a Markdown table."""
    check_instance("sweep", sweep, Sweep, "a Sweep")
    rows = ["| setting | seeds | solved | late or never | median episodes to solved | greedy return |"]
    rows.append("|---|---|---|---|---|---|")
    for name, study in sweep.items():
        x = summarize(study, late_after)
        shares = x.share_solved.as_percent(), x.share_late.as_percent()
        greedy = "" if np.isnan(x.greedy_return.value) else str(x.greedy_return)
        rows.append(f"| {name} | {len(study.outcomes)} | {shares[0]} | {shares[1]} | {x.median} | {greedy} |")
    return "\n".join(rows)


def _share(claims: np.ndarray) -> Estimate:
    """Returns the share of true claims, with its Wilson interval."""
    interval = scipy.stats.binomtest(int(claims.sum()), len(claims)).proportion_ci(method="wilson")
    return Estimate(float(claims.mean()), float(interval.low), float(interval.high))


class Comparison(NamedTuple):
    """The comparison of two studies."""

    difference: Estimate
    """Median of the episodes to solved in the second study, minus the median in the first."""
    probability_of_improvement: Estimate
    """Probability that a run of the second study is solved earlier than a run of the first; ties count half (Agarwal et
    al. 2021)."""


def compare(first: Study, second: Study) -> Comparison:
    """Compares the episodes to solved of two studies, with bootstrap intervals."""
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
    if np.isnan(value) or all(len(np.unique(sample)) == 1 for sample in samples):  # for example, one seed
        return Estimate(value, np.nan, np.nan)
    interval = scipy.stats.bootstrap(
        samples, statistic, n_resamples=2_000, method="percentile", rng=np.random.default_rng(0), batch=200
    ).confidence_interval
    return Estimate(value, float(interval.low), float(interval.high))
