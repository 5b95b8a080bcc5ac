"""Writes the networks for the page "Watch it learn": one for every tenth episode of a training run.

    python docs/snapshots.py [FILE]

It trains as the lesson does, with seed 0, and writes docs/assets/snapshots.js. The file is JSON behind `const RUN =`,
because a page that is opened from a folder may load scripts but not fetch files. Weights are rounded to five
significant digits.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import keras
import numpy as np

from dqn_keras import Config, train
from dqn_keras.seeding import evaluation_seed

FILE = Path(__file__).parent / "assets" / "snapshots.js"
BEFORE_JSON, AFTER_JSON = "const RUN = ", ";\n"
SEED = 0
EVERY = 10
NUM_STARTS = 10


class Snapshots(keras.callbacks.Callback):
    """Keeps the weights at the end of every tenth episode."""

    def __init__(self) -> None:
        super().__init__()
        self.weights: dict[int, list[np.ndarray]] = {}

    def on_epoch_end(self, epoch: int, logs: dict | None = None) -> None:
        """Keeps the weights of every tenth episode."""
        if epoch % EVERY == 0:
            self.weights[epoch] = self.model.get_weights()


def record() -> tuple[dict[str, Any], dict[int, list[np.ndarray]]]:
    """Trains. Returns what the file holds, and the weights of each snapshot before they are rounded."""
    snapshots = Snapshots()
    run = train(gym.make("CartPole-v1"), Config(), SEED, callbacks=[snapshots], verbose=0)
    weights = snapshots.weights | {run.episodes[-1].number: run.q_network.get_weights()}
    contents = {
        "seed": SEED,
        "solved_at": run.solved_at,
        "gamma": run.config.gamma,
        "solved_reward": run.config.solved_reward,
        "solved_window": run.config.solved_window,
        "starts": [start_state(k) for k in range(NUM_STARTS)],
        "rewards": [int(reward) for reward in run.rewards],
        "snapshots": [
            {
                "episode": episode,
                "epsilon": round(run.episodes[episode].epsilon, 4),
                "weights": [rounded(array).tolist() for array in arrays],
            }
            for episode, arrays in weights.items()
        ],
    }
    return contents, weights


def start_state(k: int) -> list[float]:
    """Returns the state in which episode k of `evaluate(env, q_network, seed=0)` starts."""
    env = gym.make("CartPole-v1")
    env.reset(seed=evaluation_seed(0, k))
    return env.unwrapped.state.tolist()


def rounded(array: np.ndarray) -> np.ndarray:
    """Returns the array with five significant digits, float64."""
    return np.vectorize(lambda x: float(f"{x:.5g}"), otypes=[np.float64])(array)


def write(contents: dict[str, Any], file: Path) -> None:
    """Writes the file, one line for each snapshot."""
    text = json.dumps(contents, separators=(",", ":"))
    file.write_text(BEFORE_JSON + text.replace('{"episode"', '\n{"episode"') + AFTER_JSON)


def read(file: Path = FILE) -> dict[str, Any]:
    """Returns what the file holds."""
    return json.loads(file.read_text().removeprefix(BEFORE_JSON).removesuffix(AFTER_JSON))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", nargs="?", type=Path, default=FILE, metavar="FILE")
    file = parser.parse_args().file
    contents, _ = record()
    write(contents, file)
    print(f"{file}: {len(contents['snapshots'])} networks, solved at episode {contents['solved_at']}")
