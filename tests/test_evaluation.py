import gymnasium as gym
import numpy as np
import pytest

from dqn_keras import Config, evaluate, make_q_network, train
from tests.helpers.environments import Corridor


def always(action):
    network = make_q_network(2, 2, seed=0)
    network.set_weights([*[np.zeros_like(w) for w in network.get_weights()[:-1]], np.eye(2)[action]])
    return network


def test_returns_are_undiscounted_sums_of_greedy_episodes():
    env = Corridor(length=5, reward=lambda t: t)
    np.testing.assert_array_equal(evaluate(env, always(1), num_episodes=3, seed=0), [10.0, 10.0, 10.0])
    assert env.actions == [1] * 15


def test_an_episode_that_never_ends_is_left():
    assert evaluate(Corridor(), always(0), num_episodes=1, seed=0, max_steps=7).tolist() == [7.0]


def test_the_seed_decides(cartpole):
    network = make_q_network(4, 2, seed=0)
    first, again, other = (evaluate(cartpole, network, 20, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_evaluation_starts_where_training_did_not():
    starts = []
    for play in (
        lambda env: train(env, Config(num_episodes=9, batch_size=8), seed=0, verbose=0),
        lambda env: evaluate(env, always(1), 9, seed=0),
    ):
        env = Corridor(length=2)
        play(env)
        starts.append(set(env.reset_seeds))
    assert len(starts[0]) == len(starts[1]) == 9
    assert not starts[0] & starts[1]


def test_evaluation_changes_no_weight(cartpole):
    network = make_q_network(4, 2, seed=0)
    before = network.get_weights()
    evaluate(cartpole, network, 2, seed=0)
    assert all(map(np.array_equal, before, network.get_weights()))


def test_bad_arguments_are_named(cartpole):
    with pytest.raises(ValueError, match=r"^q_network must map states of shape \(4,\) to 2 actions, got input \(2,\)"):
        evaluate(cartpole, always(0))
    with pytest.raises(ValueError, match=r"^num_episodes"):
        evaluate(cartpole, make_q_network(4, 2), num_episodes=0)
    with pytest.raises(TypeError, match=r"^max_steps"):
        evaluate(cartpole, make_q_network(4, 2), max_steps=1.5)
    with pytest.raises(ValueError, match="action space"):
        evaluate(gym.make("Pendulum-v1"), make_q_network(3, 2))
