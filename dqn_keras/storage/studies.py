"""The file of a study or a sweep: the outcome of each seed of each setting, checked when it is read."""

import contextlib
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dqn_keras.checks.numbers import check_count
from dqn_keras.config import Config
from dqn_keras.metrics import Outcome
from dqn_keras.storage.files import FORMAT, from_bytes, locked, replacing, to_bytes
from dqn_keras.storage.identity import check_is_same
from dqn_keras.storage.versions import warn_of_other_versions
from dqn_keras.workers import Task

Outcomes = dict[Task, Outcome]


@contextlib.contextmanager
def kept_in(
    path: Path | None, settings: Mapping[str, dict[str, Any]], tasks: Sequence[Task]
) -> Iterator[tuple[Outcomes, Callable[[], None]]]:
    """Yields the outcomes in the file, and a function that saves them when a save is due; also saves at the end.

    No other process can write the file meanwhile. If the file cannot be written, OSError is raised at the start; later
    there is only a warning.

    Args:
        path: the file; None saves nothing.
        settings: the identity of each setting, by its name.
        tasks: the tasks to find outcomes for.
    """
    if path is None:
        yield {}, lambda: None
        return
    if path.is_dir():
        raise ValueError(f"file must be a file, got the folder {path}")
    with locked(path.with_name(f".{path.name}.lock"), f"file {path}"):
        for unfinished in path.parent.glob(f".{path.stem}.*.partial{path.suffix}"):  # of processes that have died
            with contextlib.suppress(OSError):
                unfinished.unlink()
        outcomes, theirs = _read("file", path) if path.exists() else ({}, {})
        for name in settings.keys() & theirs.keys():
            label = f"{path}, setting {name!r}" if name else str(path)
            check_is_same(label, theirs[name], settings[name])
            warn_of_other_versions(label, theirs[name], settings[name], stacklevel=5)
        if theirs and "" in theirs.keys() ^ settings.keys():
            kinds = ("study", "sweep") if "" in theirs else ("sweep", "study")
            raise ValueError(f"file {path} holds a {kinds[0]}, and cannot be used for a {kinds[1]}")
        settings = {**theirs, **settings}
        if any(task not in outcomes for task in tasks):
            try:
                _save(path, outcomes, settings)
            except OSError as error:
                raise OSError(f"file {path} cannot be written: {error}") from error
        num_saved, saved_at, seconds_to_save = len(outcomes), time.monotonic(), 0.0

        def save_when_due(is_last: bool = False) -> None:
            nonlocal num_saved, saved_at, seconds_to_save
            now = time.monotonic()
            wait = 0 if is_last else max(SECONDS_BETWEEN_SAVES, 20 * seconds_to_save)
            if len(outcomes) == num_saved or now < saved_at + wait:
                return
            saved_at = now
            try:
                _save(path, outcomes, settings)
                num_saved, seconds_to_save = len(outcomes), time.monotonic() - now
            except OSError as error:
                warnings.warn(f"file {path} could not be written ({error}); it keeps {num_saved} seeds", stacklevel=3)

        try:
            yield outcomes, save_when_due
        finally:
            save_when_due(is_last=True)


SECONDS_BETWEEN_SAVES = 10


def _save(path: Path, outcomes: Outcomes, settings: Mapping[str, dict[str, Any]]) -> None:
    columns: dict[str, np.ndarray] = {}
    kept = []
    for i, (name, facts) in enumerate(settings.items()):
        ordered = [outcomes[task] for task in sorted(outcomes) if task.name == name]
        columns |= {f"{i}/{o.seed}/{column}": getattr(o, column) for o in ordered for column in ("rewards", "steps")}
        seeds = [(o.seed, o.solved_at, o.greedy_return, o.seconds, o.digest.hex()) for o in ordered]
        kept.append({**facts, "name": name, "seeds": seeds})
    with replacing(path) as temporary:
        temporary.write_bytes(to_bytes(columns, {"format": FORMAT, "settings": kept}))


def read(path: Path) -> tuple[dict[str, Config], Outcomes]:
    """Returns the parameters of each setting, by its name, and all outcomes.

    Raises:
        ValueError: the file is damaged or was not written by `study` or `sweep`; the message names the file.
    """
    outcomes, settings = _read("path", path)
    return {name: _config(facts) for name, facts in settings.items()}, outcomes


def _read(argument: str, path: Path) -> tuple[Outcomes, dict[str, dict[str, Any]]]:
    """Returns the outcomes, and the facts of each setting by its name."""
    try:
        columns, facts = from_bytes(path.read_bytes())
        outcomes: Outcomes = {}
        settings = {}
        for i, setting in enumerate(facts["settings"]):
            name, config = setting["name"], _config(setting)
            if not isinstance(name, str) or name in settings:
                raise ValueError(f"setting {name!r} is not a name, or occurs twice")
            settings[name] = {key: value for key, value in setting.items() if key not in ("name", "seeds")}
            for seed, solved_at, greedy_return, seconds, digest in setting["seeds"]:
                task = Task(name, check_count("seeds", seed, at_least=0))
                if task in outcomes:
                    raise ValueError(f"seed {seed} occurs twice")
                arrays = columns[f"{i}/{seed}/rewards"], columns[f"{i}/{seed}/steps"]
                digest = bytes.fromhex(digest)
                outcomes[task] = Outcome(seed, *arrays, solved_at, float(greedy_return), float(seconds), digest)
                _check_outcome(outcomes[task], config)
    except (ValueError, KeyError, TypeError, AttributeError, IsADirectoryError) as error:
        raise ValueError(f"{argument} {path} is not a study that can be loaded: {error}") from error
    return outcomes, settings


def _config(facts: dict[str, Any]) -> Config:
    return Config(**{**facts["config"], "hidden_units": tuple(facts["config"]["hidden_units"])})


def _check_outcome(outcome: Outcome, config: Config) -> None:
    seed, rewards, steps, solved_at, greedy_return, seconds, _ = outcome
    if solved_at is not None:
        check_count("solved_at", solved_at)
    num_whole = len(rewards) - 1 if config.num_steps else len(rewards)  # num_steps cuts the last one short
    is_right = (
        rewards.ndim == 1
        and rewards.shape == steps.shape
        and (solved_at or 1) <= len(rewards) <= config.num_episodes
        and rewards.dtype == np.float64
        and steps.dtype == np.int64
        and bool(np.isfinite(rewards[:num_whole]).all() and (steps > 0).all())
        and not np.isinf(greedy_return)
        and seconds >= 0
    )
    if not is_right:
        raise ValueError(f"the episodes of seed {seed} are not what `study` records")
