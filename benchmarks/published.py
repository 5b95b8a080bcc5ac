"""Measures whether the package reaches published results of DQN; Stable-Baselines3 runs the same settings here.

    python -m benchmarks.published > results/published.md
    python -m benchmarks.published --programs stable_baselines3 --seeds 3

One process, one core. Every run adds one line to results/published.csv. A run that is in the file is not repeated, so
you can interrupt the command and repeat it. --seeds 0 only writes the page.
"""

import argparse
import csv
import importlib.metadata
import math
import platform
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import keras
import numpy as np
import scipy

from dqn_keras import Config, make_q_network, train
from dqn_keras.environments import TWINS
from dqn_keras.statistics import Estimate

RECORDS = Path("results/published.csv")
FIRST_START = 1_000_000  # greedy episodes use gym seeds from here on, which no training run uses


class Settings(NamedTuple):
    """The settings of a published result, in this package's names, and the result."""

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
    epsilon_fraction: float  # share of num_steps over which epsilon falls linearly from 1
    epsilon_min: float
    hidden_units: tuple[int, int]
    clipnorm: float | None  # of the gradient's global norm
    loss: str
    published: str


# rl-zoo3's hyperparams/dqn.yml, and what sb3-contrib's docs/modules/qrdqn.md reports for it.
SB3 = (256, 256), 10.0, "huber"
ZOO = (
    Settings("CartPole-v1", 20, 50_000, 2.3e-3, 64, 100_000, 1_000, 0.99, 10, 256, 128, 0.16, 0.04, *SB3, "500 ± 0"),
    Settings("MountainCar-v0", 10, 120_000, 4e-3, 128, 10_000, 1_000, 0.98, 600, 16, 8, 0.2, 0.07, *SB3, "-107 ± 4"),
    Settings("LunarLander-v3", 10, 100_000, 6.3e-4, 128, 50_000, 0, 0.99, 250, 4, 4, 0.12, 0.1, *SB3, "195 ± 28 (v2)"),
    Settings("Acrobot-v1", 10, 100_000, 6.3e-4, 128, 50_000, 0, 0.99, 250, 4, 4, 0.12, 0.1, *SB3, "-74 ± 2"),
)
# CleanRL's dqn.py and dqn_jax.py, and its docs/rl-algorithms/dqn.md.
CLEANRL = Settings(
    *("CartPole-v1", 10, 500_000, 2.5e-4, 128, 10_000, 10_000, 0.99, 500, 10, 1, 0.5, 0.05),
    *((120, 84), None, "mse", "488.7 ± 16.1 (dqn.py), 498.4 ± 2.3 (dqn_jax.py)"),
)


@dataclass
class Record:
    """The results of one run."""

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
    parser.add_argument("--seeds", type=int, default=20, help="most seeds, 0, 1, ... (20 of CartPole, 10 of others)")
    parser.add_argument("--programs", nargs="+", choices=PROGRAMS, default=list(PROGRAMS))
    names = [settings.environment for settings in ZOO]
    parser.add_argument("--environments", nargs="+", choices=names, default=names)
    arguments = parser.parse_args()
    for program, settings, seed in missing_runs(arguments.programs, arguments.environments, arguments.seeds):
        record = PROGRAMS[program].run(program, settings, seed)
        print(record, file=sys.stderr, flush=True)
        append_record(record)
    print_page(read_records())


def missing_runs(programs: list[str], environments: list[str], max_seeds: int) -> Iterator[tuple[str, Settings, int]]:
    """Yields the runs that are not in the file, seed by seed over all environments."""
    done = {(record.program, record.environment, record.seed) for record in read_records()}
    for seed in range(max_seeds):
        for program in programs:
            for settings in PROGRAMS[program].settings:
                is_wanted = settings.environment in environments and seed < settings.num_seeds
                if is_wanted and (program, settings.environment, seed) not in done:
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


def run_stable_baselines3(program: str, settings: Settings, seed: int) -> Record:
    """Trains and evaluates Stable-Baselines3's DQN, with its own defaults for everything not in the settings."""
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
        policy_kwargs={"net_arch": list(settings.hidden_units)},
        seed=seed,
        device="cpu",
    )
    agent.learn(settings.num_steps)
    seconds = time.perf_counter() - start
    training_returns = env.get_episode_rewards()
    greedy = greedy_returns(settings.environment, lambda states: agent.predict(states, deterministic=True)[0])
    return make_record(program, settings, seed, agent.num_timesteps, greedy, training_returns, seconds)


def run_dqn_keras(program: str, settings: Settings, seed: int, q_network: keras.Model | None = None) -> Record:
    """Trains and evaluates this package's DQN, with its default network or a given one."""
    start = time.perf_counter()
    env = TWINS[settings.environment]() if settings.environment in TWINS else gym.make(settings.environment)
    optimizer = keras.optimizers.Adam(settings.learning_rate, epsilon=1e-8, global_clipnorm=settings.clipnorm)
    run = train(env, config_of(settings), seed, q_network=q_network, optimizer=optimizer, loss=settings.loss, verbose=0)
    seconds = time.perf_counter() - start
    num_env_steps = sum(episode.steps for episode in run.episodes)
    greedy = greedy_returns(settings.environment, lambda states: np.argmax(run.q_network(states), axis=-1))
    complete = run.rewards[~np.isnan(run.rewards)]  # num_steps cuts the last episode short
    return make_record(program, settings, seed, num_env_steps, greedy, complete, seconds)


def run_from_torch_start(program: str, settings: Settings, seed: int) -> Record:
    """Does the same as `run_dqn_keras`, but starts with weights and biases distributed as in torch's Linear."""
    with gym.make(settings.environment) as env:
        q_network = make_q_network(env.observation_space.shape[0], int(env.action_space.n), settings.hidden_units)
    rng = np.random.default_rng(seed)
    for layer in q_network.layers:
        bound = 1 / math.sqrt(layer.kernel.shape[0])
        layer.set_weights([rng.uniform(-bound, bound, weights.shape) for weights in layer.get_weights()])
    return run_dqn_keras(program, settings, seed, q_network)


def config_of(settings: Settings) -> Config:
    """Returns the settings as this package's Config; the learning rate is the optimizer's."""
    # Stable-Baselines3 counts steps from 1 and ends with an update, after 50,176 steps of CartPole. Here, that update
    # comes at the step with index 50,176.
    num_steps = math.ceil(settings.num_steps / settings.steps_per_update) * settings.steps_per_update + 1
    # A target that is copied more often than Q changes is copied once per round of updates.
    steps_per_target = max(settings.steps_per_target, settings.steps_per_update)
    return Config(
        num_steps=num_steps,
        num_episodes=num_steps,
        memory_size=settings.memory_size,
        learning_starts=settings.learning_starts,
        batch_size=settings.batch_size,
        gamma=settings.gamma,
        steps_count_from="run",
        steps_per_update=settings.steps_per_update,
        gradient_steps=settings.gradient_steps,
        gradient_steps_per_target=steps_per_target * settings.gradient_steps // settings.steps_per_update,
        tau=1.0,
        epsilon_steps=round(settings.epsilon_fraction * settings.num_steps),
        epsilon_min=settings.epsilon_min,
        hidden_units=settings.hidden_units,
        solved_reward=None,
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
    settings: Settings,
    seed: int,
    num_env_steps: int,
    greedy: np.ndarray,
    training_returns: list[float] | np.ndarray,
    seconds: float,
) -> Record:
    """Returns the record of one run; `seconds` is the time of training."""
    greedy_return, greedy_return_10 = float(np.mean(greedy)), float(np.mean(greedy[:10]))
    training_return = float(np.mean(training_returns[-100:]))
    means = round(greedy_return, 3), round(greedy_return_10, 3), round(training_return, 3)
    return Record(program, settings.environment, seed, num_env_steps, *means, round(seconds, 1))


class Program(NamedTuple):
    """A program and its settings."""

    run: Callable[[str, Settings, int], Record]
    settings: tuple[Settings, ...]


PROGRAMS = {
    "stable_baselines3": Program(run_stable_baselines3, ZOO),
    "dqn_keras": Program(run_dqn_keras, ZOO),
    "dqn_keras_torch_start": Program(run_from_torch_start, ZOO),
    "dqn_keras_cleanrl": Program(run_dqn_keras, (CLEANRL,)),
}


def print_page(records: list[Record]) -> None:
    """Prints the page of results."""
    packages = "tensorflow", "keras", "stable_baselines3", "torch", "gymnasium", "numpy"
    versions = ", ".join(f"{package} {importlib.metadata.version(package)}" for package in packages)
    print(f"""# Published tables of DQN, run again

`python -m benchmarks.published`, one core (Python {platform.python_version()}, {versions}).
Every run: [published.csv](published.csv).

The settings are rl-zoo3's (`hyperparams/dqn.yml`). "Published" is sb3-contrib's table for them
(`docs/modules/qrdqn.md`): the mean over 3 to 5 seeds of 10 greedy episodes, ± the standard error. "SB3 here" is
Stable-Baselines3's DQN, run with these settings. "torch's start" is this package, with networks that start as torch's
do, and "Keras' start" is this package with its own networks. Adam's epsilon is torch's in all of them, 1e-8; Keras' own
is 1e-7.

A cell holds the mean over the seeds (from 5 seeds on, its 95 % interval, percentile bootstrap over the seeds), the
median and the number of seeds; each seed counts with its mean return. In the columns p, this package is compared with
"SB3 here": the p-values of Mann-Whitney's U, and of a permutation test of the difference of the means.
A high p does not prove that the two are equal: with so few seeds, only large differences would show.
""")
    measures = {
        "## 100 greedy episodes after training": "greedy_return",
        "## The first 10 of them, the published measure": "greedy_return_10",
        "## Training: the last 100 episodes, with epsilon at its minimum": "training_return",
    }
    for title, measure in measures.items():
        print_table(title, records, measure)
    print_starts(records)
    print_cleanrl(returns_of(records, "dqn_keras_cleanrl", "CartPole-v1", "training_return"))
    print(DIFFERENCES)


def print_table(title: str, records: list[Record], measure: str) -> None:
    """Prints the table of one measure, with a row for each environment."""
    print(
        f"{title}\n\n| | published | SB3 here | torch's start | p | Keras' start | p |\n|---|---|---|---|---|---|---|"
    )
    for settings in ZOO:
        theirs = returns_of(records, "stable_baselines3", settings.environment, measure)
        cells = [settings.environment, settings.published if measure != "training_return" else "", show(theirs)]
        for program in ("dqn_keras_torch_start", "dqn_keras"):
            ours = returns_of(records, program, settings.environment, measure)
            cells += [show(ours), equality(theirs, ours)]
        print("|", " | ".join(cells), "|")
    print()


def print_starts(records: list[Record]) -> None:
    """Prints whether this package's two starts differ: the same program and settings, only other initial weights."""
    print("""## What the initial weights change

"torch's start" against "Keras' start", the p-values of the same two tests. Nothing else differs between the two.

| | 100 greedy episodes after training | training |
|---|---|---|""")
    for settings in ZOO:
        cells = [settings.environment]
        for measure in ("greedy_return", "training_return"):
            programs = "dqn_keras_torch_start", "dqn_keras"
            cells.append(
                equality(*(returns_of(records, program, settings.environment, measure) for program in programs))
            )
        print("|", " | ".join(cells), "|")
    print()


def print_cleanrl(returns: np.ndarray) -> None:
    """Prints the results for CleanRL's setting."""
    deviation = f"{np.std(returns, ddof=1):.1f}" if len(returns) > 1 else "-"
    print(f"""## CleanRL's CartPole-v1

500,000 steps with the settings of CleanRL's `dqn.py`. The measure is CleanRL's: the training return at epsilon 0.05,
here over the last 100 episodes. CleanRL publishes 3 seeds.

| published | Keras' start | standard deviation over the seeds |
|---|---|---|
| {CLEANRL.published} | {show(returns)} | {deviation} |
""")


DIFFERENCES = """## What is not the same

- Both programs store a time limit as a truncation, and bootstrap from it. In the published runs,
  Stable-Baselines3 still stored it as a terminal state. LunarLander was v2 then and is v3 here.
- The memory: Stable-Baselines3 samples a batch with replacement, this package without. It learns only when the memory
  holds a whole batch.
- The networks start differently, except in the column "torch's start": Keras' kernels are Glorot uniform and its biases
  zero; in torch, both are uniform in ±1/sqrt(number of inputs).
- CartPole, Acrobot and MountainCar are this package's compiled twins in training, and Gymnasium's own in all greedy
  episodes. These start from the same 100 states for both programs.
"""


def returns_of(records: list[Record], program: str, environment: str, measure: str) -> np.ndarray:
    """Returns one measure for each seed."""
    chosen = [record for record in records if (record.program, record.environment) == (program, environment)]
    return np.array([getattr(record, measure) for record in chosen])


def show(returns: np.ndarray) -> str:
    """Returns mean, interval and median over the seeds, and their number, as text."""
    if len(returns) == 0:
        return "-"
    low = high = math.nan
    if len(returns) >= 5 and len(np.unique(returns)) > 1:
        rng = np.random.default_rng(0)
        low, high = scipy.stats.bootstrap([returns], np.mean, method="percentile", rng=rng).confidence_interval
    return f"{Estimate(float(np.mean(returns)), low, high)}; median {np.median(returns):.1f}; {len(returns)}"


def equality(first: np.ndarray, second: np.ndarray) -> str:
    """Returns, as text, the p-values of two tests that two samples have the same distribution."""
    if min(len(first), len(second)) < 2:
        return "-"
    u_test = scipy.stats.mannwhitneyu(first, second)
    rng = np.random.default_rng(0)
    means = scipy.stats.permutation_test((first, second), difference_of_means, vectorized=True, rng=rng)
    return f"{u_test.pvalue:.2g}, {means.pvalue:.2g}"


def difference_of_means(first: np.ndarray, second: np.ndarray, axis: int) -> np.ndarray:
    return np.mean(first, axis=axis) - np.mean(second, axis=axis)


if __name__ == "__main__":
    main()
