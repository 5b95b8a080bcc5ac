"""Learning curves."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from dqn_keras.config import count


def plot_rewards(rewards: Sequence[float] | np.ndarray, ax: Axes | None = None, window: int = 20) -> Axes:
    """Each episode's reward, and the mean over the last `window` episodes once there are as many.

    Args:
        rewards: [num_episodes], as `run.rewards`.
        ax: where to draw; by default a new figure of 10 by 5 inches.
        window: episodes in the moving average.
    """
    window = count("window", window)
    rewards = np.asarray(rewards, np.float64)
    if rewards.ndim != 1:
        raise ValueError(f"rewards must have one axis, got shape {rewards.shape}")
    if ax is None:
        _, ax = plt.subplots(figsize=(10, 5))
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
