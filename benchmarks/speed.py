"""Measures the env steps per second of the training loop and of other programs that do the same.

    python -m benchmarks.speed [--rounds 9] > results/speed.md

One process, one core, the same task for all: CartPole-v1, a 4-64-2 network, batch 64, an update every 4 env steps, a
soft update with each, epsilon fixed at 0.1. The programs take turns, round by round, each for about the same time, so
that a machine that slows down slows all of them. A ratio is the median over the rounds of the ratio within a round.
Imports and compilation are not timed. The time to the first update, which includes compilation, is printed separately.

Not included: purejaxrl (not on PyPI), CleanRL (its package on PyPI needs the old gym) and coax (needs dm_control).
"""

import argparse
import importlib.metadata
import importlib.util
import itertools
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import gymnasium as gym

from dqn_keras import Config
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import CheckedEnv, check_functional
from dqn_keras.environments import CartPole
from dqn_keras.loops.compiled import episodes as compiled_loop_episodes
from dqn_keras.loops.gymnasium import episodes
from dqn_keras.seeding import episode_seed
from tests.helpers import original_algorithm

CONFIG = Config(epsilon=0.1, epsilon_min=0.1, num_episodes=10**9 // 1000)
SEED = 0


def gymnasium_loop() -> Callable[[int], int]:
    """Returns a function that plays at least so many steps -> steps played; so do the functions below."""
    env = CheckedEnv(gym.make("CartPole-v1"))
    loop = episodes(env, make_agent((4,), 2, CONFIG, SEED), CONFIG)

    def play(num_steps: int) -> int:
        played = 0
        while played < num_steps:
            played += next(loop).steps
        return played

    return play


def compiled_loop() -> Callable[[int], int]:
    agent = make_agent((4,), 2, CONFIG, SEED)
    env = CartPole()
    loop = compiled_loop_episodes(env, check_functional(env), agent, CONFIG)

    def play(num_steps: int) -> int:
        start = agent.memory.num_appended
        while agent.memory.num_appended < start + num_steps:
            next(loop)
        return agent.memory.num_appended - start

    return play


def rejax() -> Callable[[int], int]:
    """Plays four environments in parallel, which gives one update per four env steps."""
    import jax
    from flax import linen as nn
    from rejax import DQN
    from rejax.networks import DiscreteQNetwork, EpsilonGreedyPolicy

    agent = EpsilonGreedyPolicy(DiscreteQNetwork)(
        hidden_layer_sizes=CONFIG.hidden_units, action_dim=2, activation=nn.relu
    )
    num_steps = 20_000
    algorithm = DQN.create(
        env="CartPole-v1",
        num_envs=4,
        total_timesteps=num_steps,
        eval_freq=num_steps,
        skip_initial_evaluation=True,
        buffer_size=CONFIG.memory_size,
        fill_buffer=CONFIG.batch_size,
        batch_size=CONFIG.batch_size,
        learning_rate=CONFIG.alpha,
        gamma=CONFIG.gamma,
        polyak=1 - CONFIG.tau,
        eps_start=0.1,
        eps_end=0.1,
        ddqn=False,
    ).replace(agent=agent, eval_callback=lambda *_: ())
    compiled = jax.jit(algorithm.train)
    keys = (jax.random.PRNGKey(k) for k in itertools.count())

    def play(_: int) -> int:
        jax.block_until_ready(compiled(next(keys)))
        return num_steps

    return play


def eager_original() -> Callable[[int], int]:
    agent = make_agent((4,), 2, CONFIG, SEED)
    env = gym.make("CartPole-v1")
    steps = original_algorithm.run(
        env, agent.q_network, agent.q_hat_network, agent.rng, lambda k: episode_seed(SEED, k), epsilon=0.1
    )
    return lambda num_steps: sum(1 for _ in itertools.islice(steps, num_steps))


def stable_baselines3() -> Callable[[int], int]:
    import torch
    from stable_baselines3 import DQN

    torch.set_num_threads(1)
    return _baseline(DQN)


def sbx() -> Callable[[int], int]:
    """Plays Stable-Baselines3's loop with a learning step that JAX compiles."""
    from sbx import DQN

    return _baseline(DQN)


def _baseline(algorithm: Any) -> Callable[[int], int]:
    model = algorithm(
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
    parser.add_argument("--rounds", type=int, default=9, help="number of timed rounds (9)")
    parser.add_argument("--seconds", type=float, default=1.5, help="approximate seconds per program and round (1.5)")
    arguments = parser.parse_args()

    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    programs = {
        "dqn_keras, compiled episodes": compiled_loop,
        "dqn_keras, Gymnasium loop": gymnasium_loop,
        "the original's way, eager": eager_original,
    }
    for module, name, make in [
        ("stable_baselines3", "Stable-Baselines3", stable_baselines3),
        ("sbx", "SBX (Stable-Baselines3's loop, JAX)", sbx),
        ("rejax", "rejax", rejax),
    ]:
        if importlib.util.find_spec(module):
            start = time.perf_counter()
            importlib.import_module(module)
            print(f"- {name}: imported in {time.perf_counter() - start:.1f} s", file=sys.stderr)
            programs[name] = make
        else:
            print(f'{name} is left out: pip install "dqn_keras[benchmarks]"', file=sys.stderr)
    packages = ["tensorflow", "keras", "gymnasium", "numpy", "stable-baselines3", "sbx-rl", "rejax", "jax"]
    installed = [p for p in packages if importlib.util.find_spec(p.removesuffix("-rl").replace("-", "_"))]
    versions = [f"{p} {importlib.metadata.version(p)}" for p in installed]
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
        print(f"- {name}: {time.perf_counter() - start:.1f} s from fresh networks to past the first update, compiled")
        start = time.perf_counter()
        played = plays[name](500)
        num_steps[name] = int(played / (time.perf_counter() - start) * arguments.seconds)
        speeds[name] = []
    for _ in range(arguments.rounds):
        for name, play in plays.items():
            start = time.perf_counter()
            played = play(num_steps[name])
            speeds[name].append(played / (time.perf_counter() - start))

    print(
        "\n| program | env steps/s, median (lowest to highest) | compiled episodes are faster by | Gymnasium loop by |"
    )
    print("|---|---|---|---|")
    for name, values in speeds.items():
        columns = [name, f"{statistics.median(values):,.0f} ({min(values):,.0f} to {max(values):,.0f})"]
        for ours in list(speeds.values())[:2]:
            ratios = [a / b for a, b in zip(ours, values, strict=True)]
            columns.append(f"{statistics.median(ratios):.1f} ({min(ratios):.1f} to {max(ratios):.1f})")
        print(f"| {' | '.join(columns)} |")


if __name__ == "__main__":
    main()
