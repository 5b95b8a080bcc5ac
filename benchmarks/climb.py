"""Measures when the learning curve climbs: when the memory holds enough, or when the network has learned enough.

    python -m benchmarks.climb [--seeds 100] > results/climb.md

The climb is the first episode after which the mean reward of the last 20 episodes is above 50 (random actions reach
about 22). Half of the runs start with an empty memory, the other half with 5,000 transitions of random actions. All
else is the same: another run fills the memory, so epsilon begins at its first value in both halves.
"""

import argparse
import dataclasses
import itertools
import platform
from collections.abc import Sequence
from typing import NamedTuple

import gymnasium as gym
import keras
import numpy as np
import scipy
import tensorflow as tf
from tqdm.auto import tqdm

from dqn_keras import Config, ReplayMemory, train
from dqn_keras.environments import CartPole
from dqn_keras.learn import td_targets
from dqn_keras.loops.compiled import episodes
from dqn_keras.statistics import Estimate
from dqn_keras.training import prepare

LESSON = Config(solved_reward=50, solved_window=20)
FEW_RANDOM_ACTIONS = dataclasses.replace(LESSON, epsilon=0.1)
NUM_PREFILLED = 5_000


class Climb(NamedTuple):
    """Episodes, steps and updates of one run until the climb."""

    episodes: int
    env_steps: int
    updates: int


def climb(config: Config, seed: int, memory: ReplayMemory | None) -> Climb:
    """Trains until the climb, with a copy of `memory` or an empty memory."""
    spaces, formulas, agent = prepare(CartPole(), config, seed, None, None, td_targets, None)
    num_before = 0 if memory is None else memory.num_appended
    if memory is not None:
        agent.memory.rows[:num_before] = memory.rows[:num_before]
        agent.memory.num_appended = num_before
    rewards: list[float] = []
    for episode in episodes(CartPole(), spaces, agent, config, formulas=formulas):
        rewards.append(episode.reward)
        last = rewards[-config.solved_window :]
        if len(last) == config.solved_window and np.mean(last) > config.solved_reward:
            return Climb(len(rewards), agent.memory.num_appended - num_before, agent.num_updates)
    raise RuntimeError(f"seed {seed} did not climb in {config.num_episodes} episodes")


def random_transitions(seed: int) -> ReplayMemory:
    """Returns a memory with transitions of random actions."""
    num_steps = NUM_PREFILLED + 1  # a run must have an update; it comes after these transitions
    config = Config(learning_starts=NUM_PREFILLED, num_steps=num_steps, memory_size=num_steps, steps_per_update=1)
    memory = train(CartPole(), config, seed, verbose=0).agent.memory
    memory.num_appended = NUM_PREFILLED
    return memory


def median(values: Sequence[int]) -> str:
    """Returns the median with its 95 % bootstrap interval."""
    found = scipy.stats.bootstrap((values,), np.median, n_resamples=2_000, method="percentile", rng=0)
    return str(Estimate(float(np.median(values)), *found.confidence_interval))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=100, help="seeds 0, 1, ... of each row (100)")
    num_seeds = parser.parse_args().seeds
    memories = {"empty": [None] * num_seeds}
    memories["prefilled"] = [random_transitions(1_000_000 + seed) for seed in range(num_seeds)]
    rows = [*itertools.product(("falls from 1",), (1, 2, 4, 8), memories), *(("is 0.1", 4, name) for name in memories)]

    versions = f"tensorflow {tf.__version__}, keras {keras.__version__}, gymnasium {gym.__version__}"
    print("# What makes the learning curve climb\n")
    print(f"`python -m benchmarks.climb --seeds {num_seeds}`: compiled CartPole, seeds 0 to {num_seeds - 1} (Python")
    print(f"{platform.python_version()}, {versions}, numpy {np.__version__}). The climb: the first episode after which")
    print("the mean reward of the last 20 is above 50. Prefilled: the memory holds 5,000 transitions of random actions")
    print("before the first episode. Everything else is the original's. Medians over the seeds; in brackets, 95 %")
    print("intervals.\n")
    print("| epsilon | an update every | memory at the start | episodes | env steps | updates |")
    print("|---|---|---|---|---|---|")
    for epsilon, steps_per_update, name in tqdm(rows, unit="row"):
        config = LESSON if epsilon == "falls from 1" else FEW_RANDOM_ACTIONS
        config = dataclasses.replace(config, steps_per_update=steps_per_update)
        climbs = [climb(config, seed, memory) for seed, memory in enumerate(memories[name])]
        columns = " | ".join(median(values) for values in zip(*climbs, strict=True))
        steps = "step" if steps_per_update == 1 else f"{steps_per_update} steps"
        print(f"| {epsilon} | {steps} | {name} | {columns} |", flush=True)


if __name__ == "__main__":
    main()
