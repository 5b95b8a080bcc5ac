"""Measures what other numbers and your own parts cost in addition to training: CPU seconds and memory.

    python -m benchmarks.own_parts > results/own_parts.md

Each row is a separate process, on one core, that calls `train` several times, each time with something new. Rows with
own parts begin with a run with the defaults, which is not counted. The seconds are the CPU time of a run minus the CPU
time of a run of the same Config with the default parts, which comes right after it and needs no compilation. Memory is
the resident memory of the process, after Python's garbage collection, and after glibc has returned unused memory.
"""

import ctypes
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
from dqn_keras._engine.tensorflow import keras, tf
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
    """Returns a network, an optimizer and targets: new objects at each call, which compute the same."""
    layers = [keras.Input((4,)), keras.layers.Dense(64, "relu"), keras.layers.Dense(2)]
    optimizer = keras.optimizers.AdamW(0.001, global_clipnorm=10)
    return {"q_network": keras.Sequential(layers), "optimizer": optimizer, "targets": double_td_targets}


SERIES: dict[str, Callable[[], Iterator[tuple[Config, dict]]]] = {
    "six Configs": lambda: ((config, {}) for config in CONFIGS),
    "one loss, twelve times": lambda: ((CONFIG, {"loss": lambda y, q: tf.square(y - q)}) for _ in range(12)),
    "new parts, twelve times": lambda: ((CONFIG, new_parts()) for _ in range(12)),
    "six losses": lambda: ((CONFIG, {"loss": loss}) for loss in LOSSES),
}


def seconds_beyond_training(make_env: Callable, config: Config, parts: dict[str, Any]) -> float:
    return cpu_seconds(make_env, config, parts) - cpu_seconds(make_env, config, {})


def cpu_seconds(make_env: Callable, config: Config, parts: dict[str, Any]) -> float:
    start = time.process_time()
    train(make_env(), config, seed=0, verbose=0, **parts)
    return time.process_time() - start


def megabytes() -> float:
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # glibc returns unused memory
    with open("/proc/self/statm") as file:  # Linux
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def run_series(loop: str, name: str) -> dict[str, list[float]]:
    """Returns the seconds of each run, and the memory of the process before the first run and after each run."""
    make_env = ENVIRONMENTS[loop]
    if name != "six Configs":
        cpu_seconds(make_env, CONFIG, {})
    seconds, held = [], [megabytes()]
    for config, parts in SERIES[name]():
        seconds.append(seconds_beyond_training(make_env, config, parts))
        held.append(megabytes())
    return {"seconds": seconds, "megabytes": held}


def print_row(loop: str, name: str, seconds: list[float], megabytes: list[float]) -> None:
    first, *later = [round(x, 2) + 0.0 for x in seconds]
    cells = [
        loop,
        name,
        f"{first:.2f}",
        f"{megabytes[1] - megabytes[0]:.0f}",
        f"{statistics.median(later):.2f} ({min(later):.2f} to {max(later):.2f})",
        f"{round((megabytes[-1] - megabytes[1]) / len(later), 1) + 0.0:.1f}",
    ]
    print(f"| {' | '.join(cells)} |", flush=True)


def main() -> None:
    if len(sys.argv) == 3:  # one row, in a separate process
        print(json.dumps(run_series(*sys.argv[1:])))
        return
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Linux; the processes inherit it
    versions = [f"{p} {importlib.metadata.version(p)}" for p in ("tensorflow", "keras", "gymnasium", "numpy")]
    print("# What your own parts cost\n")
    print("`python -m benchmarks.own_parts`: each row is a process, on one core, that calls `train` several times, 100")
    print("episodes of CartPole each. Seconds are CPU time beyond the training; memory is what the process keeps.")
    print(f"Python {platform.python_version()}, {', '.join(versions)}.\n")
    print("| loop | runs | first run, s | it keeps, MB | a later run, s: median (range) | it keeps, MB (mean) |")
    print("|---|---|---|---|---|---|")
    for loop in ENVIRONMENTS:
        for name in SERIES:
            command = [sys.executable, "-m", "benchmarks.own_parts", loop, name]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            print_row(loop, name, **json.loads(done.stdout))
    print("""
Six Configs: they differ in gamma, tau, alpha, decay and solved_reward; the first run compiles what all of them use. One
loss: a new lambda for each run, of the same formula. New parts: a new network, AdamW and double targets for each run,
alike. Six losses: six formulas. Before the rows of own parts there is a run with the defaults.""")


if __name__ == "__main__":
    main()
