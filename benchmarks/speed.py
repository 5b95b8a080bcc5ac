"""Env steps per second of the training loop, side by side with other ways to do the same.

    python -m benchmarks.speed [--rounds 9] > results/speed.md

One process, one core, the same task for all: CartPole-v1, a 4-64-2 network, batch 64, an update every 4 env steps, a
soft update with each, epsilon held at 0.1. The programs take turns, round by round, each for about the same time, so
that a machine that slows down slows all of them; a ratio is the median over the rounds of the ratio within a round.
Imports and compilation are outside the timed part; the time to the first update, which holds the compilation, is
printed apart.
"""

import argparse
import importlib.metadata
import importlib.util
import itertools
import os
import platform
import statistics
import time
from collections.abc import Callable

import gymnasium as gym

from dqn_keras import Config
from dqn_keras.agent import episode_seed, make_agent
from dqn_keras.environment import CheckedEnv
from dqn_keras.gymnasium_loop import episodes
from tests import original_algorithm

CONFIG = Config(epsilon=0.1, epsilon_min=0.1, num_episodes=10**9 // 1000)
SEED = 0


def gymnasium_loop() -> Callable[[int], int]:
    """Return a function: play at least so many steps -> steps played. The other programs alike."""
    env = CheckedEnv(gym.make("CartPole-v1"))
    loop = episodes(env, make_agent(4, 2, CONFIG, SEED), CONFIG)

    def play(num_steps: int) -> int:
        played = 0
        while played < num_steps:
            played += next(loop).steps
        return played

    return play


def eager_original() -> Callable[[int], int]:
    agent = make_agent(4, 2, CONFIG, SEED)
    env = gym.make("CartPole-v1")
    steps = original_algorithm.run(
        env, agent.q_network, agent.q_hat_network, agent.rng, lambda k: episode_seed(SEED, k), epsilon=0.1
    )
    return lambda num_steps: sum(1 for _ in itertools.islice(steps, num_steps))


def stable_baselines3() -> Callable[[int], int]:
    import torch
    from stable_baselines3 import DQN

    torch.set_num_threads(1)
    model = DQN(
        "MlpPolicy",
        gym.make("CartPole-v1"),
        learning_rate=CONFIG.alpha,
        buffer_size=CONFIG.memory_size,
        learning_starts=CONFIG.batch_size,
        batch_size=CONFIG.batch_size,
        tau=CONFIG.tau,
        gamma=CONFIG.gamma,
        train_freq=CONFIG.steps_per_update,
        target_update_interval=CONFIG.steps_per_update,
        exploration_initial_eps=0.1,
        exploration_final_eps=0.1,
        policy_kwargs={"net_arch": list(CONFIG.hidden_units)},
        seed=SEED,
        device="cpu",
    )

    def play(num_steps: int) -> int:
        model.learn(num_steps, reset_num_timesteps=False)
        return num_steps

    return play


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9, help="rounds that are timed (9)")
    parser.add_argument("--seconds", type=float, default=2.0, help="about how long each program plays per round (2)")
    arguments = parser.parse_args()

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    programs = {"dqn_keras, Gymnasium loop": gymnasium_loop, "the original's way, eager": eager_original}
    if importlib.util.find_spec("stable_baselines3"):
        programs["Stable-Baselines3"] = stable_baselines3
    packages = ["tensorflow", "keras", "gymnasium", "numpy", "stable-baselines3"]
    versions = [f"{p} {importlib.metadata.version(p)}" for p in packages[: len(programs) + 2]]
    print("# Env steps per second\n")
    print(
        "`python -m benchmarks.speed`: all programs in turn, in one process on one core; what is timed starts after the"
    )
    print("first update. The ratio is the median over rounds of the ratio within a round (lowest to highest).")
    print(f"Python {platform.python_version()}, {', '.join(versions)}; {arguments.rounds} rounds.\n")

    plays, speeds, num_steps = {}, {}, {}
    for name, make in programs.items():
        start = time.perf_counter()
        plays[name] = make()
        plays[name](4 * CONFIG.batch_size)
        print(f"- {name}: {time.perf_counter() - start:.1f} s from fresh networks to past the first update")
        start = time.perf_counter()
        played = plays[name](500)
        num_steps[name] = int(played / (time.perf_counter() - start) * arguments.seconds)
        speeds[name] = []
    for _ in range(arguments.rounds):
        for name, play in plays.items():
            start = time.perf_counter()
            played = play(num_steps[name])
            speeds[name].append(played / (time.perf_counter() - start))

    ours = speeds["dqn_keras, Gymnasium loop"]
    print("\n| program | env steps/s, median (lowest to highest) | this package is faster by |")
    print("|---|---|---|")
    for name, values in speeds.items():
        ratios = [a / b for a, b in zip(ours, values, strict=True)]
        spread = f"{statistics.median(values):,.0f} ({min(values):,.0f} to {max(values):,.0f})"
        print(f"| {name} | {spread} | {statistics.median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f}) |")


if __name__ == "__main__":
    main()
