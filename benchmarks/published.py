"""Does the package reach published tables of DQN? Stable-Baselines3 runs the same settings here, too.

    python -m benchmarks.published > results/published.md
    python -m benchmarks.published --programs stable_baselines3 --seeds 3

Every run adds one line to results/published.csv. A run that is in the file is not repeated, so the command can be
interrupted and given again.
"""

import argparse
import csv
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np

RECORDS = Path("results/published.csv")
FIRST_START = 1_000_000  # start states of the greedy episodes: gym seeds from here on, which no training run uses


class Settings(NamedTuple):
    """One column of rl-zoo3's hyperparams/dqn.yml, and the result that sb3-contrib publishes for it."""

    environment: str
    num_seeds: int
    num_steps: int
    learning_rate: float
    batch_size: int
    memory_size: int
    learning_starts: int
    gamma: float
    steps_per_target: int
    steps_per_update: int
    gradient_steps: int
    epsilon_fraction: float
    epsilon_min: float
    published: str


ZOO = (
    Settings("CartPole-v1", 20, 50_000, 2.3e-3, 64, 100_000, 1_000, 0.99, 10, 256, 128, 0.16, 0.04, "500 ± 0"),
    Settings("MountainCar-v0", 10, 120_000, 4e-3, 128, 10_000, 1_000, 0.98, 600, 16, 8, 0.2, 0.07, "-107 ± 4"),
    Settings("LunarLander-v3", 10, 100_000, 6.3e-4, 128, 50_000, 0, 0.99, 250, 4, 4, 0.12, 0.1, "195 ± 28 (v2)"),
    Settings("Acrobot-v1", 10, 100_000, 6.3e-4, 128, 50_000, 0, 0.99, 250, 4, 4, 0.12, 0.1, "-74 ± 2"),
)


@dataclass
class Record:
    """What one run reached."""

    program: str
    environment: str
    seed: int
    num_env_steps: int
    greedy_return: float  # mean of 100 greedy episodes after training
    greedy_return_10: float  # mean of the first 10 of them
    training_return: float  # mean of the last 100 complete episodes of training
    seconds: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="at most seeds 0, 1, ... (20 of CartPole, 10 of others)")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS))
    arguments = parser.parse_args()
    for program, settings, seed in missing_runs(arguments.programs, arguments.seeds):
        record = PROGRAMS[program](settings, seed)
        print(record, file=sys.stderr, flush=True)
        append_record(record)


def missing_runs(programs: list[str], max_seeds: int) -> Iterator[tuple[str, Settings, int]]:
    """Yields the runs that the file lacks, one seed of every environment after the other."""
    done = {(record.program, record.environment, record.seed) for record in read_records()}
    for seed in range(max_seeds):
        for settings in ZOO:
            for program in programs:
                if seed < settings.num_seeds and (program, settings.environment, seed) not in done:
                    yield program, settings, seed


def read_records() -> list[Record]:
    """Returns the runs in the file."""
    if not RECORDS.exists():
        return []
    with RECORDS.open(newline="") as file:
        return [Record(**{f.name: f.type(row[f.name]) for f in fields(Record)}) for row in csv.DictReader(file)]


def append_record(record: Record) -> None:
    """Adds one line to the file."""
    is_new = not RECORDS.exists()
    with RECORDS.open("a", newline="") as file:
        writer = csv.DictWriter(file, [f.name for f in fields(Record)], lineterminator="\n")
        if is_new:
            writer.writeheader()
        writer.writerow(asdict(record))


def run_stable_baselines3(settings: Settings, seed: int) -> Record:
    """Trains and evaluates Stable-Baselines3's DQN, with its own defaults where the settings say nothing."""
    import torch
    from stable_baselines3 import DQN
    from stable_baselines3.common.monitor import Monitor

    torch.set_num_threads(1)
    start = time.perf_counter()
    env = Monitor(gym.make(settings.environment))
    agent = DQN(
        "MlpPolicy",
        env,
        learning_rate=settings.learning_rate,
        buffer_size=settings.memory_size,
        learning_starts=settings.learning_starts,
        batch_size=settings.batch_size,
        gamma=settings.gamma,
        train_freq=settings.steps_per_update,
        gradient_steps=settings.gradient_steps,
        target_update_interval=settings.steps_per_target,
        exploration_fraction=settings.epsilon_fraction,
        exploration_final_eps=settings.epsilon_min,
        policy_kwargs={"net_arch": [256, 256]},
        seed=seed,
        device="cpu",
    )
    agent.learn(settings.num_steps)
    seconds = time.perf_counter() - start
    training_returns = env.get_episode_rewards()
    greedy = greedy_returns(settings.environment, lambda states: agent.predict(states, deterministic=True)[0])
    return make_record(
        "stable_baselines3", settings.environment, seed, agent.num_timesteps, greedy, training_returns, seconds
    )


def greedy_returns(environment: str, greedy_actions: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Returns the undiscounted returns of 100 greedy episodes, played side by side from 100 start states."""
    envs = [gym.make(environment) for _ in range(100)]
    states = np.stack([env.reset(seed=FIRST_START + index)[0] for index, env in enumerate(envs)])
    returns, playing = np.zeros(len(envs)), np.arange(len(envs))
    while len(playing):
        ended = []
        for index, action in zip(playing, greedy_actions(states[playing]), strict=True):
            states[index], reward, terminated, truncated, _ = envs[index].step(int(action))
            returns[index] += reward
            if terminated or truncated:
                ended.append(index)
        playing = np.setdiff1d(playing, ended)
    return returns


def make_record(
    program: str,
    environment: str,
    seed: int,
    num_env_steps: int,
    greedy: np.ndarray,
    training_returns: list[float],
    seconds: float,
) -> Record:
    """Returns the record of one run; seconds are those of training."""
    return Record(
        program,
        environment,
        seed,
        num_env_steps,
        round(float(np.mean(greedy)), 3),
        round(float(np.mean(greedy[:10])), 3),
        round(float(np.mean(training_returns[-100:])), 3),
        round(seconds, 1),
    )


PROGRAMS = {"stable_baselines3": run_stable_baselines3}


if __name__ == "__main__":
    main()
