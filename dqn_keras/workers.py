"""Trains many seeds and settings in parallel, in processes on this machine or on a Ray cluster."""

import contextlib
import functools
import hashlib
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import uuid
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from types import ModuleType
from typing import Any, NamedTuple

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from joblib import Parallel, delayed, parallel_config

from dqn_keras._engine.cache import fetch, publish
from dqn_keras._engine.libraries import is_of_a_library
from dqn_keras._engine.programs import shared_in
from dqn_keras._engine.recycling import recycle
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.config import Config
from dqn_keras.evaluation import evaluate
from dqn_keras.interruption import TrainingInterrupted
from dqn_keras.learn import td_targets
from dqn_keras.metrics import Outcome
from dqn_keras.storage.parts import describe
from dqn_keras.training import train


class Setting(NamedTuple):
    """The arguments that all seeds of a study share."""

    env: gym.Env | FuncEnv
    config: Config = Config()
    q_network: Callable[[int], keras.Model] | None = None
    """Returns a new network for a seed."""
    optimizer: Callable[[], keras.Optimizer] | None = None
    """Returns a new optimizer."""
    targets: Callable = td_targets
    loss: str | Callable | None = None
    evaluate_on: gym.Env | FuncEnv | None = None

    def own_parts(self, seed: int) -> dict[str, Any]:
        """Returns new parts for one seed, as arguments of `train`."""
        return {
            "q_network": None if self.q_network is None else self.q_network(seed),
            "optimizer": None if self.optimizer is None else self.optimizer(),
            "targets": self.targets,
            "loss": self.loss,
        }


class Task(NamedTuple):
    """One seed of one setting, given by its name."""

    name: str
    seed: int


Results = Generator[tuple[Task, Outcome] | None, None, None]


def results(settings: Mapping[str, Setting], tasks: Sequence[Task], engine: str, num_workers: int) -> Results:
    """Trains the tasks and yields each with its outcome as soon as it ends; yields None for an interrupted run."""
    names = {task.name for task in tasks}
    pickled = {name: _pickled(setting) for name, setting in settings.items() if name in names}
    yield from ENGINES[engine](pickled, tasks, num_workers)
    fetch()  # what the workers have compiled


class _Pickled(NamedTuple):
    """A setting, pickled for a worker."""

    content: bytes
    computes: str
    """Digest of what a functional environment computes in this process."""
    key: str
    """Unique to this setting of this study."""


def _pickled(setting: Setting) -> _Pickled:
    """Pickles a setting. If that fails, as it may after rendering, pickles the specs of its environments instead."""
    computes = describe(setting.env)[0].computes
    try:
        content = _pickled_with_its_modules(setting)
    except (TypeError, AttributeError, pickle.PicklingError):
        envs = {name: env for name in ("env", "evaluate_on") if (env := getattr(setting, name)) is not None}
        specs: dict[str, Any] = {name: x.spec for name, x in envs.items() if isinstance(x, gym.Env) and x.spec}
        if not specs:
            raise
        content = _pickled_with_its_modules(setting._replace(**specs))
    return _Pickled(content, computes, uuid.uuid4().hex)


def _pickled_with_its_modules(thing: Any) -> bytes:
    """Pickles something with the user's modules as they are in memory; a worker would import them from the disk."""
    modules = [x for x in sys.modules.copy().values() if isinstance(x, ModuleType) and not is_of_a_library(x)]
    modules = [x for x in modules if sys.modules.get(x.__name__) is x and x.__name__ != "__main__"]
    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        return cloudpickle.dumps(thing)
    except Exception:  # a module holds something that cannot be pickled, such as a lock
        pass
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)
    return cloudpickle.dumps(thing)


@functools.lru_cache(maxsize=100)
def _unpickled(pickled: _Pickled) -> tuple[Setting, dict]:
    """Unpickles a setting once in this process; also returns a dictionary for the programs compiled for it."""
    setting: Setting = cloudpickle.loads(pickled.content)
    setting = setting._replace(env=_made(setting.env), evaluate_on=_made(setting.evaluate_on))
    if describe(setting.env)[0].computes != pickled.computes:
        raise ValueError(
            f"num_workers must be 1 for env {type(setting.env).__name__}, which computes something else in a worker: a "
            "worker imports modules from the disk, without changes that were made after their import"
        )
    return setting, {}


def _made(env: Any) -> Any:
    """Makes the environment of a spec; returns an environment unchanged."""
    return gym.make(env) if isinstance(env, gym.envs.registration.EnvSpec) else env


def _train_seed(pickled: _Pickled, seed: int) -> Outcome | None:
    """Trains one seed in this process; returns None if it was interrupted."""
    setting, programs = _unpickled(pickled)
    try:
        with shared_in(programs):
            start = time.perf_counter()
            run = train(setting.env, setting.config, seed, **setting.own_parts(seed), verbose=0)
            seconds = time.perf_counter() - start
            greedy_return = np.nan
            if setting.evaluate_on is not None:
                returns = evaluate(setting.evaluate_on, run.q_network, seed=seed, max_steps=setting.config.max_steps)
                greedy_return = float(returns.mean())
    except TrainingInterrupted:
        return None
    weights = [*run.q_network.get_weights(), *run.q_hat_network.get_weights()]
    digest = hashlib.sha256(b"".join(w.tobytes() for w in weights)).digest()
    steps = np.array([episode.steps for episode in run.episodes], np.int64)
    recycle(run.agent.learner)
    return Outcome(seed, run.rewards, steps, run.solved_at, greedy_return, seconds, digest)


def _train_seed_in_worker(pickled: _Pickled, task: Task) -> tuple[Task, Outcome] | None:
    """Trains one seed in a worker, where TensorFlow gets only one thread, because each core has a worker."""
    with contextlib.suppress(RuntimeError):  # TensorFlow has started already: the worker has had a task before
        tf.config.threading.set_intra_op_parallelism_threads(1)
    fetch()
    outcome = _train_seed(pickled, task.seed)
    publish()  # now, because a worker may be killed when the study ends
    return None if outcome is None else (task, outcome)


def _by_joblib(settings: Mapping[str, _Pickled], tasks: Sequence[Task], num_workers: int) -> Results:
    if num_workers == 1 or len(tasks) <= 1:
        for task in tasks:
            outcome = _train_seed(settings[task.name], task.seed)
            yield None if outcome is None else (task, outcome)
        return
    # loky replaces a worker whose memory has grown, for example when an optimizer is compiled for each seed. The new
    # worker continues, and no seed is lost.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs were given to the executor", UserWarning)
    publish()  # what this process has compiled, for the workers
    backend = parallel_config(backend="loky", inner_max_num_threads=1)
    with backend, _compilation_cache_in_children(), _interrupts_ignored_by_children():
        parallel = Parallel(
            n_jobs=min(num_workers, len(tasks)),
            batch_size=1,
            return_as="generator_unordered",
            max_nbytes=None,  # arrays are sent as they are; joblib would otherwise leave an empty folder behind
            temp_folder=tempfile.gettempdir(),
        )
        trained = parallel(delayed(_train_seed_in_worker)(settings[task.name], task) for task in tasks)
    yield from trained


@contextlib.contextmanager
def _compilation_cache_in_children() -> Iterator[None]:
    """Makes processes that start in the block use the cache of compiled programs, unless the user has set it."""
    is_chosen = "DQN_KERAS_CACHE" in os.environ
    os.environ.setdefault("DQN_KERAS_CACHE", "1")
    try:
        yield
    finally:
        if not is_chosen:
            del os.environ["DQN_KERAS_CACHE"]


@contextlib.contextmanager
def _interrupts_ignored_by_children() -> Iterator[None]:
    """Makes processes that start in the block ignore Ctrl-C, which a terminal sends to all; this process handles it."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _by_ray(settings: Mapping[str, _Pickled], tasks: Sequence[Task], _: int) -> Results:
    try:
        import ray
    except ImportError:
        raise ImportError('engine="ray" needs the extra `ray`: pip install "dqn_keras[ray]"') from None
    is_ours = not ray.is_initialized()
    if is_ours:
        ray.init(include_dashboard=False, log_to_driver=False)
    train_remotely = ray.remote(max_retries=3)(_train_seed_in_worker)
    stored = {name: ray.put(setting) for name, setting in settings.items()}
    waiting = [train_remotely.remote(stored[task.name], task) for task in tasks]
    try:
        while waiting:
            done, waiting = ray.wait(waiting)
            yield from ray.get(done)
    finally:
        for unfinished in waiting:
            ray.cancel(unfinished, force=True)
        if is_ours:
            ray.shutdown()


ENGINES = {"joblib": _by_joblib, "ray": _by_ray}
