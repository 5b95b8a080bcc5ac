"""Where the time of a compiled turn goes: its parts alone, each in a loop that XLA compiles, on one core.

    python -m benchmarks.anatomy > results/anatomy.md

A part is timed as the best of forty passes over 3,000 turns of its loop. The parts do not add up to the whole exactly:
compiled together, they are fused in other ways.
"""

import os
import time
from collections.abc import Callable

import numpy as np
import tensorflow as tf

from dqn_keras import Config
from dqn_keras._engine.programs import stand_in
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import check_functional
from dqn_keras.environments import CartPole
from dqn_keras.learn import gradient_step, loss_values
from dqn_keras.loops.compiled import episodes
from dqn_keras.loops.draws import draw_bits, sample_indices
from dqn_keras.replay import unpack

CONFIG = Config(epsilon=0.1, num_episodes=10**6)
TURNS = 3_000


def microseconds(part: Callable[[tf.Tensor], tf.Tensor]) -> float:
    """Of one call of `part` (number of the turn -> a scalar), compiled in a loop."""

    def loop() -> tf.Tensor:
        start = (tf.constant(0), tf.constant(0.0))
        return tf.while_loop(lambda i, _: i < TURNS, lambda i, x: (i + 1, x + part(i)), start)[1]

    compiled = tf.function(loop, jit_compile=True, autograph=False).get_concrete_function()
    compiled().numpy()
    best = np.inf
    for _ in range(40):
        start = time.perf_counter()
        compiled().numpy()
        best = min(best, time.perf_counter() - start)
    return best / TURNS * 1e6


def matmul_gigaflops(size: int = 768) -> float:
    """Of a large matrix product, the fastest that this core does arithmetic in XLA."""
    x = tf.random.stateless_normal([size, size], [0, 0])
    product = tf.function(lambda a: a @ a, jit_compile=True)
    product(x).numpy()
    best = np.inf
    for _ in range(10):
        start = time.perf_counter()
        product(x).numpy()
        best = min(best, time.perf_counter() - start)
    return 2 * size**3 / best / 1e9


def whole_turn() -> tuple[float, float]:
    """Microseconds of a turn, and env steps per second, of long episodes."""
    agent, env = make_agent((4,), 2, CONFIG, 0), CartPole()
    loop = episodes(env, check_functional(env), agent, CONFIG)
    while agent.memory.num_appended < 60_000:  # learn to balance first
        next(loop)
    best = (np.inf, 0.0)
    for _ in range(40):
        steps, updates, start = agent.memory.num_appended, agent.num_updates, time.perf_counter()
        while agent.memory.num_appended == steps:
            next(loop)
        seconds = time.perf_counter() - start
        turn = seconds / (agent.num_updates - updates) * 1e6
        best = min(best, (turn, (agent.memory.num_appended - steps) / seconds))
    return best


def main() -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Linux
    agent, rng = make_agent((4,), 2, CONFIG, 0), np.random.default_rng(0)
    learner = stand_in((4, 64, 2), jit_compile=True)  # whose layers are those that a program compiles
    data = rng.normal(size=agent.memory.rows.shape).astype(np.float32)
    data[:, 8:] = np.stack([rng.integers(2, size=len(data)), np.ones(len(data)), np.zeros(len(data))], axis=1)
    rows = tf.Variable(data)
    indices = tf.constant(rng.integers(CONFIG.memory_size, size=CONFIG.batch_size), tf.int32)
    key = tf.constant(1, tf.int64)

    def batch(i: tf.Tensor):
        return unpack(tf.gather(rows, (indices + i) % CONFIG.memory_size), (4,))

    def forward(i: tf.Tensor) -> tf.Tensor:
        return loss_values(batch(i), CONFIG.gamma, learner.q_network, learner.q_hat_network)

    def sample(i: tf.Tensor) -> tf.Tensor:
        return tf.cast(tf.reduce_max(sample_indices(draw_bits(CONFIG.batch_size, key, i), key, i, 50_000)), tf.float32)

    parts = {
        "gather the batch": lambda i: tf.reduce_sum(batch(i).state),
        "the same, and the loss (one pass through each network)": forward,
        "the same, with the gradient, Adam and the soft update: the whole update": lambda i: (
            gradient_step(batch(i), CONFIG.gamma, *learner, CONFIG.tau).loss
        ),
        "draw 64 different indices": sample,
    }
    print("# Where the time of the compiled loop goes\n")
    print("`python -m benchmarks.anatomy`, one core, best of forty. A turn is up to four env steps and an update.\n")
    print("| part | microseconds |")
    print("|---|---|")
    for name, part in parts.items():
        print(f"| {name} | {microseconds(part):.1f} |", flush=True)
    turn, steps_per_second = whole_turn()
    print(f"| a whole turn in long episodes ({steps_per_second:,.0f} env steps/s) | {turn:.1f} |")
    b, (f, u, a) = CONFIG.batch_size, (4, CONFIG.hidden_units[0], 2)
    flops = 2 * b * (2 * (f * u + u * a) + (f * u + 2 * u * a))  # two forward passes; both kernels and the hidden layer
    gigaflops = matmul_gigaflops()
    print(f"""
The matrix products of an update are {flops:,} floating-point operations. At the {gigaflops:.0f} Gflop/s of a large
product on this core they would take {flops / gigaflops / 1e3:.1f} microseconds: the physical limit, were small
products as fast as large ones. The rest is what small ones cost, the loop around them, random numbers, and the
environment.""")


if __name__ == "__main__":
    main()
