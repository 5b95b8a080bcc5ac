"""Plots: learning curves of one run or of many, and the Q-values of a network."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.networks import check_network
from dqn_keras.checks.numbers import (
    check_array,
    check_choice,
    check_count,
    check_flag,
    check_instance,
    check_number,
    check_sequence,
    shown,
)
from dqn_keras.config import Config
from dqn_keras.statistics import Estimate, summarize
from dqn_keras.study import Study, Sweep
from dqn_keras.training import Run


def plot_rewards(rewards: Sequence[float] | np.ndarray, ax: Axes | None = None, window: int = 20) -> Axes:
    """Plots the reward of each episode and the moving average over `window` episodes.

    Args:
        rewards: one reward for each episode, [num_episodes], such as `run.rewards`.
        ax: the Axes to draw in; by default, a new figure of 10 by 5 inches.
        window: number of episodes in the moving average, which starts when there are so many.
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

    Q-values above their bound are overestimated. The page "When it does not learn" of the documentation says what else
    to look for. Returns the Axes in the order above; `plot_run(run)[0].figure` is the figure, 10 inches wide.

    Args:
        run: the result of `train`.
        speed: also plot the steps per second, the only curve that differs between two runs of the same seed.
    """
    check_instance("run", run, Run, "the result of train")
    return plot_history(run.history, run.config, speed)


def plot_history(history: Mapping[str, Sequence[float]], config: Config, speed: bool = True) -> np.ndarray:
    """Does the same as `plot_run`, but takes `run.history` or the columns of a log file."""
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


def plot_q(
    q_network: keras.Model,
    x: tuple[int, float, float],
    y: tuple[int, float, float],
    state: Sequence[float] | np.ndarray | None = None,
    ax: Axes | None = None,
    limits: tuple[float, float] | None = None,
) -> Axes:
    """Plots the Q-values of a network over two entries of the state; all other entries are fixed.

    The colour shows max_a Q(s, a). The hatching shows the greedy action: none for action 0, lines for action 1, and
    another kind for each further action up to 7; after that, the kinds repeat.

    Args:
        q_network: a network that takes vectors: states [B, N] -> Q-values [B, A].
        x: the entry of the state along the x-axis: its index, its lowest and its highest value.
        y: the entry along the y-axis, in the same form.
        state: the values of the other entries, [N]; by default, they are 0.
        ax: the Axes to draw in; by default, a new figure of 6 by 4.5 inches with a colour bar.
        limits: the Q-values of the darkest and the brightest colour; by default, the lowest and the highest plotted.

    Raises:
        TypeError, ValueError: an argument is wrong; the message names it.
    """
    check_network("q_network", q_network)
    if len(q_network.input_shape) != 2:
        raise ValueError(f"q_network must take vectors, [B, N], got an input of shape {q_network.input_shape}")
    num_features = q_network.input_shape[-1]
    state = check_array("state", np.zeros(num_features) if state is None else state, num_axes=1)
    if state.shape != (num_features,):
        raise ValueError(f"state must have {num_features} entries, the input size of q_network, got {state.shape[0]}")
    if not np.isfinite(state).all():
        raise ValueError(f"state must be finite, got {shown(state)}")
    limits = None if limits is None else _limits(limits)
    (i, xs), (j, ys) = _entry("x", x, num_features), _entry("y", y, num_features)
    if i == j:
        raise ValueError(f"x and y must be different entries of the state, got {i} for both")
    states = np.tile(state.astype(np.float32), (len(ys), len(xs), 1))  # [Y, X, N]
    states[..., i], states[..., j] = np.meshgrid(xs, ys)
    q_values = np.asarray(q_network(states.reshape(-1, num_features))).reshape(len(ys), len(xs), -1)
    return _draw_q(xs, ys, q_values, ax, limits or (q_values.max(-1).min(), q_values.max()))


def _entry(name: str, entry: Any, num_features: int) -> tuple[int, np.ndarray]:
    """Returns the index of an entry of the state and 61 values for it."""
    values = check_sequence(name, entry, "an index and two values")
    if len(values) != 3:
        raise ValueError(f"{name} must be an index, a lowest and a highest value, got {shown(entry)}")
    index = check_count(f"{name}[0]", values[0], at_least=0)
    if index >= num_features:
        raise ValueError(f"{name}[0] must be an index of the state's {num_features} entries, got {index}")
    low, high = (check_number(f"{name}[{k}]", values[k]) for k in (1, 2))
    if low >= high:
        raise ValueError(f"{name} must have its lowest value before its highest, got {shown(entry)}")
    return index, np.linspace(low, high, 61)


def _limits(limits: Any) -> tuple[float, float]:
    values = check_sequence("limits", limits, "two Q-values")
    if len(values) != 2:
        raise ValueError(f"limits must be two Q-values, got {len(values)}")
    low, high = (check_number("limits", value) for value in values)
    if low >= high:
        raise ValueError(f"limits must be two Q-values, the lower first, got {low:g} and {high:g}")
    return low, high


HATCHES = ("//", "\\\\", "xx", "..", "--", "||", "++")


def _draw_q(xs: np.ndarray, ys: np.ndarray, q_values: np.ndarray, ax: Axes | None, limits: tuple) -> Axes:
    """Draws max_a Q as colours and the greedy action as hatching; q_values are [Y, X, A]."""
    has_bar = ax is None
    if ax is None:
        _, ax = plt.subplots(figsize=(6, 4.5), layout="constrained")
    check_instance("ax", ax, Axes, "an Axes of Matplotlib")
    low, high = limits
    image = ax.pcolormesh(xs, ys, q_values.max(axis=-1), vmin=low, vmax=high, shading="gouraud", rasterized=True)
    greedy_actions = q_values.argmax(axis=-1)
    with plt.rc_context({"hatch.color": "white", "hatch.linewidth": 0.5}):
        for action in range(1, q_values.shape[-1]):
            hatch = HATCHES[(action - 1) % len(HATCHES)]
            ax.contourf(xs, ys, greedy_actions == action, levels=[0.5, 1.5], colors="none", hatches=[hatch])
    if has_bar:
        ax.figure.colorbar(image, ax=ax, label="max over a of Q(s, a)")
    return ax


def plot_study(
    study: Study,
    axes: Sequence[Axes] | np.ndarray | None = None,
    published: float | None = 293,
    x: Literal["episodes", "env_steps"] = "episodes",
) -> np.ndarray:
    """Plots a study in three panels: learning curves, episodes to solved, and share of seeds solved by episode.

    Without a stop rule (`solved_reward=None`), the last two panels show the rewards at the end of the runs.

    Args:
        study: a study with any number of seeds.
        axes: the three Axes to draw in; by default, a new figure of 15 by 4.5 inches.
        published: the number of episodes of one published run, such as the original's 293, to mark in the plots; None
            marks nothing.
        x: the unit of the x-axes: "episodes" or "env_steps".
    """
    check_instance("study", study, Study, "a Study")
    if published is not None:
        published = check_number("published", published, at_least=0)
    is_steps = check_choice("x", x, ("episodes", "env_steps")) == "env_steps"
    window, config = study.config.solved_window, study.config
    if not study.outcomes or min(np.isfinite(outcome.rewards).sum() for outcome in study.outcomes) < window:
        raise ValueError(f"study must have seeds with at least solved_window episodes each, got {study}")
    if axes is None:
        _, axes = plt.subplots(1, 3, figsize=(15, 4.5), layout="constrained")
    curves, distribution, shares = _three(axes)
    ends = study.env_steps_to_solved if is_steps else study.episodes_to_solved
    if config.solved_reward is None:
        ends = np.array([o.steps.sum() if is_steps else len(o.rewards) for o in study.outcomes])
    until = int(1.5 * np.quantile(ends, 0.9)) + 1  # the slowest curves are cut off here
    label = "Environment steps" if is_steps else "Episode"

    places, means = _curves(study, until, is_steps)
    num_seeds = len(study.outcomes)
    faint = curves.plot(places, means.T, color="0.5", alpha=max(0.02, min(1, 10 / num_seeds)), linewidth=0.7)
    faint[0].set_label("each seed")
    low, median, high = np.nanquantile(means, (0.25, 0.5, 0.75), axis=0)
    curves.fill_between(places, low, high, color="tab:blue", alpha=0.35, label="middle half of the seeds")
    curves.plot(places, median, color="tab:blue", linewidth=2, label="median")
    if config.solved_reward is not None:
        curves.axhline(config.solved_reward, color="black", linestyle=":", linewidth=1, label="solved")
    curves.set(xlabel=label, ylabel=f"Mean reward of the last {window} episodes", title=f"{num_seeds} seeds")
    curves.legend(loc="lower right")

    if config.solved_reward is None:
        _plot_ends(means[:, -1], window, distribution, shares)
    else:
        _plot_solved(study, ends, until, is_steps, None if is_steps else published, distribution, shares)
    return np.asarray(axes)


def _curves(study: Study, until: int, is_steps: bool) -> tuple[np.ndarray, np.ndarray]:
    """Returns points on the x-axis [N], and the mean of each seed's last rewards at these points [S, N].

    After the end of a run, its last mean continues.
    """
    window = study.config.solved_window
    longest = max(len(outcome.rewards) for outcome in study.outcomes)
    places = np.linspace(0, until, 500) if is_steps else np.arange(window - 1, min(until, longest))
    rows = []
    for outcome in study.outcomes:
        rewards = outcome.rewards[np.isfinite(outcome.rewards)]  # without an episode that is cut short
        mean = np.convolve(rewards, np.full(window, 1 / window), mode="valid")
        at = outcome.steps.cumsum()[window - 1 : len(rewards)] if is_steps else np.arange(window - 1, len(rewards))
        rows.append(np.interp(places, at, mean, left=np.nan))
    means = np.array(rows)
    is_known = ~np.isnan(means).all(axis=0)
    return places[is_known], means[:, is_known]


def _plot_solved(
    study: Study,
    ends: np.ndarray,
    until: int,
    is_steps: bool,
    published: float | None,
    distribution: Axes,
    shares: Axes,
) -> None:
    """Plots when the seeds are solved, as a histogram and as a cumulative share."""
    config, num_seeds = study.config, len(study.outcomes)
    solved = np.sort(ends[np.isfinite(study.solved_at)])
    most = (config.num_steps or config.num_episodes * config.max_steps) if is_steps else config.num_episodes
    unit = "environment steps" if is_steps else "episodes"
    distribution.hist(np.minimum(solved, until), bins=40, color="tab:blue", alpha=0.7)
    distribution.axvline(np.median(ends), color="tab:blue", linewidth=2, label="median")
    late = int((solved > until).sum())
    title = f"{late} later (in the last bar), {num_seeds - len(solved)} not within {most:,}"
    distribution.set(xlabel=f"{unit.capitalize()} to solved", ylabel="Seeds", title=title)

    steps = [*solved, most]
    shares.step(steps, np.minimum(np.arange(1, len(steps) + 1), len(solved)) / num_seeds, where="post", linewidth=2)
    shares.set(xscale="log", xlabel=unit.capitalize(), ylabel="Share of seeds solved", ylim=(0, 1.02))
    shares.set(title=f"{len(solved) / num_seeds:.1%} solved in the end", xlim=(0.8 * steps[0], most))
    if not is_steps:
        ticks = [k for k in (100, 200, 300, 500, 1_000, 2_000) if k <= most]
        shares.set_xticks(ticks, map(str, ticks))
        shares.minorticks_off()
    shares.grid(alpha=0.3)
    if published is not None:
        for ax in (distribution, shares):
            ax.axvline(published, color="tab:orange", linestyle="--", label=f"the one published run ({published:g})")
    distribution.legend(loc="upper right")


def _plot_ends(means: np.ndarray, window: int, distribution: Axes, shares: Axes) -> None:
    """Plots the mean rewards at the end of runs without a stop rule, as a histogram and as a cumulative share."""
    label = f"Mean reward of the last {window} episodes"
    distribution.hist(means, bins=40, color="tab:blue", alpha=0.7)
    distribution.axvline(np.median(means), color="tab:blue", linewidth=2, label="median")
    distribution.set(xlabel=label, ylabel="Seeds", title="At the end of the runs")
    distribution.legend(loc="upper left")
    shares.ecdf(means, complementary=True, linewidth=2)
    shares.set(xlabel=label, ylabel="Share of seeds with at least this", ylim=(0, 1.02), title="At the end of the runs")
    shares.grid(alpha=0.3)


def plot_sweep(sweep: Sweep, late_after: int = 500) -> np.ndarray:
    """Plots the settings of a sweep side by side: a dot and a 95 % interval for each setting and statistic.

    The statistics are the share of seeds that are late or never solved, the median of the episodes to solved, and, with
    `evaluate_on`, the greedy return. Returns the Axes; `plot_sweep(sweep)[0].figure` is the figure.

    Args:
        sweep: the result of `sweep`.
        late_after: number of episodes after which a seed counts as late.
    """
    check_instance("sweep", sweep, Sweep, "a Sweep")
    summaries = [summarize(study, late_after) for study in sweep.values()]
    late = [Estimate(*(100 * x for x in summary.share_late)) for summary in summaries]
    panels = {
        f"Not solved by episode {late_after} (%)": late,
        "Episodes to solved, median": [x.median for x in summaries],
    }
    if not all(np.isnan(x.greedy_return.value) for x in summaries):
        panels["Greedy return, mean"] = [x.greedy_return for x in summaries]
    size = 3.4 * len(panels) + 2, 0.32 * len(sweep) + 1.3
    _, axes = plt.subplots(1, len(panels), figsize=size, layout="constrained", sharey=True, squeeze=False)
    rows = np.arange(len(sweep))
    for ax, (label, estimates) in zip(axes[0], panels.items(), strict=True):
        value, low, high = np.array(estimates, np.float64).T
        low, high = np.where(np.isnan(low), value, low), np.where(np.isnan(high), value, high)
        ax.errorbar(value, rows, xerr=[value - low, high - value], fmt="o", color="tab:blue", capsize=3)
        ax.set(xlabel=label)
        ax.grid(alpha=0.3)
    axes[0, 0].set_yticks(rows, list(sweep))
    axes[0, 0].invert_yaxis()
    return axes[0]


def _three(axes: Any) -> Sequence[Axes]:
    three = check_sequence("axes", axes, "three Axes of Matplotlib")
    if len(three) != 3:
        raise ValueError(f"axes must be three Axes of Matplotlib, got {shown(axes)}")
    for i, ax in enumerate(three):
        check_instance(f"axes[{i}]", ax, Axes, "an Axes of Matplotlib")
    return three
