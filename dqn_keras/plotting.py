"""Learning curves: of one run, together with its other logged values, and of many runs."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from dqn_keras.checks.numbers import (
    check_array,
    check_count,
    check_flag,
    check_instance,
    check_number,
    check_sequence,
    shown,
)
from dqn_keras.config import Config
from dqn_keras.study import Study
from dqn_keras.training import Run


def plot_rewards(rewards: Sequence[float] | np.ndarray, ax: Axes | None = None, window: int = 20) -> Axes:
    """Plots each episode's reward, and the mean of the last `window` episodes, starting when there are that many.

    Args:
        rewards: one reward for each episode, [num_episodes], such as `run.rewards`.
        ax: the Axes to draw in; by default those of a new figure, 10 by 5 inches.
        window: number of episodes in the moving average.
    """
    window = check_count("window", window)
    rewards = check_array("rewards", rewards, num_axes=1).astype(np.float64)
    if ax is None:
        _, ax = plt.subplots(figsize=(10, 5))
    check_instance("ax", ax, Axes, "an Axes of Matplotlib")
    ax.plot(rewards, label="Episode reward", color="tab:blue", alpha=0.4, linewidth=1)
    if len(rewards) >= window:
        smoothed = np.convolve(rewards, np.full(window, 1 / window), mode="valid")
        ax.plot(
            np.arange(window - 1, len(rewards)), smoothed, label=f"Mean of the last {window}", color="tab:orange", lw=2
        )
    ax.set(xlabel="Episode", ylabel="Reward per episode", title="Episode rewards in training")
    ax.legend(loc="upper left")
    ax.grid(alpha=0.3)
    return ax


def plot_run(run: Run, speed: bool = True) -> np.ndarray:
    """Plots a run at a glance: its rewards, and below them Q-values, TD error, terminal transitions and speed.

    Q-values above their bound are overestimated. The documentation says what else to look for, in "It does not learn".
    Returns the Axes in the order above; `plot_run(run)[0].figure` is the figure, 10 inches wide.

    Args:
        run: the result of `train`.
        speed: also plot the steps per second, the only curve that differs between two runs of the same seed.
    """
    check_instance("run", run, Run, "the result of train")
    return plot_history(run.history, run.config, speed)


def plot_history(history: Mapping[str, Sequence[float]], config: Config, speed: bool = True) -> np.ndarray:
    """Plots a run as `plot_run` does, from `run.history` alone or from the columns of a log file."""
    speed = check_flag("speed", speed)
    columns = {name: np.asarray(values, np.float64) for name, values in history.items()}
    num_rows, num_columns = (2, 2) if speed else (1, 3)
    figure = plt.figure(figsize=(10, 3.5 + 2.75 * num_rows), layout="constrained")
    grid = figure.add_gridspec(1 + num_rows, num_columns, height_ratios=(1.4, *[1] * num_rows))
    rewards = plot_rewards(columns["reward"], figure.add_subplot(grid[0, :]), window=config.solved_window)
    if config.solved_reward is not None:
        rewards.axhline(config.solved_reward, color="black", linestyle=":", linewidth=1, label="Solved")
    rewards.legend(loc="upper left")
    cells = [grid[1 + i, j] for i in range(num_rows) for j in range(num_columns)]
    values, errors, terminals, *others = panels = [figure.add_subplot(cell, sharex=rewards) for cell in cells]

    values.plot(columns["mean_q"], color="tab:blue", label="Mean")
    values.plot(columns["max_q"], color="tab:orange", label="Highest")
    values.plot(columns["q_bound"], color="black", linestyle="--", linewidth=1, label="Bound")
    values.set(title="Q-values of the batches", ylabel="max over a of Q(s, a)")
    values.legend(loc="best")
    errors.plot(columns["td_error"], color="tab:blue")
    errors.set(title="TD error", ylabel="Mean of |y - Q(s, a)|", ylim=(0, None))
    terminals.plot(100 * columns["terminal_share"], color="tab:blue")
    terminals.set(title="Terminal transitions", ylabel="Share of the memory (%)", ylim=(0, None))
    for ax in others:
        ax.plot(columns["steps_per_second"], color="tab:blue")
        ax.set(title="Speed, learning included", ylabel="Env steps per second", ylim=(0, None))
    for ax in panels:
        ax.grid(alpha=0.3)
    for ax in panels[-num_columns:]:
        ax.set_xlabel("Episode")
    rewards.locator_params(axis="x", nbins=6)  # for all panels, which share the x-axis
    return np.array([rewards, *panels])


def plot_study(
    study: Study, axes: Sequence[Axes] | np.ndarray | None = None, published: float | None = 293
) -> np.ndarray:
    """Plots many seeds in three pictures: the learning curves, the episodes to solved, the share solved by episode.

    Args:
        study: a study with any number of seeds.
        axes: the three Axes to draw in; by default those of a new figure, 15 by 4.5 inches.
        published: an episode to mark: how many one published run needed, such as the original's 293. None marks
            nothing.
    """
    check_instance("study", study, Study, "a Study")
    if published is not None:
        published = check_number("published", published, at_least=0)
    if not study.outcomes or study.config.num_episodes < study.config.solved_window:
        raise ValueError(f"study must have seeds with at least solved_window episodes each, got {study}")
    if axes is None:
        _, axes = plt.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    curves, distribution, shares = _three(axes)
    window, config = study.config.solved_window, study.config
    solved = np.sort(study.solved_at[np.isfinite(study.solved_at)])
    num_seeds, num_unsolved = len(study.outcomes), len(study.outcomes) - len(solved)
    until = int(1.5 * np.quantile(study.episodes_to_solved, 0.9)) + 1  # the slowest curves are cut off here

    means = np.full((num_seeds, study.rewards.shape[1]), np.nan)  # of the last `window` episodes
    for row, outcome in zip(means, study.outcomes, strict=True):
        mean = np.convolve(outcome.rewards, np.full(window, 1 / window), mode="valid")
        row[window - 1 : len(outcome.rewards)] = mean
        row[len(outcome.rewards) :] = mean[-1]  # after its end, a run keeps its last mean
    means = means[:, :until]
    faint = curves.plot(means.T, color="0.5", alpha=max(0.02, min(1, 10 / num_seeds)), linewidth=0.7)
    faint[0].set_label("each seed")
    episodes = np.arange(window - 1, means.shape[1])
    low, median, high = np.nanquantile(means[:, window - 1 :], (0.25, 0.5, 0.75), axis=0)
    curves.fill_between(episodes, low, high, color="tab:blue", alpha=0.35, label="middle half of the seeds")
    curves.plot(episodes, median, color="tab:blue", linewidth=2, label="median")
    curves.axhline(config.solved_reward, color="black", linestyle=":", linewidth=1, label="solved")
    curves.set(xlabel="Episode", ylabel=f"Mean reward of the last {window} episodes", title=f"{num_seeds} seeds")
    curves.legend(loc="lower right")

    distribution.hist(np.minimum(solved, until), bins=40, color="tab:blue", alpha=0.7)
    distribution.axvline(np.median(study.episodes_to_solved), color="tab:blue", linewidth=2, label="median")
    late = int((solved > until).sum())
    title = f"{late} later (in the last bar), {num_unsolved} not within {config.num_episodes:,}"
    distribution.set(xlabel="Episodes to solved", ylabel="Seeds", title=title)

    ends = [*solved, config.num_episodes]
    shares.step(ends, np.minimum(np.arange(1, len(ends) + 1), len(solved)) / num_seeds, where="post", linewidth=2)
    shares.set(xscale="log", xlabel="Episodes", ylabel="Share of seeds solved", ylim=(0, 1.02))
    shares.set(title=f"{len(solved) / num_seeds:.1%} solved in the end", xlim=(0.8 * ends[0], config.num_episodes))
    ticks = [k for k in (100, 200, 300, 500, 1_000, 2_000) if k <= config.num_episodes]
    shares.set_xticks(ticks, map(str, ticks))
    shares.minorticks_off()
    shares.grid(alpha=0.3)
    if published is not None:
        for ax in (distribution, shares):
            ax.axvline(published, color="tab:orange", linestyle="--", label=f"the one published run ({published:g})")
    distribution.legend(loc="upper right")
    return np.asarray(axes)


def _three(axes: Any) -> Sequence[Axes]:
    three = check_sequence("axes", axes, "three Axes of Matplotlib")
    if len(three) != 3:
        raise ValueError(f"axes must be three Axes of Matplotlib, got {shown(axes)}")
    for i, ax in enumerate(three):
        check_instance(f"axes[{i}]", ax, Axes, "an Axes of Matplotlib")
    return three
