"""Measures what many agents, runs and studies leave behind in one process."""

import gc
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import gymnasium as gym
import keras
import numpy as np
import psutil
from joblib.externals.loky import get_reusable_executor

from dqn_keras import Config, learn, make_networks, study, train
from dqn_keras.environments import CartPole

TINY = Config(num_episodes=2, batch_size=4, max_steps=20, solved_window=1)
WARM_UP = 40  # the memory that the first ones compile and allocate stays
SHARED_MEMORY = Path("/dev/shm")


def resident() -> float:
    """Returns the resident memory of this process in MB, without garbage."""
    gc.collect()
    return psutil.Process().memory_info().rss / 1e6


def held(folder: Path) -> dict[str, int]:
    """Counts what this process holds other than memory. `folder` has its temporary files and cache."""
    process, temporary = psutil.Process(), [x for x in folder.iterdir() if x.name != "cache"]
    return {
        "file descriptors": process.num_fds(),
        "threads": process.num_threads(),
        "processes": len(process.children(recursive=True)),
        "temporary files": len(temporary),
        "files in shared memory": sum(f"_{process.pid}_" in x.name for x in SHARED_MEMORY.iterdir()),
        "folders of processes in the cache": len(list(folder.glob("cache/*/process-*"))),
    }


def use_an_agent(seed: int) -> None:
    """Makes an agent as a script does, lets it learn, and drops it."""
    rng = np.random.default_rng(seed)
    states, next_states = rng.normal(size=(2, 8, 4)).astype(np.float32)
    batch = states, rng.integers(2, size=8), np.ones(8, np.float32), next_states, np.zeros(8, np.float32)
    q_network, q_hat_network = make_networks(4, 2, seed=seed)
    optimizer = keras.optimizers.Adam()
    for _ in range(3):
        learn(batch, 0.95, q_network, q_hat_network, optimizer)


def train_in_both_loops(seed: int) -> None:
    """Trains twice, in the Gymnasium loop and in compiled episodes."""
    with gym.make("CartPole-v1") as env:
        train(env, TINY, seed, verbose=0)
    train(CartPole(), TINY, seed, verbose=0)


def study_here(seed: int) -> None:
    """Makes a study of two seeds in this process."""
    study(CartPole(), TINY, [seed, seed + 1], num_workers=1, verbose=0)


def study_in_workers(seed: int) -> None:
    """Makes a study of two seeds in two worker processes, which joblib keeps for the next study."""
    study(CartPole(), TINY, [seed, seed + 1], num_workers=2, verbose=0)


def study_in_new_workers(num_studies: int) -> None:
    """Makes studies in two worker processes, which end after the last study."""
    for seed in range(num_studies):
        study_in_workers(seed)
    get_reusable_executor().shutdown(wait=True)


def growth(use: Callable[[int], None], number: int) -> float:
    """Returns the resident memory in MB that `number` uses add, after some uses to warm up."""
    for seed in range(WARM_UP):
        use(seed)
    before = resident()
    for seed in range(number):
        use(seed)
    return round(resident() - before, 1)


def long_runs(num_agents: int, num_trains: int, num_studies: int, num_in_workers: int) -> dict[str, float]:
    """Returns the growth of memory in MB for each kind of use, and the number of other things left at the end."""
    with tempfile.TemporaryDirectory() as folder:
        own = {"TMPDIR": folder, "DQN_KERAS_CACHE": f"{folder}/cache"}
        with mock.patch.dict(os.environ, own), mock.patch.object(tempfile, "tempdir", folder):
            for use in (use_an_agent, train_in_both_loops, study_here, study_in_new_workers):
                use(1)  # TensorFlow starts its threads, and Python its process for shared memory
            before = held(Path(folder))
            figures = {
                f"MB more after {num_agents} agents of learn": growth(use_an_agent, num_agents),
                f"MB more after {num_trains} runs": growth(train_in_both_loops, num_trains // 2),
                f"MB more after {num_studies} studies": growth(study_here, num_studies),
            }
            study_in_new_workers(num_in_workers)
            after = held(Path(folder))
    return figures | {f"{name} left": after[name] - before[name] for name in before}
