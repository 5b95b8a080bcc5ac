"""Checkpoints: the whole state of a run on disk.

A checkpoint is a NumPy archive (.npz, only arrays, nothing is pickled) followed by the SHA-256 of its bytes. It is
written under another name, flushed to the disk and only then renamed, so that a crash leaves the previous one whole.
"""

import contextlib
import os
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.agent import Agent
from dqn_keras.learn import Metrics
from dqn_keras.metrics import Episode
from dqn_keras.replay import unpack
from dqn_keras.storage.files import FORMAT, DamagedError, from_bytes, locked, replacing, to_bytes
from dqn_keras.storage.identity import MAY_CHANGE_ON_RESUME, Identity, check_is_same
from dqn_keras.storage.versions import warn_of_other_versions


class Checkpoints:
    """Saves and restores the checkpoints of one run, one file each, in a folder. Only the last two are kept."""

    def __init__(
        self,
        folder: str | os.PathLike,
        identity: Identity,
        every: int = 100,
    ) -> None:
        self.folder = Path(folder).absolute()  # a callback may change the current folder
        self._every, self._saved_at, self._is_failing = every, 0, False
        self._identity, self._other_variables = identity
        self._kept: list[Path] = []  # files of this run, newest first; the first is whole

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Keeps other runs out of the folder while the block runs."""
        with locked(self.folder / ".lock", f"checkpoint {self.folder}"):
            for unfinished in self.folder.glob(".checkpoint-*.partial.npz"):  # of processes that have died
                with contextlib.suppress(OSError):
                    unfinished.unlink()
            yield

    def paths(self) -> list[Path]:
        """Returns the checkpoint files, newest first."""
        return sorted(self.folder.glob(f"checkpoint-{'[0-9]' * 10}.npz"), reverse=True)

    def begin(self, agent: Agent, seed: int | None, resume: bool) -> Path | None:
        """Restores the saved run, or saves a new one before any work starts; returns the file that was read, if any."""
        if not resume and (paths := self.paths()):
            raise ValueError(
                f"checkpoint {paths[0]} exists already; resume=True continues that run, a new run needs another folder"
            )
        path = self.restore(agent, seed) if resume else None
        if path is None:
            try:
                self.save(agent)
            except OSError as error:
                raise OSError(f"checkpoint {self.folder} cannot be written: {error}") from error
        self._saved_at = len(agent.episodes)
        return path

    def save_when_due(self, agent: Agent) -> None:
        """Saves if at least `every` episodes have passed since the last save; warns if the disk cannot be written."""
        if len(agent.episodes) >= self._saved_at + self._every:
            self._save_or_warn(agent)

    def save_the_end(self, agent: Agent, may_have_changed: bool = False) -> None:
        """Saves if episodes have passed since the last save, or if callbacks may have changed the agent."""
        if may_have_changed or len(agent.episodes) > self._saved_at:
            self._save_or_warn(agent)

    def _save_or_warn(self, agent: Agent) -> None:
        """Saves; warns at the first of several failures in a row."""
        self._saved_at = len(agent.episodes)
        try:
            self.save(agent)
            self._is_failing = False
        except OSError as error:
            if not self._is_failing:
                warnings.warn(
                    f"checkpoint after episode {len(agent.episodes) - 1} could not be saved ({error}); "
                    f"the last one stays, and the run tries again every {self._every} episodes",
                    stacklevel=4,
                )
            self._is_failing = True

    def save(self, agent: Agent) -> None:
        """Saves the state of `agent` at the end of an episode; raises OSError if the disk cannot be written."""
        path = self.folder / f"checkpoint-{len(agent.episodes):010d}.npz"
        content = to_bytes(
            _arrays(agent, self._other_variables), {"format": FORMAT, **self._identity, **_counters(agent)}
        )
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        self._kept = [path, *(older for older in self._kept if older != path)]
        self._delete_all_but_two()

    def _delete_all_but_two(self) -> None:
        for older in self._kept[2:]:
            with contextlib.suppress(OSError):
                older.unlink()
        del self._kept[2:]

    def restore(self, agent: Agent, seed: int | None) -> Path | None:
        """Restores `agent` from the newest whole checkpoint and returns its file; returns None if there is none yet.

        Raises:
            ValueError: the state is from another run (the message begins with what differs, such as a field of Config),
                it has more episodes than `num_episodes`, or no file is whole.
        """
        damaged = []
        for path in self.paths():
            try:
                arrays, facts = from_bytes(path.read_bytes())
                check_facts(facts, self._identity | _counters(agent))
                check_is_same(path, facts, {**self._identity, "seed": seed}, MAY_CHANGE_ON_RESUME)
                _restore(agent, self._other_variables, arrays, facts)
            except (DamagedError, OSError) as error:
                damaged.append(f"{path} cannot be used: {error}")
                continue
            num_episodes = self._identity["config"]["num_episodes"]
            if num_episodes < len(agent.episodes):
                raise ValueError(
                    f"num_episodes must be at least {len(agent.episodes)}, the number in {path}, got {num_episodes}"
                )
            if damaged:
                warnings.warn(f"{'; '.join(damaged)}. The run continues from the older {path}", stacklevel=4)
            warn_of_other_versions(path, facts, self._identity, stacklevel=5)
            older = [x for x in self.paths() if x < path and self._is_of_this_run(x, facts)]
            self._kept = [path, *older]
            self._delete_all_but_two()
            return path
        if damaged:
            raise ValueError(f"checkpoint: {'; '.join(damaged)}")
        return None

    def _is_of_this_run(self, path: Path, facts: dict[str, Any]) -> bool:
        """Returns whether an older file is from the run with these facts, so that it may be deleted."""
        try:
            _, theirs = from_bytes(path.read_bytes())
            check_is_same(path, theirs, {**self._identity, "seed": facts["seed"]}, MAY_CHANGE_ON_RESUME)
        except (ValueError, KeyError, OSError):
            return False
        return True


def _arrays(agent: Agent, others: Sequence[tf.Variable]) -> dict[str, Any]:
    """Returns the arrays of the state, by name."""
    columns = {f"episodes/{x}": np.array([getattr(e, x) for e in agent.episodes], t) for x, t in _COLUMNS.items()}
    variables = {name: v.numpy() for name, v in _variables(agent, others).items()}
    return {**columns, "memory": agent.memory.rows[: len(agent.memory)], **variables}


_COLUMNS: dict[str, Any] = dict.fromkeys(Episode._fields[1:], np.float64) | {"steps": np.int64, "terminated": np.bool_}


def _variables(agent: Agent, others: Sequence[tf.Variable]) -> dict[str, keras.Variable | tf.Variable]:
    """Returns the variables by names without layer names, which Keras numbers across a process."""
    owners = {name: part.variables for name, part in agent.learner._asdict().items()} | {"other": others}
    return {f"{owner}/{i}": variable for owner, variables in owners.items() for i, variable in enumerate(variables)}


def _counters(agent: Agent) -> dict[str, Any]:
    """Returns the rest of the state, as JSON values."""
    return {
        "seed": agent.seed,
        "episodes_played": len(agent.episodes),
        "num_appended": agent.memory.num_appended,
        "num_updates": agent.num_updates,
        "epsilon": agent.epsilon,
        "rng": agent.rng.bit_generator.state,
    }


def check_facts(facts: dict[str, Any], expected: dict[str, Any]) -> None:
    """Raises DamagedError if one of the expected facts is missing or has another type."""
    for name, value in expected.items():
        if type(facts.get(name)) is not type(value):
            raise DamagedError(f"{name} is missing or wrong in it: {facts.get(name)!r}")


def _restore(agent: Agent, others: Sequence[tf.Variable], arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
    """Restores a new agent to a saved state; if the state does not fit, raises DamagedError before any change."""
    episodes_played, num_appended, epsilon = facts["episodes_played"], facts["num_appended"], facts["epsilon"]
    rng = np.random.default_rng(0)
    try:
        rng.bit_generator.state = facts["rng"]
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedError(f"rng is wrong in it: {error!r}") from None
    expected = _arrays(agent, others)
    expected |= {f"episodes/{name}": np.zeros(max(0, episodes_played), dtype) for name, dtype in _COLUMNS.items()}
    expected["memory"] = agent.memory.rows[:num_appended]
    # Adam's averages may overflow: a run continues as long as the weights are finite.
    may_be_infinite = {f"episodes/{name}" for name in (*Metrics._fields, "reward")} | {
        name for name in expected if name.startswith(("optimizer/", "other/"))
    }
    if names := sorted(expected.keys() ^ arrays.keys()):
        raise DamagedError(f"its arrays are not an agent's: {', '.join(names)} missing or too many")
    for name, array in arrays.items():
        wanted = expected[name]
        if (array.shape, array.dtype) != (wanted.shape, wanted.dtype):
            raise DamagedError(
                f"{name} has shape {array.shape} and dtype {array.dtype}, not {wanted.shape} and {wanted.dtype}"
            )
        parts = unpack(array, agent.memory.state_shape) if name == "memory" else [array]
        if name not in may_be_infinite and not all(np.isfinite(x).all() for x in parts):
            raise DamagedError(f"{name} holds a number that is not finite")
    if not np.isfinite(arrays["episodes/reward"][:-1]).all():
        raise DamagedError("episodes/reward holds a number that is not finite")
    if arrays["episodes/steps"].sum() != num_appended or not 0 <= epsilon <= 1:
        raise DamagedError("its counts contradict each other")

    columns = (arrays[f"episodes/{name}"].tolist() for name in _COLUMNS)
    agent.episodes[:] = [Episode(k, *values) for k, values in enumerate(zip(*columns, strict=True))]
    agent.memory.rows[: len(arrays["memory"])] = arrays["memory"]
    agent.memory.num_appended, agent.num_updates = num_appended, facts["num_updates"]
    agent.seed, agent.epsilon, agent.rng = facts["seed"], epsilon, rng
    for name, variable in _variables(agent, others).items():
        variable.assign(arrays[name])
