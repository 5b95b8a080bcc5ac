"""Tests at full size that nothing is lost or silent: kills, stops, full disks, damaged files and bad arguments.

    python -m benchmarks.reliability [--kills 120] > results/reliability.md

The faults are in tests/helpers/faults.py and bad_configs.py; `make test` does the same at a smaller size. Linux only.
"""

import argparse
import collections
import platform
import signal
import tempfile
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import keras
import numpy as np
import tensorflow as tf
from hypothesis import HealthCheck, given, settings

from dqn_keras import Config, train
from dqn_keras._engine.programs import _shared
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import CheckedEnv, check_functional
from dqn_keras.environments import CartPole
from dqn_keras.loops import compiled
from dqn_keras.loops import updates as updates_module
from dqn_keras.storage.checkpoint import Checkpoints
from dqn_keras.storage.identity import identity
from tests.helpers import faults
from tests.helpers.bad_configs import bad_fields, refused
from tests.helpers.fuzz import fuzz
from tests.helpers.long_runs import long_runs


def bad_configs(number: int) -> dict[str, Any]:
    """Tries many bad fields: each must raise an error that begins with the field and shows the value."""
    tried: collections.Counter[str] = collections.Counter()

    @settings(max_examples=number, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(bad_fields)
    def refuse(field: tuple[str, Any]) -> None:
        tried[field[0]] += 1
        refused(*field)

    refuse()
    return {"bad Configs": sum(tried.values()), "fields": len(tried), "not an error with its name": 0}


def kills_with_own_parts(folder: str, num_kills: int) -> dict[str, int]:
    """Kills runs of six cases, ten times each."""
    return faults.kill_campaign(folder, num_kills, num_kills // 4, cases=tuple(faults.OWN_PARTS))


def forgotten() -> dict[str, int]:
    figures = collections.Counter()
    for loop in faults.LOOPS:
        with tempfile.TemporaryDirectory() as folder:
            for name, (missing, reset) in faults.forgetting_campaign(loop, folder).items():
                figures["parts dropped or reset"] += 2
                is_noticed = missing == "refused" and (reset in ("refused", "other bits") or name == "versions")
                figures["not noticed"] += not is_noticed
    return dict(figures)


def cost_of_checks() -> dict[str, str]:
    """Measures the share of the checks of the environment in an env step of training, in the Gymnasium loop."""
    env = gym.make("CartPole-v1")
    checked = CheckedEnv(env)

    def microseconds(step: Callable, reset: Callable) -> float:
        best = np.inf
        for _ in range(200):
            reset()
            start = time.perf_counter()
            for k in range(8):
                step(k % 2)
            best = min(best, (time.perf_counter() - start) / 8 * 1e6)
        return best

    def unchecked(a: int) -> None:
        state, reward, terminated, truncated, _ = env.step(a)
        return np.array(state, np.float32), reward, terminated, truncated

    bare = microseconds(unchecked, lambda: env.reset(seed=0))
    with_checks = microseconds(checked.step, lambda: checked.reset(0, 0))
    config = Config(num_episodes=300, solved_reward=1e6)
    for _ in range(2):  # the second has nothing to compile
        start = time.perf_counter()
        run = train(env, config, 0, verbose=0)
        whole = (time.perf_counter() - start) / run.agent.memory.num_appended * 1e6
    seconds = []
    with tempfile.TemporaryDirectory() as folder:
        checkpoints = Checkpoints(folder, identity(env, config, run.agent))
        for _ in range(20):
            start = time.perf_counter()
            checkpoints.save(run.agent)
            seconds.append(time.perf_counter() - start)
        size = checkpoints.paths()[0].stat().st_size
    return {
        "checks of an env step": f"{with_checks - bare:.1f} us of {whole:.0f} ({(with_checks - bare) / whole:.1%})",
        "a checkpoint": f"{np.median(seconds) * 1e3:.0f} ms, {size / 1e6:.1f} MB",
    }


def cost_of_compiled_checks(rounds: int = 30) -> dict[str, str]:
    """Measures the same for compiled episodes: their program with and without the checks, in turn."""
    checks, config = compiled.is_all_finite, Config(num_episodes=10**6, epsilon=0.1, solved_reward=1e6)
    loops = []
    for is_all_finite in (checks, lambda *_: tf.constant(True)):
        compiled.is_all_finite = updates_module.is_all_finite = is_all_finite
        _shared.clear()
        agent = make_agent((4,), 2, config, 0)
        loop = compiled.episodes(CartPole(), check_functional(CartPole()), agent, config)
        while agent.memory.num_appended < 60_000:
            next(loop)
        loops.append((agent, loop))
    compiled.is_all_finite = updates_module.is_all_finite = checks
    costs = []
    for _ in range(rounds):
        turns = []
        for agent, loop in loops:
            steps, updates, start = agent.memory.num_appended, agent.num_updates, time.perf_counter()
            while agent.memory.num_appended < steps + 20_000:
                next(loop)
            turns.append((time.perf_counter() - start) / (agent.num_updates - updates) * 1e6)
        costs.append(turns)
    with_checks, without = np.min(costs, axis=0)
    share = np.median([a / b for a, b in costs]) - 1
    return {"checks of a turn": f"{with_checks:.1f} us with them, {without:.1f} without (best); {share:.1%} (median)"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=120, help="number of SIGKILLs, a quarter of them in a save (120)")
    parser.add_argument("--only", default="", metavar="TEXT", help="only the rows with this text in their name")
    parser.add_argument("--own-kills", type=int, default=60, help="number of SIGKILLs of runs with own parts (60)")
    parser.add_argument("--races", type=int, default=12, help="number of pairs of processes in one folder (12)")
    parser.add_argument("--cases", type=int, default=2_500, help="number of calls of public functions (2,500)")
    parser.add_argument("--signals", type=int, default=24, help="number of SIGINTs and SIGTERMs (24)")
    parser.add_argument("--corruptions", type=int, default=5_000, help="number of corrupted checkpoints (5,000)")
    parser.add_argument("--configs", type=int, default=2_000, help="number of bad Configs (2,000)")
    arguments = parser.parse_args()
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # in a background job; the runs here must be interruptible
        signal.signal(signal.SIGINT, signal.default_int_handler)
    versions = f"tensorflow {tf.__version__}, keras {keras.__version__}, gymnasium {gym.__version__}"
    print("# Nothing lost, nothing silent\n")
    print(f"`python -m benchmarks.reliability --kills {arguments.kills} --signals {arguments.signals}`")
    print(f"`--corruptions {arguments.corruptions} --configs {arguments.configs} --own-kills {arguments.own_kills}`")
    print(f"`--races {arguments.races} --cases {arguments.cases}` (Python {platform.python_version()},")
    print(f"{versions}, numpy {np.__version__}). Every figure that should be 0 is in bold.\n")
    print("| what | figures |\n|---|---|")

    def in_folder(campaign: Callable, *numbers: int) -> Callable[[], dict[str, Any]]:
        def run() -> dict[str, Any]:
            with tempfile.TemporaryDirectory() as folder:
                return campaign(folder, *numbers)

        return run

    for what, campaign in {
        "SIGKILL at random times and inside saves, resumed each time; a run differs if a bit of its last checkpoint "
        "does (weights, target, Adam, memory, random state, rewards, counters) or a file is left over": in_folder(
            faults.kill_campaign, arguments.kills, arguments.kills // 4
        ),
        "the same with parts of the user's: a convolution, an LSTM, BatchNormalization, a schedule, targets and a loss "
        "with a variable, in both loops": in_folder(kills_with_own_parts, arguments.own_kills),
        "SIGINT and SIGTERM at random times, then resumed": in_folder(faults.signal_campaign, arguments.signals),
        "faults of the disk in the middle of a run, then resumed on the mended disk": in_folder(faults.disk_campaign),
        "two processes that train in one folder at once, or one after the other": in_folder(
            faults.race_campaign, arguments.races
        ),
        "each array and fact of a checkpoint taken out, then put back to its start, both loops": forgotten,
        "the newest checkpoint corrupted; silent is what was loaded, not told, or not replaced by the older one": (
            in_folder(faults.corruption_campaign, arguments.corruptions)
        ),
        "Config with a bad field": lambda: bad_configs(arguments.configs),
        "public functions with a bad argument": lambda: fuzz(arguments.cases),
        "many short agents, runs and studies in one process": lambda: long_runs(2_000, 500, 200, 20),
        "cost, Gymnasium loop on CartPole-v1": cost_of_checks,
        "cost, compiled episodes": cost_of_compiled_checks,
    }.items():
        if arguments.only not in what:
            continue
        start = time.perf_counter()
        figures = campaign()
        bad = (
            "differing runs",
            "not noticed",
            "silent",
            "not an error with its name",
            "not one warning",
            "litter",
            "foreign",
        )
        bad += ("nonsense", "refused")
        cells = []
        for name, value in figures.items():
            if isinstance(value, dict):
                value = ", ".join(f"{v:,} {k}" for k, v in sorted(value.items()))
            elif isinstance(value, list):
                value = len(value)
            cells.append(f"{name}: **{value}**" if name in bad else f"{name}: {value}")
        print(f"| {what} | {'; '.join(cells)}; {time.perf_counter() - start:.0f} s |", flush=True)


if __name__ == "__main__":
    main()
