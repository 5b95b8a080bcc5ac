"""The options of the command line, and its error messages. The commands themselves are in `commands`.

TensorFlow and Gymnasium are imported only when a command runs, so that `--help` appears at once.
"""

import dataclasses
import difflib
import importlib
import itertools
import os
import re
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, cast

import tyro
from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes, Positional, arg

from dqn_keras.checks.fields import OTHER_NAMES
from dqn_keras.config import Config
from dqn_keras.version import __version__

Flag = FlagCreatePairsOff[bool]


Folder = Annotated[Positional[Path], arg(metavar="FOLDER")]


@dataclasses.dataclass(frozen=True)
class _Unchecked(Config):
    """The parameters as typed. Config checks them later, so that tyro puts no box around its messages."""

    def __post_init__(self) -> None:
        """Checks nothing."""


@dataclasses.dataclass(kw_only=True)
class _Task:
    """An environment and how to learn it."""

    env: Annotated[Positional[str], arg(metavar="ENV")]
    """Id of a Gymnasium environment, such as CartPole-v1. MODULE:ID imports the module that registers it."""
    config: OmitArgPrefixes[_Unchecked] = _Unchecked()
    """Parameters of the algorithm. The defaults are the original notebook's."""
    env_args: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE ...", help_behavior_hint="(default: none)")] = ()
    """Arguments for gymnasium.make, such as is_slippery=False map_name=8x8."""
    flatten: Flag = False
    """Flatten the observations to one axis (FlattenObservation). Discrete observations need it."""
    compiled: Flag = False
    """Compile whole episodes. This takes seconds; training is then about ten times as fast.
    Only for CartPole-v1, Acrobot-v1 and MountainCar-v0, which have a functional twin."""
    preset: Flag = False
    """Start from parameters that are known to solve ENV, not from the original's. Those that you type replace them."""
    double: Flag = False
    """Use the targets of Double DQN."""
    loss: Annotated[str, arg(metavar="NAME")] = "mse"
    """Name of a Keras loss, such as mse, huber or mae."""


@dataclasses.dataclass(kw_only=True)
class Train(_Task):
    """Train an agent and save it in a folder."""

    seed: Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: random)")] = None
    """Seed of the run. The same seed gives the same run, bit for bit."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: runs/ENV-SEED)")] = None
    """Folder for the run, with these files:
    config.json (environment, seed, parameters, versions),
    log.csv (a line for each episode),
    agent.keras (the network),
    curve.png, and checkpoint/, from which `resume` continues.
    Ctrl-C stops the run at the end of an episode and saves everything."""
    tensorboard: Flag = False
    """Also write every scalar for TensorBoard, into the folder's tensorboard/ (slower)."""
    quiet: Flag = False
    """Print only errors."""


@dataclasses.dataclass(kw_only=True)
class _Kept:
    """A run that is saved in a folder."""

    folder: Folder
    """Folder of the run."""
    import_module: Annotated[str | None, arg(name="import", metavar="MODULE", help_behavior_hint="(default: none)")] = (
        None
    )
    """Module that registers the environment, in the current folder or installed. Importing it runs its code, so you
    must name it here; the files in FOLDER alone never import anything."""


@dataclasses.dataclass(kw_only=True)
class Resume(_Kept):
    """Continue an interrupted or killed run, or make a run longer: the same run, bit for bit, as without a break."""

    num_episodes: Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: as before)")] = None
    """Maximum number of episodes."""
    quiet: Flag = False
    """Print only errors."""


@dataclasses.dataclass(kw_only=True)
class Watch(_Kept):
    """Watch the agent play in a window. Without a display, write a GIF to the folder."""

    episodes: int = 3
    """Number of episodes in the window; the GIF shows only the first."""
    seed: int = 0
    """Seed of the start states, which differ from those in training."""
    gif: Flag = False
    """Write a GIF even if there is a display."""


@dataclasses.dataclass(kw_only=True)
class Evaluate(_Kept):
    """Let the agent play greedily, from start states that differ from those in training."""

    episodes: int = 100
    """Number of episodes."""
    seed: int = 0
    """Seed of the start states."""


@dataclasses.dataclass(kw_only=True)
class _ManySeeds(_Task):
    """An environment, how to learn it, and the seeds."""

    seeds: int = 100
    """Number of seeds; they are 0, 1, 2, ..."""
    evaluate: Flag = False
    """Let each trained agent play 100 greedy episodes."""
    workers: Annotated[int | None, arg(metavar="INT", help_behavior_hint="(default: one for each core)")] = None
    """Number of processes."""
    quiet: Flag = False
    """Print only errors and the result."""


@dataclasses.dataclass(kw_only=True)
class Study(_ManySeeds):
    """Train an agent for each of many seeds, on all cores, to see how reliable it is."""

    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: runs/ENV-study)")] = None
    """Folder for the study: study.npz, study.csv (a line for each seed) and study.png.
    If you repeat the command, it trains only the missing seeds."""


@dataclasses.dataclass(kw_only=True)
class Sweep(_ManySeeds):
    """Compare several settings: train an agent for each of many seeds with each setting."""

    vary: Annotated[tuple[str, ...], arg(metavar="NAME=VALUE,VALUE ...")]
    """Parameters to vary, and their values, such as tau=0.01,0.05 hidden_units=64,128x128 loss=mse,huber.
    All combinations are trained."""
    out: Annotated[Path | None, arg(metavar="FOLDER", help_behavior_hint="(default: runs/ENV-sweep)")] = None
    """Folder for the sweep: sweep.npz, sweep.csv (a line for each seed) and sweep.png.
    If you repeat the command, it trains only what is missing, and adds new values."""


@dataclasses.dataclass(kw_only=True)
class Plot:
    """Draw the picture of a study, a sweep or a run, even while it is in progress."""

    folder: Folder
    """Folder of the run, study or sweep. The picture is written there: curve.png, study.png or sweep.png."""


def parse(arguments: Sequence[str]) -> Any:
    """Returns the command with its checked options. After the help or an error, tyro raises SystemExit."""
    commands: Any = Train | Resume | Watch | Evaluate | Study | Sweep | Plot
    description = "Train Deep Q-Networks on Gymnasium's environments."
    try:
        command = tyro.cli(commands, prog="dqn-keras", description=description, args=arguments)
    except SystemExit as end:
        if end.code and (hint := _hint(arguments)):
            print(f"dqn-keras: {hint}", file=sys.stderr)
        raise
    if isinstance(command, _Task):
        fields = vars(command.config)
        if command.preset:
            typed = {word.partition("=")[0].removeprefix("--").replace("-", "_") for word in arguments}
            typed = {name.removeprefix("no_") for name in typed}
            fields = {name: x for name, x in fields.items() if name in typed}
            command.config = cast(Any, dataclasses.replace(_preset(command.env), **fields))
        else:
            command.config = cast(Any, Config(**fields))
    return command


def _preset(env: str) -> Config:
    from dqn_keras.presets import presets

    if env not in presets:
        raise ValueError(f"preset exists for {', '.join(presets)}, got {env}")
    return presets[env]


def _hint(arguments: Sequence[str]) -> str | None:
    """Returns a hint on a common mistake in arguments that tyro cannot read; None if there is none."""
    names = [command.__name__.lower() for command in (Train, Resume, Watch, Evaluate, Study, Sweep, Plot)]
    if not arguments:
        return None
    if arguments[0] not in names:
        close = difflib.get_close_matches(arguments[0], names, n=1)
        return f"did you mean `dqn-keras {close[0]}`?" if close else None
    are_floats = {field.name for field in dataclasses.fields(Config) if field.type is float}
    words = [part for word in arguments for part in (word.split("=", 1) if word.startswith("--") else [word])]
    for option, value in itertools.pairwise([*words, ""]):
        name = option.removeprefix("--").replace("-", "_")
        if name == option:
            continue
        if name in OTHER_NAMES:
            what, name_here = OTHER_NAMES[name]
            return f"the {what} is --{name_here.replace('_', '-')}"
        if name == "hidden_units" and re.fullmatch(r"[\[(]?\d+(,\d+)*[\])]?", value) and not value.isdigit():
            return f"spaces separate the numbers: {option} {' '.join(re.findall(r'[0-9]+', value))}"
        if name not in are_floats and re.fullmatch(r"\d+(\.0*)?(e\+?\d+)?", value) and not value.isdigit():
            return f"whole numbers have only digits: {option} {float(value):.0f}"
    return None


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command line and returns its exit code: 0, 2 after an error, 130 after Ctrl-C, 141 after a broken pipe.

    Prints an error as one line on standard error or, for an option that cannot be read, as a box with help.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if arguments == ["--version"]:
        print(f"dqn_keras {__version__}")
        return 0
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    os.environ.setdefault("DQN_KERAS_CACHE", "1")
    os.environ.setdefault("MPLBACKEND", "Agg")
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    command = None
    try:
        command = parse(arguments)
        _import_from_this_folder(command)
        from dqn_keras.cli import commands

        warnings.formatwarning = lambda message, *_: f"dqn-keras: {_in_plain_text(str(message))}\n"
        return getattr(commands, type(command).__name__.lower())(command)
    except SystemExit as end:  # tyro has printed the help or the error
        return int(end.code or 0)
    except KeyboardInterrupt:
        print(f"Interrupted{_how_to_continue(command)}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # nobody reads the rest, for example after `| head`
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (for the interpreter's last flush)
        print(f"dqn-keras: nobody reads the output{_how_to_continue(command)}", file=sys.stderr)
        return 141
    except Exception as error:
        if not _says_it_all(error):
            raise
        return _error(str(error))


def _import_from_this_folder(command: Any) -> None:
    """Imports the module that was typed, if any. Only in that case, modules in the current folder are found."""
    if module := _module_of(command):
        sys.path.append(os.getcwd())
        importlib.import_module(module)


def _module_of(command: Any) -> str | None:
    return command.env.rpartition(":")[0] if isinstance(command, _Task) else getattr(command, "import_module", None)


def how_to_resume(command: Any, folder: Path) -> str:
    """Returns the command that continues the run of `command`, which is in `folder`."""
    module = _module_of(command)
    return f"dqn-keras resume {shlex.quote(str(folder))}" + (f" --import {module}" if module else "")


def _how_to_continue(command: Any) -> str:
    """Returns a hint on how to continue the run; empty if it has not begun."""
    folder = getattr(command, "folder", None) or getattr(command, "out", None)
    is_run = isinstance(command, Train | Resume) and folder is not None and (folder / "config.json").exists()
    return f". To continue: {how_to_resume(command, cast(Path, folder))}" if is_run else ""


def _says_it_all(error: Exception) -> bool:
    """Returns whether the message is enough. An error in an environment's code has a note, and needs its traceback."""
    is_known = isinstance(error, ValueError | TypeError | OSError | ImportError)
    is_known |= type(error).__module__ == "gymnasium.error"
    return is_known and not hasattr(error, "__notes__")


def _error(message: str) -> int:
    print(f"dqn-keras: {_in_plain_text(message)}", file=sys.stderr)
    return 2


def _in_plain_text(message: str) -> str:
    """Returns the message in one line, without terminal colors."""
    return " ".join(re.sub(r"\x1b\[[0-9;]*m", "", message).split())
