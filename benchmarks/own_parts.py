"""What other numbers and parts of one's own cost beside the training: CPU seconds and memory.

    python -m benchmarks.own_parts > results/own_parts.md

Each row is a process of its own, on one core. In it `train` runs several times, each run with something new. A run with
a part of one's own comes after one with the defaults, so that what the package compiles for itself is not counted. The
seconds are a run's CPU time less that of the same Config with default parts, run right after it, when nothing of that is
left to compile. Memory is what the process holds, after Python's garbage collector.
"""

import gc
import importlib.metadata
import json
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import gymnasium as gym

from dqn_keras import Config, double_td_targets, train
from dqn_keras._tensorflow import keras, tf
from dqn_keras.environments import CartPole

ENVIRONMENTS = {"Gymnasium": lambda: gym.make("CartPole-v1"), "compiled": CartPole}
CONFIG = Config(num_episodes=100)
CONFIGS = [
    CONFIG,
    Config(num_episodes=100, gamma=0.99),
    Config(num_episodes=100, tau=0.05),
    Config(num_episodes=100, alpha=0.0005),
    Config(num_episodes=100, decay=0.99),
    Config(num_episodes=100, solved_reward=100.0),
]
LOSSES = [
    lambda y, q: tf.abs(y - q),
    lambda y, q: tf.square(y - q) ** 2,
    lambda y, q: tf.sqrt(1 + tf.square(y - q)) - 1,
    lambda y, q: tf.math.log(tf.cosh(y - q)),
    lambda y, q: tf.where(q > y, 2.0, 1.0) * tf.square(y - q),
    lambda y, q: tf.minimum(tf.square(y - q), 1.0),
]


def new_parts() -> dict[str, Any]:
    """A network, an optimizer and targets; made anew, the program for them is the same."""
    layers = [keras.Input((4,)), keras.layers.Dense(64, "tanh"), keras.layers.Dense(2)]
    optimizer = keras.optimizers.AdamW(0.001, global_clipnorm=10)
    return {"q_network": keras.Sequential(layers), "optimizer": optimizer, "targets": double_td_targets}


SERIES: dict[str, Callable[[], Iterator[tuple[Config, dict]]]] = {
    "six Configs: another gamma, tau, alpha, decay, solved_reward": lambda: ((config, {}) for config in CONFIGS),
    "twelve lambdas as loss, of one formula": lambda: (
        (CONFIG, {"loss": lambda y, q: tf.square(y - q)}) for _ in range(12)
    ),
    "twelve times a new network, AdamW, double targets": lambda: ((CONFIG, new_parts()) for _ in range(12)),
    "six losses, of six formulas": lambda: ((CONFIG, {"loss": loss}) for loss in LOSSES),
}


def measure(make_env: Callable, config: Config, parts: dict[str, Any]) -> tuple[float, float]:
    """CPU seconds beyond the training of one run, and by how many megabytes the process has grown."""
    before = megabytes()
    seconds = cpu_seconds(make_env, config, parts)
    grown = megabytes() - before
    return seconds - cpu_seconds(make_env, config, {}), grown


def cpu_seconds(make_env: Callable, config: Config, parts: dict[str, Any]) -> float:
    start = time.process_time()
    train(make_env(), config, seed=0, verbose=0, **parts)
    return time.process_time() - start


def megabytes() -> float:
    gc.collect()
    with open("/proc/self/statm") as file:  # Linux
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run_series(loop: str, name: str) -> list[tuple[float, float]]:
    make_env, are_own = ENVIRONMENTS[loop], SERIES[name] is not next(iter(SERIES.values()))
    if are_own:
        cpu_seconds(make_env, CONFIG, {})
    return [measure(make_env, config, parts) for config, parts in SERIES[name]()]


def main() -> None:
    if len(sys.argv) == 3:  # one row, in a process of its own
        print(json.dumps(run_series(*sys.argv[1:])))
        return
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Linux; the processes inherit it
    versions = [f"{p} {importlib.metadata.version(p)}" for p in ("tensorflow", "keras", "gymnasium", "numpy")]
    print("# What other numbers and your own parts cost\n")
    print("`python -m benchmarks.own_parts`: runs of 100 episodes, one after the other, a process for each row, one core.")
    print("CPU seconds beyond training, and memory that stays. The first run compiles; what do the later ones cost?")
    print(f"Python {platform.python_version()}, {', '.join(versions)}.\n")
    print("| loop | runs | first, s | MB | later, s: median (highest) | MB of all the later |")
    print("|---|---|---|---|---|---|")
    for loop in ENVIRONMENTS:
        for name in SERIES:
            done = subprocess.run(
                [sys.executable, "-m", "benchmarks.own_parts", loop, name], capture_output=True, text=True, check=True
            )
            (first, first_megabytes), *later = json.loads(done.stdout)
            seconds, grown = zip(*later, strict=True)
            median, highest = statistics.median(seconds), max(seconds)
            row = [loop, name, f"{first:.2f}", f"{first_megabytes:.0f}", f"{median:.2f} ({highest:.2f})"]
            print(f"| {' | '.join(row)} | {sum(grown):.0f} |", flush=True)


if __name__ == "__main__":
    main()
