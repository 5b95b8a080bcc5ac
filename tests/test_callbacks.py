"""Keras' own callbacks in both loops: an episode is an epoch."""

import contextlib
import csv
import functools

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, evaluate, train
from dqn_keras.environments import CartPole
from tests.helpers.runs import SpoiledVelocity

CONFIG = Config(num_episodes=40, batch_size=16, memory_size=300, solved_reward=1e6)
NAMES = ["reward", "average_reward", "steps", "epsilon", "loss", "mean_q", "max_q", "q_bound", "td_error"]
NAMES += ["terminal_share", "steps_per_second"]


@pytest.fixture(params=["Gymnasium loop", "compiled episodes"])
def env(request):
    return CartPole() if request.param == "compiled episodes" else gym.make("CartPole-v1")


def play(env, *callbacks, config=CONFIG, **arguments):
    return train(env, config, seed=2, callbacks=callbacks, **{"verbose": 0, **arguments})


def weights(run):
    return np.concatenate([w.ravel() for w in run.q_network.get_weights()])


@pytest.mark.slow
def test_the_history_equals_keras_history(env):
    keras_history = keras.callbacks.History()
    run = play(env, keras_history)
    assert list(run.history) == NAMES
    assert keras_history.epoch == list(range(40))
    for name in NAMES:
        np.testing.assert_array_equal(run.history[name], keras_history.history[name])


@pytest.mark.slow
def test_csv_logger_writes_the_history_and_changes_nothing(env, tmp_path):
    run = play(env, keras.callbacks.CSVLogger(tmp_path / "log.csv"))
    rows = list(csv.DictReader((tmp_path / "log.csv").open()))
    assert [int(row["epoch"]) for row in rows] == list(range(40))
    assert rows[0].keys() == {"epoch", *NAMES}
    for name in NAMES:
        np.testing.assert_array_equal([float(row[name]) for row in rows], run.history[name])
    np.testing.assert_array_equal(weights(run), weights(play(env)))  # no callbacks
    np.testing.assert_array_equal(weights(run), weights(play(env, keras.callbacks.Callback())))  # one call an episode


def test_tensorboard_shows_every_scalar(env, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    run = play(env, keras.callbacks.TensorBoard(tmp_path))
    events = EventAccumulator(str(tmp_path / "train"), size_guidance={"tensors": 0})  # all of them
    events.Reload()
    for name in NAMES:
        scalars = events.Tensors(f"epoch_{name}")
        assert [event.step for event in scalars] == list(range(40))
        shown = [float(tf.make_ndarray(event.tensor_proto)) for event in scalars]
        np.testing.assert_allclose(shown, run.history[name], rtol=1e-6)


class Snapshots(keras.callbacks.Callback):
    def __init__(self):
        super().__init__()
        self.weights = []

    def on_epoch_end(self, epoch, logs=None):
        self.weights.append(self.model.get_weights())


def test_model_checkpoint_keeps_the_network_of_the_best_moving_average(env, tmp_path):
    snapshots, path = Snapshots(), tmp_path / "best.keras"
    saver = keras.callbacks.ModelCheckpoint(path, monitor="average_reward", mode="max", save_best_only=True)
    run = play(env, snapshots, saver)
    best = snapshots.weights[int(np.argmax(run.history["average_reward"]))]
    kept = keras.saving.load_model(path)
    for ours, theirs in zip(kept.get_weights(), best, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert evaluate(gym.make("CartPole-v1"), kept, 1, seed=0).shape == (1,)


def test_early_stopping_ends_the_run_where_it_should_and_restores_the_best_weights(env):
    rewards = play(env).rewards
    patience, best, waited = 5, -np.inf, 0
    for stop, reward in enumerate(rewards):  # noqa: B007
        best, waited = (reward, 0) if reward > best else (best, waited + 1)
        if waited == patience:
            break
    assert stop < 39
    snapshots = Snapshots()
    stopper = keras.callbacks.EarlyStopping("reward", mode="max", patience=patience, restore_best_weights=True)
    run = play(env, snapshots, stopper)
    np.testing.assert_array_equal(run.rewards, rewards[: stop + 1])
    best_weights = snapshots.weights[int(np.argmax(run.rewards))]
    for ours, theirs in zip(run.q_network.get_weights(), best_weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_terminate_on_nan_ends_a_run_that_diverges(env, tmp_path):
    terminate = keras.callbacks.TerminateOnNaN()
    run = play(env, SpoiledVelocity(), terminate, checkpoint=tmp_path / "run", checkpoint_every=5)
    assert (run.diverged, len(run.rewards)) == (True, 12)
    sound = play(env, checkpoint=tmp_path / "run", resume=True)  # from episode 10, a whole checkpoint
    np.testing.assert_array_equal(weights(sound), weights(play(env)))
    assert not sound.diverged
    with pytest.raises(ValueError, match="not finite in episode 12"):
        play(env, SpoiledVelocity())


@pytest.mark.slow
def test_terminate_on_nan_does_not_mind_the_episodes_before_the_first_update(env):
    run = play(env, keras.callbacks.TerminateOnNaN(), config=Config(num_episodes=30, batch_size=200))
    assert np.isnan(run.history["loss"][0])
    assert len(run.rewards) == 30


class Recorder(keras.callbacks.Callback):
    """Records each call: its name, its number if there is one, and whether the logs hold a loss."""

    def __init__(self, do=lambda event, model: None):
        super().__init__()
        self.calls, self.do = [], do
        for name in dir(keras.callbacks.Callback):
            if name.startswith("on_"):
                setattr(self, name, functools.partial(self._record, name))

    def _record(self, name, *arguments, logs=None):
        if not arguments or isinstance(arguments[-1], dict):
            logs = arguments[-1] if arguments else logs
            arguments = arguments[:-1]
        self.calls.append((name, *arguments, "loss" in (logs or {})))
        self.do(self.calls[-1][:-1], self.model)

    def set_params(self, params):
        super().set_params(params)
        self.calls.append(("set_params", params))


class PlannedError(Exception):
    pass


def at(event, do):
    return lambda call, model: do(model) if call == event else None


def stop(model):
    model.stop_training = True


def fail(model):
    raise PlannedError


ENDS = {
    "a normal end": lambda call, model: None,
    "stop after an epoch": at(("on_epoch_end", 1), stop),
    "stop after a batch": at(("on_train_batch_end", 0), stop),
    "stop before the first epoch": at(("on_train_begin",), stop),
    "a fault between epochs": at(("on_epoch_begin", 1), fail),
    "a fault in an epoch": at(("on_train_batch_begin", 0), fail),
}


@pytest.mark.parametrize("do", ENDS.values(), ids=ENDS.keys())
def test_callbacks_are_called_as_fit_calls_them(env, do):
    recorders = Recorder(do), Recorder(do)
    model = keras.Sequential([keras.Input((1,)), keras.layers.Dense(1)])
    model.compile(loss="mse")
    with contextlib.suppress(PlannedError):
        model.fit(np.ones((4, 1)), np.ones((4, 1)), batch_size=4, epochs=3, verbose=0, callbacks=[recorders[0]])
    with contextlib.suppress(PlannedError):
        play(env, recorders[1], config=Config(num_episodes=3, batch_size=2))
    assert recorders[1].calls == recorders[0].calls


def test_callbacks_are_called_as_fit_calls_them_when_a_step_fails(env):
    def break_network(model):
        model.layers[0].kernel.assign(np.full(model.layers[0].kernel.shape, np.nan))

    model = keras.Sequential([keras.Input((1,)), keras.layers.Dense(1)])
    model.compile(loss="mse")
    recorders = Recorder(at(("on_epoch_begin", 1), break_network)), Recorder(at(("on_epoch_begin", 1), break_network))
    nan = [keras.callbacks.TerminateOnNaN() for _ in range(2)]
    model.fit(np.ones((4, 1)), np.ones((4, 1)), batch_size=4, epochs=3, verbose=0, callbacks=[recorders[0], nan[0]])
    run = play(env, recorders[1], nan[1], config=Config(num_episodes=3, batch_size=2))
    assert run.diverged
    assert recorders[1].calls == recorders[0].calls


def test_a_backup_survives_an_error_and_restores_the_weights(env, tmp_path):
    class Failing(keras.callbacks.Callback):
        def on_epoch_begin(self, epoch, logs=None):
            if epoch == 20:
                self.weights = self.model.get_weights()
                raise PlannedError

    class Restored(keras.callbacks.Callback):
        def on_train_begin(self, logs=None):
            self.weights = self.model.get_weights()

    failing, restored = Failing(), Restored()
    with pytest.raises(PlannedError):
        play(env, keras.callbacks.BackupAndRestore(tmp_path / "backup"), failing)
    play(env, keras.callbacks.BackupAndRestore(tmp_path / "backup"), restored)
    for ours, theirs in zip(restored.weights, failing.weights, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert not (tmp_path / "backup").exists()


def test_no_callbacks_may_be_none(env):
    assert len(train(env, Config(num_episodes=2, batch_size=2), seed=0, callbacks=None, verbose=0).episodes) == 2


class Meddler(keras.callbacks.Callback):
    """Deletes at one episode all that was learned, as a user's own callback may."""

    def on_epoch_begin(self, epoch, logs=None):
        if epoch == 20:
            self.model.set_weights([np.zeros_like(w) for w in self.model.get_weights()])


def test_a_callback_may_change_the_network(env):
    run, other = play(env), play(env, Meddler())
    assert run.history["mean_q"][:20] == pytest.approx(other.history["mean_q"][:20], nan_ok=True)
    assert other.history["mean_q"][20] < 0.5 < run.history["mean_q"][20]


@pytest.mark.slow
def test_one_callback_needs_no_list_and_another_object_is_refused(env):
    keras_history = keras.callbacks.History()
    train(env, Config(num_episodes=2, batch_size=2), seed=0, callbacks=keras_history, verbose=0)
    assert keras_history.epoch == [0, 1]
    with pytest.raises(TypeError, match=r"^callbacks must be Keras callbacks, got 'log\.csv'"):
        train(env, callbacks=["log.csv"])


@pytest.mark.slow
def test_the_bar_stands_beside_the_originals_lines(env, capfd):
    config = Config(num_episodes=110, batch_size=16, solved_reward=1e6)
    play(env, config=config, verbose=1)
    lines = capfd.readouterr().out
    play(env, config=config, verbose=2)
    out, bar = capfd.readouterr()
    assert out.split() == lines.split()  # tqdm writes them between its own lines
    assert "110/110" in bar
    play(env, keras.callbacks.Callback(), config=config, verbose=0)
    assert capfd.readouterr() == ("", "")


def test_a_resumed_run_logs_the_same_numbers_as_the_whole_run(env, tmp_path):
    whole = play(env)
    play(env, config=Config(**{**vars(CONFIG), "num_episodes": 15}), checkpoint=tmp_path)
    keras_history = keras.callbacks.History()
    run = play(env, keras_history, checkpoint=tmp_path, resume=True)
    assert keras_history.epoch == list(range(15, 40))
    for name in NAMES[:-1]:
        np.testing.assert_array_equal(run.history[name], whole.history[name])
        np.testing.assert_array_equal(keras_history.history[name], whole.history[name][15:])
    assert np.isnan(run.history["steps_per_second"][:15]).all()
    assert (np.array(run.history["steps_per_second"][15:]) > 0).all()


@pytest.mark.slow
def test_a_csv_logger_writes_the_same_rows_as_in_keras(env, tmp_path):
    class KerasOwn(keras.callbacks.CSVLogger):
        """A subclass of CSVLogger, so that its own `on_epoch_end` is called."""

    for kind, options in [("fast", {}), ("append", {"append": True, "separator": ";"})]:
        fast, slow = tmp_path / f"{kind}.csv", tmp_path / f"{kind}_keras.csv"
        for _ in range(2):
            play(env, keras.callbacks.CSVLogger(fast, **options), KerasOwn(slow, **options))
        assert fast.read_bytes() == slow.read_bytes()
        assert len(fast.read_text().splitlines()) > 3
