"""Makes the pictures of the page "When it does not learn": one run for each cause.

    python -m benchmarks.symptoms > results/symptoms.md

Every run is CartPole-v1 with seed 0 and the default parameters, except for one mistake. After training, it plays 20
greedy episodes. The pictures are made by `plot_run`, in results/symptoms/.
"""

import importlib.metadata
import platform
from pathlib import Path

import gymnasium as gym
import matplotlib as mpl
import numpy as np

from dqn_keras import Config, evaluate, plot_run, train

FOLDER = Path(__file__).parent.parent / "results" / "symptoms"


class EndsAsTruncations(gym.Wrapper):
    """Makes a common mistake: when the pole falls, the environment returns `truncated`."""

    def step(self, action):
        state, reward, terminated, truncated, info = super().step(action)
        return state, reward, False, terminated or truncated, info


class HugeObservations(gym.ObservationWrapper):
    """Returns angles in thousandths of a degree and positions in millimetres."""

    def observation(self, observation):
        return (observation * np.array([1_000, 1_000, 57_296, 57_296])).astype(np.float32)


def make_env(*wrappers):
    env = gym.make("CartPole-v1")
    for wrapper in wrappers:
        env = wrapper(env)
    return env


SYMPTOMS = {
    "sound": ("nothing", (), {}),
    "not_yet": ("stopped after 150 episodes", (), {"num_episodes": 150}),
    "explores_for_ever": ("decay=0.9999: it explores nearly always", (), {"decay": 0.9999, "num_episodes": 400}),
    "ends_as_truncations": ("a fall is called truncated", (EndsAsTruncations,), {"num_episodes": 400}),
    "no_slow_target": ("tau=1: Q-hat is Q itself", (), {"tau": 1.0, "num_episodes": 400}),
    "learning_rate_too_high": ("alpha=0.05", (), {"alpha": 0.05, "num_episodes": 400}),
    "learning_rate_too_low": ("alpha=0.00001", (), {"alpha": 0.00001, "num_episodes": 400}),
    "observations_too_large": ("observations in the thousands", (HugeObservations,), {"num_episodes": 400}),
    "memory_too_small": ("memory_size=500", (), {"memory_size": 500, "num_episodes": 600}),
    "rewards_scaled": (
        "rewards of 100",
        (lambda env: gym.wrappers.TransformReward(env, lambda r: 100 * r),),
        {"num_episodes": 400, "solved_reward": 22500},
    ),
}


def main() -> None:
    mpl.use("Agg")
    FOLDER.mkdir(exist_ok=True)
    versions = [f"{p} {importlib.metadata.version(p)}" for p in ("tensorflow", "keras", "gymnasium", "numpy")]
    print("# What it looks like when it does not learn\n")
    print(
        "`python -m benchmarks.symptoms`: CartPole-v1, default parameters except for what is wrong, seed 0; "
        "20 greedy episodes."
    )
    print(f"Python {platform.python_version()}, {', '.join(versions)}.\n")
    print("| what is wrong | episodes | reward, last 50 | greedily | max Q, last 50 | its bound | terminal share |")
    print("|---|---|---|---|---|---|---|")
    for name, (wrong, wrappers, parameters) in SYMPTOMS.items():
        env = make_env(*wrappers)
        run = train(env, Config(**parameters), seed=0, verbose=0)
        plot_run(run, speed=False)[0].figure.savefig(FOLDER / f"{name}.png", dpi=80)
        returns, history = evaluate(env, run.q_network, 20, seed=0), run.history
        columns = [
            wrong,
            str(len(run.rewards)) if run.solved_at is None else f"solved in {run.solved_at}",
            f"{run.rewards[-50:].mean():.0f}",
            f"{returns.mean():.0f}",
            f"{max(history['max_q'][-50:]):.1f}",
            f"{history['q_bound'][-1]:.0f}",
            f"{history['terminal_share'][-1]:.1%}",
        ]
        print(f"| {' | '.join(columns)} |", flush=True)


if __name__ == "__main__":
    main()
