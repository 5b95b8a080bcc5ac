"""What is kept on disk: the whole state of a run, and the trained network alone.

A checkpoint is a NumPy archive (.npz, arrays only, nothing is pickled) followed by the SHA-256 of its bytes. It is
written under another name, flushed to the disk, and only then given its own, so that a crash leaves the last one whole.
"""

import contextlib
import hashlib
import io
import json
import os
import warnings
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._tensorflow import keras
from dqn_keras.agent import Agent, Episode
from dqn_keras.config import Config
from dqn_keras.identity import check_is_same, identity, warn_of_other_versions
from dqn_keras.learn import DEFAULT_FORMULAS, Formulas, Metrics
from dqn_keras.networks import check_is_equal, check_network, finalize_layers, python_random_kept
from dqn_keras.replay import unpack
from dqn_keras.version import __version__

FORMAT = 3


class Checkpoints:
    """The checkpoints of one run in a folder of their own, one file each, of which the last two are kept."""

    def __init__(
        self,
        folder: str | os.PathLike,
        env: gym.Env | FuncEnv,
        config: Config,
        q_network: keras.Model | None = None,
        optimizer: keras.Optimizer | None = None,
        formulas: Formulas = DEFAULT_FORMULAS,
    ) -> None:
        self.folder = Path(folder)
        self._identity = identity(env, config, q_network, optimizer, formulas)
        self._kept: list[Path] = []  # the newest first, all known to be whole

    def paths(self) -> list[Path]:
        """The files, the newest first."""
        return sorted(self.folder.glob(f"checkpoint-{'[0-9]' * 10}.npz"), reverse=True)

    def save(self, agent: Agent) -> None:
        """Save the state of `agent`, which must be at an episode's end; OSError if the disk does not take it."""
        path = self.folder / f"checkpoint-{len(agent.episodes):010d}.npz"
        content = to_bytes(_arrays(agent), {"format": FORMAT, **self._identity, **_facts(agent)})
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary:
            temporary.write_bytes(content)
        self._kept = [path, *(older for older in self._kept if older != path)][:2]
        for other in {*self.paths(), *self.folder.glob(".*.partial.npz")} - set(self._kept):
            with contextlib.suppress(OSError):
                other.unlink()

    def restore(self, agent: Agent, seed: int | None) -> Path | None:
        """Put `agent` into the newest state that is whole; None if there is none yet.

        Raises:
            ValueError: the state is of another run (the message begins with what differs, such as a field of Config),
                or no file is whole.
        """
        damaged = []
        for path in self.paths():
            try:
                arrays, facts = from_bytes(path.read_bytes())
                check_facts(facts, self._identity | _facts(agent))
                changeable = ["num_episodes"] if seed is not None else ["num_episodes", "seed"]
                check_is_same(path, facts, {**self._identity, "seed": seed}, but_for=changeable)
                _restore(agent, arrays, facts)
            except (DamagedError, OSError) as error:
                damaged.append(f"{path} cannot be used: {error}")
                continue
            num_episodes = self._identity["config"]["num_episodes"]
            if num_episodes < len(agent.episodes):
                raise ValueError(
                    f"num_episodes must be at least {len(agent.episodes)}, as many as {path} has, got {num_episodes}"
                )
            if damaged:
                warnings.warn(f"{'; '.join(damaged)}. The run goes on from the older {path}", stacklevel=4)
            warn_of_other_versions(path, facts, self._identity, stacklevel=5)
            self._kept = [path]
            return path
        if damaged:
            raise ValueError(f"checkpoint: {'; '.join(damaged)}")
        return None


class DamagedError(ValueError):
    """Why a file is no whole checkpoint."""


def to_bytes(arrays: Mapping[str, Any], facts: dict[str, Any]) -> bytes:
    """The content of a checkpoint file."""
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, facts=np.frombuffer(json.dumps(facts).encode(), np.uint8), **arrays)
    body = file.getvalue()
    return body + hashlib.sha256(body).digest()


def from_bytes(content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The opposite of `to_bytes`; an error that says why, if the content is not as that made it."""
    body, digest = content[:-32], content[-32:]
    if hashlib.sha256(body).digest() != digest:
        raise DamagedError("its SHA-256 is not that of its content, so that it has been cut short or changed")
    try:
        with np.load(io.BytesIO(body), allow_pickle=False) as archive:
            arrays = dict(archive)
        facts = json.loads(arrays.pop("facts").tobytes())
        file_format = facts["format"]
    except (KeyError, TypeError, ValueError, OSError, zipfile.BadZipFile) as error:
        raise DamagedError(f"it is not a checkpoint ({error})") from None
    if file_format != FORMAT:
        raise DamagedError(f"its format is {file_format!r}, and dqn_keras {__version__} reads {FORMAT}")
    return arrays, facts


def _arrays(agent: Agent) -> dict[str, Any]:
    """All that is an array, by name."""
    columns = {f"episodes/{x}": np.array([getattr(e, x) for e in agent.episodes], t) for x, t in _COLUMNS.items()}
    variables = {name: v.numpy() for name, v in _variables(agent).items()}
    return {**columns, "memory": agent.memory.rows[: len(agent.memory)], **variables}


_COLUMNS: dict[str, Any] = dict.fromkeys(Episode._fields[1:], np.float64) | {"steps": np.int64, "terminated": np.bool_}


def _variables(agent: Agent) -> dict[str, keras.Variable]:
    """By names that do not depend on those of the layers, which Keras numbers through a process."""
    return {
        f"{owner}/{i}": variable
        for owner, part in agent.learner._asdict().items()
        for i, variable in enumerate(part.variables)
    }


def _facts(agent: Agent) -> dict[str, Any]:
    """All that is not."""
    return {
        "seed": agent.seed,
        "num_episodes": len(agent.episodes),
        "num_appended": agent.memory.num_appended,
        "num_updates": agent.num_updates,
        "epsilon": agent.epsilon,
        "rng": agent.rng.bit_generator.state,
    }


def check_facts(facts: dict[str, Any], expected: dict[str, Any]) -> None:
    """They must be all there, and of the right kind."""
    for name, value in expected.items():
        if type(facts.get(name)) is not type(value):
            raise DamagedError(f"{name} is missing or wrong in it: {facts.get(name)!r}")


def _restore(agent: Agent, arrays: dict[str, np.ndarray], facts: dict[str, Any]) -> None:
    """Put a fresh agent into a saved state; nothing is changed if the state does not fit it."""
    num_episodes, num_appended, epsilon = facts["num_episodes"], facts["num_appended"], facts["epsilon"]
    rng = np.random.default_rng(0)
    try:
        rng.bit_generator.state = facts["rng"]
    except (KeyError, TypeError, ValueError) as error:
        raise DamagedError(f"rng is wrong in it: {error!r}") from None
    expected = _arrays(agent)
    expected |= {f"episodes/{name}": np.zeros(max(0, num_episodes), dtype) for name, dtype in _COLUMNS.items()}
    expected["memory"] = agent.memory.rows[:num_appended]
    # A run goes on while an average of Adam's overflows, as long as the weights are finite.
    may_be_infinite = {f"episodes/{name}" for name in Metrics._fields} | {
        name for name in expected if name.startswith("optimizer/")
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
    if arrays["episodes/steps"].sum() != num_appended or not 0 <= epsilon <= 1:
        raise DamagedError("its counts do not belong together")

    columns = (arrays[f"episodes/{name}"].tolist() for name in _COLUMNS)
    agent.episodes[:] = [Episode(k, *values) for k, values in enumerate(zip(*columns, strict=True))]
    agent.memory.rows[: len(arrays["memory"])] = arrays["memory"]
    agent.memory.num_appended, agent.num_updates = num_appended, facts["num_updates"]
    agent.seed, agent.epsilon, agent.rng = facts["seed"], epsilon, rng
    for name, variable in _variables(agent).items():
        variable.assign(arrays[name])


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A temporary file beside `path`, which takes its place at once when the block has ended without an error."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    if os.name == "posix":  # the folder's list of names, too
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def save_agent(path: str | os.PathLike, q_network: keras.Model) -> None:
    """Save the network alone, in Keras' own format; an older file of that name is replaced at once.

    Raises:
        ValueError: `path` does not end in .keras; the network has a layer of an unregistered class.
        OSError: the disk does not take it.
    """
    path = Path(path)
    if path.suffix != ".keras":
        raise ValueError(f"path must end in .keras, got {str(path)!r}")
    try:
        with python_random_kept():
            network = type(q_network).from_config(q_network.get_config())  # which has no optimizer to save
    except (TypeError, ValueError) as error:
        raise ValueError(
            "q_network has a layer that no file can name: keras.saving.register_keras_serializable() on its class, and "
            f"get_config in it, make it one ({error})"
        ) from error
    network.set_weights(q_network.get_weights())
    finalize_layers(network)
    check_is_equal("q_network cannot be saved", q_network, network)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        network.save(temporary)


def load_agent(path: str | os.PathLike) -> keras.Model:
    """The network that `run.save` saved, for `evaluate`, or whatever a Keras model is good for.

    It is Keras' own format, in Keras' safe mode: a file that would run code of its own is refused.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged or not a Q-network; the message names the file.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if (broken := archive.testzip()) is not None:  # Keras reads parts, and so checks no sum
                raise ValueError(f"{broken} in it is damaged")
        network = keras.saving.load_model(path, compile=False, safe_mode=True)
        check_network("it", network)
        if not all(np.isfinite(w).all() for w in network.get_weights()):
            raise ValueError("one of its weights is not finite")
    except FileNotFoundError:
        raise
    except Exception as error:  # whatever Keras, h5py or zipfile say of bytes that are not theirs
        raise ValueError(f"path {path} is not a network that can be loaded: {error}") from error
    return network
