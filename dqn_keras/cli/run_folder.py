"""The folder of a command-line run: its files, and how a run starts and continues in it."""

import ast
import contextlib
import csv
import dataclasses
import itertools
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium as gym
import matplotlib.pyplot as plt
import numpy as np

from dqn_keras import environments
from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.environments import can_flatten, check_environment, way_to_a_box
from dqn_keras.checks.formulas import Formulas
from dqn_keras.checks.numbers import check_flag
from dqn_keras.config import Config
from dqn_keras.interruption import TrainingInterrupted
from dqn_keras.learn import double_td_targets, td_targets
from dqn_keras.metrics import LOGGED
from dqn_keras.plotting import plot_history, plot_study, plot_sweep
from dqn_keras.storage.files import locked, replacing
from dqn_keras.storage.networks import load_q_network
from dqn_keras.storage.versions import versions
from dqn_keras.study import load_study, load_sweep
from dqn_keras.training import Run, train


@dataclasses.dataclass(frozen=True)
class EnvOptions:
    """The options for making an environment."""

    id: str
    arguments: dict[str, Any]
    flatten: bool
    compiled: bool

    @classmethod
    def parse(cls, id: str, arguments: Sequence[str], flatten: bool, compiled: bool) -> "EnvOptions":
        """Parses NAME=VALUE words; raises ValueError if one has another form, or if there is no functional twin."""
        if compiled and (id not in environments.TWINS or arguments or flatten):
            raise ValueError(
                f"compiled is only for {', '.join(environments.TWINS)}, without env_args or flatten, "
                f"got {' '.join([id, *arguments])}"
            )
        values = {}
        for word in arguments:
            name, is_assignment, value = word.partition("=")
            if not (is_assignment and name.isidentifier()):
                raise ValueError(f"env_args must be of the form NAME=VALUE, got {word!r}")
            try:
                values[name] = ast.literal_eval(value)
            except (ValueError, SyntaxError):
                values[name] = value
        return cls(id, values, flatten, compiled)

    def make(self, render_mode: str | None = None) -> gym.Env:
        """Makes the Gymnasium environment."""
        rendering: dict[str, Any] = {} if render_mode is None else {"render_mode": render_mode}  # not all take it
        try:
            env = gym.make(self.id, **rendering, **self.arguments)
        except (gym.error.Error, ImportError):
            raise
        except Exception as error:  # the environment's own code rejects an argument
            arguments = "".join(f" {name}={value!r}" for name, value in self.arguments.items())
            raise ValueError(f"{self.id}{arguments} cannot be made: {type(error).__name__}: {error}") from error
        space = env.observation_space
        is_flat = self.flatten and can_flatten(space)
        if not is_flat and (self.flatten or not isinstance(space, gym.spaces.Box)):
            way = "use --flatten" if can_flatten(space) else way_to_a_box(space)
            raise ValueError(f"{self.id} has the observation space {space}; {way}")
        return gym.wrappers.FlattenObservation(env) if is_flat else env

    def make_for_training(self) -> Any:
        """Makes the Gymnasium environment, or its functional twin if episodes are compiled."""
        return environments.TWINS[self.id]() if self.compiled else self.make()


@dataclasses.dataclass(frozen=True)
class Settings:
    """The contents of config.json."""

    env: EnvOptions
    seed: int
    config: Config
    tensorboard: bool
    double: bool
    loss: str


def own_formulas(double: bool, loss: str) -> dict[str, Any]:
    """Returns the targets and the loss as arguments of `train`."""
    return {"targets": double_td_targets if check_flag("double", double) else td_targets, "loss": loss}


def write_settings(folder: Path, settings: Settings) -> None:
    """Writes config.json, with the software versions of the run."""
    content = {
        "environment": dataclasses.asdict(settings.env),
        "seed": settings.seed,
        "config": dataclasses.asdict(settings.config),
        "tensorboard": settings.tensorboard,
        "double": settings.double,
        "loss": settings.loss,
        "versions": versions(),
    }
    with replacing(folder / "config.json") as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n")


def read_settings(folder: Path) -> Settings:
    """Reads config.json; raises FileNotFoundError if there is none, ValueError if something in it is wrong."""
    path = folder / "config.json"
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no run: there is no config.json in it")
    try:
        content = json.loads(path.read_text())
        config = {**content["config"], "hidden_units": tuple(content["config"]["hidden_units"])}
        env = EnvOptions(**content["environment"])
        if not (isinstance(env.id, str) and isinstance(env.arguments, dict)):
            raise TypeError("the environment must have an id and arguments")
        names = ("tensorboard", "double", "loss")
        return Settings(env, content["seed"], Config(**config), *(content[name] for name in names))
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path} is not what `dqn-keras train` writes: {error}") from None


def read_settings_to_play(folder: Path, imported: str | None) -> Settings:
    """Reads config.json; raises ValueError if making its environment would import a module other than `imported`.

    Gymnasium imports the module in an id MODULE:ID, and so could run code that the sender of a folder has chosen.
    """
    settings = read_settings(folder)
    for name in (settings.env.id, settings.env.arguments.get("env_id", "")):
        module, is_named, _ = str(name).rpartition(":")
        if is_named and module != imported:
            raise ValueError(
                f"{folder} needs the module {module!r}. Importing it runs its code; if you trust it: --import {module}"
            )
    return settings


def read_q_network(folder: Path) -> keras.Model:
    """Loads the network of a finished run."""
    if not (folder / "agent.keras").exists():
        raise FileNotFoundError(
            f"{folder} has no agent.keras: its run is in progress or was killed; "
            f"to continue it: dqn-keras resume {folder}"
        )
    return load_q_network(folder / "agent.keras")


def begin(folder: Path, settings: Settings, verbose: int) -> Run:
    """Starts a run in a folder that does not hold one yet."""
    env = settings.env.make_for_training()
    check_environment(env)  # before the folder is made
    Formulas(**own_formulas(settings.double, settings.loss)).check()
    with _alone_in(folder):
        if (folder / "config.json").exists():
            raise ValueError(
                f"{folder} already holds a run: `dqn-keras resume {folder}` continues it, "
                "another --out starts a new one"
            )
        write_settings(folder, settings)
        return _train(folder, env, settings, verbose, resume=False)


def resume(folder: Path, num_episodes: int | None, verbose: int, imported: str | None = None) -> Run:
    """Continues a run, up to `num_episodes` episodes if this is given."""
    before = settings = read_settings_to_play(folder, imported)
    if num_episodes is not None:
        config = dataclasses.replace(settings.config, num_episodes=num_episodes)
        settings = dataclasses.replace(settings, config=config)
    env = settings.env.make_for_training()
    with _alone_in(folder):
        write_settings(folder, settings)
        try:
            return _train(folder, env, settings, verbose, resume=True)
        except ValueError:
            write_settings(folder, before)
            raise


def _alone_in(folder: Path) -> contextlib.AbstractContextManager[None]:
    return locked(folder / ".lock", str(folder))


def _train(folder: Path, env: Any, settings: Settings, verbose: int, resume: bool) -> Run:
    log = folder / "log.csv"
    if log.exists():  # a kill may have cut off its last line
        content = log.read_bytes()
        log.write_bytes(content[: content.rfind(b"\n") + 1])
    callbacks = [keras.callbacks.CSVLogger(log, append=True)]
    if settings.tensorboard:
        callbacks.append(keras.callbacks.TensorBoard(folder / "tensorboard"))
    try:
        run = train(
            env,
            settings.config,
            settings.seed,
            **own_formulas(settings.double, settings.loss),
            callbacks=callbacks,
            checkpoint=folder / "checkpoint",
            resume=resume,
            verbose=verbose,
        )
    except TrainingInterrupted as interrupted:
        run = interrupted.run
    _write_log(log, run.history)
    run.save(folder / "agent.keras")
    draw(folder)
    return run


def _write_log(log: Path, history: dict[str, list[float]]) -> None:
    """Writes log.csv from the whole history, in the format of keras.callbacks.CSVLogger, without repeats or gaps."""
    names = sorted(history)
    with replacing(log) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["epoch", *names])
        writer.writerows(zip(itertools.count(), *(history[name] for name in names), strict=False))


def write_columns(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Writes columns of equal length as a CSV file."""
    with replacing(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*(column.tolist() for column in columns.values()), strict=True))


def read_log(folder: Path) -> dict[str, list[float]]:
    """Returns log.csv in the form of `run.history`. If an episode was played twice, its last row counts."""
    rows: dict[int, dict[str, float]] = {}
    if (folder / "log.csv").exists():
        with (folder / "log.csv").open(newline="") as file:
            for row in csv.DictReader(file):
                with contextlib.suppress(KeyError, TypeError, ValueError):  # the last row may be incomplete
                    rows[int(row["epoch"])] = {name: float(row.get(name, math.nan)) for name in LOGGED}
    return {name: [rows[episode][name] for episode in sorted(rows)] for name in LOGGED}


def draw(folder: Path) -> Path:
    """Draws study.png, sweep.png or curve.png from the files in the folder, and returns its path."""
    if (folder / "sweep.npz").exists():
        axes, path = plot_sweep(load_sweep(folder / "sweep.npz")), folder / "sweep.png"
    elif (folder / "study.npz").exists():
        axes, path = plot_study(load_study(folder / "study.npz"), published=None), folder / "study.png"
    else:
        config = read_settings(folder).config
        history = read_log(folder)
        if not history["reward"]:
            raise ValueError(f"{folder} has no episode in log.csv yet")
        axes, path = plot_history(history, config), folder / "curve.png"
    with replacing(path) as temporary:
        axes[0].figure.savefig(temporary, dpi=120)
    plt.close(axes[0].figure)
    return path
