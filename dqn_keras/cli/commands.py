"""The commands of `dqn-keras`: each takes its options and returns its exit code."""

import contextlib
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dqn_keras.checks.numbers import check_count
from dqn_keras.cli import run_folder
from dqn_keras.cli.options import how_to_resume
from dqn_keras.cli.run_folder import EnvOptions, Settings
from dqn_keras.cli.vary import varied
from dqn_keras.evaluation import evaluate as play_greedily
from dqn_keras.rendering import record_episode, save_animation
from dqn_keras.seeding import checked_seed
from dqn_keras.statistics import summarize, sweep_table
from dqn_keras.study import load_sweep
from dqn_keras.study import study as train_seeds
from dqn_keras.study import sweep as sweep_settings
from dqn_keras.training import Run

if TYPE_CHECKING:
    from dqn_keras.cli import options as cli


def train(options: "cli.Train") -> int:
    """Trains an agent in a new folder."""
    seed = checked_seed(options.seed)
    folder = options.out or _default_folder(options.env, str(seed))
    settings = Settings(_env_options(options), seed, options.config, options.tensorboard, options.double, options.loss)
    return _report(run_folder.begin(folder, settings, _verbosity(options.quiet)), folder, options)


def resume(options: "cli.Resume") -> int:
    """Continues the run in a folder."""
    verbose = _verbosity(options.quiet)
    run = run_folder.resume(options.folder, options.num_episodes, verbose, options.import_module)
    return _report(run, options.folder, options)


def watch(options: "cli.Watch") -> int:
    """Plays greedily in a window, or writes a GIF."""
    settings = run_folder.read_settings_to_play(options.folder, options.import_module)
    network = run_folder.read_q_network(options.folder)
    max_steps = settings.config.max_steps
    if _has_display() and not options.gif:
        with contextlib.closing(settings.env.make(render_mode="human")) as env:
            _print_returns(play_greedily(env, network, options.episodes, options.seed, max_steps))
        return 0
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")  # lets pygame draw without a display
    with contextlib.closing(settings.env.make(render_mode="rgb_array")) as env:
        frames = record_episode(env, network, options.seed, max_steps)
        fps = env.metadata.get("render_fps", 30)
    path = options.folder / "episode.gif"
    save_animation(frames, path, fps=fps)
    print(f"An episode of {len(frames) - 1} steps is in {path}")
    return 0


def evaluate(options: "cli.Evaluate") -> int:
    """Plays greedily and prints the returns."""
    settings = run_folder.read_settings_to_play(options.folder, options.import_module)
    network = run_folder.read_q_network(options.folder)
    with contextlib.closing(settings.env.make()) as env:
        _print_returns(play_greedily(env, network, options.episodes, options.seed, settings.config.max_steps))
    return 0


def study(options: "cli.Study") -> int:
    """Trains many seeds and prints their statistics."""
    folder = options.out or _default_folder(options.env, "study")
    if options.config.num_episodes < options.config.solved_window:
        raise ValueError(
            f"num_episodes must be at least solved_window={options.config.solved_window} in a study, because the "
            f"curves are means over it, got {options.config.num_episodes}"
        )
    own = run_folder.own_formulas(options.double, options.loss)
    trained = train_seeds(_make_env(options), options.config, **own, **_how(options), file=folder / "study.npz")
    if len(trained.outcomes) < options.seeds:
        return _interrupted("the same command again")
    run_folder.write_columns(folder / "study.csv", trained.to_dict())
    summary = summarize(trained)
    if options.config.solved_reward is not None:
        print(f"Share of seeds solved within {options.config.num_episodes:,} episodes: {summary.share_solved}")
        print(f"Episodes to solved: median {summary.median}, mean of the middle half {summary.interquartile_mean}")
    if options.evaluate:
        print(f"Mean return of 100 greedy episodes, mean over the seeds: {summary.greedy_return}")
    print(f"The numbers in brackets are 95 % intervals; the curves are in {run_folder.draw(folder)}")
    return 0


def sweep(options: "cli.Sweep") -> int:
    """Trains many seeds of several settings and prints a table."""
    folder = options.out or _default_folder(options.env, "sweep")
    settings = varied(options.config, options.vary, {"double": options.double, "loss": options.loss})
    trained = sweep_settings(_make_env(options), settings, **_how(options), file=folder / "sweep.npz")
    if any(len(one.outcomes) < options.seeds for one in trained.values()):
        return _interrupted("the same command again")
    run_folder.write_columns(folder / "sweep.csv", load_sweep(folder / "sweep.npz").to_dict())
    print(sweep_table(trained))
    print(f"In brackets: 95 % intervals. Late: after episode 500. The picture is in {run_folder.draw(folder)}")
    return 0


def _how(options: "cli.Study | cli.Sweep") -> dict[str, Any]:
    """Returns the arguments that `study` and `sweep` share."""
    return {
        "seeds": range(check_count("seeds", options.seeds)),
        "evaluate_on": _make_env(options) if options.evaluate else None,
        "num_workers": options.workers,
        "verbose": 0 if options.quiet else 1,
    }


def plot(options: "cli.Plot") -> int:
    """Draws the curves of the run, study or sweep in a folder."""
    print(f"The curves are in {run_folder.draw(options.folder)}")
    return 0


def _env_options(options: "cli.Train | cli.Study | cli.Sweep") -> EnvOptions:
    return EnvOptions.parse(options.env, options.env_args, options.flatten, options.compiled)


def _make_env(options: "cli.Study | cli.Sweep") -> Any:
    """Makes the environment to train in."""
    return _env_options(options).make_for_training()


def _default_folder(env_id: str, name: str) -> Path:
    return Path("runs", f"{env_id.replace('/', '-').replace(':', '-')}-{name}")


def _report(run: Run, folder: Path, options: "cli.Train | cli.Resume") -> int:
    """Prints how a run ended, and returns the exit code."""
    if run.interrupted:
        return _interrupted(how_to_resume(options, folder))
    if not options.quiet:
        if run.solved_at is None:
            print(f"Not solved within {len(run.rewards):,} episodes")
        print(f"The run is in {folder}; its curves are in curve.png")
    return 0


def _interrupted(how: str) -> int:
    print(f"Interrupted; the finished part is saved. To continue: {how}", file=sys.stderr)
    return 130


def _print_returns(returns: np.ndarray) -> None:
    print(
        f"{len(returns)} greedy episodes: mean return {returns.mean():.1f}, standard deviation {returns.std():.1f}, "
        f"lowest {returns.min():g}, highest {returns.max():g}"
    )


def _verbosity(quiet: bool) -> int:
    return 0 if quiet else 2 if sys.stderr is not None and sys.stderr.isatty() else 1


def _has_display() -> bool:
    if os.environ.get("SDL_VIDEODRIVER") == "dummy":
        return False
    return sys.platform in ("darwin", "win32") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
