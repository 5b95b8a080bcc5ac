import csv

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import Config, train
from tests.helpers.environments import Corridor
from tests.helpers.runs import QUICK, Tape, fingerprint


@pytest.mark.slow
def test_cartpole_is_solved_in_the_originals_way(cartpole, capsys):
    # One seed is enough to see every printed line; results/ has the share of many seeds that are solved.
    run = train(cartpole, Config(), seed=0)
    lines = capsys.readouterr().out.splitlines()
    assert run.solved_at is not None
    assert len(run.rewards) == run.solved_at + 1
    means = np.convolve(run.rewards, np.full(50, 1 / 50), mode="valid")
    assert means[-1] > 225
    assert (means[:-1] <= 225).all()
    averages = {k: round(run.rewards[max(0, k - 99) : k + 1].mean(), 2) for k in range(0, run.solved_at + 1, 100)}
    expected = [f"Episode {k}, Reward: {run.rewards[k]}, Last 100 Average: {x}" for k, x in averages.items()]
    assert lines == [*expected, f"Solved with {round(means[-1], 2)} reward in {run.solved_at} episodes!"]
    assert repr(run) == f"<Run: seed=0, {len(run.rewards)} episodes, solved_at={run.solved_at}>"


def test_fewer_episodes_than_the_window_never_count_as_solved():
    config = Config(num_episodes=60, batch_size=8, solved_reward=3.5, solved_window=50)
    run = train(Corridor(length=100, limit=4), config, seed=0, verbose=0)
    assert run.solved_at == 49


def test_the_stop_rule_needs_more_than_solved_reward_not_as_much():
    config = Config(num_episodes=60, batch_size=8, solved_reward=4.0, solved_window=50)
    assert train(Corridor(length=100, limit=4), config, seed=0, verbose=0).solved_at is None


def test_without_a_seed_a_new_one_is_drawn_that_can_be_used_again(cartpole):
    first, second = (train(cartpole, QUICK, verbose=0) for _ in range(2))
    assert first.seed != second.seed
    assert fingerprint(train(cartpole, QUICK, seed=first.seed, verbose=0)) == fingerprint(first)


def test_the_global_random_state_is_neither_read_nor_set(cartpole):
    prints = []
    for seed in (1, 2):
        keras.utils.set_random_seed(seed)
        before = np.random.get_state()[1].copy()  # noqa: NPY002
        prints.append(fingerprint(train(cartpole, QUICK, seed=0, verbose=0)))
        np.testing.assert_array_equal(before, np.random.get_state()[1])  # noqa: NPY002
    assert prints[0] == prints[1]


def test_verbose_zero_prints_nothing(cartpole, capfd):
    train(cartpole, QUICK, seed=0, verbose=0)
    assert capfd.readouterr().out == ""


def test_an_episode_is_an_epoch_to_keras_callbacks(cartpole):
    tape = Tape(stop_after=1)
    run = train(cartpole, QUICK, seed=0, verbose=0, callbacks=[tape])
    assert tape.calls == ["train begins", *[(w, k) for k in (0, 1) for w in ("begins", "ends")], "train ends"]
    assert tape.logs["reward"] == run.rewards[-1]
    assert len(run.episodes) == 2


def test_callbacks_see_every_end_also_when_the_run_is_solved():
    tape = Tape()
    config = Config(num_episodes=60, batch_size=8, solved_reward=3.5)
    train(Corridor(length=100, limit=4), config, seed=0, verbose=0, callbacks=[tape])
    assert tape.calls[-2:] == [("ends", 49), "train ends"]


def test_keras_own_callbacks_work(cartpole, tmp_path):
    log, model = tmp_path / "log.csv", tmp_path / "best.keras"
    schedule = keras.callbacks.LearningRateScheduler(lambda episode: 0.001 * 0.9**episode)
    run = train(
        cartpole,
        QUICK,
        seed=0,
        verbose=0,
        callbacks=[
            keras.callbacks.CSVLogger(log),
            keras.callbacks.ModelCheckpoint(model, monitor="reward", mode="max", save_best_only=True),
            schedule,
        ],
    )
    rows = list(csv.DictReader(log.open()))
    assert [float(row["reward"]) for row in rows] == run.rewards.tolist()
    assert keras.saving.load_model(model).optimizer is not None
    assert run.agent.optimizer.learning_rate.numpy() == pytest.approx(0.001 * 0.9**29)


def test_an_error_at_the_end_of_training_is_not_swallowed():
    class Full(keras.callbacks.Callback):
        def on_train_end(self, logs=None):
            raise OSError("disk full")

    config = Config(num_episodes=60, batch_size=8, solved_reward=3.5)
    with pytest.raises(OSError, match="disk full"):
        train(Corridor(length=100, limit=4), config, seed=0, verbose=0, callbacks=[Full()])


@pytest.mark.slow
def test_the_networks_have_the_hidden_layers_of_the_config():
    run = train(Corridor(length=2), Config(num_episodes=9, batch_size=8, hidden_units=(5, 3)), seed=0, verbose=0)
    assert [layer.units for layer in run.q_network.layers] == [5, 3, 2]


class Zeroed(keras.callbacks.Callback):
    """Makes the network prefer action 1 before each episode."""

    def on_epoch_begin(self, epoch, logs=None):
        self.model.set_weights([np.zeros_like(w) for w in self.model.get_weights()[:-1]] + [np.array([0.0, 1.0])])


def test_the_loop_acts_with_the_weights_that_a_callback_set():
    env = Corridor(length=3)
    config = Config(num_episodes=20, epsilon=0.0, epsilon_min=0.0, batch_size=64)
    with pytest.warns(UserWarning, match="without an update: the memory holds 60 transitions, batch_size is 64"):
        train(env, config, verbose=0, callbacks=[Zeroed()], seed=0)
    assert env.actions == [1] * 60


def test_bad_arguments_are_refused_before_any_work(cartpole):
    with pytest.raises(TypeError, match=r"^config must be a Config"):
        train(cartpole, {"gamma": 0.9})
    for seed in (-1, 1.5, "0", True, np.nan):
        with pytest.raises((TypeError, ValueError), match=r"^seed must be a whole number"):
            train(cartpole, seed=seed)
    with pytest.raises(ValueError, match=r"^verbose must be 0, 1 or 2, got 3"):
        train(cartpole, verbose=3)


def test_numpy_seeds_are_accepted(cartpole):
    assert train(cartpole, Config(num_episodes=4, batch_size=8), seed=np.int64(3), verbose=0).seed == 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Acrobot-v1", "MountainCar-v0"])
def test_other_environments_train(name):
    run = train(gym.make(name), Config(num_episodes=2), seed=0, verbose=0)
    assert run.agent.num_updates > 50
    assert np.isfinite(run.rewards).all()
