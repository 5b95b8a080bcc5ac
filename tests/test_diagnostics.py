import math

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import Config, make_networks, train
from dqn_keras._engine.numpy_acting import q_values
from dqn_keras._engine.programs import Learner
from dqn_keras.checks.batches import as_batch
from dqn_keras.checks.formulas import Formulas
from dqn_keras.environments import Acrobot, CartPole
from dqn_keras.learn import DEFAULT_FORMULAS, Metrics, double_td_targets
from dqn_keras.loops.updates import checked_step, sum_up
from dqn_keras.metrics import Episode, Log
from tests.helpers.environments import Corridor


@pytest.mark.parametrize("is_double", [False, True], ids=["DQN", "Double DQN"])
def test_the_metrics_are_measured_on_the_batch_before_the_step_with_the_targets_in_use(random_batch, is_double):
    batch = random_batch(32)
    networks = make_networks(4, 2, seed=0)
    networks[1].set_weights([0.1 - w for w in networks[1].get_weights()])
    q, q_hat = (network.get_weights() for network in networks)
    states, actions, rewards, next_states, terminal = batch
    next_values = q_values(q_hat, next_states)
    chosen = q_values(q if is_double else q_hat, next_states).argmax(axis=1)
    targets = rewards + (1 - terminal) * 0.95 * next_values[np.arange(32), chosen]
    errors = targets - q_values(q, states)[np.arange(32), actions]
    best = q_values(q, states).max(axis=1)

    learner = Learner(*networks, keras.optimizers.Adam())
    learner.prepare()
    formulas = Formulas(double_td_targets, "mse") if is_double else DEFAULT_FORMULAS
    metrics = checked_step(as_batch(batch, (4,), 2), learner, 0.95, 0.01, formulas)
    expected = Metrics(np.mean(errors**2), best.mean(), best.max(), np.abs(errors).mean())
    np.testing.assert_allclose(metrics, expected, rtol=1e-4)


def test_an_episode_is_the_mean_of_its_updates_and_their_highest_q():
    assert sum_up([Metrics(1.0, 2.0, 3.0, 4.0), Metrics(2.0, 4.0, 9.0, 0.0)]) == Metrics(1.5, 3.0, 9.0, 2.0)
    assert all(math.isnan(x) for x in sum_up([]))


@pytest.mark.slow
@pytest.mark.parametrize("make_env", [lambda: gym.make("CartPole-v1"), CartPole], ids=["Gymnasium", "compiled"])
def test_the_terminal_share_is_the_share_in_the_memory(make_env):
    # One memory holds whole episodes, the other begins in the middle of one.
    for memory_size in (100_000, 400):
        run = train(make_env(), Config(num_episodes=60, memory_size=memory_size, batch_size=16), seed=0, verbose=0)
        memory = run.agent.memory
        terminal = memory.rows[: len(memory), -1].mean()
        assert run.history["terminal_share"][-1] == terminal
    assert sum(run.history["steps"]) > 400


def episode(reward=1.0, steps=10, terminated=True, max_reward=1.0):
    return Episode(0, reward, steps, 1.0, math.nan, math.nan, math.nan, math.nan, max_reward, terminated)


def test_the_moving_average_is_over_the_window_of_the_stop_rule():
    log = Log(Config(solved_window=3))
    assert [log.add(episode(reward), 1.0)["average_reward"] for reward in (1, 2, 6, 7, 8)] == [1, 1.5, 3, 5, 7]


@pytest.mark.parametrize(
    ("rewards", "gamma", "bounds"),
    [
        ([1.0, 2.0, 1.0], 0.5, [2, 4, 4]),  # forever
        ([-1.0, -1.0], 0.5, [-1, -1]),  # one step, then the end
        ([-1.0, 0.0], 0.9, [-1, 0]),
        ([1.0], 1.0, [math.inf]),
        ([0.0, -1.0], 1.0, [0, 0]),
    ],
)
def test_the_bound_is_the_highest_possible_return(rewards, gamma, bounds):
    log = Log(Config(gamma=gamma))
    assert [log.add(episode(max_reward=r), 1.0)["q_bound"] for r in rewards] == pytest.approx(bounds)


@pytest.mark.slow
def test_both_loops_record_the_highest_reward_and_termination():
    run = train(Corridor(length=9, limit=6, reward=lambda t: [0, 5, 1][t % 3]), Config(num_episodes=30), 0, verbose=0)
    assert {e.max_reward for e in run.episodes} == {5.0}
    assert not any(e.terminated for e in run.episodes)
    for env in (gym.make("Acrobot-v1"), Acrobot()):
        run = train(env, Config(num_episodes=3, epsilon_min=1.0), seed=0, verbose=0)
        assert [e.max_reward for e in run.episodes] == [0.0 if e.terminated else -1.0 for e in run.episodes]
        assert [e.terminated for e in run.episodes] == [e.reward > -e.steps for e in run.episodes]
