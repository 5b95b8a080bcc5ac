"""Measures the seconds from the start of a process to "solved", part by part.

    python -m benchmarks.solve [--seeds 12] > results/solve.md

Each seed has a fresh process on one core, timed from the start of Python to the end of training. The process then
trains the same seed again, with nothing left to compile: that is the time of training itself. (Python's garbage
collector runs in between, so that it does not count.) Last, it plays a longer run in the same way: 400 episodes without
a stop rule, about 50,000 env steps. A second process does all this with the cache of compiled programs that the first
one has filled, as the command line and notebooks do (`DQN_KERAS_CACHE`).

Run it in an environment with only the package, without the extra `benchmarks`.
"""

import argparse
import importlib.util
import os
import statistics
import subprocess
import sys
import tempfile
import time

PROGRAM = """
import gc
import time
start = time.perf_counter()
from dqn_keras import Config, train
from dqn_keras.environments import CartPole

def seconds_and_run(config):
    before = time.perf_counter()
    run = train(CartPole(), config, seed={seed}, verbose=0)
    return time.perf_counter() - before, run

imports = time.perf_counter() - start
first, run = seconds_and_run(Config())
solved = time.perf_counter()
gc.collect()
training, again = seconds_and_run(Config())
assert (run.rewards == again.rewards).all()
print(solved, imports, first - training, training, run.agent.memory.num_appended / training)
long = Config(num_episodes=400, solved_reward=501)
seconds_and_run(long)
seconds, run = seconds_and_run(long)
print(run.agent.memory.num_appended / seconds, again.solved_at)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12, help="seeds 0, 1, ... (12)")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Linux; the processes inherit it
    print("# From nothing to solved\n")
    print(f"`python -m benchmarks.solve --seeds {arguments.seeds}`: a fresh process for each seed, one core. Training")
    print("is a whole run except for its compilation; it includes building the networks. JAX, which Keras")
    print(f"and TensorFlow import if they find it, is {'' if importlib.util.find_spec('jax') else 'not '}installed.\n")
    print(
        "| seed | start to solved, s | second process, s | imports, s | trace, compile, s | training, s "
        "| env steps/s of it | env steps/s of 400 episodes | solved at |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    rows = []
    for seed in range(arguments.seeds):
        with tempfile.TemporaryDirectory() as cache:
            (first, *measured, solved_at), (second, *_) = (run_process(seed, cache) for _ in range(2))
        rows.append([float(x) for x in (first, second, *measured)])
        print_row(seed, rows[-1], solved_at)
    print_row("median", [statistics.median(column) for column in zip(*rows, strict=True)])


def run_process(seed: int, cache: str) -> list[str]:
    """Returns the seconds from the start of a process to solved, and the other numbers that it prints."""
    command, environment = [sys.executable, "-c", PROGRAM.format(seed=seed)], {**os.environ, "DQN_KERAS_CACHE": cache}
    start = time.perf_counter()  # both processes read the machine's clock
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    solved, *others = done.stdout.split()
    return [str(float(solved) - start), *others]


def print_row(name: int | str, row: list[float], solved_at: str = "") -> None:
    *seconds, training_speed, long_speed = row
    cells = [str(name), *(f"{x:.2f}" for x in seconds), f"{training_speed:,.0f}", f"{long_speed:,.0f}", solved_at]
    print(f"| {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
