"""`study`: the same run with many seeds, to see how reliable it is. `sweep`: a study of each of several settings."""

import contextlib
import dataclasses
import functools
import os
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Literal

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from joblib import cpu_count

from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.numbers import check_choice, check_count, check_path
from dqn_keras.checks.run import check_seeds
from dqn_keras.checks.settings import check_setting, check_settings
from dqn_keras.config import Config
from dqn_keras.interruption import sigterm_interrupts
from dqn_keras.learn import td_targets
from dqn_keras.metrics import Outcome
from dqn_keras.progress import tqdm
from dqn_keras.storage import studies
from dqn_keras.workers import ENGINES, Setting, Task, results


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Study:
    """The result of `study`: arrays with one entry for each seed."""

    config: Config
    outcomes: list[Outcome]
    """One outcome per seed, in the order of the argument `seeds`; unfinished seeds are missing."""

    @property
    def seeds(self) -> np.ndarray:
        """The seeds, [S] int64."""
        return np.array([outcome.seed for outcome in self.outcomes], np.int64)

    @functools.cached_property
    def rewards(self) -> np.ndarray:
        """Each episode's reward, [S, num_episodes] float64; NaN after a run's last episode."""
        return _padded([outcome.rewards for outcome in self.outcomes])

    @functools.cached_property
    def env_steps(self) -> np.ndarray:
        """Environment steps of the run at each episode's end, [S, num_episodes] float64; NaN after the last one."""
        return _padded([outcome.steps.cumsum() for outcome in self.outcomes])

    @property
    def solved_at(self) -> np.ndarray:
        """Number of the episode after which the stop rule held, [S] float64; NaN if it never did."""
        return np.array([np.nan if o.solved_at is None else o.solved_at for o in self.outcomes], np.float64)

    @property
    def episodes_to_solved(self) -> np.ndarray:
        """The same as `solved_at`, but `config.num_episodes` if the stop rule never held, [S] float64."""
        return np.nan_to_num(self.solved_at, nan=self.config.num_episodes)

    @property
    def env_steps_to_solved(self) -> np.ndarray:
        """Environment steps until the stop rule held, [S] float64; the maximum of `config` if it never did."""
        most = self.config.num_steps or self.config.num_episodes * self.config.max_steps
        return np.array([most if o.solved_at is None else o.steps.sum() for o in self.outcomes], np.float64)

    @property
    def greedy_returns(self) -> np.ndarray:
        """Mean return of 100 greedy episodes after each run, [S] float64; NaN without `evaluate_on`."""
        return np.array([outcome.greedy_return for outcome in self.outcomes], np.float64)

    @property
    def num_env_steps(self) -> int:
        """Number of environment steps of all seeds together."""
        return int(sum(outcome.steps.sum() for outcome in self.outcomes))

    def to_dict(self, each: Literal["seed", "episode"] = "seed") -> dict[str, np.ndarray]:
        """Returns columns of equal length, for `pandas.DataFrame` or a CSV file.

        Args:
            each: "seed" makes a row for each seed; "episode" makes one for each episode of each seed.
        """
        if check_choice("each", each, ("seed", "episode")) == "seed":
            return {
                "seed": self.seeds,
                "solved_at": self.solved_at,
                "num_episodes": np.array([len(o.rewards) for o in self.outcomes], np.int64),
                "num_env_steps": np.array([o.steps.sum() for o in self.outcomes], np.int64),
                "greedy_return": self.greedy_returns,
                "seconds": np.array([o.seconds for o in self.outcomes], np.float64),
            }
        lengths = [len(outcome.rewards) for outcome in self.outcomes]
        return {
            "seed": np.repeat(self.seeds, lengths),
            "episode": _joined([np.arange(length) for length in lengths], np.int64),
            "env_steps": _joined([o.steps.cumsum() for o in self.outcomes], np.int64),
            "reward": _joined([o.rewards for o in self.outcomes], np.float64),
        }

    def __repr__(self) -> str:
        return f"<Study: {len(self.outcomes)} seeds, {np.isfinite(self.solved_at).sum()} solved>"


class Sweep(Mapping[str, Study]):
    """The result of `sweep`: the study of each setting, by its name."""

    def __init__(self, studies: Mapping[str, Study]) -> None:
        self._studies = dict(studies)

    def __getitem__(self, name: str) -> Study:
        return self._studies[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._studies)

    def __len__(self) -> int:
        return len(self._studies)

    def to_dict(self, each: Literal["seed", "episode"] = "seed") -> dict[str, np.ndarray]:
        """Returns the columns of `Study.to_dict` for all settings, after a column `setting`."""
        parts = {name: study.to_dict(each) for name, study in self.items()}
        if not parts:
            return {}
        setting = np.repeat(list(parts), [len(part["seed"]) for part in parts.values()])
        columns = next(iter(parts.values()))
        return {"setting": setting, **{x: np.concatenate([part[x] for part in parts.values()]) for x in columns}}

    def __repr__(self) -> str:
        return f"<Sweep: {len(self)} settings, {sum(len(study.outcomes) for study in self.values())} seeds>"


def study(
    env: gym.Env | FuncEnv,
    config: Config = Config(),
    seeds: Sequence[int] = range(100),
    *,
    q_network: Callable[[int], keras.Model] | None = None,
    optimizer: Callable[[], keras.Optimizer] | None = None,
    targets: Callable = td_targets,
    loss: str | Callable | None = None,
    evaluate_on: gym.Env | FuncEnv | None = None,
    file: str | os.PathLike | None = None,
    engine: str = "joblib",
    num_workers: int | None = None,
    verbose: int = 1,
) -> Study:
    """Trains one agent per seed, several in parallel; each run equals the run of `train` with that seed, bit for bit.

    Ctrl-C or SIGTERM ends the study and returns the finished seeds. Only a study with a `file` can be continued.

    Args:
        env: an environment, as for `train`. Each worker process gets its own pickled copy.
        config: the parameters of every run.
        seeds: whole numbers without repeats.
        q_network: a function of the seed that returns a new network; the default is a network of `make_q_network`.
        optimizer: a function without arguments that returns a new optimizer, such as
            `lambda: keras.optimizers.Adam(1e-3, clipnorm=1.0)`.
        targets: as for `train`.
        loss: as for `train`.
        evaluate_on: an environment in which each trained network plays 100 greedy episodes (`evaluate`, with the seed
            of the run); None evaluates nothing.
        file: a file for the finished seeds. If you repeat the study, it trains only the missing seeds. Ctrl-C or a
            crash loses the unfinished ones.
        engine: "joblib" uses processes on this machine. "ray" uses tasks on the Ray cluster that this process is
            connected to, or else on this machine (needs the extra `ray`). A Ray task is repeated if its worker dies.
        num_workers: number of joblib's processes; by default one for each core. With 1, everything runs in this
            process. (Ray uses all cores of its cluster.) A worker's copy of the environment includes your own modules
            that it uses, in their present state.
        verbose: 1 shows a progress bar, 0 nothing.

    Raises:
        TypeError, ValueError: as for `train`; or `file` is from another study (the message begins with the difference),
            or another process is writing it.
        OSError: `file` cannot be written.
    """
    setting = Setting(env, config, q_network, optimizer, targets, loss, evaluate_on)
    return _trained({"": setting}, seeds, file, engine, num_workers, verbose)[""]


def sweep(
    env: gym.Env | FuncEnv,
    settings: Mapping[str, Config | Mapping[str, Any]],
    seeds: Sequence[int] = range(100),
    *,
    evaluate_on: gym.Env | FuncEnv | None = None,
    file: str | os.PathLike | None = None,
    engine: str = "joblib",
    num_workers: int | None = None,
    verbose: int = 1,
) -> Sweep:
    """Makes a study of each of several settings, in parallel: no worker waits for a setting to end.

    Args:
        env: an environment, as for `train`.
        settings: for each name, a Config, or a dict of arguments of `study`: env, config, q_network, optimizer,
            targets, loss, evaluate_on. For example `{"original": Config(), "Huber": {"loss": "huber"}}`.
        seeds: as for `study`, the same for each setting.
        evaluate_on: as for `study`.
        file: as for `study`; settings may be added later.
        engine: as for `study`.
        num_workers: as for `study`.
        verbose: 1 shows a progress bar, 0 nothing.

    Raises:
        TypeError, ValueError, OSError: as for `study`; the message names the setting.
    """
    checked = check_settings(env, settings, evaluate_on, verbose)
    return Sweep(_trained(checked, seeds, file, engine, num_workers, verbose))


def _trained(
    settings: Mapping[str, Setting],
    seeds: Sequence[int],
    file: str | os.PathLike | None,
    engine: str,
    num_workers: int | None,
    verbose: int,
) -> dict[str, Study]:
    """Trains all seeds of all settings, and returns the study of each."""
    seeds = check_seeds(seeds)
    check_choice("engine", engine, tuple(ENGINES))
    num_workers = cpu_count() if num_workers is None else check_count("num_workers", num_workers)
    path = None if file is None else check_path("file", file).absolute()
    identities = {name: check_setting(name, setting, verbose, path is not None) for name, setting in settings.items()}
    tasks = [Task(name, seed) for name in settings for seed in seeds]
    is_interrupted = False
    with studies.kept_in(path, identities, tasks) as (outcomes, save_when_due):
        missing = [task for task in tasks if task not in outcomes]
        missing.sort(key=lambda task: task.seed != seeds[0])  # so that each setting is compiled once for all workers
        bar = tqdm(total=len(tasks), initial=len(tasks) - len(missing), unit="seed", disable=not verbose)
        trained = results(settings, missing, engine, num_workers)
        with bar, contextlib.closing(trained), sigterm_interrupts():
            try:
                for result in trained:
                    if result is None:  # a signal stopped its run
                        is_interrupted = True
                        break
                    task, outcomes[task] = result[0], result[1]
                    bar.update()
                    save_when_due()
            except KeyboardInterrupt:
                is_interrupted = True
    if is_interrupted:
        unfinished = sum(task not in outcomes for task in tasks)
        kind = "study" if "" in settings else "sweep"
        warnings.warn(f"{unfinished} of {len(tasks)} seeds are not in this {kind}: it was interrupted", stacklevel=3)
    found = {name: [outcomes[x] for x in (Task(name, seed) for seed in seeds) if x in outcomes] for name in settings}
    return {name: Study(setting.config, found[name]) for name, setting in settings.items()}


def _padded(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Returns arrays of different lengths as the rows of one array, padded with NaN."""
    padded = np.full((len(rows), max(map(len, rows), default=0)), np.nan)
    for row, values in zip(padded, rows, strict=True):
        row[: len(values)] = values
    return padded


def _joined(arrays: Sequence[np.ndarray], dtype: Any) -> np.ndarray:
    return np.concatenate([np.zeros(0, dtype), *arrays])


def load_study(path: str | os.PathLike) -> Study:
    """Loads the study that `study(..., file=path)` saved, with all its seeds in ascending order.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or was not written by `study`; the message names the file.
    """
    loaded = load_sweep(path)
    if list(loaded) != [""]:
        raise ValueError(f"path {path} holds a sweep of {len(loaded)} settings: load it with load_sweep")
    return loaded[""]


def load_sweep(path: str | os.PathLike) -> Sweep:
    """Loads the sweep that `sweep(..., file=path)` saved, with all its settings, and their seeds in ascending order.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or was not written by `sweep`; the message names the file.
    """
    configs, outcomes = studies.read(check_path("path", path))
    found = {name: [outcome for task, outcome in outcomes.items() if task.name == name] for name in configs}
    return Sweep({name: Study(config, found[name]) for name, config in configs.items()})
