"""The callback Evaluation: greedy returns during a run and the best network, in both loops."""

import csv
import itertools
import math

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import Config, Evaluation, evaluate, load_q_network, make_q_network, train
from dqn_keras.environments import CartPole
from dqn_keras.storage.networks import save_q_network
from tests.helpers.environments import Corridor
from tests.helpers.runs import SpoiledVelocity

CONFIG = Config(num_episodes=40, batch_size=16, memory_size=300, solved_reward=1e6)


@pytest.fixture(params=["Gymnasium loop", "compiled episodes"])
def env(request):
    return CartPole() if request.param == "compiled episodes" else gym.make("CartPole-v1")


def evaluation(best=None, every_steps=100, **arguments):
    return Evaluation(gym.make("CartPole-v1"), every_steps, num_episodes=3, best=best, **arguments)


def play(env, *callbacks, config=CONFIG, **arguments):
    return train(env, config, seed=2, callbacks=callbacks, **{"verbose": 0, **arguments})


def weights(network):
    return np.concatenate([w.ravel() for w in network.get_weights()])


class Snapshots(keras.callbacks.Callback):
    """Records the environment steps and the weights at the start and after each episode."""

    def on_train_begin(self, logs=None):
        self.steps, self.weights = [0], [weights(self.model)]

    def on_epoch_end(self, epoch, logs=None):
        self.steps.append(self.steps[-1] + logs["steps"])
        self.weights.append(weights(self.model))


def test_training_with_evaluations_is_the_same_bit_for_bit(env, tmp_path):
    run, other = play(env, evaluation(tmp_path / "best.keras")), play(env)
    np.testing.assert_array_equal(run.rewards, other.rewards)
    np.testing.assert_array_equal(weights(run.q_network), weights(other.q_network))
    np.testing.assert_array_equal(weights(run.q_hat_network), weights(other.q_hat_network))
    assert run.agent.rng.bit_generator.state == other.agent.rng.bit_generator.state


@pytest.mark.slow
def test_a_network_with_random_state_is_trained_the_same():
    @keras.saving.register_keras_serializable("test_evaluation_callback")
    class Noise(keras.layers.Layer):
        def __init__(self, **arguments):
            super().__init__(**arguments)
            self.generator = keras.random.SeedGenerator(0)

        def call(self, x):
            return x + keras.random.normal(keras.ops.shape(x), seed=self.generator)

    def final(*callbacks):
        initializer = keras.initializers.GlorotUniform(seed=1)
        dense = keras.layers.Dense(2, kernel_initializer=initializer)
        network = keras.Sequential([keras.Input((4,)), Noise(), dense])
        config = Config(num_episodes=4, batch_size=8)
        run = play(gym.make("CartPole-v1"), *callbacks, config=config, q_network=network)
        return weights(run.q_network)

    np.testing.assert_array_equal(final(evaluation(every_steps=10)), final())


def test_it_evaluates_at_the_start_after_each_multiple_of_every_steps_and_at_the_end(env):
    greedy, snapshots = evaluation(), Snapshots()
    run = play(env, greedy, snapshots)
    due = [after for before, after in itertools.pairwise(snapshots.steps) if after // 100 > before // 100]
    assert len(due) > 5
    assert greedy.steps == [0, *due] + ([snapshots.steps[-1]] if due[-1] < snapshots.steps[-1] else [])
    assert greedy.returns[-1] == evaluate(gym.make("CartPole-v1"), run.q_network, 3, seed=0).mean()
    assert len(greedy.returns) == len(greedy.steps)


def test_the_file_holds_the_network_of_the_best_evaluation(env, tmp_path):
    greedy, snapshots = evaluation(tmp_path / "kept" / "best.keras"), Snapshots()
    play(env, greedy, snapshots)
    best = int(np.argmax(greedy.returns))
    assert 0 < best < len(greedy.returns) - 1  # neither the first nor the last network is the best
    kept = load_q_network(tmp_path / "kept" / "best.keras")
    assert evaluate(gym.make("CartPole-v1"), kept, 3, seed=0).mean() == greedy.best_return == max(greedy.returns)
    np.testing.assert_array_equal(weights(kept), snapshots.weights[snapshots.steps.index(greedy.steps[best])])


def test_of_equal_networks_the_earliest_stays(tmp_path):
    greedy, snapshots = Evaluation(Corridor(limit=3), 5, 1, tmp_path / "best.keras"), Snapshots()
    play(Corridor(limit=3), greedy, snapshots, config=Config(num_episodes=9, batch_size=4))
    assert set(greedy.returns) == {3.0}
    np.testing.assert_array_equal(weights(load_q_network(tmp_path / "best.keras")), snapshots.weights[0])
    assert not np.array_equal(snapshots.weights[0], snapshots.weights[-1])


def test_every_log_holds_the_latest_mean_return_whatever_the_order_of_callbacks(env, tmp_path):
    greedy, snapshots, keras_history = evaluation(), Snapshots(), keras.callbacks.History()
    run = play(env, keras.callbacks.CSVLogger(tmp_path / "log.csv"), keras_history, snapshots, greedy)
    returns_at, expected = dict(zip(greedy.steps, greedy.returns, strict=True)), [greedy.returns[0]]
    for before, after in itertools.pairwise(snapshots.steps):
        expected.append(returns_at[after] if after // 100 > before // 100 else expected[-1])
    del expected[0]
    assert len(set(expected)) > 3
    np.testing.assert_array_equal(run.history["greedy_return"], expected)
    np.testing.assert_array_equal(keras_history.history["greedy_return"], expected)
    rows = list(csv.DictReader((tmp_path / "log.csv").open()))
    assert rows[0].keys() == {"epoch", *run.history}
    np.testing.assert_array_equal([float(row["greedy_return"]) for row in rows], expected)


@pytest.mark.slow
def test_early_stopping_and_model_checkpoint_can_monitor_it(env, tmp_path):
    returns = play(env, evaluation()).history["greedy_return"]
    stop = next(i for i in range(8, 40) if max(returns[: i + 1]) == max(returns[: i - 7]))  # 8 without a better one
    assert stop < 39
    stopper = keras.callbacks.EarlyStopping("greedy_return", mode="max", patience=8)
    saver = keras.callbacks.ModelCheckpoint(
        tmp_path / "theirs.keras", monitor="greedy_return", mode="max", save_best_only=True
    )
    greedy = evaluation()
    run = play(env, stopper, saver, greedy)
    assert len(run.rewards) == stop + 1
    theirs = evaluate(gym.make("CartPole-v1"), load_q_network(tmp_path / "theirs.keras"), 3, seed=0).mean()
    assert theirs == max(run.history["greedy_return"])


@pytest.mark.slow
def test_what_any_callback_adds_to_the_logs_is_in_the_history(cartpole, tmp_path):
    config = Config(num_episodes=4, batch_size=16)
    callbacks = keras.callbacks.LearningRateScheduler(lambda epoch, rate: 0.5 / (epoch + 1)), evaluation()
    run = play(cartpole, *callbacks, config=config)
    assert run.history["learning_rate"] == pytest.approx([0.5, 0.25, 0.5 / 3, 0.125])
    play(cartpole, config=config, checkpoint=tmp_path)
    longer = play(
        cartpole, evaluation(), config=Config(num_episodes=6, batch_size=16), checkpoint=tmp_path, resume=True
    )
    assert [math.isnan(x) for x in longer.history["greedy_return"]] == [True] * 4 + [False] * 2


def test_a_resumed_run_evaluates_where_the_whole_run_does(env, tmp_path):
    whole, second = evaluation(), evaluation()
    play(env, whole)
    run = play(env, evaluation(), config=Config(**{**vars(CONFIG), "num_episodes": 15}), checkpoint=tmp_path)
    play(env, second, checkpoint=tmp_path, resume=True)
    begin = sum(episode.steps for episode in run.episodes)
    rest = whole.steps.index(next(steps for steps in whole.steps if steps > begin))
    assert second.steps == [begin, *whole.steps[rest:]]
    assert second.returns[1:] == whole.returns[rest:]


def steers(to):
    """Returns a network that balances the pole for about 200 steps (1), or topples it (-1)."""
    network = make_q_network(4, 2, hidden_units=(2,), seed=0)
    network.set_weights([to * np.outer([0, 0, 1, 1], [1, -1]), np.zeros(2), np.eye(2)[::-1], np.zeros(2)])
    return network


@pytest.mark.parametrize("is_good", [True, False])
def test_a_resumed_run_replaces_the_best_network_only_by_a_better_one(cartpole, tmp_path, is_good):
    best, config = tmp_path / "best.keras", Config(num_episodes=10, batch_size=16)
    play(cartpole, config=Config(num_episodes=5, batch_size=16), checkpoint=tmp_path / "run")
    save_q_network(best, steers(1 if is_good else -1))
    greedy = evaluation(best)
    play(cartpole, greedy, config=config, checkpoint=tmp_path / "run", resume=True)
    is_still_there = load_q_network(best).count_params() == steers(1).count_params()
    assert is_still_there == is_good == (greedy.best_return > max(greedy.returns))
    assert evaluate(cartpole, load_q_network(best), 3, seed=0).mean() == greedy.best_return


def test_a_new_run_replaces_the_file_of_another(cartpole, tmp_path):
    save_q_network(tmp_path / "best.keras", steers(1))
    greedy = evaluation(tmp_path / "best.keras")
    play(cartpole, greedy, config=Config(num_episodes=2, batch_size=16))
    kept = load_q_network(tmp_path / "best.keras")
    assert evaluate(cartpole, kept, 3, seed=0).mean() == greedy.best_return
    assert greedy.best_return < evaluate(cartpole, steers(1), 3, seed=0).mean()


def test_a_resumed_run_refuses_a_file_without_one_of_its_networks(tmp_path):
    best, arguments = tmp_path / "best.keras", {"checkpoint": tmp_path / "run", "resume": True}
    play(Corridor(limit=3), config=Config(num_episodes=2, batch_size=4), **arguments)
    greedy, config = Evaluation(Corridor(limit=3), 5, 1, best), Config(num_episodes=4, batch_size=4)
    for write, why in [
        (lambda: save_q_network(best, make_q_network(3, 2, seed=0)), "q_network must map states of shape"),
        (lambda: best.write_bytes(best.read_bytes()[:-100]), "is not a network that can be loaded"),
    ]:
        write()
        with pytest.raises(ValueError, match=rf"^best .*best\.keras must hold a network of the resumed run.*{why}"):
            play(Corridor(limit=3), greedy, config=config, **arguments)
    best.unlink()
    play(Corridor(limit=3), greedy, config=config, **arguments)
    assert best.exists()


@pytest.mark.slow
def test_the_averaged_weights_of_the_end_are_evaluated(cartpole):
    greedy = evaluation(every_steps=1)
    run = play(cartpole, greedy, optimizer=keras.optimizers.Adam(use_ema=True, ema_momentum=0.9))
    assert greedy.steps[-2:] == [sum(run.history["steps"])] * 2  # the network of the last step, and the average
    assert greedy.returns[-1] == evaluate(cartpole, run.q_network, 3, seed=0).mean()


@pytest.mark.slow
@pytest.mark.parametrize(("every_steps", "num_evaluations"), [(1, 13), (10_000, 1)])
def test_a_diverged_network_is_not_evaluated(env, every_steps, num_evaluations):
    greedy, keras_history = evaluation(every_steps=every_steps), keras.callbacks.History()
    run = play(env, greedy, keras_history, SpoiledVelocity(), keras.callbacks.TerminateOnNaN())
    assert run.diverged
    assert len(greedy.steps) == num_evaluations
    assert len(run.history["greedy_return"]) == len(run.rewards) == 12
    assert math.isnan(keras_history.history["greedy_return"][12])


@pytest.mark.slow
def test_a_full_disk_is_a_warning_and_the_next_better_network_is_kept(env, tmp_path, monkeypatch):
    def fail(self, *_, **__):
        raise OSError("no space left")

    class DiskIsFull(keras.callbacks.Callback):
        def on_epoch_end(self, epoch, logs=None):
            if epoch == 2:
                monkeypatch.setattr(keras.Sequential, "save", fail)
            if epoch == 12:
                monkeypatch.undo()

    greedy = evaluation(tmp_path / "best.keras", every_steps=1)
    with pytest.warns(UserWarning, match=r"^best .* could not be written \(no space left\); the earlier file stays"):
        play(env, greedy, DiskIsFull())
    kept = load_q_network(tmp_path / "best.keras")
    assert evaluate(gym.make("CartPole-v1"), kept, 3, seed=0).mean() == greedy.best_return
    assert [path.name for path in tmp_path.iterdir()] == ["best.keras"]


def test_a_file_that_cannot_be_written_is_an_error_before_any_work_starts(tmp_path):
    (tmp_path / "file").touch()
    env = Corridor()
    with pytest.raises(OSError, match=r"^best .*best\.keras cannot be written"):
        play(env, Evaluation(Corridor(limit=3), 5, 1, tmp_path / "file" / "best.keras"))
    assert not env.reset_seeds


def test_an_environment_that_does_not_fit_is_an_error_before_any_work_starts(cartpole):
    wrapped = gym.wrappers.TimeLimit(cartpole, 10)
    for env in (cartpole, wrapped):
        with pytest.raises(
            ValueError, match=r"^callbacks must evaluate in an environment of their own, got .*CartPole"
        ):
            play(env, Evaluation(cartpole, 100))
    for env in (cartpole, CartPole()):
        with pytest.raises(
            ValueError,
            match=r"^callbacks must evaluate in an environment like env, with float32 states of shape \(4,\) and 2 "
            r"actions, got with float32 states of shape \(2,\) and 2 actions",
        ):
            play(env, Evaluation(Corridor(), 100))


def test_two_evaluations_in_a_run_are_refused(env):
    with pytest.raises(ValueError, match=r"^callbacks must hold only one Evaluation: .* got 2$"):
        play(env, evaluation(), evaluation())


def test_bad_arguments_are_named(cartpole):
    for error, name, arguments in [
        (TypeError, "env", ("CartPole-v1", 100)),
        (ValueError, "every_steps", (cartpole, 0)),
        (TypeError, "num_episodes", (cartpole, 100, 1.5)),
        (ValueError, "best must end in .keras", (cartpole, 100, 1, "best.h5")),
    ]:
        with pytest.raises(error, match=f"^{name}"):
            Evaluation(*arguments)
