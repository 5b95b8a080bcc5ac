"""Measures how often and when the original's parameters solve CartPole-v1 in the Gymnasium loop.

    python -m benchmarks.reproduction [--seeds 100]

Writes results/reproduction.md. Each of the seeds 0, 1, 2, ... is trained as in the notebook and then plays 100 greedy
episodes. One process per core. The numbers follow from the seeds alone; no seed is left out.
"""

import argparse
import concurrent.futures
import importlib.metadata
import multiprocessing
import os
import platform
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np

from dqn_keras import Config, evaluate, train

TARGET = Path(__file__).parent.parent / "results" / "reproduction.md"
WINDOW = Config().solved_window


class Outcome(NamedTuple):
    """The result of one seed."""

    seed: int
    solved_at: int | None
    env_steps: int
    training: float
    """Mean reward of the last 50 training episodes."""
    greedy: float
    """Mean return of 100 greedy episodes."""


def reproduce(seed: int) -> Outcome:
    env = gym.make("CartPole-v1")
    run = train(env, Config(), seed, verbose=0)
    greedy = evaluate(env, run.q_network, num_episodes=100, seed=seed)
    steps = sum(episode.steps for episode in run.episodes)
    return Outcome(seed, run.solved_at, steps, float(run.rewards[-WINDOW:].mean()), float(greedy.mean()))


def keep_to_one_core(cores: multiprocessing.Queue) -> None:
    os.sched_setaffinity(0, {cores.get()})


def report(outcomes: list[Outcome]) -> str:
    solved = [o for o in outcomes if o.solved_at is not None]
    late = [o for o in solved if o.solved_at >= 500]
    episodes, n = np.array([o.solved_at for o in solved]), len(outcomes)
    usual = episodes[episodes < 500]
    versions = ", ".join(f"{p} {importlib.metadata.version(p)}" for p in ("tensorflow", "keras", "gymnasium", "numpy"))
    low, median, high = np.quantile([o.greedy for o in solved], (0.25, 0.5, 0.75))
    not_worse = sum(o.greedy >= o.training for o in solved)
    lines = [
        "# The original's claim, over many seeds",
        "",
        f"`python -m benchmarks.reproduction --seeds {n}` (seeds 0 to {n - 1}; Python {platform.python_version()}, "
        f"{versions}).",
        "",
        "| | measured |",
        "|---|---|",
        f"| solved before episode 500 | {len(usual)} of {n} seeds, in {usual.min()} to {usual.max()} episodes |",
        f"| solved later | {len(late)} of {n} seeds: {', '.join(str(o.solved_at) for o in late) or 'none'} |",
        f"| not solved within 2,000 episodes | {n - len(solved)} of {n} seeds |",
        f"| median episodes to solved, all seeds | {np.median([o.solved_at or 2000 for o in outcomes]):.1f} |",
        f"| median env steps of a run | {np.median([o.env_steps for o in outcomes]):,.0f} |",
        f"| mean return of 100 greedy episodes after solved runs, median over seeds (quartiles) | "
        f"{median:.0f} ({low:.0f} to {high:.0f}) |",
        f"| greedy play at least as good as the last 50 training episodes | {not_worse} of {len(solved)} solved runs |",
        "",
        "Each seed: episode at which it was solved (- if not), mean reward of the last 50 training episodes, mean "
        "return of 100 greedy episodes.",
        "",
        "| seed | solved at | training | greedy |",
        "|---|---|---|---|",
        *(f"| {o.seed} | {o.solved_at or '-'} | {o.training:.1f} | {o.greedy:.1f} |" for o in outcomes),
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100, help="number of seeds (100)")
    num_seeds = parser.parse_args().seeds
    context = multiprocessing.get_context("spawn")
    cores = context.Queue()
    for core in os.sched_getaffinity(0):
        cores.put(core)
    num_workers = len(os.sched_getaffinity(0))
    with concurrent.futures.ProcessPoolExecutor(num_workers, context, keep_to_one_core, (cores,)) as pool:
        outcomes = []
        for outcome in pool.map(reproduce, range(num_seeds)):
            outcomes.append(outcome)
            print(outcome, flush=True)
    TARGET.write_text(report(outcomes))
    print(f"written: {TARGET}")


if __name__ == "__main__":
    main()
