"""The command line, as a user types it."""

import csv
import dataclasses
import json
import os
import shlex
import shutil
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import filelock
import gymnasium as gym
import numpy as np
import pytest
from PIL import Image

from dqn_keras import (
    Config,
    double_td_targets,
    evaluate,
    load_q_network,
    load_study,
    load_sweep,
    presets,
    train,
)
from dqn_keras.cli.options import main
from dqn_keras.environments import CartPole
from tests.helpers.processes import killed_after

SHORT = "--num-episodes 12 --batch-size 16 --solved-reward 1000 --quiet"


@pytest.fixture(autouse=True)
def _folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)
    for name in ("MPLBACKEND", "TF_CPP_MIN_LOG_LEVEL", "PYGAME_HIDE_SUPPORT_PROMPT", "SDL_VIDEODRIVER"):
        monkeypatch.setenv(name, os.environ.get(name, {"SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "Agg"}.get(name, "3")))


def dqn_keras(line):
    return main(shlex.split(line))


def log(folder):
    return list(csv.DictReader(Path(folder, "log.csv").open()))


def test_help_does_not_wait_for_tensorflow():
    script = """
import sys
from dqn_keras.cli.options import main
for arguments in (["--help"], ["train", "--help"], ["--version"]):
    assert main(arguments) == 0
assert main(["train", "CartPole-v1", "--tau", "2"]) == 2
assert not {"tensorflow", "keras", "gymnasium", "matplotlib"} & sys.modules.keys()
"""
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    for word in ("evaluate", "--hidden-units", "Adam's learning rate, in (0, 1]", "--compiled", "dqn_keras 0."):
        assert word in done.stdout


@pytest.mark.slow
def test_the_installed_command_and_the_module_are_the_same():
    commands = [[Path(sys.executable).with_name("dqn-keras")], [sys.executable, "-m", "dqn_keras"]]
    first, second = (
        subprocess.run([*x, "plot", "nowhere"], capture_output=True, text=True, timeout=600) for x in commands
    )
    assert first.returncode == second.returncode == 2
    assert first.stderr == second.stderr == "dqn-keras: nowhere holds no run: there is no config.json in it\n"


@pytest.mark.slow
def test_a_run_folder_holds_what_one_expects():
    assert dqn_keras(f"train CartPole-v1 --seed 3 --tau 0.005 --hidden-units 8 4 --out runs/a {SHORT}") == 0
    names = {path.name for path in Path("runs/a").iterdir()}
    assert names - {".lock"} == {"config.json", "log.csv", "agent.keras", "checkpoint", "curve.png"}
    content = json.loads(Path("runs/a/config.json").read_text())
    assert content["seed"] == 3
    assert (content["config"]["tau"], content["config"]["hidden_units"]) == (0.005, [8, 4])
    assert {"tensorflow", "keras", "numpy", "gymnasium", "python", "dqn_keras"} <= content["versions"].keys()
    config = Config(tau=0.005, hidden_units=(8, 4), num_episodes=12, batch_size=16, solved_reward=1000)
    run = train(gym.make("CartPole-v1"), config, seed=3, verbose=0)
    assert [float(row["reward"]) for row in log("runs/a")] == run.rewards.tolist()
    for kept, ours in zip(load_q_network("runs/a/agent.keras").get_weights(), run.q_network.get_weights(), strict=True):
        np.testing.assert_array_equal(kept, ours)
    with Image.open("runs/a/curve.png") as picture:
        assert picture.width > 1000


@pytest.mark.slow
def test_the_option_compiled_plays_the_functional_twin():
    assert dqn_keras(f"train CartPole-v1 --seed 3 --compiled --tensorboard {SHORT}") == 0
    config = Config(num_episodes=12, batch_size=16, solved_reward=1000)
    rewards = train(CartPole(), config, seed=3, verbose=0).rewards.tolist()
    assert [float(row["reward"]) for row in log("runs/CartPole-v1-3")] == rewards
    assert list(Path("runs/CartPole-v1-3/tensorboard").rglob("*tfevents*"))


def test_the_agent_is_evaluated_and_watched(capsys):
    dqn_keras(f"train CartPole-v1 --seed 0 --out a {SHORT}")
    assert dqn_keras("evaluate a --episodes 5 --seed 1") == 0
    returns = evaluate(gym.make("CartPole-v1"), load_q_network("a/agent.keras"), 5, seed=1)
    assert capsys.readouterr().out.startswith(
        f"5 greedy episodes: mean return {returns.mean():.1f}, standard deviation"
    )
    assert dqn_keras("watch a --seed 1") == 0
    assert capsys.readouterr().out == f"An episode of {returns[0]:.0f} steps is in a/episode.gif\n"
    with Image.open("a/episode.gif") as picture:
        assert picture.is_animated


@pytest.mark.slow
def test_the_agent_is_watched_in_a_window_where_there_is_a_display(capsys, monkeypatch):
    dqn_keras(f"train FrozenLake-v1 --flatten --seed 0 --out a {SHORT}")
    made, make = [], gym.make

    def made_for_eyes(*arguments, render_mode=None, **others):
        made.append(render_mode)
        return make(*arguments, **others)

    monkeypatch.setattr(gym, "make", made_for_eyes)
    monkeypatch.delenv("SDL_VIDEODRIVER")
    monkeypatch.setenv("DISPLAY", ":0")
    assert dqn_keras("watch a --episodes 2") == 0
    assert made == ["human"]
    assert capsys.readouterr().out.startswith("2 greedy episodes: mean return")


@pytest.mark.skipif(shutil.which("xvfb-run") is None, reason="needs a display, or Xvfb to stand for one")
def test_a_real_window_opens(capsys):
    dqn_keras(f"train CartPole-v1 --seed 0 --out a {SHORT}")
    command = ["xvfb-run", "-a", sys.executable, "-m", "dqn_keras", "watch", "a", "--episodes", "1"]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("SDL_")}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0
    assert done.stdout.startswith("1 greedy episodes: mean return")


@pytest.mark.slow
def test_environments_take_arguments_and_wrappers(tmp_path):
    line = f"train FrozenLake-v1 --flatten --env-args is_slippery=False map_name=8x8 --seed 0 --out a {SHORT}"
    assert dqn_keras(line) == 0
    assert load_q_network("a/agent.keras").input_shape == (None, 64)
    assert dqn_keras("evaluate a --episodes 2") == 0
    Path("my_environments.py").write_text(
        "import gymnasium as gym\nfrom tests.helpers.environments import Corridor\n"
        "gym.register('Corridor-v0', Corridor, max_episode_steps=9)\n"
    )
    assert dqn_keras(f"train my_environments:Corridor-v0 --env-args length=5 --seed 1 {SHORT}") == 0
    assert Path("runs/my_environments-Corridor-v0-1/agent.keras").exists()


@pytest.mark.slow
def test_a_study_is_saved_continued_and_drawn(capsys):
    line = "study CartPole-v1 --compiled --out s --workers 1 --num-episodes 60 --solved-reward 10 --quiet"
    assert dqn_keras(f"{line} --seeds 2") == 0
    assert "Share of seeds solved within 60 episodes: 1.000" in capsys.readouterr().out
    assert dqn_keras(f"{line} --seeds 3") == 0
    assert load_study("s/study.npz").seeds.tolist() == [0, 1, 2]
    Path("s/study.png").unlink()
    assert dqn_keras("plot s") == 0
    assert Path("s/study.png").exists()


@pytest.mark.slow
def test_a_sweep_is_saved_continued_and_drawn(capsys):
    line = "sweep CartPole-v1 --compiled --out s --workers 1 --num-episodes 60 --evaluate --quiet"
    assert dqn_keras(f"{line} --vary hidden_units=8x8 double=False,True tau=0.1,0.5 --seeds 1") == 0
    table = capsys.readouterr().out
    names = [f"hidden_units=8x8 double={double} tau={tau}" for double in (False, True) for tau in (0.1, 0.5)]
    assert all(f"| {name} | 1 |" in table for name in names)
    kept = load_sweep("s/sweep.npz")
    assert [kept[name].config.hidden_units for name in names] == [(8, 8)] * 4
    assert [kept[name].config.tau for name in names] == [0.1, 0.5, 0.1, 0.5]
    assert len({study.outcomes[0].digest for study in kept.values()}) == 4
    assert np.isfinite(kept[names[0]].greedy_returns).all()
    with Path("s/sweep.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["setting"], row["seed"]) for row in rows] == [(name, "0") for name in names]
    Path("s/sweep.png").unlink()
    assert dqn_keras("plot s") == 0
    assert Path("s/sweep.png").exists()


@pytest.mark.slow
def test_formulas_and_presets_of_a_run_are_kept_for_its_resume():
    line = f"train CartPole-v1 --seed 3 --preset --tau 0.01 --double --loss huber {SHORT} --out"
    assert dqn_keras(f"{line} run") == 0
    kept = json.loads(Path("run/config.json").read_text())
    assert (kept["double"], kept["loss"], kept["config"]["tau"], kept["config"]["gamma"]) == (True, "huber", 0.01, 0.99)
    assert dqn_keras("resume run --num-episodes 20 --quiet") == 0
    dqn_keras(f"{line} whole --num-episodes 20")
    own = {"targets": double_td_targets, "loss": "huber"}
    config = dataclasses.replace(presets["CartPole-v1"], tau=0.01, num_episodes=20, batch_size=16, solved_reward=1000)
    run = train(gym.make("CartPole-v1"), config, 3, **own, verbose=0)
    for folder in ("run", "whole"):
        for a, b in zip(load_q_network(f"{folder}/agent.keras").weights, run.q_network.weights, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_a_run_made_longer_equals_one_that_was_longer_from_the_start():
    dqn_keras(f"train CartPole-v1 --seed 3 --out whole {SHORT}")
    dqn_keras(f"train CartPole-v1 --seed 3 --out parts {SHORT} --num-episodes 7")
    assert dqn_keras("resume parts --num-episodes 12 --quiet") == 0
    assert not differing("whole", "parts")


def differing(*folders):
    """Returns what differs in the results of two runs, apart from speeds."""
    logs = [[{k: v for k, v in row.items() if k != "steps_per_second"} for row in log(folder)] for folder in folders]
    weights = [load_q_network(Path(folder, "agent.keras")).get_weights() for folder in folders]
    return [
        name
        for name, same in (
            ("log", logs[0] == logs[1]),
            ("weights", all(map(np.array_equal, *weights))),
            ("config", len({Path(folder, "config.json").read_text() for folder in folders}) == 1),
        )
        if not same
    ]


LONG = "--seed 3 --num-episodes 330 --solved-reward 1000"


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Returns the folder of a run that nothing has stopped."""
    folder = tmp_path_factory.mktemp("runs") / "whole"
    dqn_keras(f"train CartPole-v1 --out {shlex.quote(str(folder))} {LONG} --quiet")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 130), (signal.SIGKILL, -signal.SIGKILL)]
)
def test_a_stopped_run_is_resumed_exactly(number, code, whole):
    command = [sys.executable, "-m", "dqn_keras", "train", "CartPole-v1", "--out", "run", *LONG.split()]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    with killed_after(600, process):
        assert any(line.startswith("Episode 100") for line in process.stdout)
        process.send_signal(number)
        _, printed = process.communicate()
    assert process.returncode == code
    if code == 130:
        assert printed == "Interrupted; the finished part is saved. To continue: dqn-keras resume run\n"
        assert {"agent.keras", "curve.png"} <= {path.name for path in Path("run").iterdir()}
        assert [int(row["epoch"]) for row in log("run")] == list(range(len(log("run"))))
    else:
        with Path("run/log.csv").open("a") as file:
            file.write("999,1.0,0.")  # a power cut in the middle of a line
        assert dqn_keras("plot run") == 0
    assert 100 <= len(log("run")) < 330
    assert dqn_keras("resume run --quiet") == 0
    assert not differing("run", whole)


ERRORS = {
    "train CartPole-v1 --tau 3": "tau must be a finite number above 0, at most 1, got 3.0",
    "train Nope-v1": "Environment `Nope` doesn't exist.",
    "train no_module:Nope-v1": "No module named 'no_module'",
    "train FrozenLake-v1": "FrozenLake-v1 has the observation space Discrete(16); use --flatten",
    "train Pendulum-v1": "env Pendulum-v1 has the action space Box(-2.0, 2.0, (1,), float32); it must be Discrete",
    "train CarRacing-v3 --env-args continuous=False": "env CarRacing-v3 has observations of shape (96, 96, 3)",
    "train CartPole-v1 --env-args gravity": "env_args must be of the form NAME=VALUE, got 'gravity'",
    "train CartPole-v1 --env-args wings=2": "CartPole-v1 wings=2 cannot be made: TypeError: CartPoleEnv.__init__() got",
    "train LunarLander-v3 --env-args gravity=5": "LunarLander-v3 gravity=5 cannot be made: AssertionError: gravity",
    "train FrozenLake-v1 --flatten --env-args map_name=9x9": "FrozenLake-v1 map_name='9x9' cannot be made: KeyError",
    "study CartPole-v1 --num-episodes 20": "num_episodes must be at least solved_window=50 in a study",
    "train LunarLander-v3 --compiled": "compiled is only for CartPole-v1, Acrobot-v1, MountainCar-v0, without",
    "train CartPole-v1 --seed -1": "seed must be a whole number from 0",
    "train CartPole-v1 --loss hubr": "loss must be a name that Keras knows, such as 'mse', got 'hubr'",
    "train Nope-v1 --preset": "preset exists for CartPole-v1",
    "train CartPole-v1 --preset --tau 7": "tau must be a finite number above 0, at most 1, got 7.0",
    "train CartPole-v1 --steps-count-from run --num-steps 10": "batch_size must be at most num_steps = 10, got 64",
    "sweep CartPole-v1 --vary tua=1": "vary must be of the form NAME=VALUE,VALUE with a name from --help, got 'tua=1'",
    "sweep CartPole-v1 --vary tau": "vary must be of the form NAME=VALUE,VALUE with a name from --help, got 'tau'",
    "sweep CartPole-v1 --vary tau=0.1,x": "tau must be a finite number above 0, at most 1, got 'x'",
    "sweep CartPole-v1 --vary loss=mse,x": "settings['loss=x']: loss must be a name that Keras knows",
    "sweep CartPole-v1 --vary double=1": "double must be True or False, got 1",
    "study CartPole-v1 --seeds 0": "seeds must be a whole number from 1",
    "resume nowhere": "nowhere holds no run: there is no config.json in it",
    "evaluate nowhere": "nowhere holds no run",
    "watch nowhere": "nowhere holds no run",
    "plot nowhere": "nowhere holds no run",
}


@pytest.mark.parametrize(("line", "message"), ERRORS.items(), ids=ERRORS)
def test_an_error_is_one_clear_line(line, message, capfd):
    if "CarRacing" in line or "LunarLander-v3 --env-args" in line:
        pytest.importorskip("Box2D")
    assert dqn_keras(line) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert err.startswith(f"dqn-keras: {message}")
    assert err.count("\n") == 1
    assert not any(Path.cwd().iterdir())


USAGE_ERRORS = {
    "train CartPole-v1 --tua 0.1": ("Unrecognized options: --tua, 0.1", "--tau FLOAT"),
    "train CartPole-v1 --tau x": (
        "--tau: could not convert string to float: 'x'",
        "Share of Q that is mixed into Q-hat",
    ),
    "train": ("Missing from dqn-keras train", "ENV"),
    "fly": ("Unrecognized options: fly", "train, resume, watch, evaluate, study, sweep, plot"),
    "": ("Expected one of {train, resume, watch, evaluate, study, sweep, plot}.",),
    "sweep CartPole-v1": ("Missing from dqn-keras sweep", "--vary"),
}


SLIPS = {
    "trian CartPole-v1": "did you mean `dqn-keras train`?",
    "train CartPole-v1 --lr 0.1": "the learning rate is --alpha",
    "train CartPole-v1 --learning-rate 0.1": "the learning rate is --alpha",
    "train CartPole-v1 --tau 1e-1 --buffer-size 1e5": "the size of the replay memory is --memory-size",
    "train CartPole-v1 --hidden-units 64,64": "spaces separate the numbers: --hidden-units 64 64",
    "train CartPole-v1 --gamma 1e0 --num-episodes 1e3": "whole numbers have only digits: --num-episodes 1000",
    "train CartPole-v1 --lr=0.1": "the learning rate is --alpha",
    "train CartPole-v1 --hidden-units=[64,64]": "spaces separate the numbers: --hidden-units 64 64",
    "train CartPole-v1 --num-episodes=1e3": "whole numbers have only digits: --num-episodes 1000",
    "train CartPole-v1 --batch-size 64.0": "whole numbers have only digits: --batch-size 64",
}


@pytest.mark.parametrize(("line", "hint"), SLIPS.items(), ids=SLIPS)
def test_a_common_mistake_gets_a_hint(line, hint, capfd):
    assert dqn_keras(line) == 2
    assert capfd.readouterr().err.endswith(f"╯\ndqn-keras: {hint}\n")


@pytest.mark.parametrize(("line", "parts"), USAGE_ERRORS.items(), ids=USAGE_ERRORS)
def test_an_option_that_cannot_be_read_is_explained(line, parts, capfd):
    assert dqn_keras(line) == 2
    out, err = capfd.readouterr()
    assert out == ""
    assert all(part in err for part in parts)
    assert err.endswith("╯\n")
    assert "__tyro" not in err
    assert not any(Path.cwd().iterdir())


def test_an_incomplete_folder_is_a_clear_error(capfd):
    dqn_keras(f"train CartPole-v1 --seed 3 --out a {SHORT}")
    capfd.readouterr()
    errors = []

    def fail(line):
        assert dqn_keras(line) == 2
        errors.append(capfd.readouterr().err)

    fail(f"train CartPole-v1 --out a {SHORT}")
    Path("a/agent.keras").unlink()
    fail("evaluate a")
    Path("a/log.csv").unlink()
    fail("plot a")
    Path("a/config.json").write_text('{"seed": 3}')
    fail("evaluate a")
    assert errors[0].startswith("dqn-keras: a already holds a run: `dqn-keras resume a` continues it")
    assert errors[1].startswith(
        "dqn-keras: a has no agent.keras: its run is in progress or was killed; to continue it: dqn-keras resume"
    )
    assert errors[2] == "dqn-keras: a has no episode in log.csv yet\n"
    assert errors[3].startswith("dqn-keras: a/config.json is not what `dqn-keras train` writes: 'config'")


@pytest.mark.slow
def test_a_folder_is_for_one_process_at_a_time(capfd):
    dqn_keras(f"train CartPole-v1 --seed 3 --out a {SHORT}")
    with filelock.FileLock("a/.lock"):
        assert dqn_keras("resume a") == 2
    assert capfd.readouterr().err == "dqn-keras: a is in use: another process or thread writes there\n"
    assert dqn_keras("resume a --quiet") == 0


@pytest.mark.slow
def test_a_log_that_was_lost_or_damaged_is_made_again():
    dqn_keras(f"train CartPole-v1 --seed 3 --out a {SHORT}")
    whole = log("a")
    lines = Path("a/log.csv").read_text().splitlines(keepends=True)
    Path("a/log.csv").write_text("".join([*lines[:4], "more\n", "5,1,x\n", *lines[8:10], lines[10][:20]]))
    assert dqn_keras("resume a --quiet") == 0
    rows = [{k: v for k, v in row.items() if k != "steps_per_second"} for row in log("a")]
    assert rows == [{k: v for k, v in row.items() if k != "steps_per_second"} for row in whole]


def test_a_longer_run_that_is_refused_changes_nothing():
    dqn_keras(f"train CartPole-v1 --seed 3 --out a {SHORT}")
    before = {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()}
    assert dqn_keras("resume a --num-episodes 5") == 2
    assert {path: path.read_bytes() for path in Path("a").rglob("*") if path.is_file()} == before


@pytest.mark.slow
def test_a_closed_output_is_not_a_traceback():
    script = (
        f"{shlex.quote(sys.executable)} -m dqn_keras train CartPole-v1 --seed 3 --out a --num-episodes 500 | head -1"
    )
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=600)
    assert done.stdout.count("\n") == 1
    assert done.stderr == "dqn-keras: nobody reads the output. To continue: dqn-keras resume a\n"


def test_an_error_in_the_environments_own_code_keeps_its_traceback():
    Path("broken.py").write_text(
        "import gymnasium as gym\nfrom tests.helpers.environments import Corridor\n\n"
        "def reward(t):\n    raise ValueError('the simulator died')\n\n"
        "gym.register('Broken-v0', lambda: Corridor(length=9, reward=reward))\n"
    )
    with pytest.raises(ValueError, match="the simulator died"):
        dqn_keras(f"train broken:Broken-v0 --out a {SHORT}")


def test_quiet_is_quiet(capfd):
    dqn_keras(f"train CartPole-v1 --seed 3 --out a {SHORT}")
    assert capfd.readouterr() == ("", "")
