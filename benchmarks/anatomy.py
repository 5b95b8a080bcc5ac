"""Measures where the time of a compiled turn goes: each part alone, in a loop that XLA compiles, on one core.

    python -m benchmarks.anatomy > results/anatomy.md

A part is timed as the best of forty passes over 3,000 turns of its loop. The parts do not add up to the whole exactly:
compiled together, they are fused in other ways. XLA compiles a part to kernels, which it runs one by one. It compiles a
small loop, such as the four env steps of a turn, to a single kernel.
"""

import os
import re
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from dqn_keras import Config
from dqn_keras._engine.programs import Learner, stand_in
from dqn_keras._engine.tensorflow import tf  # before any other import of TensorFlow: it sets XLA's options
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import check_functional
from dqn_keras.environments import CartPole
from dqn_keras.learn import DEFAULT_FORMULAS, gradient_step, loss_values
from dqn_keras.loops.compiled import _Loop, _numbers, episodes
from dqn_keras.loops.draws import draw_bits, episode_key, sample_indices, step_rng
from dqn_keras.loops.updates import checked_step
from dqn_keras.replay import Experience, unpack

CONFIG = Config(epsilon=0.1, num_episodes=10**6)
TURNS = 3_000


def measure(part: Callable[[tf.Tensor], tf.Tensor]) -> tuple[float, int]:
    """Returns the microseconds and kernels of a call of `part` (number of the turn -> a scalar), compiled in a loop."""

    def loop() -> tf.Tensor:
        start = (tf.constant(0), tf.constant(0.0))
        return tf.while_loop(lambda i, _: i < TURNS, lambda i, x: (i + 1, x + part(i)), start)[1]

    compiled = tf.function(loop, jit_compile=True, autograph=False)
    compiled().numpy()
    best = np.inf
    for _ in range(40):
        start = time.perf_counter()
        compiled().numpy()
        best = min(best, time.perf_counter() - start)
    return best / TURNS * 1e6, num_kernels(compiled.experimental_get_compiler_ir()(stage="optimized_hlo"))


def num_kernels(program: str) -> int:
    """Returns the number of kernels in one pass of the outermost loop of a program, given as XLA's text."""
    computations, entry = {}, ""
    for text in re.split(r"\n(?=%|ENTRY)", program):
        name = re.match(r"(?:ENTRY )?(%\S+)", text)
        if name:
            computations[name[1]] = text
            entry = name[1] if text.startswith("ENTRY") else entry

    def count(name: str) -> int:
        total = 0
        for line in computations[name].splitlines()[1:]:
            operation = re.search(r"= .*? ([a-z-]+)\(", line)
            if not operation or operation[1] in ("parameter", "constant", "get-tuple-element", "tuple", "bitcast"):
                continue
            inner = re.findall(r"(?:body|to_apply|true_computation|false_computation)=(%[^\s,]+)", line)
            inner += [x for xs in re.findall(r"branch_computations=\{([^}]*)\}", line) for x in xs.split(", ")]
            is_one = operation[1] not in ("while", "call", "conditional") or "xla_cpu_small_call" in line
            total += 1 if is_one else max(map(count, inner))
        return total

    outermost = re.search(r" while\(.*body=(%[^\s,]+)", computations[entry])
    return count(outermost[1]) if outermost else 1


def matmul_gigaflops(size: int = 768) -> float:
    """Returns the speed of a large matrix product, the fastest arithmetic of this core in XLA."""
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
    """Returns the microseconds of a turn, and env steps per second, in long episodes."""
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


def parts_of_a_turn() -> dict[str, Callable[[tf.Tensor], tf.Tensor]]:
    agent, rng, env = make_agent((4,), 2, CONFIG, 0), np.random.default_rng(0), CartPole()
    learner: Learner = stand_in((4, 64, 2), jit_compile=True)  # it has the layers that a program compiles
    data = rng.normal(size=agent.memory.rows.shape).astype(np.float32)
    data[:, 8:] = np.stack([rng.integers(2, size=len(data)), np.ones(len(data)), np.zeros(len(data))], axis=1)
    rows, num_appended = tf.Variable(data), tf.Variable(0, dtype=tf.int64)
    indices = tf.constant(rng.integers(CONFIG.memory_size, size=CONFIG.batch_size), tf.int32)
    key = tf.constant(1, tf.int64)
    numbers = _numbers(env, agent, CONFIG, [0.1] * 100, 1)
    variables = rows, num_appended, tf.Variable(0, dtype=tf.int64)
    loop = _Loop(env, check_functional(env), CONFIG, DEFAULT_FORMULAS, learner, variables, numbers)

    def batch(i: tf.Tensor) -> Experience:
        return unpack(tf.gather(rows, (indices + i) % CONFIG.memory_size), (4,))

    def bits(i: tf.Tensor) -> tf.Tensor:
        return draw_bits(2 * CONFIG.steps_per_update + CONFIG.batch_size, episode_key(key, 0), i)

    def env_steps(i: tf.Tensor) -> tf.Tensor:
        drawn = bits(i)

        def step(j: tf.Tensor, state: Any, total: tf.Tensor) -> tuple[Any, ...]:
            draws = drawn[j], drawn[CONFIG.steps_per_update + j]
            state, reward, *_ = loop._step(state, tf.constant(0.1), *draws, step_rng(key, j))
            return j + 1, state, total + reward

        state = tf.zeros([4], tf.float64) + 1e-9 * tf.cast(i, tf.float64)
        start = (tf.constant(0), (state, tf.cast(state, tf.float32)), tf.constant(0.0))
        return tf.while_loop(lambda j, *_: j < CONFIG.steps_per_update, step, start)[2]

    def sample(i: tf.Tensor) -> tf.Tensor:
        drawn = sample_indices(bits(i)[2 * CONFIG.steps_per_update :], key, i, CONFIG.memory_size, CONFIG.memory_size)
        return tf.reduce_sum(unpack(tf.gather(rows, drawn), (4,)).state)

    def loss(i: tf.Tensor) -> tf.Tensor:
        return loss_values(batch(i), CONFIG.gamma, learner.q_network, learner.q_hat_network)

    def gradient(i: tf.Tensor) -> tf.Tensor:
        with tf.GradientTape() as tape:
            value = loss(i)
        weights = learner.q_network.trainable_variables
        return value + sum(tf.reduce_max(x) for x in tape.gradient(value, weights))

    return {
        "four env steps: act, step, write a row of the memory": env_steps,
        "draw 64 different indices, gather their batch": sample,
        "gather a given batch": lambda i: tf.reduce_sum(batch(i).state),
        "… and the loss (one pass through each network)": loss,
        "… and the gradient": gradient,
        "… and Adam, the soft update, the metrics": lambda i: (
            gradient_step(batch(i), CONFIG.gamma, *learner, CONFIG.tau).loss
        ),
        "… and the check that all weights are finite: the whole update": lambda i: (
            checked_step(batch(i), learner, CONFIG.gamma, CONFIG.tau, DEFAULT_FORMULAS).loss
        ),
    }


def main() -> None:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # Linux
    print("# Where the time of the compiled loop goes\n")
    print("`python -m benchmarks.anatomy`, one core, best of forty. A turn is up to four env steps and an update.")
    print("A row that begins with … contains the rows before it, back to the one without.\n")
    print("| part | microseconds | kernels |")
    print("|---|---|---|")
    for name, part in parts_of_a_turn().items():
        microseconds, kernels = measure(part)
        print(f"| {name} | {microseconds:.1f} | {kernels} |", flush=True)
    turn, steps_per_second = whole_turn()
    print(f"| a whole turn in long episodes ({steps_per_second:,.0f} env steps/s) | {turn:.1f} | |")
    b, (f, u, a) = CONFIG.batch_size, (4, CONFIG.hidden_units[0], 2)
    flops = 2 * b * (2 * (f * u + u * a) + (f * u + 2 * u * a))  # two forward passes; both kernels and the hidden layer
    gigaflops = matmul_gigaflops()
    print(f"""
The matrix products of an update are {flops:,} floating-point operations. At the {gigaflops:.0f} Gflop/s of a large
product on this core they would take {flops / gigaflops / 1e3:.1f} microseconds: the physical limit, were small
products as fast as large ones. The rest is what small ones cost, the start of each kernel, the loop around them, random
numbers, and the environment.""")


if __name__ == "__main__":
    main()
