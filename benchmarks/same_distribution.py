"""Measures whether compiled episodes and the Gymnasium loop learn alike: the episodes to solved over many seeds.

    python -m benchmarks.same_distribution [--seeds 50] > results/same_distribution.md

The two loops draw different random numbers, so a seed gives two different runs. Their distributions must agree. A run
that is not solved counts as 2,000 episodes. Linux only (it uses a single core).
"""

import argparse
import os

import gymnasium as gym
import numpy as np
from scipy import stats

from dqn_keras import Config, train
from dqn_keras.environments import CartPole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=50, help="seeds 0, 1, ... (50)")
    num_seeds = parser.parse_args().seeds
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    solved = {"Gymnasium loop": [], "compiled episodes": []}
    for name, env in zip(solved, (gym.make("CartPole-v1"), CartPole()), strict=True):
        for seed in range(num_seeds):
            solved[name].append(train(env, Config(), seed, verbose=0).solved_at or Config().num_episodes)

    print("# Both loops learn alike\n")
    print(f"`python -m benchmarks.same_distribution --seeds {num_seeds}`: episodes to solved, 2,000 if not.\n")
    print("| loop | quartiles | later than 500 | not solved | all, sorted |")
    print("|---|---|---|---|---|")
    for name, values in solved.items():
        x = np.sort(values)
        low, median, high = np.quantile(x, (0.25, 0.5, 0.75))
        late = f"{((x >= 500) & (x < 2000)).sum()} of {num_seeds} | {(x == 2000).sum()} of {num_seeds}"
        print(f"| {name} | {low:.0f}, {median:.0f}, {high:.0f} | {late} | {' '.join(map(str, x))} |")
    print("\nTwo-sample tests of the hypothesis that they are the same distribution:\n")
    print(f"- Kolmogorov-Smirnov: p = {stats.ks_2samp(*solved.values()).pvalue:.2f}")
    print(f"- Mann-Whitney: p = {stats.mannwhitneyu(*solved.values()).pvalue:.2f}")


if __name__ == "__main__":
    main()
