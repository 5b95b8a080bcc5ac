import dataclasses
import errno
import hashlib
import importlib
import os
import signal
import subprocess
import sys
import threading

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats

from dqn_keras import Config, Study, compare, episode_seed, load_study, plot_study, study, summarize, train, workers
from dqn_keras.environments import CartPole
from dqn_keras.metrics import Outcome
from tests.helpers.environments import Corridor
from tests.helpers.faults import failing
from tests.helpers.processes import killed_after

QUICK = Config(num_episodes=30, batch_size=16, solved_reward=1000)


def digests(outcome):
    return dict(zip(outcome.seeds.tolist(), (o.digest for o in outcome.outcomes), strict=True))


def same(first, second):
    assert first.seeds.tolist() == second.seeds.tolist()
    assert digests(first) == digests(second)
    np.testing.assert_array_equal(first.rewards, second.rewards)
    np.testing.assert_array_equal(first.solved_at, second.solved_at)


@pytest.mark.slow
@pytest.mark.parametrize("env", [CartPole(), gym.make("CartPole-v1")], ids=["functional", "Gymnasium"])
def test_a_seed_is_the_run_of_train_in_any_process_and_with_any_other_seeds(env):
    outcomes = study(env, QUICK, [5, 3, 4, 0], num_workers=2, verbose=0)
    assert outcomes.seeds.tolist() == [5, 3, 4, 0]
    assert len(set(digests(outcomes).values())) == 4
    alone = study(env, QUICK, [4], num_workers=1, verbose=0)
    assert digests(alone)[4] == digests(outcomes)[4]
    run = train(env, QUICK, 3, verbose=0)
    weights = b"".join(w.tobytes() for w in [*run.q_network.get_weights(), *run.q_hat_network.get_weights()])
    assert digests(outcomes)[3] == hashlib.sha256(weights).digest()
    np.testing.assert_array_equal(outcomes.rewards[1], run.rewards)
    assert outcomes.outcomes[1].steps.tolist() == [episode.steps for episode in run.episodes]
    assert outcomes.num_env_steps == outcomes.rewards.sum()  # CartPole's reward is 1 a step


@pytest.mark.slow
def test_an_environment_that_is_not_registered_is_sent_to_the_workers_as_it_is():
    config = Config(num_episodes=60, batch_size=8, solved_reward=3.5)
    outcomes = study(Corridor(length=100, limit=4), config, range(3), num_workers=2, verbose=0)
    assert outcomes.solved_at.tolist() == [49, 49, 49]
    assert outcomes.rewards.shape == (3, 50)


@pytest.mark.slow
def test_workers_see_what_was_changed_in_a_module_since_its_import(tmp_path, monkeypatch):
    (tmp_path / "payment.py").write_text("AMOUNT = 1.0\n")
    (tmp_path / "paying.py").write_text(
        "import payment\nfrom tests.helpers.environments import Corridor\n"
        "class Paying(Corridor):\n"
        "    def step(self, action):\n"
        "        state, _, *others = super().step(action)\n"
        "        return state, payment.AMOUNT, *others\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    paying = importlib.import_module("paying")
    monkeypatch.setattr(paying.payment, "AMOUNT", 7.0)
    config = Config(num_episodes=3, batch_size=4)
    outcomes = study(paying.Paying(length=100, limit=4), config, range(2), num_workers=2, verbose=0)
    assert (outcomes.rewards == 28.0).all()
    for name in ("paying", "payment"):
        sys.modules.pop(name)


@pytest.mark.slow
def test_a_change_that_workers_cannot_see_is_refused(monkeypatch):
    monkeypatch.setattr(importlib.import_module("dqn_keras.environments.cartpole"), "GRAVITY", 30.0)
    with pytest.raises(ValueError, match=r"^num_workers must be 1 for env CartPole, which computes something else"):
        study(CartPole(), QUICK, range(2), num_workers=2, verbose=0)
    run = train(CartPole(), QUICK, 0, verbose=0)
    np.testing.assert_array_equal(study(CartPole(), QUICK, [0], num_workers=1, verbose=0).rewards[0], run.rewards)


@pytest.fixture
def trained(monkeypatch):
    """Returns a list that records the seeds trained in this process."""
    seeds, train_seed = [], workers._train_seed

    def note_and_train(setting, seed):
        seeds.append(seed)
        return train_seed(setting, seed)

    monkeypatch.setattr(workers, "_train_seed", note_and_train)
    return seeds


def test_a_repeated_study_trains_only_the_missing_seeds(tmp_path, trained):
    file = tmp_path / "studies" / "quick.npz"
    first = study(CartPole(), QUICK, range(3), file=file, num_workers=1, verbose=0)
    again = study(CartPole(), QUICK, range(3), file=file, num_workers=1, verbose=0)
    assert trained == [0, 1, 2]
    same(first, again)
    more = study(CartPole(), QUICK, [4, 1], file=file, num_workers=1, verbose=0)
    assert trained == [0, 1, 2, 4]
    assert more.seeds.tolist() == [4, 1]
    assert load_study(file).seeds.tolist() == [0, 1, 2, 4]
    assert load_study(file).config == QUICK
    assert digests(load_study(file)) == {**digests(first), **digests(more)}
    for config, name in [(dataclasses.replace(QUICK, gamma=0.9), "gamma"), (Config(), "batch_size")]:
        with pytest.raises(ValueError, match=rf"^{name} is .* in .*quick\.npz, got"):
            study(CartPole(), config, range(3), file=file, verbose=0)
    with pytest.raises(ValueError, match=r"^env is .*functional.*got .*CartPole-v1"):
        study(gym.make("CartPole-v1"), QUICK, range(3), file=file, verbose=0)
    file.write_bytes(file.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"quick\.npz is not a study that can be loaded: its SHA-256"):
        load_study(file)


def test_a_second_study_is_refused_while_one_writes_the_file(tmp_path, trained):
    refused = []

    def try_to_join(outcomes):
        for task, outcome in outcomes:
            with pytest.raises(ValueError, match=r"^file .*study\.npz is in use: another process or thread"):
                study(CartPole(), QUICK, [7], file=tmp_path / "study.npz", num_workers=1, verbose=0)
            refused.append(outcome.seed)
            yield task, outcome

    by_joblib = workers.ENGINES["joblib"]
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(workers.ENGINES, "joblib", lambda *arguments: try_to_join(by_joblib(*arguments)))
        study(CartPole(), QUICK, range(2), file=tmp_path / "study.npz", num_workers=1, verbose=0)
    assert refused == trained == [0, 1]
    assert len(study(CartPole(), QUICK, [7], file=tmp_path / "study.npz", num_workers=1, verbose=0).outcomes) == 1


def test_a_file_that_cannot_be_written_is_an_error_before_any_work(tmp_path, trained):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"^file .*study\.npz cannot be written: "):
        study(CartPole(), QUICK, range(2), file=tmp_path / "file" / "study.npz", num_workers=1, verbose=0)
    assert trained == []


def test_a_file_that_cannot_be_written_at_the_end_loses_nothing_but_the_file(tmp_path, trained):
    full = OSError(errno.ENOSPC, "No space left on device")
    with (
        failing(os, "fsync", full, after=2),  # a save flushes a file and a folder
        pytest.warns(UserWarning, match=r"^file .*study\.npz could not be written \(.*No space left.*keeps 0 seeds"),
    ):
        kept = study(CartPole(), QUICK, range(2), file=tmp_path / "study.npz", num_workers=1, verbose=0)
    same(kept, study(CartPole(), QUICK, range(2), file=tmp_path / "study.npz", num_workers=1, verbose=0))
    assert trained == [0, 1, 0, 1]


def test_an_interrupted_run_in_this_process_ends_the_study_with_what_is_finished(tmp_path, monkeypatch, trained):
    file, train, long = tmp_path / "study.npz", workers.train, dataclasses.replace(QUICK, num_episodes=10**6)

    def interrupted_in_the_third(env, config, seed, **others):
        if seed == 2 and len(trained) == 3:
            threading.Timer(0.05, signal.raise_signal, [signal.SIGINT]).start()
            config = long
        return train(env, config, seed, **others)

    monkeypatch.setattr(workers, "train", interrupted_in_the_third)
    with pytest.warns(UserWarning, match=r"^3 of 5 seeds are not in this study: it was interrupted"):
        kept = study(CartPole(), QUICK, range(5), file=file, num_workers=1, verbose=0)
    assert kept.seeds.tolist() == load_study(file).seeds.tolist() == [0, 1]
    whole = study(CartPole(), QUICK, range(5), file=file, num_workers=1, verbose=0)
    same(whole, study(CartPole(), QUICK, range(5), num_workers=1, verbose=0))


STUDY = """
import contextlib, sys
import gymnasium as gym
from dqn_keras import Config, study, workers
from dqn_keras.storage import studies
studies.SECONDS_BETWEEN_SAVES = 0
ignored, save = workers._interrupts_ignored_by_children, studies._save

@contextlib.contextmanager
def ignored_and_said():
    with ignored():
        yield
    print("workers started", flush=True)

def save_and_say(path, outcomes, facts):
    save(path, outcomes, facts)
    print("saved", len(outcomes), flush=True)

workers._interrupts_ignored_by_children, studies._save = ignored_and_said, save_and_say
config = Config(num_episodes=100, solved_reward=1000)
outcome = study(gym.make("CartPole-v1"), config, range(10_000), file=sys.argv[1], num_workers=2, verbose=0)
print("kept", len(outcome.seeds), flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("moment", "least", "send"),
    [
        ("saved 2", 2, lambda pid: os.killpg(pid, signal.SIGINT)),  # to all processes, as a terminal does
        ("workers started", 0, lambda pid: os.kill(pid, signal.SIGTERM)),
    ],
    ids=["Ctrl-C", "SIGTERM at the start"],
)
def test_ctrl_c_or_sigterm_keeps_the_finished_seeds(moment, least, send, tmp_path):
    file = tmp_path / "study.npz"
    command = [sys.executable, "-W", "ignore", "-c", STUDY, file]
    child = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True)
    with killed_after(600, child):
        assert any(line.startswith(moment) for line in child.stdout)
        send(child.pid)
        out, err = child.communicate()
    assert child.returncode == 0, err
    assert "Traceback" not in err
    *_, last = out.splitlines()
    assert last == f"kept {len(load_study(file).seeds)}"
    assert least <= len(load_study(file).seeds) < 10_000


@pytest.mark.slow
def test_an_environment_is_copied_as_it_is():
    env = gym.make("CartPole-v1")
    env.unwrapped.gravity = 500.0
    outcomes = study(env, QUICK, [0, 1], num_workers=2, verbose=0)
    np.testing.assert_array_equal(outcomes.rewards[0], train(env, QUICK, 0, verbose=0).rewards)


@pytest.mark.slow
def test_an_environment_that_has_rendered_is_made_again_from_its_spec():
    env = gym.make("CartPole-v1", render_mode="rgb_array")
    env.reset(seed=0)
    env.render()
    outcomes = study(env, QUICK, [0, 1], num_workers=2, verbose=0)
    np.testing.assert_array_equal(outcomes.rewards[1], train(gym.make("CartPole-v1"), QUICK, 1, verbose=0).rewards)


def test_an_error_in_a_worker_is_the_studys_and_the_finished_seeds_are_kept(tmp_path):
    class Broken(Corridor):
        def reset(self, *, seed=None, options=None):
            if seed == episode_seed(2, 0):
                raise RuntimeError("the simulator died")
            return super().reset(seed=seed)

    file, config = tmp_path / "study.npz", Config(num_episodes=9, batch_size=8)
    with pytest.raises(RuntimeError, match="the simulator died"):
        study(Broken(), config, range(4), file=file, num_workers=1, verbose=0)
    assert load_study(file).seeds.tolist() == [0, 1]


def test_the_bar_is_shown_unless_verbose_is_0(capfd):
    study(CartPole(), QUICK, [0], num_workers=1)
    assert "1/1" in capfd.readouterr().err
    study(CartPole(), QUICK, [0], num_workers=1, verbose=0)
    assert "1/1" not in capfd.readouterr().err


def test_bad_arguments_are_named():
    for bad, message in [
        ({"seeds": [0, 0]}, r"^seeds must name each seed once"),
        ({"seeds": [-1]}, r"^seeds must be a whole number"),
        ({"engine": "dask"}, r"^engine must be one of joblib, ray, got 'dask'"),
        ({"num_workers": 0}, r"^num_workers must be"),
    ]:
        with pytest.raises(ValueError, match=message):
            study(CartPole(), QUICK, **bad)
    with pytest.raises(TypeError, match=r"^env must be a gymnasium\.Env or a FuncEnv, got 'CartPole-v1'"):
        study("CartPole-v1")
    with pytest.raises(TypeError, match=r"^config must be a Config"):
        study(CartPole(), {})
    with pytest.raises(ValueError, match=r"^study must have at least one seed"):
        summarize(Study(QUICK, []))
    with pytest.raises(ValueError, match=r"^study must have seeds with at least solved_window episodes"):
        plot_study(Study(QUICK, []))


def test_without_ray_the_error_names_the_extra(monkeypatch):
    monkeypatch.setitem(importlib.sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r'pip install "dqn_keras\[ray\]"'):
        study(CartPole(), QUICK, [0], engine="ray", verbose=0)


# A cluster


# Statistics


def made_up(*solved_at):
    """Returns a study with these episodes to solved."""
    outcomes = [
        Outcome(k, np.full(k + 60, 10.0 * k), np.full(k + 60, 10), at, np.nan, 1.0, bytes(32))
        for k, at in enumerate(solved_at)
    ]
    return Study(Config(), outcomes)


def test_a_summary_worked_out_by_hand():
    outcomes = made_up(300, 280, None, 260, 320, 310, 290, 1000)
    np.testing.assert_array_equal(outcomes.episodes_to_solved, [300, 280, 2000, 260, 320, 310, 290, 1000])
    assert np.isnan(outcomes.solved_at[2])
    summary = summarize(outcomes)
    assert summary.share_solved.value == 7 / 8
    assert 0.5 < summary.share_solved.low < 7 / 8 < summary.share_solved.high < 1
    assert summary.median.value == 305
    assert summary.interquartile_mean.value == (290 + 300 + 310 + 320) / 4
    assert summary.share_late.value == 2 / 8
    assert summarize(outcomes, late_after=300).share_late.value == 4 / 8
    for estimate in summary[1:4]:
        assert estimate.low < estimate.value < estimate.high
    assert np.isnan(summary.greedy_return.value)
    assert str(summary.median).startswith("305.0 (")
    assert repr(outcomes) == "<Study: 8 seeds, 7 solved>"
    assert np.isnan(outcomes.rewards[0, 60:]).all()
    assert outcomes.rewards.shape == (8, 67)


def test_a_comparison_worked_out_by_hand():
    first, second = made_up(300, 310, 320, 330), made_up(290, 300, 305, 315)
    comparison = compare(first, second)
    assert comparison.difference.value == 302.5 - 315
    # of the 16 pairs the second is earlier in 4 + 3.5 + 3 + 2
    assert comparison.probability_of_improvement.value == 12.5 / 16
    assert compare(first, first).probability_of_improvement.value == 0.5
    assert comparison.difference.low <= comparison.difference.value <= comparison.difference.high


def test_intervals_hold_the_truth_as_often_as_they_say():
    rng = np.random.default_rng(0)
    truth = stats.lognorm(0.5, scale=300)
    held = 0
    for _ in range(60):
        low, high = summarize(made_up(*truth.rvs(40, random_state=rng).astype(int).tolist())).median[1:]
        held += low <= truth.median() <= high
    assert held >= 50  # of 60; a share of 0.95 gives fewer than once in a thousand


def test_the_picture_of_a_study_says_what_it_shows():
    axes = plot_study(made_up(300, 280, None, 260, 320, 310, 290, 1000))
    assert [ax.get_xlabel() for ax in axes] == ["Episode", "Episodes to solved", "Episodes"]
    assert axes[1].get_title() == "0 later (in the last bar), 1 not within 2,000"
    assert axes[2].get_title() == "87.5% solved in the end"
    legends = [text.get_text() for ax in axes[:2] for text in ax.get_legend().get_texts()]
    assert {"each seed", "median", "middle half of the seeds", "the one published run (293)"} <= set(legends)
    plot_study(made_up(None, None), published=None)  # also if nothing is solved
