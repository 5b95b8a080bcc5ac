"""Studies with the user's own parts, and sweeps of many settings."""

import contextlib
import dataclasses
import os
import sys
import threading
import time
import warnings

import gymnasium as gym
import keras
import matplotlib.pyplot as plt
import numpy as np
import psutil
import pytest

from dqn_keras import (
    Config,
    double_td_targets,
    evaluate,
    load_study,
    load_sweep,
    make_q_network,
    plot_study,
    plot_sweep,
    study,
    summarize,
    sweep,
    sweep_table,
    train,
    workers,
)
from dqn_keras._engine import programs
from dqn_keras.environments import CartPole, MountainCar
from tests.helpers.environments import Corridor

QUICK = Config(num_episodes=6, batch_size=8, max_steps=20, solved_window=2, solved_reward=1000)


def network(seed):
    return make_q_network(4, 2, (8, 8), seed=seed)


def sgd():
    return keras.optimizers.SGD(0.01)


OWN = {"q_network": network, "optimizer": sgd, "targets": double_td_targets, "loss": "huber"}
SETTINGS = {"plain": QUICK, "short": dataclasses.replace(QUICK, max_steps=10), "own": {"config": QUICK, **OWN}}


ENVIRONMENTS = {"functional": CartPole, "Gymnasium": lambda: gym.make("CartPole-v1")}


def weights(run):
    return b"".join(w.tobytes() for w in [*run.q_network.get_weights(), *run.q_hat_network.get_weights()])


def rewards(studies):
    return {name: x.rewards.tolist() for name, x in studies.items()}


def digests(studies):
    return {name: [outcome.digest for outcome in x.outcomes] for name, x in studies.items()}


def test_the_first_seed_of_each_setting_comes_first_so_that_workers_share_what_they_compile(monkeypatch):
    tasks = []

    def interrupted_at_once(settings, missing, engine, num_workers):
        tasks.extend((task.name, task.seed) for task in missing)
        yield None

    monkeypatch.setattr(sys.modules["dqn_keras.study"], "results", interrupted_at_once)
    with pytest.warns(UserWarning, match="4 of 4 seeds are not in this sweep"):
        sweep(CartPole(), {"plain": QUICK, "short": QUICK}, seeds=[5, 3], verbose=0)
    assert tasks == [("plain", 5), ("short", 5), ("plain", 3), ("short", 3)]


@pytest.mark.parametrize("env", [CartPole(), gym.make("CartPole-v1")], ids=["functional", "Gymnasium"])
def test_a_seed_with_own_parts_is_the_run_of_train_with_them(env):
    import hashlib

    found = study(env, QUICK, [3, 5], **OWN, num_workers=1, verbose=0)
    for seed, outcome in zip([3, 5], found.outcomes, strict=True):
        own = {**OWN, "q_network": network(seed), "optimizer": sgd()}
        run = train(env, QUICK, seed, **own, verbose=0)
        assert outcome.digest == hashlib.sha256(weights(run)).digest()
        np.testing.assert_array_equal(outcome.rewards, run.rewards)


def clipped(norm=1.0):
    return keras.optimizers.Adam(0.001, global_clipnorm=norm)


def backwards():
    optimizer = clipped()
    step = optimizer.update_step
    optimizer.update_step = lambda gradient, *others: step(-gradient, *others)
    return optimizer


def scheduled(first_rate):
    schedule = keras.optimizers.schedules.PiecewiseConstantDecay([2, 4], [first_rate, 0.1, 0.01])
    return keras.optimizers.SGD(schedule)


@pytest.mark.parametrize(
    ("env", "makers", "num_traces"),
    [
        pytest.param("Gymnasium", [clipped] * 3, 1, id="equal"),
        pytest.param("Gymnasium", [clipped, lambda: clipped(0.1), clipped], 2, id="a setting differs"),
        pytest.param(
            "Gymnasium",
            [lambda: scheduled(0.5), lambda: scheduled(0.2), lambda: scheduled(0.5)],
            2,
            id="a schedule differs",
        ),
        pytest.param("Gymnasium", [clipped, backwards, backwards], 3, id="a method of the user's"),
        pytest.param("functional", [clipped, clipped, backwards], 2, id="functional", marks=pytest.mark.slow),
    ],
)
def test_seeds_share_a_trace_if_their_optimizers_are_keras_with_equal_settings(env, makers, num_traces, monkeypatch):
    env = ENVIRONMENTS[env]()

    def run_all():
        return [weights(train(env, QUICK, seed, optimizer=make(), verbose=0)) for seed, make in enumerate(makers)]

    alone = run_all()
    traced = []
    monkeypatch.setattr(programs, "_trace", lambda *args, _trace=programs._trace: traced.append(args) or _trace(*args))
    with programs.shared_in({}):  # as a study does
        assert run_all() == alone
    assert len(traced) == num_traces


@pytest.mark.slow
def test_a_sweep_equals_its_studies_in_any_process():
    found = sweep(CartPole(), SETTINGS, range(3), num_workers=2, verbose=0)
    assert list(found) == list(SETTINGS)
    assert digests(found) == digests(sweep(CartPole(), SETTINGS, range(3), num_workers=1, verbose=0))
    alone = study(CartPole(), QUICK, range(3), num_workers=1, verbose=0, **OWN)
    assert [x.digest for x in alone.outcomes] == digests(found)["own"]
    assert len({digest for row in digests(found).values() for digest in row}) == 9


def kill_a_busy_worker(killed):
    """Kills the first process that trains a seed."""
    deadline = time.monotonic() + 600
    while not killed and time.monotonic() < deadline:
        for process in psutil.Process().children(recursive=True):
            with contextlib.suppress(psutil.Error):  # it has ended
                if "ray::_train_seed" in " ".join(process.cmdline()):
                    process.kill()
                    killed.append(process.pid)
                    return
        time.sleep(0.05)


@pytest.mark.slow
def test_a_cluster_of_two_nodes_loses_a_worker_and_the_numbers_are_the_same(monkeypatch):
    import ray
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", os.getcwd(), prepend=os.pathsep)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False)
        assert len(ray.nodes()) == 2
        killed = []
        killer = threading.Thread(target=kill_a_busy_worker, args=(killed,))
        killer.start()
        by_ray = sweep(CartPole(), SETTINGS, range(2), engine="ray", verbose=0)
        killer.join()
        assert len(killed) == 1
    finally:
        ray.shutdown()
        cluster.shutdown()
    assert digests(by_ray) == digests(sweep(CartPole(), SETTINGS, range(2), num_workers=1, verbose=0))


@pytest.mark.slow
def test_ray_is_started_if_it_does_not_run_and_stopped_again():
    import ray

    by_ray = study(gym.make("CartPole-v1"), QUICK, [0], engine="ray", verbose=0)
    assert not ray.is_initialized()
    here = study(gym.make("CartPole-v1"), QUICK, [0], num_workers=1, verbose=0)
    assert by_ray.outcomes[0].digest == here.outcomes[0].digest


@pytest.mark.slow
def test_a_sweep_continues_in_its_file_with_more_seeds_and_more_settings(tmp_path, monkeypatch):
    done, train_seed = [], workers._train_seed
    monkeypatch.setattr(workers, "_train_seed", lambda setting, seed: done.append(seed) or train_seed(setting, seed))
    file, few = tmp_path / "sweep.npz", {name: SETTINGS[name] for name in ("plain", "short")}
    how = {"file": file, "num_workers": 1, "verbose": 0}
    sweep(CartPole(), few, [0], **how)
    assert done == [0, 0]
    found = sweep(CartPole(), SETTINGS, [1, 0], **how)
    assert done == [0, 0, 1, 1, 1, 0]
    assert digests(found) == digests(sweep(CartPole(), SETTINGS, [1, 0], num_workers=1, verbose=0))
    loaded = load_sweep(file)
    assert {name: x.config for name, x in loaded.items()} == {name: x.config for name, x in found.items()}
    assert [outcome.seed for outcome in loaded["own"].outcomes] == [0, 1]
    # a setting that is not part of the call stays in the file
    assert list(sweep(CartPole(), few, [0], **how)) == ["plain", "short"]
    assert list(load_sweep(file)) == list(SETTINGS)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (dataclasses.replace(QUICK, gamma=0.5), r"gamma is 0.95 in .*sweep\.npz, setting 'own', got 0.5"),
        ({"config": QUICK, **OWN, "loss": "mse"}, r"loss is 'huber' in .*setting 'own', got 'mse'"),
        (
            {"config": QUICK, **OWN, "optimizer": lambda: keras.optimizers.SGD(0.02)},
            r"optimizer is .*0\.01.*got .*0\.02",
        ),
        ({"config": QUICK, **OWN, "q_network": lambda seed: make_q_network(4, 2, (9,), seed=seed)}, "q_network is "),
        ({"config": QUICK, **OWN, "evaluate_on": CartPole()}, "evaluate_on is 'nothing' in "),
        ({"config": QUICK, **OWN, "env": gym.make("CartPole-v1")}, "env is "),
    ],
    ids=["number", "loss", "optimizer", "network", "evaluation", "environment"],
)
def test_a_changed_setting_is_an_error_that_names_it(tmp_path, changed, message):
    how = {"file": tmp_path / "sweep.npz", "num_workers": 1, "verbose": 0}
    sweep(CartPole(), {"own": SETTINGS["own"]}, [0], **how)
    with pytest.raises(ValueError, match=message):
        sweep(CartPole(), {"own": changed}, [0], **how)


def test_files_of_studies_and_sweeps_are_not_mixed_up(tmp_path):
    how = {"num_workers": 1, "verbose": 0}
    study(CartPole(), QUICK, [0], file=tmp_path / "study.npz", **how)
    sweep(CartPole(), {"a": QUICK}, [0], file=tmp_path / "sweep.npz", **how)
    with pytest.raises(ValueError, match=r"^path .*sweep\.npz holds a sweep of 1 setting.*load_sweep"):
        load_study(tmp_path / "sweep.npz")
    with pytest.raises(ValueError, match=r"^file .*sweep\.npz holds a sweep"):
        study(CartPole(), QUICK, [0], file=tmp_path / "sweep.npz", **how)
    with pytest.raises(ValueError, match=r"^file .*study\.npz holds a study"):
        sweep(CartPole(), {"a": QUICK}, [0], file=tmp_path / "study.npz", **how)


ONE_NETWORK, ONE_OPTIMIZER = network(0), sgd()


@pytest.mark.parametrize(
    ("own", "error", "message"),
    [
        (
            {"q_network": ONE_NETWORK},
            TypeError,
            r"q_network must be a function of \(seed\) that returns a new keras.Model",
        ),
        ({"q_network": lambda seed: ONE_NETWORK}, ValueError, "q_network must be .*returns the same object again"),
        ({"q_network": lambda seed: "network"}, TypeError, r"q_network must be a function of \(seed\) that returns"),
        ({"q_network": lambda: network(0)}, TypeError, r"q_network must be a function of \(seed\), got"),
        ({"q_network": lambda seed: make_q_network(3, 2, (8,))}, ValueError, "q_network must "),
        ({"optimizer": ONE_OPTIMIZER}, TypeError, r"optimizer must be a function of \(\) that returns"),
        ({"optimizer": lambda: ONE_OPTIMIZER}, ValueError, "optimizer must be .*returns the same object again"),
        ({"optimizer": "adam"}, TypeError, r"optimizer must be a function of \(\)"),
        ({"loss": "hubr"}, ValueError, "loss must be a name that Keras knows"),
        ({"targets": 3}, TypeError, "targets must be a function"),
        ({"evaluate_on": "CartPole-v1"}, TypeError, "evaluate_on must be a gymnasium.Env"),
        ({"evaluate_on": MountainCar()}, ValueError, "evaluate_on must be an environment like env CartPole"),
    ],
)
def test_wrong_parts_are_an_error_that_names_them_before_any_work(own, error, message):
    with pytest.raises(error, match=f"^{message}"):
        study(CartPole(), QUICK, [0], **own, verbose=0)
    with pytest.raises(error, match=rf"^settings\['x'\]: {message}"):
        sweep(CartPole(), {"plain": QUICK, "x": own}, [0], verbose=0)


def test_a_wrong_shared_argument_is_an_error_that_names_it():
    with pytest.raises(TypeError, match=r"^env must be"):
        sweep("CartPole-v1", {"plain": QUICK}, [0], verbose=0)
    with pytest.raises(ValueError, match=r"^evaluate_on must be an environment like env CartPole"):
        sweep(CartPole(), {"plain": QUICK}, [0], evaluate_on=MountainCar(), verbose=0)
    with pytest.raises(ValueError, match=r"^verbose must be"):
        sweep(CartPole(), {"plain": QUICK}, [0], verbose=3)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ([QUICK], TypeError, "settings must be a dict"),
        ({}, ValueError, "settings must hold at least one"),
        ({"": QUICK}, TypeError, "settings must have names"),
        ({3: QUICK}, TypeError, "settings must have names"),
        ({"x": 3}, TypeError, r"settings\['x'\] must be a Config or a dict"),
        ({"x": {"callbacks": []}}, TypeError, r"settings\['x'\] must hold only env, .* got 'callbacks'"),
        ({"x": {"config": {}}}, TypeError, r"settings\['x'\]: config must be a Config"),
    ],
)
def test_what_is_not_settings_is_refused(settings, error, message):
    with pytest.raises(error, match=f"^{message}"):
        sweep(CartPole(), settings, [0], verbose=0)


@pytest.mark.parametrize("place", [CartPole(), gym.make("CartPole-v1")], ids=["functional", "Gymnasium"])
def test_greedy_returns_equal_evaluate_and_are_saved(tmp_path, place):
    file = tmp_path / "study.npz"
    found = study(CartPole(), QUICK, [4, 2], evaluate_on=place, file=file, num_workers=1, verbose=0)
    run = train(CartPole(), QUICK, 4, verbose=0)
    assert found.greedy_returns[0] == evaluate(place, run.q_network, seed=4, max_steps=QUICK.max_steps).mean()
    np.testing.assert_array_equal(load_study(file).greedy_returns, found.greedy_returns[::-1])
    assert np.isnan(study(CartPole(), QUICK, [4], num_workers=1, verbose=0).greedy_returns).all()


def test_columns_for_pandas_worked_out_by_hand():
    config = Config(num_episodes=3, batch_size=2, solved_window=2, solved_reward=3.5)
    found = study(Corridor(length=100, limit=4), config, [7, 1], num_workers=1, verbose=0)
    columns = found.to_dict()
    assert {name: x.tolist() for name, x in columns.items() if name not in ("seconds", "greedy_return")} == {
        "seed": [7, 1],
        "solved_at": [1.0, 1.0],
        "num_episodes": [2, 2],
        "num_env_steps": [8, 8],
    }
    assert {name: x.tolist() for name, x in found.to_dict(each="episode").items()} == {
        "seed": [7, 7, 1, 1],
        "episode": [0, 1, 0, 1],
        "env_steps": [4, 8, 4, 8],
        "reward": [4.0, 4.0, 4.0, 4.0],
    }
    np.testing.assert_array_equal(found.env_steps, [[4, 8], [4, 8]])
    np.testing.assert_array_equal(found.env_steps_to_solved, [8, 8])
    several = sweep(Corridor(length=100, limit=4), {"a": config, "b": config}, [7], num_workers=1, verbose=0)
    assert several.to_dict("episode")["setting"].tolist() == ["a", "a", "b", "b"]
    with pytest.raises(ValueError, match=r"^each must be one of seed, episode"):
        found.to_dict("run")


def test_a_budget_of_steps_in_a_study(tmp_path):
    config = Config(num_steps=300, batch_size=8, solved_window=5, solved_reward=None)
    file = tmp_path / "study.npz"
    found = study(CartPole(), config, range(3), file=file, num_workers=1, verbose=0)
    assert np.nanmax(found.env_steps, axis=1).tolist() == [300] * 3
    assert found.env_steps_to_solved.tolist() == [300] * 3
    np.testing.assert_array_equal(load_study(file).rewards, found.rewards)
    titles = [ax.get_title() for ax in plot_study(found)]
    assert titles[1:] == ["At the end of the runs"] * 2
    plt.close("all")


@pytest.fixture(scope="module")
def swept():
    config = Config(num_episodes=12, batch_size=8, solved_window=3, solved_reward=25)
    settings = {"a": config, "b": dataclasses.replace(config, solved_reward=1e6)}
    return sweep(CartPole(), settings, range(6), evaluate_on=CartPole(), num_workers=1, verbose=0)


def test_the_table_has_a_row_of_summaries_for_each_setting(swept):
    rows = sweep_table(swept, late_after=5).splitlines()
    assert [row.split(" | ")[0] for row in rows[2:]] == ["| a", "| b"]
    for name, row in zip(swept, rows[2:], strict=True):
        summary = summarize(swept[name], late_after=5)
        for estimate in (summary.median, summary.greedy_return):
            assert str(estimate) in row
        assert summary.share_late.as_percent() in row
    assert summary.share_late.value == 1
    assert summary.greedy_return.value == swept["b"].greedy_returns.mean()


def test_the_picture_of_a_sweep_shows_each_setting_with_its_interval(swept):
    axes = plot_sweep(swept, late_after=5)
    assert [label.get_text() for label in axes[0].get_yticklabels()] == ["a", "b"]
    for ax, name in zip(axes, ("share_late", "median", "greedy_return"), strict=True):
        scale = 100 if name == "share_late" else 1
        expected = [scale * getattr(summarize(x, 5), name).value for x in swept.values()]
        np.testing.assert_allclose(ax.lines[0].get_xdata(), expected)
    plt.close("all")


def test_a_study_over_env_steps(swept):
    curves, distribution, shares = plot_study(swept["a"], x="env_steps")
    assert curves.get_xlabel() == "Environment steps"
    assert distribution.get_xlabel() == shares.get_xlabel().replace("steps", "steps to solved")
    with warnings.catch_warnings(action="error", category=RuntimeWarning):
        curves.figure.canvas.draw()
    plt.close("all")
