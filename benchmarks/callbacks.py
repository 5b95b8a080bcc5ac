"""Measures what a log file and the progress bar cost.

    python -m benchmarks.callbacks [--rounds 15] > results/callbacks.md

Times whole runs of `train` in one process on one core, in turn: silent, and with keras.callbacks.CSVLogger and
verbose=2. The ratio compares the two times within a round. Both are compiled before, and give the same results.
"""

import argparse
import contextlib
import importlib.metadata
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium as gym

from dqn_keras import Config, train
from dqn_keras._engine.tensorflow import keras
from dqn_keras.environments import CartPole


def seconds(make_env: Callable, config: Config, callbacks: Sequence, verbose: int) -> float:
    env = make_env()
    with (
        open(os.devnull, "w") as nowhere,
        contextlib.redirect_stdout(nowhere),
        contextlib.redirect_stderr(nowhere),
    ):
        start = time.perf_counter()
        train(env, config, seed=0, callbacks=callbacks, verbose=verbose)
        return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=15, help="number of timed rounds (15)")
    rounds = parser.parse_args().rounds

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    versions = [f"{p} {importlib.metadata.version(p)}" for p in ("tensorflow", "keras", "gymnasium", "numpy")]
    print("# What a log file and the progress bar cost\n")
    print(
        "`python -m benchmarks.callbacks`: whole runs of `train`, seed 0, in turn in one process on one core; silent,"
    )
    print("and with CSVLogger and verbose=2. The ratio of their times within a round, median (quartiles).")
    print(f"Python {platform.python_version()}, {', '.join(versions)}; {rounds} rounds.\n")
    print("| loop | episodes | silent, s | with both, s | ratio |")
    print("|---|---|---|---|---|")
    for name, make_env, num_episodes in [
        ("Gymnasium loop", lambda: gym.make("CartPole-v1"), 300),
        ("compiled episodes", CartPole, 600),
    ]:
        config = Config(num_episodes=num_episodes, solved_reward=1e6)
        silent, logged = [], []
        for _ in range(rounds + 1):
            silent.append(seconds(make_env, config, (), 0))
            with tempfile.TemporaryDirectory() as folder:
                log = keras.callbacks.CSVLogger(Path(folder) / "log.csv")
                logged.append(seconds(make_env, config, [log], 2))
        silent, logged = silent[1:], logged[1:]  # the first round compiles
        low, ratio, high = statistics.quantiles([b / a for a, b in zip(silent, logged, strict=True)])
        times = [f"{statistics.median(x):.2f}" for x in (silent, logged)]
        print(
            f"| {name} | {num_episodes} | {times[0]} | {times[1]} | {ratio:.3f} ({low:.3f} to {high:.3f}) |", flush=True
        )


if __name__ == "__main__":
    main()
