"""Ctrl-C and SIGTERM: `train` finishes the episode, saves, and also ends the code around it."""

import dataclasses
import pickle
import signal
import threading

import keras
import pytest

from dqn_keras import TrainingInterrupted, train
from dqn_keras.environments import CartPole
from tests.helpers.faults import CONFIG, LOOPS, SEED, files, play
from tests.helpers.runs import fingerprint

QUICK = dataclasses.replace(CONFIG, num_episodes=40)


class Asking(keras.callbacks.Callback):
    """Sends signals to its own process in episode 7."""

    def __init__(self, *numbers):
        super().__init__()
        self.numbers = numbers

    def on_epoch_begin(self, epoch, logs=None):
        if epoch == 7:
            for number in self.numbers:
                signal.raise_signal(number)


def interrupted(call):
    with pytest.raises(TrainingInterrupted) as caught:
        call()
    return caught.value


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("loop", LOOPS)
def test_a_request_ends_the_run_with_that_episode_and_then_raises(loop, number):
    handlers = [signal.getsignal(x) for x in (signal.SIGINT, signal.SIGTERM)]
    error = interrupted(lambda: train(LOOPS[loop](), QUICK, SEED, verbose=0, callbacks=[Asking(number)]))
    assert isinstance(error, KeyboardInterrupt)
    assert error.run.interrupted
    assert len(error.run.episodes) == 8
    assert str(error) == "after 8 episodes; the exception's `run` has them (in a notebook: sys.last_value.run)"
    assert [signal.getsignal(x) for x in (signal.SIGINT, signal.SIGTERM)] == handlers


def test_a_loop_over_seeds_ends_and_does_not_take_a_cut_run_for_a_whole_one(cartpole):
    runs, callbacks = [], {1: [Asking(signal.SIGINT)]}
    interrupted(lambda: runs.extend(train(cartpole, QUICK, k, verbose=0, callbacks=callbacks.get(k)) for k in range(3)))
    assert [len(run.episodes) for run in runs] == [40]


def test_the_interrupted_run_is_saved_and_can_be_resumed(tmp_path):
    error = interrupted(lambda: play("Gymnasium loop", tmp_path, QUICK, callbacks=[Asking(signal.SIGTERM)]))
    assert str(error) == f"after 8 episodes, which are saved in {tmp_path}; train(..., resume=True) continues"
    assert files(tmp_path)[-1] == "checkpoint-0000000008.npz"
    whole = play("Gymnasium loop", tmp_path / "whole", QUICK)
    assert fingerprint(play("Gymnasium loop", tmp_path, QUICK)) == fingerprint(whole)


def test_a_request_in_the_last_episode_is_not_lost_but_the_run_is_whole(cartpole):
    config = dataclasses.replace(QUICK, num_episodes=8)
    run = interrupted(lambda: train(cartpole, config, SEED, verbose=0, callbacks=[Asking(signal.SIGINT)])).run
    assert not run.interrupted
    assert len(run.episodes) == 8
    error = interrupted(lambda: train(cartpole, config, SEED, verbose=0, callbacks=[Asking(signal.SIGINT)]))
    assert str(error) == "after 8 episodes, the last of the run; the exception's `run` has them"


def test_a_second_ctrl_c_stops_at_once(cartpole):
    with pytest.raises(KeyboardInterrupt) as caught:
        train(cartpole, QUICK, SEED, verbose=0, callbacks=[Asking(signal.SIGINT, signal.SIGINT)])
    assert type(caught.value) is KeyboardInterrupt
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_run_inside_a_callback_is_interrupted_too(cartpole):
    inner = []

    def train_inside(epoch, logs):
        inner.append(interrupted(lambda: train(cartpole, QUICK, SEED, verbose=0, callbacks=[Asking(signal.SIGINT)])))
        raise inner[0]

    outside = keras.callbacks.LambdaCallback(on_epoch_end=train_inside)
    error = interrupted(lambda: train(CartPole(), QUICK, SEED, verbose=0, callbacks=[outside]))
    assert error is inner[0]
    assert len(error.run.episodes) == 8


def test_the_exception_can_be_sent_to_another_process_without_its_run(cartpole):
    error = interrupted(lambda: train(cartpole, QUICK, SEED, verbose=0, callbacks=[Asking(signal.SIGINT)]))
    sent = pickle.loads(pickle.dumps(error))
    assert type(sent) is KeyboardInterrupt
    assert str(sent) == str(error)


def test_handlers_of_the_user_stay(cartpole):
    received = []
    previous = signal.signal(signal.SIGTERM, lambda *_: received.append(1))
    try:
        run = train(cartpole, QUICK, SEED, verbose=0, callbacks=[Asking(signal.SIGTERM)])
    finally:
        signal.signal(signal.SIGTERM, previous)
    assert received == [1]
    assert not run.interrupted


def test_a_signal_that_is_ignored_stays_ignored(cartpole):
    previous = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        run = train(cartpole, QUICK, SEED, verbose=0, callbacks=[Asking(signal.SIGINT)])
    finally:
        signal.signal(signal.SIGINT, previous)
    assert len(run.episodes) == 40


def test_training_works_in_a_thread(cartpole):
    runs = []
    thread = threading.Thread(target=lambda: runs.append(train(cartpole, QUICK, SEED, verbose=0)))
    thread.start()
    thread.join()
    assert len(runs[0].episodes) == 40


@pytest.mark.slow
def test_an_interrupted_notebook_cell_stops_and_keeps_the_run():
    from jupyter_client.manager import start_new_kernel

    cell = """
import gymnasium as gym
from dqn_keras import Config, train
seeds = []
for seed in range(3):
    seeds.append(seed)
    train(gym.make("CartPole-v1"), Config(num_episodes=10**6, solved_reward=1e6), seed)
"""
    manager, client = start_new_kernel(kernel_name="python3")
    try:

        def interrupt_when_ready(message):
            if message["msg_type"] == "stream" and "Episode 0" in message["content"]["text"]:
                manager.interrupt_kernel()

        reply = client.execute_interactive(cell, timeout=600, output_hook=interrupt_when_ready)
        assert reply["content"]["ename"] == "TrainingInterrupted"
        texts = []
        client.execute_interactive(
            "import sys; print(seeds, sys.last_value.run.interrupted)",
            timeout=600,
            output_hook=lambda m: texts.append(m["content"].get("text", "")),
        )
        assert "[0] True" in "".join(texts)
    finally:
        client.stop_channels()
        manager.shutdown_kernel(now=True)
