"""Opening a file from a stranger runs none of its code, and takes neither unbounded memory nor unbounded time."""

import hashlib
import io
import json
import math
import os
import re
import sys
import warnings
import zipfile

import h5py
import numpy as np
import pytest

from dqn_keras import Config, load_q_network, load_study
from dqn_keras.cli.options import how_to_resume, main, parse
from dqn_keras.networks import make_q_network
from dqn_keras.storage.files import FORMAT, DamagedError, from_bytes, to_bytes
from dqn_keras.storage.networks import save_q_network


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Makes a run whose config.json names evil.py, a module in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [x for x in sys.path if x not in ("", str(tmp_path))])
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    monkeypatch.setattr(warnings, "formatwarning", warnings.formatwarning)  # `main` sets it, and these
    for name, value in {"SDL_VIDEODRIVER": "dummy", "MPLBACKEND": "Agg", "DQN_KERAS_CACHE": "0"}.items():
        monkeypatch.setenv(name, os.environ.get(name, value))
    for name in ("TF_CPP_MIN_LOG_LEVEL", "PYGAME_HIDE_SUPPORT_PROMPT"):
        monkeypatch.setenv(name, os.environ.get(name, "3"))
    assert (
        main(
            [
                "train",
                "CartPole-v1",
                "--num-episodes",
                "3",
                "--batch-size",
                "8",
                "--seed",
                "0",
                "--quiet",
                "--out",
                "run",
            ]
        )
        == 0
    )
    (tmp_path / "evil.py").write_text("from pathlib import Path\nPath('was_run').touch()\n")
    change_environment(tmp_path, id="evil:CartPole-v1")
    return tmp_path


def change_environment(tmp_path, **changes):
    path = tmp_path / "run" / "config.json"
    content = json.loads(path.read_text())
    content["environment"] |= changes
    path.write_text(json.dumps(content))


COMMANDS = ["evaluate run --episodes 1", "watch run --gif", "resume run --num-episodes 4"]


@pytest.mark.slow
def test_a_folder_imports_no_module_unless_the_user_names_it(folder, capfd):
    for command in COMMANDS:
        assert main(command.split()) == 2
        assert "if you trust it: --import evil" in capfd.readouterr().err
    assert main(["plot", "run"]) == 0
    change_environment(folder, id="GymV26Environment-v0", arguments={"env_id": "evil:CartPole-v1"})
    assert main(COMMANDS[0].split()) == 2
    assert not (folder / "was_run").exists()
    assert "evil" not in sys.modules
    assert str(folder) not in sys.path

    assert main([*COMMANDS[0].split(), "--import", "json"]) == 2  # not the module that is named
    assert not (folder / "was_run").exists()
    change_environment(folder, id="evil:CartPole-v1", arguments={})
    assert main([*COMMANDS[0].split(), "--import", "evil"]) == 0
    assert (folder / "was_run").exists()


@pytest.mark.parametrize("environment", [{"id": 5}, {"id": None}, {"arguments": [1]}, {"id": ["evil:CartPole-v1"]}])
def test_an_environment_of_the_wrong_kind_is_an_error(folder, environment, capfd):
    change_environment(folder, **environment)
    assert main(COMMANDS[0].split()) == 2
    assert "config.json is not what `dqn-keras train` writes" in capfd.readouterr().err


def signed(body):
    return body + hashlib.sha256(body).digest()


def archive(parts, compression=zipfile.ZIP_STORED):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", compression) as zipped:
        for name, content in parts.items():
            zipped.writestr(name, content)
    return signed(file.getvalue())


def npy(shape, dtype="<f4", data=b""):
    header = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {shape!r}, }}"
    header += " " * (63 - (10 + len(header)) % 64) + "\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode() + data


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (archive({"a.npy": npy((10**12,))}), "does not fit its data"),
        (archive({"a.npy": npy((2**40, 2**40))}), "does not fit its data"),
        (archive({"a.npy": npy((-1,), data=bytes(4))}), "does not fit its data"),
        (archive({"a.npy": npy((1,), "|O", b"cos\nsystem\n")}), "does not fit its data"),
        (archive({"a.npy": bytes(10**8)}, zipfile.ZIP_DEFLATED), "a part is compressed"),
        (archive({"a.npy": b"no array"}), "it is not a checkpoint"),
        (archive({}), "it is not a checkpoint"),
        (signed(b"PK"), "it is not a checkpoint"),
    ],
    ids=range(8),
)
def test_crafted_archives_are_refused(content, message):
    with pytest.raises(DamagedError, match=message):
        from_bytes(content)


def outcome(seed, solved_at, digest="ab" * 32, greedy_return=math.nan, seconds=1.0):
    """Returns a seed's entry for the file of a study."""
    return seed, solved_at, greedy_return, seconds, digest


def study_file(path, **changes):
    """Writes a study of two seeds of 60 episodes, with these changes of columns and facts."""
    config = {**vars(Config(num_episodes=60)), "hidden_units": [64]}
    columns = {f"{seed}/rewards": np.ones(60) for seed in (0, 1)} | {f"{seed}/steps": np.full(60, 7) for seed in (0, 1)}
    setting = {"name": "", "config": config, "seeds": [outcome(0, 55), outcome(1, None)]}
    for name, value in changes.items():
        (columns if "/" in name else setting)[name] = value
    columns = {f"0/{name}": column for name, column in columns.items()}
    path.write_bytes(to_bytes(columns, {"format": FORMAT, "settings": [setting]} | changes.get("facts", {})))
    return path


def test_a_sound_study_file_is_loaded(tmp_path):
    study = load_study(study_file(tmp_path / "study.npz"))
    assert [outcome.solved_at for outcome in study.outcomes] == [55, None]


@pytest.mark.parametrize(
    "changes",
    [
        {"0/rewards": np.full(60, np.nan)},
        {"0/rewards": np.ones((60, 1))},
        {"0/rewards": np.ones(59)},
        {"0/rewards": np.array(["a"] * 60)},
        {"0/rewards": np.ones(0), "0/steps": np.ones(0, int)},
        {"0/steps": np.full(60, -1)},
        {"0/steps": np.full(60, 1.5)},
        {"0/steps": np.ones(61, int), "0/rewards": np.ones(61)},
        {"seeds": [outcome(0, 10**9)]},
        {"seeds": [outcome(0, 1.5)]},
        {"seeds": [outcome(-1, None)]},
        {"seeds": [outcome(0, None), outcome(0, None)]},
        {"seeds": [outcome(0, None, "no hex")]},
        {"seeds": [outcome(0, None, 7)]},
        {"seeds": [outcome(2, None)]},
        {"seeds": [outcome(0, None, greedy_return=math.inf)]},
        {"seeds": [outcome(0, None, greedy_return="much")]},
        {"seeds": [outcome(0, None, seconds=-1)]},
        {"seeds": [outcome(0, None)[:4]]},
        {"name": 7},
        {"name": None},
        {"facts": {"settings": None}},
        {"facts": {"settings": [7]}},
        {"facts": {"settings": [{}]}},
        {"seeds": [0]},
        {"seeds": None},
        {"config": {}},
        {"config": None},
        {"config": {"hidden_units": [64], "gamma": 7}},
        {"config": {"hidden_units": 64}},
    ],
    ids=str,
)
def test_a_crafted_study_file_is_refused(tmp_path, changes):
    path = study_file(tmp_path / "study.npz", **changes)
    with pytest.raises(ValueError, match=r"study\.npz is not a study that can be loaded: "):
        load_study(path)


def change_parts(path, **changes):
    """Replaces parts of a zip file with functions of their content; compresses the part named `compressed`."""
    compressed = changes.pop("compressed", None)
    with zipfile.ZipFile(path) as zipped:
        parts = {name: zipped.read(name) for name in zipped.namelist()}
    with zipfile.ZipFile(path, "w") as zipped:
        for name, content in parts.items():
            change = changes.get(name.partition(".")[0], lambda content: content)
            zipped.writestr(name, change(content), zipfile.ZIP_DEFLATED if name == compressed else zipfile.ZIP_STORED)


def with_lambda(content):
    config = json.loads(content)
    layer = config["config"]["layers"][1]
    layer["class_name"], layer["registered_name"] = "Lambda", None
    code = {"class_name": "__lambda__", "config": {"code": "4wEAAAAAAAAA", "defaults": None, "closure": None}}
    layer["config"] = {"name": "evil", "function": code, "arguments": {}}
    return json.dumps(config)


def with_class(content):
    config = json.loads(content)
    layer = config["config"]["layers"][1]
    layer["module"], layer["class_name"], layer["registered_name"] = "evil", "Evil", "Evil>Evil"
    return json.dumps(config)


def change_weights(change):
    def changed(content):
        file = io.BytesIO(content)
        with h5py.File(file, "r+") as weights:
            change(weights)
        return file.getvalue()

    return changed


def first_dataset(weights):
    names = []
    weights.visititems(lambda name, x: names.append(name) if isinstance(x, h5py.Dataset) else None)
    return names[0]


def make_huge(weights):
    name = first_dataset(weights)
    del weights[name]
    weights.create_dataset(name, (10**12,), "f4", chunks=(1024,))  # takes no room in the file


def make_external(weights):
    name = first_dataset(weights)
    del weights[name]
    weights[name] = h5py.ExternalLink("other.h5", "/x")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"config": with_lambda}, "(?i)lambda|safe mode|unsafe"),
        ({"config": with_class}, "Evil"),
        ({"compressed": "model.weights.h5"}, "is compressed"),
        ({"model": change_weights(make_huge)}, "is not as Keras writes it"),
        ({"model": change_weights(make_external)}, "is not as Keras writes it"),
        ({"model": lambda content: content[:100]}, "path "),
    ],
    ids=["lambda", "class", "compressed", "huge", "external", "cut"],
)
def test_a_crafted_network_is_refused(tmp_path, monkeypatch, changes, message):
    (tmp_path / "evil.py").write_text("raise SystemExit('it was imported')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "evil", raising=False)
    path = tmp_path / "agent.keras"
    save_q_network(path, make_q_network(4, 2, (8,), seed=0))
    load_q_network(path)
    change_parts(path, **changes)
    with pytest.raises(ValueError, match=r"agent\.keras is not a network that can be loaded: ") as caught:
        load_q_network(path)
    assert re.search(message, str(caught.value))
    assert "evil" not in sys.modules


def test_the_hint_how_to_continue_names_the_module_again():
    for line in ("train my.module:Catch-v0 --out folder", "resume folder --import my.module"):
        assert how_to_resume(parse(line.split()), "folder") == "dqn-keras resume folder --import my.module"
    assert how_to_resume(parse(["train", "CartPole-v1", "--out", "folder"]), "a b") == "dqn-keras resume 'a b'"
