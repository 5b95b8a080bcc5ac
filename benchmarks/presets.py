"""Measures whether the presets solve their environments, each by Gymnasium's own threshold.

    python -m benchmarks.presets --file presets.npz > results/presets.md
    python -m benchmarks.presets --seeds 2

With --file, the outcomes are saved in that file, and a repeated command trains only the missing seeds.

CartPole's preset has the recommended numbers of benchmarks.ablation. Acrobot's has the best numbers that
benchmarks.tune found, rounded. MountainCar's (after such a search) and LunarLander's were tuned by hand. These three
used seeds 1000 to 1023, which are not reported. Only CartPole's was found on seeds that include the reported ones.
"""

import argparse
import platform
from pathlib import Path
from typing import Any

import gymnasium as gym
import keras
import numpy as np
import tensorflow as tf

from dqn_keras import Study, presets, summarize, sweep
from dqn_keras.environments import TWINS

NUM_SEEDS = {"LunarLander-v3": 10}  # minutes each; the others have 20


def make_env(env_id: str) -> Any:
    """Makes the functional twin of an environment, or the environment itself if it has none."""
    return TWINS[env_id]() if env_id in TWINS else gym.make(env_id)


def run(most: int, file: Path | None) -> dict[str, Study]:
    """Makes the study of each preset, or continues the one in `file`."""
    found = {}
    for env_id, config in presets.items():
        seeds = range(min(most, NUM_SEEDS.get(env_id, 20)))
        setting = {env_id: {"config": config, "evaluate_on": make_env(env_id)}}
        found |= sweep(make_env(env_id), setting, seeds, file=file)
    return found


def row(env_id: str, study: Study) -> str:
    """Returns the row of one environment in the table."""
    summary, seconds = summarize(study), study.to_dict()["seconds"]
    loop = "compiled" if env_id in TWINS else "Gymnasium's"
    threshold, seeds = gym.spec(env_id).reward_threshold, len(study.outcomes)
    solved = f"{np.isfinite(study.solved_at).sum()} of {seeds}"
    steps, low, high = (f"{x:,.0f}" for x in summary.median_env_steps)
    return (
        f"| {env_id} | {threshold:g} | {solved} | {steps} ({low} to {high}) | {np.median(seconds):.1f} s, {loop} loop "
        f"| {summary.greedy_return} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="maximum number of seeds of each environment (20)")
    parser.add_argument("--file", type=Path, help="save the outcomes in this file")
    arguments = parser.parse_args()

    found = run(arguments.seeds, arguments.file)
    versions = f"tensorflow {tf.__version__}, keras {keras.__version__}, gymnasium {gym.__version__}"
    print("# The presets\n")
    print(f"`python -m benchmarks.presets --seeds {arguments.seeds}`: seeds 0, 1, 2, ... (Python")
    print(f"{platform.python_version()}, {versions}, numpy {np.__version__}).")
    print("Solved: a mean reward of 100 episodes above Gymnasium's threshold, while training. Steps: median of the")
    print("environment steps to solved. Time: median of one seed's training on one core, with nothing left to compile")
    print("for most. Greedy return: 100 episodes after the run, mean over the seeds. In brackets: 95 % intervals.\n")
    print("| environment | threshold | solved | steps | time | greedy return |")
    print("|---|---|---|---|---|---|")
    for env_id, study in found.items():
        print(row(env_id, study))
    print("\nThe settings are in `dqn_keras/presets.py`.")


if __name__ == "__main__":
    main()
