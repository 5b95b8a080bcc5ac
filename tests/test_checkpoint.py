import contextlib
import dataclasses
import os
import re
import subprocess
import sys
import warnings

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import Config, evaluate, load_q_network, make_networks, train
from dqn_keras.agent import make_agent
from dqn_keras.environments import CartPole
from dqn_keras.storage.checkpoint import Checkpoints
from dqn_keras.storage.files import from_bytes, to_bytes
from dqn_keras.storage.identity import identity
from dqn_keras.storage.networks import save_q_network
from tests.helpers import faults
from tests.helpers.environments import Corridor
from tests.helpers.faults import CONFIG, LOOPS, SEED, files, final_bits, newest, play
from tests.helpers.runs import Tape, fingerprint

QUICK = dataclasses.replace(CONFIG, num_episodes=40)


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
def test_a_run_resumed_three_times_ends_with_the_bits_of_an_uninterrupted_one(loop, tmp_path):
    whole = train(LOOPS[loop](), QUICK, SEED, verbose=0)
    for num_episodes in (7, 8, 33, 40):
        config = dataclasses.replace(QUICK, num_episodes=num_episodes)
        resumed = play(loop, tmp_path / "resumed", config)
    assert fingerprint(resumed) == fingerprint(whole)
    assert repr(resumed.episodes) == repr(whole.episodes)  # some losses are NaN
    play(loop, tmp_path / "whole", QUICK)
    assert final_bits(tmp_path / "resumed") == final_bits(tmp_path / "whole")


@pytest.mark.slow
def test_killed_runs_end_with_the_bits_of_an_uninterrupted_one(tmp_path):
    figures = faults.kill_campaign(tmp_path, num_kills=4, num_in_saves=2, kills_per_run=2)
    assert figures["kills"] == 4
    assert figures["of them inside a save"] >= 2
    assert figures["differing runs"] == 0


@pytest.mark.slow
def test_killed_runs_with_own_parts_end_with_the_bits_of_an_uninterrupted_one(tmp_path):
    cases = (("compiled episodes", "convolution, own loss"),)
    figures = faults.kill_campaign(tmp_path, num_kills=2, num_in_saves=1, kills_per_run=2, cases=cases)
    assert figures["kills"] == 2
    assert figures["differing runs"] == 0


@pytest.mark.slow
def test_runs_that_are_asked_to_stop_stop_and_continue_to_the_same_bits(tmp_path):
    figures = faults.signal_campaign(tmp_path, 4)
    assert figures["runs stopped by them"] > 0
    assert figures["differing runs"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("loop", LOOPS)
def test_no_part_of_a_checkpoint_can_be_forgotten(loop, tmp_path):
    outcomes = faults.forgetting_campaign(loop, tmp_path)
    assert len(outcomes) > 30
    versions = outcomes.pop("versions")
    assert versions == ("refused", "warned")  # they change nothing that the run computes
    assert all(missing == "refused" for missing, _ in outcomes.values()), outcomes
    assert all(reset in ("refused", "other bits") for _, reset in outcomes.values()), outcomes


@pytest.mark.slow
def test_a_corrupted_checkpoint_is_a_warning_and_the_older_one_is_used(tmp_path):
    figures = faults.corruption_campaign(tmp_path, 150)
    assert figures["corruptions"] > 120
    assert len(figures["by way"]) == 14
    assert figures["silent"] == []


@pytest.mark.slow
def test_if_no_checkpoint_is_whole_the_error_says_why_of_each(tmp_path):
    play("compiled episodes", tmp_path, QUICK)
    paths = [tmp_path / name for name in files(tmp_path)]
    assert len(paths) == 2
    for path in paths:
        path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"^checkpoint: .*0040\.npz cannot be used: its SHA.*\.npz cannot be used"):
        play("compiled episodes", tmp_path, QUICK)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"config": dataclasses.replace(QUICK, gamma=0.9)}, r"^gamma is 0\.95 in .*, got 0\.9"),
        ({"config": dataclasses.replace(QUICK, hidden_units=(8,))}, r"^hidden_units is \[64\] in .*, got \[8\]"),
        ({"config": dataclasses.replace(QUICK, num_episodes=39)}, r"^num_episodes must be at least 40, .*, got 39"),
        ({"seed": 4}, r"^seed is 3 in .*, got 4"),
        ({"env": gym.make("CartPole-v1", max_episode_steps=9)}, r"^env is .* 500.*got .*'max_episode_steps': 9"),
        ({"env": gym.make("CartPole-v1", sutton_barto_reward=True)}, r"^env is .*, got .*'sutton_barto_reward': True"),
        ({"env": CartPole()}, r"^env is .*, got \{'name': 'CartPole \(functional\)'"),
        ({"env": gym.make("MountainCar-v0")}, r"^env is .*, got \{'name': 'MountainCar-v0'"),
        ({"resume": False}, r"^checkpoint .*0040\.npz exists already; resume=True"),
    ],
    ids=lambda x: "",
)
def test_a_checkpoint_of_another_run_is_an_error_that_names_the_difference(change, message, tmp_path):
    play("Gymnasium loop", tmp_path, QUICK)
    before = final_bits(tmp_path)
    with pytest.raises(ValueError, match=message):
        play("Gymnasium loop", tmp_path, **{"config": QUICK, **change})
    assert final_bits(tmp_path) == before


def test_another_render_mode_is_the_same_environment(tmp_path):
    play("Gymnasium loop", tmp_path, QUICK)
    env = gym.make("CartPole-v1", render_mode="rgb_array")
    assert len(play(None, tmp_path, dataclasses.replace(QUICK, num_episodes=41), env=env).episodes) == 41


def test_a_finished_run_is_returned_unchanged(tmp_path, capsys):
    config = Config(num_episodes=60, batch_size=8, solved_reward=3.5)
    env = Corridor(length=100, limit=4)
    first = train(env, config, verbose=0, checkpoint=tmp_path)
    again = train(env, config, checkpoint=tmp_path, resume=True)  # the seed is the checkpoint's
    assert (again.seed, again.solved_at, fingerprint(again)) == (first.seed, 49, fingerprint(first))
    assert len(env.actions) == 200
    assert capsys.readouterr().out.splitlines() == [
        f"Resumed at episode 50 from {newest(tmp_path)}",
        "Solved with 4.0 reward in 49 episodes!",
    ]


def test_the_folder_keeps_the_last_two_and_nothing_else(tmp_path):
    folder = tmp_path / "runs" / "cartpole"
    folder.mkdir(parents=True)
    (folder / ".checkpoint-0000000005.99.partial.npz").write_bytes(b"left by a crash")
    play("Gymnasium loop", folder, QUICK)
    assert files(folder) == ["checkpoint-0000000035.npz", "checkpoint-0000000040.npz"]


def test_a_finished_run_that_is_resumed_keeps_both_checkpoints(tmp_path):
    for _ in range(2):
        play("Gymnasium loop", tmp_path, QUICK, callbacks=[keras.callbacks.Callback()])
        assert files(tmp_path) == ["checkpoint-0000000035.npz", "checkpoint-0000000040.npz"]


def test_a_damaged_checkpoint_is_not_one_of_the_two_that_are_kept(tmp_path):
    play("Gymnasium loop", tmp_path, QUICK)
    newest(tmp_path).write_bytes(b"")
    with pytest.warns(UserWarning, match="0040"):
        play("Gymnasium loop", tmp_path, dataclasses.replace(QUICK, num_episodes=42))
    assert files(tmp_path) == ["checkpoint-0000000040.npz", "checkpoint-0000000042.npz"]
    for name in files(tmp_path):
        from_bytes((tmp_path / name).read_bytes())


def test_a_run_that_cannot_start_leaves_no_checkpoint(tmp_path):
    with pytest.raises(ValueError, match=r"^jit_compile must be True for a functional environment"):
        train(CartPole(), dataclasses.replace(QUICK, jit_compile=False), checkpoint=tmp_path / "run")
    assert not (tmp_path / "run").exists()


class Paying(Corridor):
    """A Corridor whose reward is an argument."""

    def __init__(self, amount):
        super().__init__(length=100, limit=4, reward=lambda t: float(amount))
        self.amount = amount


class Doubled(gym.RewardWrapper):
    def reward(self, reward):
        return 2 * reward


@pytest.mark.parametrize("other", [Paying(2), Paying(np.float32(2)), Paying([1]), Doubled(Paying(1))])
def test_an_environment_with_other_arguments_is_another(other, tmp_path):
    config = dataclasses.replace(QUICK, batch_size=4)
    play(None, tmp_path, config, env=Paying(1))
    play(None, tmp_path, config, env=Paying(np.int64(1)))  # an equal argument of another type
    with pytest.raises(ValueError, match=r"^env is "):
        play(None, tmp_path, config, env=other)


def test_other_versions_are_one_warning(tmp_path):
    play("Gymnasium loop", tmp_path, QUICK)
    arrays, facts = from_bytes(newest(tmp_path).read_bytes())
    facts["versions"] |= {"keras": "3.0.0", "processor": "x86_64 sse4_1"}
    newest(tmp_path).write_bytes(to_bytes(arrays, facts))
    with pytest.warns(
        UserWarning, match=r"saved with keras 3\.0\.0 \(here .*\), processor x86_64 sse4_1 \(here"
    ) as caught:
        play("Gymnasium loop", tmp_path, QUICK)
    assert len(caught) == 1


def test_a_checkpoint_is_arrays_only_and_numpy_reads_it(tmp_path):
    play("Gymnasium loop", tmp_path, QUICK)
    with np.load(newest(tmp_path), allow_pickle=False) as archive:
        assert archive["q_network/0"].shape == (4, 64)


def test_what_callbacks_change_is_kept(tmp_path):
    schedule = keras.callbacks.LearningRateScheduler(lambda episode: 0.001 * 0.9**episode)
    whole = train(gym.make("CartPole-v1"), QUICK, SEED, verbose=0, callbacks=[schedule])
    tape = Tape(stop_after=20)
    stopped = play("Gymnasium loop", tmp_path, QUICK, callbacks=[schedule, tape])
    assert len(stopped.episodes) == 21
    assert not stopped.interrupted
    tape = Tape()
    resumed = play("Gymnasium loop", tmp_path, QUICK, callbacks=[schedule, tape])
    assert tape.calls[1] == ("begins", 21)
    assert fingerprint(resumed) == fingerprint(whole)


class LastWord(keras.callbacks.Callback):
    """Changes the agent at the end of training, as EarlyStopping may."""

    def on_train_end(self, logs=None):
        self.model.set_weights([w + 1 for w in self.model.get_weights()])


@pytest.mark.parametrize("loop", LOOPS)
def test_what_a_callback_does_at_the_end_is_saved_too(loop, tmp_path):
    run = play(loop, tmp_path, QUICK, callbacks=[LastWord()])
    assert fingerprint(play(loop, tmp_path, QUICK)) == fingerprint(run)


# Two runs in one folder


class Meanwhile(keras.callbacks.Callback):
    """Calls a function in the middle of a run."""

    def __init__(self, do):
        super().__init__()
        self.do = do

    def on_epoch_end(self, epoch, logs=None):
        if epoch == 12:
            self.do()


def test_a_second_run_is_refused_while_one_writes_in_the_folder(tmp_path):
    refused = []

    def try_to_join():
        before = {name: (tmp_path / name).read_bytes() for name in files(tmp_path)}
        for seed in (SEED, SEED + 1):
            with pytest.raises(ValueError, match=r"^checkpoint .* is in use: another process or thread"):
                play("Gymnasium loop", tmp_path, QUICK, seed)
            refused.append({name: (tmp_path / name).read_bytes() for name in files(tmp_path)} == before)

    (tmp_path / ".lock").write_text("left by a process that has died")
    run = play("Gymnasium loop", tmp_path, QUICK, callbacks=[Meanwhile(try_to_join)])
    assert refused == [True, True]
    assert fingerprint(play("Gymnasium loop", tmp_path, QUICK)) == fingerprint(run)  # the folder is free now


@pytest.mark.slow
def test_two_processes_that_start_at_once_leave_one_whole_run(tmp_path):
    figures = faults.race_campaign(tmp_path, 1)
    assert figures["pairs"] == 1
    assert figures["differing runs"] == 0


def test_a_callback_that_changes_the_current_folder_moves_no_checkpoint(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path)
    play("Gymnasium loop", "run", QUICK, callbacks=[Meanwhile(lambda: os.chdir("elsewhere"))])
    assert files(tmp_path / "run") == ["checkpoint-0000000035.npz", "checkpoint-0000000040.npz"]
    assert not list((tmp_path / "elsewhere").iterdir())


def test_a_lock_that_cannot_be_taken_in_a_folder_that_can_be_written_is_an_error(tmp_path):
    (tmp_path / ".lock").mkdir()  # or a file of another user
    with pytest.raises(OSError, match=r"^checkpoint .* cannot be locked: "):
        play("Gymnasium loop", tmp_path, QUICK)
    assert files(tmp_path) == []


def test_only_older_files_of_the_same_run_are_deleted(tmp_path):
    play("Gymnasium loop", tmp_path / "other", QUICK, SEED + 1)
    others = {}

    def bring_files_of_another_run():
        for name, new_name in zip(files(tmp_path / "other"), ("0000000003", "0000000099"), strict=True):
            path = tmp_path / "run" / f"checkpoint-{new_name}.npz"
            others[path] = (tmp_path / "other" / name).read_bytes()
            path.write_bytes(others[path])

    play("Gymnasium loop", tmp_path / "run", QUICK, callbacks=[Meanwhile(bring_files_of_another_run)])
    assert {path: path.read_bytes() for path in others} == others
    assert len(files(tmp_path / "run")) == 4


# Saves that fail


@pytest.mark.parametrize("name", faults.DISK_FAULTS)
def test_a_fault_of_the_disk_is_one_warning_and_leaves_the_last_state_and_no_litter(name, tmp_path):
    if not faults.is_possible(name, tmp_path):
        pytest.skip("this process may not do that")
    run, resumed, messages, left = faults.under_disk_fault(name, tmp_path)
    assert len(messages) == 1
    assert re.match(r"checkpoint after episode \d+ could not be saved \(.*\); the last one stays, and", messages[0])
    assert left == ["checkpoint-0000000005.npz", "checkpoint-0000000010.npz"]
    assert fingerprint(resumed) == fingerprint(run)


def test_a_warning_comes_again_if_saving_works_in_between(tmp_path):
    class Blocker(keras.callbacks.Callback):
        """Makes a folder with the name of the next file, twice."""

        def on_epoch_end(self, epoch, logs=None):
            if epoch in (6, 16):
                (tmp_path / f"checkpoint-{epoch + 4:010d}.npz").mkdir()

    with pytest.warns(UserWarning, match="could not be saved") as caught:
        run = play("Gymnasium loop", tmp_path, QUICK, callbacks=[Blocker()])
    assert [str(w.message).split(" could")[0] for w in caught] == [f"checkpoint after episode {k}" for k in (9, 19)]
    folders = ["checkpoint-0000000010.npz", "checkpoint-0000000020.npz"]
    assert files(tmp_path) == [*folders, "checkpoint-0000000035.npz", "checkpoint-0000000040.npz"]
    assert fingerprint(play("Gymnasium loop", tmp_path, QUICK)) == fingerprint(run)


def test_a_folder_that_cannot_be_one_is_an_error_before_any_work(tmp_path):
    (tmp_path / "file").write_text("")
    env = Corridor()
    with pytest.raises(OSError, match="file"):
        train(env, QUICK, verbose=0, checkpoint=tmp_path / "file" / "runs")
    assert env.reset_seeds == []
    with pytest.raises(ValueError, match=r"^resume needs .* checkpoint must be a path, got None"):
        train(env, QUICK, resume=True)
    with pytest.raises(ValueError, match=r"^checkpoint_every must be"):
        train(env, QUICK, checkpoint=tmp_path, checkpoint_every=0)


def test_a_folder_that_is_removed_during_the_run_is_made_again(tmp_path):
    class Remover(keras.callbacks.Callback):
        def on_epoch_end(self, epoch, logs=None):
            if epoch == 12:
                faults.shutil.rmtree(tmp_path / "run")

    run = play("Gymnasium loop", tmp_path / "run", QUICK, callbacks=[Remover()])
    assert len(files(tmp_path / "run")) == 2
    assert fingerprint(play("Gymnasium loop", tmp_path / "run", QUICK)) == fingerprint(run)


def test_an_error_in_the_environment_leaves_the_last_checkpoint(tmp_path):
    config = dataclasses.replace(QUICK, batch_size=4)
    broken = Corridor(limit=3, length=100, reward=lambda t: np.nan if len(broken.actions) == 50 else 1.0)
    with pytest.raises(ValueError, match=r"env Corridor: the reward must be finite.*in episode 16, step 1"):
        play(None, tmp_path, config, env=broken)
    assert newest(tmp_path).name == "checkpoint-0000000015.npz"
    whole = train(Corridor(limit=3, length=100), config, SEED, verbose=0)
    assert fingerprint(play(None, tmp_path, config, env=Corridor(limit=3, length=100))) == fingerprint(whole)


# The same bits in fresh processes


BITS = """
import dataclasses
import sys
from tests.helpers.faults import CONFIG, LOOPS, final_bits, play
QUICK = dataclasses.replace(CONFIG, num_episodes=40)
for loop in LOOPS:
    play(loop, f"{sys.argv[1]}/{loop}", QUICK)
    print(final_bits(f"{sys.argv[1]}/{loop}"))
"""


@pytest.mark.slow
def test_fresh_processes_with_other_threads_and_hash_seeds_give_the_same_bits(tmp_path):
    for loop in LOOPS:
        play(loop, tmp_path / loop, QUICK)
    here = [final_bits(tmp_path / loop) for loop in LOOPS]
    for threads, hash_seed in [(1, 0), (2, 1)]:
        numbers = {f"TF_NUM_{kind}OP_THREADS": str(threads) for kind in ("INTRA", "INTER")}
        environment = {**os.environ, **numbers, "PYTHONHASHSEED": str(hash_seed)}
        folder = tmp_path / f"{threads} {hash_seed}"
        command = [sys.executable, "-c", BITS, folder]
        printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
        assert printed.split() == here


# The network alone


def test_a_saved_network_plays_the_same_and_is_only_a_network(tmp_path, cartpole):
    run = train(cartpole, QUICK, SEED, verbose=0)
    path = tmp_path / "new folder" / "agent.keras"
    run.save(path)
    run.save(path)
    assert [p.name for p in path.parent.iterdir()] == ["agent.keras"]
    for network in (load_q_network(path), keras.saving.load_model(path)):
        for ours, theirs in zip(network.get_weights(), run.q_network.get_weights(), strict=True):
            np.testing.assert_array_equal(ours, theirs)
        assert getattr(network, "optimizer", None) is None
    returns = [evaluate(cartpole, n, num_episodes=3, seed=0) for n in (load_q_network(path), run.q_network)]
    np.testing.assert_array_equal(*returns)
    with pytest.raises(ValueError, match=r"^path must end in \.keras, got 'agent\.h5'"):
        run.save("agent.h5")


def test_a_network_that_cannot_be_trusted_is_not_loaded(tmp_path):
    path = tmp_path / "agent.keras"
    with pytest.raises(FileNotFoundError, match=r"agent\.keras"):
        load_q_network(path)
    network, _ = make_networks(4, 2, seed=0)
    save_q_network(path, network)
    good, silent = path.read_bytes(), 0
    rng = np.random.default_rng(0)
    for _ in range(100):
        damaged = bytearray(good)
        damaged[rng.integers(len(good))] ^= 1 << rng.integers(8)
        path.write_bytes(damaged)
        with contextlib.suppress(ValueError):  # the flipped bit may be outside the network, for example in a date
            loaded = load_q_network(path).get_weights()
            silent += any((a != b).any() for a, b in zip(loaded, network.get_weights(), strict=True))
    assert silent == 0
    network.set_weights([np.full_like(w, np.nan) for w in network.get_weights()])
    save_q_network(path, network)
    with pytest.raises(ValueError, match=r"agent\.keras is not a network that can be loaded: .*not finite"):
        load_q_network(path)
    unsafe = keras.Sequential([keras.Input((4,)), keras.layers.Lambda(lambda x: x)])
    unsafe.save(path)
    with pytest.raises(ValueError, match=r"agent\.keras is not a network that can be loaded"):
        load_q_network(path)


def test_nothing_is_restored_from_a_checkpoint_that_is_not_there(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        agent = make_agent((4,), 2, CONFIG, SEED)
        checkpoints = Checkpoints(tmp_path / "none", identity(CartPole(), CONFIG, agent))
        assert checkpoints.restore(agent, SEED) is None
