"""Measures how reliable the original's configuration is: compiled runs of many seeds on all cores.

    python -m benchmarks.thousand_seeds --figure results/thousand_seeds.png > results/thousand_seeds.md
    python -m benchmarks.thousand_seeds --seeds 100

The wall time starts at the first line of this program, so it includes imports, worker processes and their compilation.
The speed with nothing left to compile is measured on a hundred further seeds in the same workers.
"""

import time

START = time.perf_counter()

import argparse
import os
import platform
from pathlib import Path

import gymnasium as gym
import keras
import numpy as np
import tensorflow as tf

from dqn_keras import Config, Study, plot_study, study, summarize
from dqn_keras.environments import CartPole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1_000, help="seeds 0, 1, ... (1,000)")
    parser.add_argument("--figure", type=Path, help="save the picture in this file")
    arguments = parser.parse_args()

    outcome = study(CartPole(), Config(), range(arguments.seeds))
    seconds = time.perf_counter() - START
    start = time.perf_counter()
    further = study(CartPole(), Config(), range(arguments.seeds, arguments.seeds + 100), verbose=0)
    speed = further.num_env_steps / (time.perf_counter() - start)

    num_cores = len(os.sched_getaffinity(0))
    versions = f"tensorflow {tf.__version__}, keras {keras.__version__}, gymnasium {gym.__version__}"
    print(f"# The original's configuration over {arguments.seeds:,} seeds\n")
    print(f"`python -m benchmarks.thousand_seeds --seeds {arguments.seeds}`: compiled episodes, seeds 0 to")
    print(f"{arguments.seeds - 1}, {num_cores} cores (Python {platform.python_version()}, {versions}, numpy")
    print(f"{np.__version__}). In brackets: 95 % intervals. A seed that was not solved counts with 2,000 episodes.\n")
    print("| | measured |\n|---|---|")
    for name, value in table(outcome).items():
        print(f"| {name} | {value} |")
    print(f"| wall time, from the start of the program | {seconds:.1f} s |")
    print(f"| env steps | {outcome.num_env_steps:,}, {outcome.num_env_steps / seconds:,.0f}/s of that time |")
    print(f"| env steps/s of a hundred further seeds, nothing left to compile | {speed:,.0f} |")
    unsolved = outcome.seeds[np.isnan(outcome.solved_at)]
    print(f"\nNot solved: seeds {', '.join(map(str, unsolved)) or 'none'}.")
    if arguments.figure:
        plot_study(outcome)[0].figure.savefig(arguments.figure, dpi=90)


def table(outcome: Study) -> dict[str, str]:
    """Returns the figures that show how reliable it is."""
    episodes, num_seeds = outcome.episodes_to_solved, len(outcome.outcomes)
    summary = summarize(outcome)
    late = (episodes >= 500) & np.isfinite(outcome.solved_at)
    low, high = np.quantile(episodes, (0.05, 0.95))
    return {
        "share of seeds solved within 2,000 episodes": str(summary.share_solved),
        "of them after episode 500": f"{late.sum()} of {num_seeds} seeds",
        "not solved": f"{np.isnan(outcome.solved_at).sum()} of {num_seeds} seeds",
        "median episodes to solved": str(summary.median),
        "interquartile mean": str(summary.interquartile_mean),
        "the earliest; 5 % and 95 % of the seeds": f"{episodes.min():.0f}; {low:.0f}, {high:.0f}",
        "solved by episode 293, which the original reports": f"{np.mean(episodes <= 293):.1%} of the seeds",
    }


if __name__ == "__main__":
    main()
