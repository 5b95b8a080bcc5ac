"""Many seeds of one run: how reliable is it? One seed is an anecdote."""

import contextlib
import dataclasses
import functools
import hashlib
import os
import pickle
import signal
import sys
import threading
import time
import uuid
import warnings
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from joblib import Parallel, cpu_count, delayed, parallel_config

from dqn_keras._engine.libraries import is_of_a_library
from dqn_keras._engine.programs import shared_in
from dqn_keras._engine.recycling import recycle
from dqn_keras._engine.tensorflow import tf
from dqn_keras.checks.numbers import check_count
from dqn_keras.checks.run import check_arguments
from dqn_keras.config import Config
from dqn_keras.progress import tqdm
from dqn_keras.storage.files import FORMAT, from_bytes, replacing, to_bytes
from dqn_keras.storage.identity import check_is_same, identity_of_study
from dqn_keras.storage.parts import describe
from dqn_keras.storage.versions import warn_of_other_versions
from dqn_keras.training import train


class Outcome(NamedTuple):
    """What came of one seed."""

    seed: int
    rewards: np.ndarray
    """[num_episodes] float64, as `Run.rewards`."""
    steps: np.ndarray
    """[num_episodes] int64, environment steps of each episode."""
    solved_at: int | None
    """As `Run.solved_at`."""
    digest: bytes
    """SHA-256 of the final weights of both networks: equal for equal bits."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Study:
    """What came of `study`: arrays with one entry for each seed."""

    config: Config
    outcomes: list[Outcome]
    """One per seed, in the order asked for; seeds that were interrupted are not among them."""

    @property
    def seeds(self) -> np.ndarray:
        """[S] int64."""
        return np.array([outcome.seed for outcome in self.outcomes], np.int64)

    @functools.cached_property
    def rewards(self) -> np.ndarray:
        """[S, num_episodes] float64: each episode's reward; NaN after a run's last."""
        longest = max((len(outcome.rewards) for outcome in self.outcomes), default=0)
        rewards = np.full((len(self.outcomes), longest), np.nan)
        for row, outcome in zip(rewards, self.outcomes, strict=True):
            row[: len(outcome.rewards)] = outcome.rewards
        return rewards

    @property
    def solved_at(self) -> np.ndarray:
        """[S] float64: the episode at whose end the stop rule held; NaN where it never did."""
        return np.array([np.nan if o.solved_at is None else o.solved_at for o in self.outcomes], np.float64)

    @property
    def episodes_to_solved(self) -> np.ndarray:
        """[S] float64: the same, with `config.num_episodes` where it never did."""
        return np.nan_to_num(self.solved_at, nan=self.config.num_episodes)

    @property
    def num_env_steps(self) -> int:
        """Environment steps of all seeds together."""
        return int(sum(outcome.steps.sum() for outcome in self.outcomes))

    def __repr__(self) -> str:
        return f"<Study: {len(self.outcomes)} seeds, {np.isfinite(self.solved_at).sum()} solved>"


def study(
    env: gym.Env | FuncEnv,
    config: Config = Config(),
    seeds: Sequence[int] = range(100),
    *,
    file: str | os.PathLike | None = None,
    engine: str = "joblib",
    num_workers: int | None = None,
    verbose: int = 1,
) -> Study:
    """Train one agent for each seed, several at once; each is the very run that `train(env, config, seed)` gives.

    Ctrl-C ends it, and what is finished is returned; without `file` the rest of the seeds can only be done anew.

    Args:
        env: as for `train`. Each worker process has a pickled copy of its own.
        config: the parameters of every run.
        seeds: whole numbers, each once.
        file: where to keep what is finished. The same study again does only what is missing; Ctrl-C, or a crash,
            loses what has not been finished.
        engine: "joblib", processes on this machine; or "ray", tasks on the Ray cluster that this process is connected
            to, or else on this machine (needs the extra `ray`); a task whose worker dies is tried again.
        num_workers: processes of joblib; by default as many as there are cores. With 1 all is done in this process.
            (Ray has as many as its cluster has cores.) A worker's copy of the environment holds what it uses of your
            own modules as it is now.
        verbose: 1 shows a progress bar, 0 nothing.

    Raises:
        TypeError, ValueError: as for `train`; or `file` is of another study (the message begins with what differs).
    """
    check_arguments(env, config, verbose)
    seeds = [check_count("seeds", seed, at_least=0) for seed in seeds]
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds must name each seed once, got {seeds}")
    if engine not in _ENGINES:
        raise ValueError(f"engine must be one of {', '.join(_ENGINES)}, got {engine!r}")
    num_workers = cpu_count() if num_workers is None else check_count("num_workers", num_workers)
    facts = {} if file is None else {"format": FORMAT, **identity_of_study(env, config)}
    outcomes = {} if file is None else _load(Path(file), facts)

    missing = [seed for seed in seeds if seed not in outcomes]
    bar = tqdm(total=len(seeds), initial=len(seeds) - len(missing), unit="seed", disable=not verbose)
    saved_at, interrupted = time.monotonic(), False
    with bar, contextlib.closing(_ENGINES[engine](_pickled_env(env), config, missing, num_workers)) as results:
        try:
            for outcome in results:
                if outcome is None:  # a run in this process was asked to stop
                    interrupted = True
                    break
                outcomes[outcome.seed] = outcome
                bar.update()
                if file is not None and time.monotonic() > saved_at + _SECONDS_BETWEEN_SAVES:
                    _save(Path(file), outcomes, facts)
                    saved_at = time.monotonic()
        except KeyboardInterrupt:
            interrupted = True
        finally:
            if file is not None and missing:
                _save(Path(file), outcomes, facts)
    if interrupted:
        unfinished = sum(seed not in outcomes for seed in seeds)
        warnings.warn(f"{unfinished} of {len(seeds)} seeds are not in this study: it was interrupted", stacklevel=2)
    return Study(config, [outcomes[seed] for seed in seeds if seed in outcomes])


_SECONDS_BETWEEN_SAVES = 10


_Results = Generator[Outcome | None, None, None]


class _PickledEnv(NamedTuple):
    """What a worker makes its environment from."""

    pickled: bytes
    computes: str
    """A digest of what a functional environment computes here."""
    study: str
    """Tells this call of `study` from others, in which the environment may have been another."""


def _pickled_env(env: gym.Env | FuncEnv) -> _PickledEnv:
    """A copy of the environment, or, if it cannot be copied, as after rendering, its spec."""
    try:
        pickled = _pickled_with_its_modules(env)
    except (TypeError, AttributeError, pickle.PicklingError):
        if not (isinstance(env, gym.Env) and env.spec):
            raise
        pickled = cloudpickle.dumps(env.spec)
    return _PickledEnv(pickled, describe(env)[0].computes, uuid.uuid4().hex)


def _pickled_with_its_modules(env: gym.Env | FuncEnv) -> bytes:
    """With what it uses of the user's modules as it is now, where a worker would import what is on the disk."""
    modules = [x for x in sys.modules.copy().values() if isinstance(x, ModuleType) and not is_of_a_library(x)]
    modules = [x for x in modules if sys.modules.get(x.__name__) is x and x.__name__ != "__main__"]
    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        return cloudpickle.dumps(env)
    except Exception:  # something in them cannot be copied, such as a lock
        pass
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)
    return cloudpickle.dumps(env)


@functools.lru_cache(maxsize=1)
def _parts(env_copy: _PickledEnv) -> tuple[gym.Env | FuncEnv, dict]:
    """The process's own environment, and the programs compiled for it: made once in a study."""
    env = cloudpickle.loads(env_copy.pickled)
    if isinstance(env, gym.envs.registration.EnvSpec):
        env = gym.make(env)
    if describe(env)[0].computes != env_copy.computes:
        raise ValueError(
            f"num_workers must be 1 for env {type(env).__name__}, which computes something else in another process: "
            "a module that was changed after its import is imported there as it is on the disk"
        )
    return env, {}


def _train_seed(env_copy: _PickledEnv, config: Config, seed: int) -> Outcome | None:
    """One agent, in whatever process; None if it was interrupted there."""
    env, programs = _parts(env_copy)
    with shared_in(programs):
        run = train(env, config, seed, verbose=0)
    if run.interrupted:
        return None
    weights = [*run.q_network.get_weights(), *run.q_hat_network.get_weights()]
    digest = hashlib.sha256(b"".join(w.tobytes() for w in weights)).digest()
    steps = np.array([episode.steps for episode in run.episodes], np.int64)
    recycle(run.agent.learner)
    return Outcome(seed, run.rewards, steps, run.solved_at, digest)


def _train_seed_in_worker(env_copy: _PickledEnv, config: Config, seed: int) -> Outcome | None:
    """The same in a process of its own. TensorFlow gets one thread there: there is a process for each core."""
    with contextlib.suppress(RuntimeError):  # it has started already, in a worker that someone else has used
        tf.config.threading.set_intra_op_parallelism_threads(1)
    return _train_seed(env_copy, config, seed)


def _by_joblib(env_copy: _PickledEnv, config: Config, seeds: list[int], num_workers: int) -> _Results:
    if num_workers == 1 or len(seeds) <= 1:
        yield from (_train_seed(env_copy, config, seed) for seed in seeds)
        return
    with parallel_config(backend="loky", inner_max_num_threads=1), _interrupts_ignored_by_children():
        parallel = Parallel(n_jobs=min(num_workers, len(seeds)), batch_size=1, return_as="generator_unordered")
        results = parallel(delayed(_train_seed_in_worker)(env_copy, config, seed) for seed in seeds)
    yield from results


@contextlib.contextmanager
def _interrupts_ignored_by_children() -> Iterator[None]:
    """A terminal sends Ctrl-C to all its processes; those that start in here leave it to this one."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)


def _by_ray(env_copy: _PickledEnv, config: Config, seeds: list[int], _: int) -> _Results:
    try:
        import ray
    except ImportError:
        raise ImportError('engine="ray" needs the extra `ray`: pip install "dqn_keras[ray]"') from None
    is_ours = not ray.is_initialized()
    if is_ours:
        ray.init(include_dashboard=False, log_to_driver=False)
    task = ray.remote(max_retries=3)(_train_seed_in_worker)
    waiting = [task.remote(env_copy, config, seed) for seed in seeds]
    try:
        while waiting:
            done, waiting = ray.wait(waiting)
            yield from ray.get(done)
    finally:
        for unfinished in waiting:
            ray.cancel(unfinished, force=True)
        if is_ours:
            ray.shutdown()


_ENGINES = {"joblib": _by_joblib, "ray": _by_ray}


def _save(path: Path, outcomes: dict[int, Outcome], facts: dict[str, Any]) -> None:
    ordered = [outcomes[seed] for seed in sorted(outcomes)]
    columns = {f"{o.seed}/{name}": getattr(o, name) for o in ordered for name in ("rewards", "steps")}
    seeds = [(o.seed, o.solved_at, o.digest.hex()) for o in ordered]
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(to_bytes(columns, {**facts, "seeds": seeds}))


def _load(path: Path, facts: dict[str, Any]) -> dict[int, Outcome]:
    """By seed; none if there is no file yet."""
    if not path.exists():
        return {}
    outcomes, theirs = _read(path)
    check_is_same(path, theirs, facts)
    warn_of_other_versions(path, theirs, facts, stacklevel=4)
    return outcomes


def _read(path: Path) -> tuple[dict[int, Outcome], dict[str, Any]]:
    try:
        columns, facts = from_bytes(path.read_bytes())
        return {
            seed: Outcome(seed, columns[f"{seed}/rewards"], columns[f"{seed}/steps"], solved_at, bytes.fromhex(digest))
            for seed, solved_at, digest in facts["seeds"]
        }, facts
    except (ValueError, KeyError) as error:
        raise ValueError(f"file {path} is not a study that can be loaded: {error}") from error


def load_study(path: str | os.PathLike) -> Study:
    """The study that `study(..., file=path)` kept, all of its seeds in ascending order."""
    outcomes, facts = _read(Path(path))
    fields = {**facts["config"], "hidden_units": tuple(facts["config"]["hidden_units"])}
    return Study(Config(**fields), list(outcomes.values()))
