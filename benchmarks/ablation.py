"""Measures what each part of the algorithm does: compiled runs with one change at a time, each over many seeds.

    python -m benchmarks.ablation --file ablation.npz --figure results/ablation.png > results/ablation.md
    python -m benchmarks.ablation --seeds 20

With --file, the outcomes are saved in that file, and a repeated command trains only the missing seeds.
"""

import argparse
import dataclasses
import platform
from pathlib import Path
from typing import Any

import gymnasium as gym
import keras
import numpy as np
import tensorflow as tf

from dqn_keras import Config, Study, Sweep, double_td_targets, plot_sweep, sweep, sweep_table
from dqn_keras.environments import CartPole

ORIGINAL = Config()


class TimeLimitIsTerminal(CartPole):
    """CartPole with a terminal 500th step, as many published programs store it."""

    def initial(self, rng: Any) -> Any:
        return super().initial(rng), tf.constant(0)

    def transition(self, state: Any, action: Any, rng: Any) -> Any:
        physics, t = state
        return super().transition(physics, action, rng), t + 1

    def observation(self, state: Any, rng: Any) -> Any:
        return super().observation(state[0], rng)

    def reward(self, state: Any, action: Any, next_state: Any, rng: Any) -> Any:
        return super().reward(state[0], action, next_state[0], rng)

    def terminal(self, state: Any, rng: Any) -> Any:
        physics, t = state
        return super().terminal(physics, rng) | (t >= self.max_episode_steps)


def clipped_adam() -> keras.Optimizer:
    return keras.optimizers.Adam(ORIGINAL.alpha, global_clipnorm=1.0)


def changed(**fields: Any) -> Config:
    return dataclasses.replace(ORIGINAL, **fields)


RECOMMENDED = {"tau": 0.05, "gamma": 0.99, "epsilon_min": 0.01}
TWO_LAYERS, ORIGINAL_AT_475 = "hidden units 128, 128", "original, to be solved at 475"


SETTINGS: dict[str, Config | dict[str, Any]] = {
    "original": ORIGINAL,
    "slower target: tau 0.005": changed(tau=0.005),
    "faster target: tau 0.05": changed(tau=0.05),
    "no target network: tau 1": changed(tau=1.0),
    "hard target: a copy every 125 updates (500 steps)": changed(tau=1.0, gradient_steps_per_target=125),
    "no replay to speak of: memory of 64, the batch": changed(memory_size=64),
    "neither: tau 1 and a memory of 64": changed(tau=1.0, memory_size=64),
    "memory of 10,000": changed(memory_size=10_000),
    "memory of 1,000,000: nothing is forgotten": changed(memory_size=1_000_000),
    "gamma 0.99": changed(gamma=0.99),
    "Double DQN": {"targets": double_td_targets},
    "Huber loss": {"loss": "huber"},
    "gradients clipped to a norm of 1": {"optimizer": clipped_adam},
    TWO_LAYERS: changed(hidden_units=(128, 128)),
    "an update at every step": changed(steps_per_update=1),
    "time limit stored as terminal": {"env": TimeLimitIsTerminal()},
    "recommended": changed(**RECOMMENDED),
    ORIGINAL_AT_475: changed(solved_reward=475.0),
    "recommended, to be solved at 475": changed(**RECOMMENDED, solved_reward=475.0),
}


FEWER_SEEDS = {TWO_LAYERS: 50, ORIGINAL_AT_475: 50}
"""Settings that solve almost no seed, so that each seed takes 10 to 50 times as long."""


def run(num_seeds: int, file: Path | None) -> Sweep:
    """Makes the sweep, or continues the one in `file`."""
    found: dict[str, Study] = {}
    for names, most in [(SETTINGS.keys() - FEWER_SEEDS, num_seeds), *(([name], n) for name, n in FEWER_SEEDS.items())]:
        settings = {name: SETTINGS[name] for name in SETTINGS if name in names}
        seeds = range(min(num_seeds, most))
        found |= sweep(CartPole(), settings, seeds, evaluate_on=CartPole(), file=file)
        if any(len(found[name].outcomes) < len(seeds) for name in settings):
            raise SystemExit("interrupted")
    return Sweep({name: found[name] for name in SETTINGS})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1_000, help="seeds 0, 1, ... of each setting (1,000)")
    parser.add_argument("--file", type=Path, help="save the outcomes in this file")
    parser.add_argument("--figure", type=Path, help="save the picture in this file")
    arguments = parser.parse_args()

    outcome = run(arguments.seeds, arguments.file)
    hours = sum(study.to_dict()["seconds"].sum() for study in outcome.values()) / 3600
    versions = f"tensorflow {tf.__version__}, keras {keras.__version__}, gymnasium {gym.__version__}"
    print("# One change at a time\n")
    print(f"`python -m benchmarks.ablation --seeds {arguments.seeds}`: compiled CartPole, seeds 0, 1, 2, ... (Python")
    print(f"{platform.python_version()}, {versions}, numpy {np.__version__}).")
    print("Each setting is the original with the change that its name says. Solved: a mean reward above 225 (475 where")
    print(
        "it is said) over 50 episodes, within 2,000 episodes. Late: after episode 500. Greedy return: the mean over the"
    )
    print("seeds of the mean of 100 episodes after the run. In brackets: 95 % intervals.\n")
    print(sweep_table(outcome))
    num_steps = sum(study.num_env_steps for study in outcome.values())
    print(f"\nRecommended: {', '.join(f'{name}={value}' for name, value in RECOMMENDED.items())}.")
    print(f"All runs together took {num_steps:,} env steps and {hours:.1f} hours of one core.")
    if arguments.figure:
        plot_sweep(outcome)[0].figure.savefig(arguments.figure, dpi=90)


if __name__ == "__main__":
    main()
