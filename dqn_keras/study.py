"""A study: the same run with many seeds, to see how reliable it is. One seed is an anecdote."""

import contextlib
import dataclasses
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
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import cloudpickle
import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from joblib import Parallel, cpu_count, delayed, parallel_config

from dqn_keras._engine.cache import publish
from dqn_keras._engine.libraries import is_of_a_library
from dqn_keras._engine.programs import shared_in
from dqn_keras._engine.recycling import recycle
from dqn_keras._engine.tensorflow import tf
from dqn_keras.checks.numbers import check_choice, check_count, check_path
from dqn_keras.checks.run import check_arguments, check_seeds
from dqn_keras.config import Config
from dqn_keras.interruption import TrainingInterrupted, sigterm_interrupts
from dqn_keras.progress import tqdm
from dqn_keras.storage.files import FORMAT, from_bytes, locked, replacing, to_bytes
from dqn_keras.storage.identity import check_is_same, identity_of_study
from dqn_keras.storage.parts import describe
from dqn_keras.storage.versions import warn_of_other_versions
from dqn_keras.training import train


class Outcome(NamedTuple):
    """The result of one seed."""

    seed: int
    rewards: np.ndarray
    """Reward of each episode, [num_episodes] float64, as in `Run.rewards`."""
    steps: np.ndarray
    """Environment steps of each episode, [num_episodes] int64."""
    solved_at: int | None
    """Number of the episode after which the stop rule held, as in `Run.solved_at`; None if it never did."""
    digest: bytes
    """SHA-256 of the final weights of both networks: equal if all bits are equal."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Study:
    """The result of `study`: arrays with one entry for each seed."""

    config: Config
    outcomes: list[Outcome]
    """One outcome per seed, in the order of the `seeds` asked for; interrupted seeds are missing."""

    @property
    def seeds(self) -> np.ndarray:
        """The seeds, [S] int64."""
        return np.array([outcome.seed for outcome in self.outcomes], np.int64)

    @functools.cached_property
    def rewards(self) -> np.ndarray:
        """Each episode's reward, [S, num_episodes] float64; NaN after a run's last episode."""
        longest = max((len(outcome.rewards) for outcome in self.outcomes), default=0)
        rewards = np.full((len(self.outcomes), longest), np.nan)
        for row, outcome in zip(rewards, self.outcomes, strict=True):
            row[: len(outcome.rewards)] = outcome.rewards
        return rewards

    @property
    def solved_at(self) -> np.ndarray:
        """The number of the episode after which the stop rule held, [S] float64; NaN if it never did."""
        return np.array([np.nan if o.solved_at is None else o.solved_at for o in self.outcomes], np.float64)

    @property
    def episodes_to_solved(self) -> np.ndarray:
        """The same as `solved_at`, [S] float64, but `config.num_episodes` if the stop rule never held."""
        return np.nan_to_num(self.solved_at, nan=self.config.num_episodes)

    @property
    def num_env_steps(self) -> int:
        """The number of environment steps of all seeds together."""
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
    """Trains one agent for each seed, several at once; each run is exactly that of `train(env, config, seed)`.

    Ctrl-C or SIGTERM ends the study and returns the finished seeds. Only a study with a `file` can be continued.

    Args:
        env: an environment, as for `train`. Each worker process gets its own pickled copy.
        config: the parameters of every run.
        seeds: whole numbers without repeats.
        file: a file for the finished seeds. If you repeat the study, it trains only the missing seeds. Ctrl-C or a
            crash loses the unfinished ones.
        engine: "joblib", processes on this machine; or "ray", tasks on the Ray cluster that this process is connected
            to, or else on this machine (needs the extra `ray`). A Ray task is repeated if its worker dies.
        num_workers: number of joblib's processes; by default one for each core. With 1, everything runs in this
            process. (Ray uses all cores of its cluster.) A worker's copy of the environment includes your own modules
            that it uses, in their present state.
        verbose: 1 shows a progress bar, 0 nothing.

    Raises:
        TypeError, ValueError: as for `train`; or `file` is of another study (the message begins with what differs), or
            another process is writing it.
        OSError: `file` cannot be written.
    """
    check_arguments(env, config, verbose)
    seeds = check_seeds(seeds)
    check_choice("engine", engine, tuple(_ENGINES))
    num_workers = cpu_count() if num_workers is None else check_count("num_workers", num_workers)
    path = None if file is None else check_path("file", file).absolute()
    interrupted = False
    with _kept_in(path, seeds, env, config) as (outcomes, save_when_due):
        missing = [seed for seed in seeds if seed not in outcomes]
        bar = tqdm(total=len(seeds), initial=len(seeds) - len(missing), unit="seed", disable=not verbose)
        trained = _ENGINES[engine](_pickled_env(env), config, missing, num_workers)
        with bar, contextlib.closing(trained) as results, sigterm_interrupts():
            try:
                for outcome in results:
                    if outcome is None:  # its run was asked to stop
                        interrupted = True
                        break
                    outcomes[outcome.seed] = outcome
                    bar.update()
                    save_when_due()
            except KeyboardInterrupt:
                interrupted = True
    if interrupted:
        unfinished = sum(seed not in outcomes for seed in seeds)
        warnings.warn(f"{unfinished} of {len(seeds)} seeds are not in this study: it was interrupted", stacklevel=2)
    return Study(config, [outcomes[seed] for seed in seeds if seed in outcomes])


_SECONDS_BETWEEN_SAVES = 10


_Results = Generator[Outcome | None, None, None]


class _PickledEnv(NamedTuple):
    """What a worker needs to make its environment."""

    pickled: bytes
    computes: str
    """Digest of what a functional environment computes in this process."""
    study: str
    """Identifier of this call of `study`; another call may have another environment."""


def _pickled_env(env: gym.Env | FuncEnv) -> _PickledEnv:
    """Pickles the environment, or only its spec if it cannot be pickled, for example after rendering."""
    try:
        pickled = _pickled_with_its_modules(env)
    except (TypeError, AttributeError, pickle.PicklingError):
        if not (isinstance(env, gym.Env) and env.spec):
            raise
        pickled = cloudpickle.dumps(env.spec)
    return _PickledEnv(pickled, describe(env)[0].computes, uuid.uuid4().hex)


def _pickled_with_its_modules(env: gym.Env | FuncEnv) -> bytes:
    """Pickles the environment with the user's modules as they are now; a worker would import those on the disk."""
    modules = [x for x in sys.modules.copy().values() if isinstance(x, ModuleType) and not is_of_a_library(x)]
    modules = [x for x in modules if sys.modules.get(x.__name__) is x and x.__name__ != "__main__"]
    for module in modules:
        cloudpickle.register_pickle_by_value(module)
    try:
        return cloudpickle.dumps(env)
    except Exception:  # something in them cannot be pickled, such as a lock
        pass
    finally:
        for module in modules:
            cloudpickle.unregister_pickle_by_value(module)
    return cloudpickle.dumps(env)


@functools.lru_cache(maxsize=1)
def _parts(env_copy: _PickledEnv) -> tuple[gym.Env | FuncEnv, dict]:
    """Returns this process's own environment and the programs compiled for it, both made once in a study."""
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
    """Trains one seed in this process; returns None if it was interrupted."""
    env, programs = _parts(env_copy)
    try:
        with shared_in(programs):
            run = train(env, config, seed, verbose=0)
    except TrainingInterrupted:
        return None
    weights = [*run.q_network.get_weights(), *run.q_hat_network.get_weights()]
    digest = hashlib.sha256(b"".join(w.tobytes() for w in weights)).digest()
    steps = np.array([episode.steps for episode in run.episodes], np.int64)
    recycle(run.agent.learner)
    return Outcome(seed, run.rewards, steps, run.solved_at, digest)


def _train_seed_in_worker(env_copy: _PickledEnv, config: Config, seed: int) -> Outcome | None:
    """Trains one seed in a worker process. TensorFlow gets one thread there, because each core has a process."""
    with contextlib.suppress(RuntimeError):  # TensorFlow has started already, in a worker with an earlier task
        tf.config.threading.set_intra_op_parallelism_threads(1)
    outcome = _train_seed(env_copy, config, seed)
    publish()  # now, since a worker may be killed when the study ends
    return outcome


def _by_joblib(env_copy: _PickledEnv, config: Config, seeds: list[int], num_workers: int) -> _Results:
    if num_workers == 1 or len(seeds) <= 1:
        yield from (_train_seed(env_copy, config, seed) for seed in seeds)
        return
    backend = parallel_config(backend="loky", inner_max_num_threads=1)
    with backend, _compilation_cache_in_children(), _interrupts_ignored_by_children():
        parallel = Parallel(
            n_jobs=min(num_workers, len(seeds)),
            batch_size=1,
            return_as="generator_unordered",
            max_nbytes=None,  # arrays are sent as they are; joblib would otherwise leave an empty folder behind
            temp_folder=tempfile.gettempdir(),
        )
        results = parallel(delayed(_train_seed_in_worker)(env_copy, config, seed) for seed in seeds)
    yield from results


@contextlib.contextmanager
def _compilation_cache_in_children() -> Iterator[None]:
    """Lets the processes that start within the block use the cache of compiled programs, unless the user chose."""
    is_chosen = "DQN_KERAS_CACHE" in os.environ
    os.environ.setdefault("DQN_KERAS_CACHE", "1")
    try:
        yield
    finally:
        if not is_chosen:
            del os.environ["DQN_KERAS_CACHE"]


@contextlib.contextmanager
def _interrupts_ignored_by_children() -> Iterator[None]:
    """Makes processes that start inside it ignore Ctrl-C, which a terminal sends to all; this process handles it."""
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


@contextlib.contextmanager
def _kept_in(
    path: Path | None, seeds: Sequence[int], env: gym.Env | FuncEnv, config: Config
) -> Iterator[tuple[dict[int, Outcome], Callable[[], None]]]:
    """Yields the outcomes in a study's file, by seed, and a function that saves them when it is time; saves at the end.

    Nobody else can write the file meanwhile. If it cannot be written, that is an error at the start, and a warning
    later.
    """
    if path is None:
        yield {}, lambda: None
        return
    if path.is_dir():
        raise ValueError(f"file must be a file, got the folder {path}")
    facts = {"format": FORMAT, **identity_of_study(env, config)}
    with locked(path.with_name(f".{path.name}.lock"), f"file {path}"):
        for unfinished in path.parent.glob(f".{path.stem}.*.partial{path.suffix}"):  # of processes that have died
            with contextlib.suppress(OSError):
                unfinished.unlink()
        outcomes = _load(path, facts)
        if any(seed not in outcomes for seed in seeds):
            try:
                _save(path, outcomes, facts)
            except OSError as error:
                raise OSError(f"file {path} cannot be written: {error}") from error
        num_saved, saved_at = len(outcomes), time.monotonic()

        def save_when_due(seconds: float = _SECONDS_BETWEEN_SAVES) -> None:
            nonlocal num_saved, saved_at
            if len(outcomes) == num_saved or time.monotonic() < saved_at + seconds:
                return
            saved_at = time.monotonic()
            try:
                _save(path, outcomes, facts)
                num_saved = len(outcomes)
            except OSError as error:
                warnings.warn(f"file {path} could not be written ({error}); it keeps {num_saved} seeds", stacklevel=3)

        try:
            yield outcomes, save_when_due
        finally:
            save_when_due(seconds=0)


def _save(path: Path, outcomes: dict[int, Outcome], facts: dict[str, Any]) -> None:
    ordered = [outcomes[seed] for seed in sorted(outcomes)]
    columns = {f"{o.seed}/{name}": getattr(o, name) for o in ordered for name in ("rewards", "steps")}
    seeds = [(o.seed, o.solved_at, o.digest.hex()) for o in ordered]
    with replacing(path) as temporary:
        temporary.write_bytes(to_bytes(columns, {**facts, "seeds": seeds}))


def _load(path: Path, facts: dict[str, Any]) -> dict[int, Outcome]:
    """Returns the outcomes by seed; none if there is no file yet."""
    if not path.exists():
        return {}
    outcomes, theirs = _read("file", path)
    check_is_same(path, theirs, facts)
    warn_of_other_versions(path, theirs, facts, stacklevel=4)
    return outcomes


def _read(argument: str, path: Path) -> tuple[dict[int, Outcome], dict[str, Any]]:
    """Returns the outcomes by seed, and the facts of the study; nothing in the file is taken on trust."""
    try:
        columns, facts = from_bytes(path.read_bytes())
        config = _config(facts)
        outcomes = {}
        for seed, solved_at, digest in facts["seeds"]:
            if seed in outcomes:
                raise ValueError(f"seed {seed} is in it twice")
            rewards, steps = columns[f"{seed}/rewards"], columns[f"{seed}/steps"]
            outcomes[seed] = Outcome(seed, rewards, steps, solved_at, bytes.fromhex(digest))
            _check_outcome(outcomes[seed], config)
    except (ValueError, KeyError, TypeError, IsADirectoryError) as error:
        raise ValueError(f"{argument} {path} is not a study that can be loaded: {error}") from error
    return outcomes, facts


def _config(facts: dict[str, Any]) -> Config:
    return Config(**{**facts["config"], "hidden_units": tuple(facts["config"]["hidden_units"])})


def _check_outcome(outcome: Outcome, config: Config) -> None:
    seed, rewards, steps, solved_at, _ = outcome
    check_count("seeds", seed, at_least=0)
    if solved_at is not None:
        check_count("solved_at", solved_at)
    is_right = (
        rewards.ndim == 1
        and rewards.shape == steps.shape
        and (solved_at or 1) <= len(rewards) <= config.num_episodes
        and rewards.dtype == np.float64
        and steps.dtype == np.int64
        and bool(np.isfinite(rewards).all() and (steps > 0).all())
    )
    if not is_right:
        raise ValueError(f"the episodes of seed {seed} are not as `study` records them")


def load_study(path: str | os.PathLike) -> Study:
    """Loads the study that `study(..., file=path)` saved, with all its seeds in ascending order.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged, or something in it cannot be from a study; the message names the file.
    """
    outcomes, facts = _read("path", check_path("path", path))
    return Study(_config(facts), list(outcomes.values()))
