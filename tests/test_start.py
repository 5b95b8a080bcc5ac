"""The start of a process: the cache of compiled programs, the option of XLA, the garbage collector."""

import hashlib
import importlib.util
import os
import subprocess
import sys

import pytest

from dqn_keras._engine import cache

SCRIPT = """
import gymnasium as gym
from dqn_keras import train
from tests.helpers.runs import QUICK, fingerprint
print(fingerprint(train(gym.make("CartPole-v1"), QUICK, seed=0, verbose=0)))
"""
PROGRAMS = """
from dqn_keras._engine import cache
for path in sorted(cache._own.glob("*.pb")):
    if path.stat().st_size >= cache._SMALLEST:
        print(cache._digest(path))
"""


def start(script=SCRIPT, **environment):
    return subprocess.Popen(
        [sys.executable, "-c", script],
        env={k: x for k, x in os.environ.items() if k not in ("XLA_FLAGS", "TF_XLA_FLAGS")} | environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def output(process):
    out, err = process.communicate(timeout=600)
    assert (process.returncode, err) == (0, "")
    return out


def kept(folder):
    """Returns the files of the cache by name, after checking that each is whole."""
    assert not list(folder.glob("*/process-*"))
    contents = {path.name: path.read_bytes() for path in folder.glob("*/*")}
    assert all(name.endswith(hashlib.sha256(content).hexdigest()[:16]) for name, content in contents.items())
    return contents


@pytest.mark.slow
def test_a_cache_is_filled_used_and_repaired_and_changes_no_bit(tmp_path):
    plain = output(start(DQN_KERAS_CACHE="0"))
    first, second = (output(start(SCRIPT + PROGRAMS, DQN_KERAS_CACHE=str(tmp_path))) for _ in range(2))
    assert first == second  # a program that is compiled again has other bytes
    assert first.startswith(plain)
    assert len(first.splitlines()) == 1 + len(before := kept(tmp_path)) > 1
    for path in tmp_path.glob("*/*"):
        path.write_bytes(path.read_bytes()[:-100])
    assert output(start(DQN_KERAS_CACHE=str(tmp_path))) == plain
    assert len(kept(tmp_path)) == len(before)


OTHER_WORK = """
from dqn_keras import Config, make_q_network, train
from dqn_keras.environments import CartPole
from dqn_keras._engine.tensorflow import keras, tf
for i in range({amount}):
    tf.function(lambda x: x + i)(1.0)
    make_q_network(5, 2)
q_network = keras.Sequential([keras.Input((4,)), keras.layers.Dense(8, "tanh"), keras.layers.Dense(2)])
train(CartPole(), Config(num_episodes=3, batch_size=2), seed=0, q_network=q_network, loss="huber", verbose=0)
"""


@pytest.mark.slow
def test_a_program_is_found_whatever_the_process_did_before(tmp_path):
    for amount in (0, 3):
        output(start(OTHER_WORK.format(amount=amount), DQN_KERAS_CACHE=str(tmp_path)))
        assert len(kept(tmp_path)) == 1


@pytest.mark.slow
def test_processes_that_fill_the_cache_at_once_do_not_harm_each_other(tmp_path):
    assert len({output(process) for process in [start(DQN_KERAS_CACHE=str(tmp_path)) for _ in range(2)]}) == 1
    output(start(DQN_KERAS_CACHE=str(tmp_path)))
    before = kept(tmp_path)
    output(start(DQN_KERAS_CACHE=str(tmp_path)))
    assert kept(tmp_path) == before
    assert len({name.rpartition(".")[0] for name in before}) == len(before)


def test_running_processes_get_each_others_programs(tmp_path, monkeypatch):
    for name in ("TF_XLA_FLAGS", "TF_CPP_MIN_LOG_LEVEL"):
        monkeypatch.setenv(name, "")

    def process():
        """Returns another instance of the module, as another process has."""
        spec = importlib.util.spec_from_file_location("cache", cache.__file__)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        module.use_cache(str(tmp_path))
        return module

    def compile_in(process, name, content):
        (process._own / name).write_bytes(content * 200_000)

    def shared():
        return sorted(path.stem for path in tmp_path.glob("*/*.pb.*"))

    first, second = process(), process()
    compile_in(first, "a.pb", b"1")
    (first._own / "small.pb").write_bytes(b"1")
    first.publish()
    second.fetch()
    assert [path.name for path in second._own.iterdir()] == ["a.pb"]
    assert (second._own / "a.pb").samefile(next(tmp_path.glob("*/a.pb.*")))  # so that many processes need no more space
    for either in (first, second):
        compile_in(either, "b.pb", either._own.name[-1].encode())
        either.publish()
    assert shared() == ["a.pb", "b.pb"]
    (first._own.parent / "b.pb.0123").write_bytes(b"2" * 200_000)  # another process was as fast
    first.fetch()
    second.fetch()
    assert shared() == ["a.pb", "b.pb"]


def test_where_a_file_can_have_one_name_only_it_is_copied(tmp_path, monkeypatch):
    def link(*_):
        raise OSError("no links here")

    monkeypatch.setattr(os, "link", link)
    (tmp_path / "a").write_bytes(b"program")
    cache._link(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"program"


KERAS_FIRST = """
import sys
import keras
import gymnasium as gym
from dqn_keras import Config, train
print("Imported", file=sys.stderr)
run = train(gym.make("CartPole-v1"), Config(num_episodes=20), seed=0)
"""


@pytest.mark.slow
def test_tensorflow_logs_nothing_between_the_lines_of_train_even_if_keras_was_imported_first():
    process = start(KERAS_FIRST, DQN_KERAS_CACHE="0")
    out, err = process.communicate()
    assert out == "Episode 0, Reward: 19.0, Last 100 Average: 19.0\n"
    assert err.endswith("Imported\n")


FLAGS = """
import gc, os
gc.disable() if {is_off} else None
{first}
import dqn_keras._engine.tensorflow
assert gc.get_freeze_count() > 1000
print(gc.isenabled(), os.environ.get("XLA_FLAGS"), os.environ.get("TF_XLA_FLAGS"))
"""
OPTION = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=100000"
STUBS = {  # what the module needs of TensorFlow and Keras, whose import takes seconds
    "tensorflow": "class config: list_physical_devices = list",
    "keras": "import tensorflow\nclass backend:\n    def backend(): return 'tensorflow'",
}


@pytest.fixture
def flags(tmp_path_factory):
    """Returns a function: what to do first, whether the collector is off, variables -> what holds after the import."""
    folder = tmp_path_factory.mktemp("stubs")
    for name, content in STUBS.items():
        (folder / f"{name}.py").write_text(content)

    def after_import(first="", is_off=False, **environment):
        path = os.pathsep.join([str(folder), *sys.path])
        script = FLAGS.format(first=first, is_off=is_off)
        return output(start(script, **{"DQN_KERAS_CACHE": "0", "PYTHONPATH": path, **environment})).strip()

    return after_import


def test_the_garbage_collector_is_as_it_was(flags):
    assert flags().startswith("True")
    assert flags(is_off=True).startswith("False")


def test_what_the_user_chose_stays(flags):
    assert flags() == f"True {OPTION} None"
    assert flags(XLA_FLAGS="--xla_cpu_enable_fast_math=false") == f"True --xla_cpu_enable_fast_math=false {OPTION} None"
    chosen = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1024"
    assert flags(XLA_FLAGS=chosen) == f"True {chosen} None"
    assert flags(first="import tensorflow", DQN_KERAS_CACHE="1") == f"True {OPTION} None"
    chosen = "--tf_xla_persistent_cache_directory=/nowhere"
    assert flags(TF_XLA_FLAGS=chosen, DQN_KERAS_CACHE="1") == f"True {OPTION} {chosen}"


def test_a_process_does_not_use_the_folder_of_its_parent(flags, tmp_path):
    parents = f"--tf_xla_persistent_cache_directory={tmp_path}/xla-0/process-abc"
    assert flags(TF_XLA_FLAGS=f"--tf_xla_auto_jit=0 {parents}") == f"True {OPTION} --tf_xla_auto_jit=0"
    assert flags(TF_XLA_FLAGS=parents) == f"True {OPTION} None"
    own = flags(TF_XLA_FLAGS=parents, DQN_KERAS_CACHE=str(tmp_path))
    assert str(tmp_path) in own
    assert "process-abc" not in own
    assert not list(tmp_path.glob("*/process-*"))


def test_a_folder_that_cannot_be_used_is_no_error(flags, tmp_path):
    (tmp_path / "a file").touch()
    (tmp_path / "file").touch()
    assert flags(DQN_KERAS_CACHE=str(tmp_path / "a file")) == flags(DQN_KERAS_CACHE=str(tmp_path / "file"))
    assert flags(DQN_KERAS_CACHE=str(tmp_path / "file")).endswith("None")
