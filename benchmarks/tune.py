"""Searches for settings that solve Acrobot or MountainCar, with Optuna.

Acrobot's preset has the best settings of such a search, rounded. MountainCar's preset was found by hand instead.

    python -m benchmarks.tune Acrobot-v1 --trials 40
    python -m benchmarks.tune MountainCar-v0 --trials 40

A trial trains seeds 1000 to 1003, which benchmarks.presets does not use. It is scored by the mean greedy return of 100
episodes after training, minus a penalty for environment steps: one point for each 10,000.
"""

import argparse
import sys

import numpy as np
import optuna

from dqn_keras import Config, study
from dqn_keras.environments import TWINS

SEEDS = range(1_000, 1_004)
MOST_STEPS = 250_000


def acrobot(trial: optuna.Trial) -> Config:
    return Config(
        alpha=trial.suggest_float("alpha", 3e-4, 3e-3, log=True),
        gamma=trial.suggest_categorical("gamma", [0.98, 0.99, 0.995]),
        tau=trial.suggest_float("tau", 0.003, 0.1, log=True),
        decay=trial.suggest_float("decay", 0.9, 0.98),
        epsilon_min=0.01,
        hidden_units=(trial.suggest_categorical("hidden_units", [64, 128]),),
        solved_reward=trial.suggest_categorical("solved_reward", [-100.0, -90.0, -85.0]),
        solved_window=100,
        num_steps=MOST_STEPS,
    )


def mountain_car(trial: optuna.Trial) -> Config:
    return Config(
        alpha=trial.suggest_float("alpha", 5e-4, 4e-3, log=True),
        gamma=trial.suggest_categorical("gamma", [0.98, 0.99, 0.995]),
        tau=1.0,
        gradient_steps_per_target=trial.suggest_categorical("gradient_steps_per_target", [100, 200, 400]),
        steps_per_update=trial.suggest_categorical("steps_per_update", [2, 4]),
        epsilon=trial.suggest_float("epsilon", 0.03, 0.3, log=True),
        epsilon_steps=trial.suggest_int("epsilon_steps", 5_000, 40_000, step=5_000),
        epsilon_min=0.01,
        hidden_units=(64, 64),
        solved_reward=-110.0,
        solved_window=100,
        num_steps=MOST_STEPS,
    )


SPACES = {"Acrobot-v1": acrobot, "MountainCar-v0": mountain_car}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("environment", choices=SPACES)
    parser.add_argument("--trials", type=int, default=40, help="number of trials (40)")
    parser.add_argument("--workers", type=int, default=None, help="number of processes (one for each core)")
    arguments = parser.parse_args()
    twin = TWINS[arguments.environment]

    def score(trial: optuna.Trial) -> float:
        config = SPACES[arguments.environment](trial)
        outcome = study(twin(), config, SEEDS, evaluate_on=twin(), num_workers=arguments.workers, verbose=0)
        steps = outcome.env_steps_to_solved
        greedy = np.array([seed.greedy_return for seed in outcome.outcomes])
        print(trial.number, "steps", steps, "greedy", greedy.round(1), trial.params, file=sys.stderr, flush=True)
        return float(np.mean(greedy) - np.mean(steps) / 10_000)

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    search = optuna.create_study(direction="maximize", sampler=optuna.samplers.TPESampler(seed=0))
    search.optimize(score, n_trials=arguments.trials)
    for trial in sorted(search.trials, key=lambda trial: -trial.value)[:5]:
        print(f"{trial.value:.1f}", trial.params)


if __name__ == "__main__":
    main()
