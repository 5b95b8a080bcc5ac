"""From nothing to "solved": the seconds of a fresh process, by their parts.

    python -m benchmarks.solve [--seeds 12] > results/solve.md

Each seed trains in a process of its own, on one core, from the start of Python to the end of training; then the same
seed once more in the same process, where nothing is left to compile: that is the training itself.
"""

import argparse
import os
import statistics
import subprocess
import sys
import time

PROGRAM = """
import time
start = time.perf_counter()
from dqn_keras import Config, train
from dqn_keras.environments import CartPole
imported = time.perf_counter()
run = train(CartPole(), Config(), seed={seed}, verbose=0)
trained = time.perf_counter()
again = train(CartPole(), Config(), seed={seed}, verbose=0)
end = time.perf_counter()
assert (run.rewards == again.rewards).all()
steps = sum(episode.steps for episode in run.episodes)
print(trained, imported - start, trained - imported, end - trained, steps, run.solved_at)
"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=12, help="seeds 0, 1, ... (12)")
    arguments = parser.parse_args()
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Linux; the processes inherit it
    print("# From nothing to solved\n")
    print(f"`python -m benchmarks.solve --seeds {arguments.seeds}`: a fresh process for each seed, one core.\n")
    print("| seed | start to solved, s | imports, s | trace, compile, s | training, s | env steps/s | solved at |")
    print("|---|---|---|---|---|---|---|")
    columns = []
    for seed in range(arguments.seeds):
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM.format(seed=seed)], capture_output=True, text=True, check=True
        )
        trained, imports, first, itself, steps, solved_at = done.stdout.split()
        # the clock is the machine's, the same in both processes
        parts = (float(trained) - start, float(imports), float(first) - float(itself), float(itself))
        columns.append((*parts, int(steps) / float(itself)))
        print(
            f"| {seed} | {' | '.join(f'{x:.2f}' for x in parts)} | {columns[-1][-1]:,.0f} | {solved_at} |", flush=True
        )
    medians = [statistics.median(column) for column in zip(*columns, strict=True)]
    print(f"| median | {' | '.join(f'{x:.2f}' for x in medians[:-1])} | {medians[-1]:,.0f} | |")


if __name__ == "__main__":
    main()
