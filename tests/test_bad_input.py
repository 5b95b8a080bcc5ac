"""Bad input that the original accepts silently, or with an unclear error, is an error that names it."""

import gymnasium as gym
import keras
import numpy as np
import pytest

from dqn_keras import (
    Config,
    ReplayMemory,
    action,
    evaluate,
    learn,
    load_q_network,
    make_networks,
    make_q_network,
    train,
)
from dqn_keras.checks.numbers import check_counts
from dqn_keras.environments import CartPole
from tests.helpers.environments import Corridor, OldReset, OldStep

NAN, INF = float("nan"), float("inf")
Box, Discrete = gym.spaces.Box, gym.spaces.Discrete

CONFIGS = [
    {"memory_size": 0},
    {"memory_size": -1},
    {"memory_size": 50_000.0},
    {"memory_size": 63},
    {"memory_size": 2**40},
    {"steps_per_update": 0},
    {"steps_per_update": 2.5},
    {"steps_per_update": None},
    {"alpha": 0},
    {"alpha": -0.001},
    {"alpha": NAN},
    {"alpha": INF},
    {"alpha": "0.001"},
    {"gamma": 1.5},
    {"gamma": -0.1},
    {"gamma": NAN},
    {"gamma": None},
    {"tau": 0},
    {"tau": 1.01},
    {"tau": NAN},
    {"batch_size": 0},
    {"batch_size": 64.0},
    {"batch_size": True},
    {"batch_size": "64"},
    {"epsilon": 2},
    {"epsilon": NAN},
    {"epsilon": -1},
    {"decay": 0},
    {"decay": 1.5},
    {"decay": INF},
    {"epsilon_min": -0.1},
    {"epsilon_min": 1.5},
    {"num_episodes": 0},
    {"num_episodes": -5},
    {"num_episodes": 1e3},
    {"max_steps": 0},
    {"max_steps": False},
    {"solved_reward": NAN},
    {"solved_reward": INF},
    {"solved_window": 0},
    {"hidden_units": ()},
    {"hidden_units": (0,)},
    {"hidden_units": 64},
]


@pytest.mark.parametrize("fields", CONFIGS, ids=repr)
def test_a_bad_parameter_is_an_error_that_names_it(fields):
    with pytest.raises((TypeError, ValueError)) as caught:
        Config(**fields)
    (name,) = fields
    message_got = str(caught.value)
    assert message_got.split()[0].split("[")[0] in (name, "batch_size")
    assert name in message_got


def play(**parts):
    return train(Corridor(**{"length": 50, "limit": 50, **parts}), Config(num_episodes=20), seed=0, verbose=0)


def network(num_features=2, num_actions=2, weight=None):
    q_network = make_q_network(num_features, num_actions, seed=0)
    if weight is not None:
        q_network.set_weights([np.full_like(w, weight) for w in q_network.get_weights()])
    return q_network


def learn_from(q_hat_network=None, **fields):
    names = ("states", "actions", "rewards", "next_states", "terminal_states")
    arrays = [np.zeros((8, 2)), np.zeros(8, int), np.zeros(8), np.zeros((8, 2)), np.zeros(8)]
    batch = {**dict(zip(names, arrays, strict=True)), **fields}
    q_network, other = make_networks(2, 2, seed=0)
    return learn(tuple(batch.values()), 0.95, q_network, q_hat_network or other, keras.optimizers.Adam())


OTHERS = {
    "an observation of NaN": (lambda: play(observe=lambda p, t: np.array([NAN, 0])), "env Corridor: the observation"),
    "an observation of inf": (lambda: play(observe=lambda p, t: np.array([INF, 0])), "env Corridor: the observation"),
    "an observation of 1e39": (lambda: play(observe=lambda p, t: np.array([1e39, 0])), "env Corridor: the observation"),
    "a reward of NaN": (lambda: play(reward=lambda t: NAN), "env Corridor: the reward"),
    "a reward of inf, which would solve it": (lambda: play(reward=lambda t: INF), "env Corridor: the reward"),
    "a reward of 1e39": (lambda: play(reward=lambda t: 1e39), "env Corridor: the reward"),
    "a reward of None": (lambda: play(reward=lambda t: None), "env Corridor: the reward"),
    "a reward of two numbers": (lambda: play(reward=lambda t: np.ones(2)), "env Corridor: the reward"),
    "an observation that changes shape": (
        lambda: play(observe=lambda p, t: np.zeros(2 + (t > 5))),
        "env Corridor: the observation must have shape",
    ),
    "actions in a Box": (lambda: play(action_space=Box(0, 1, (1,))), "env Corridor has the action space"),
    "actions in MultiBinary": (lambda: play(action_space=gym.spaces.MultiBinary(2)), "env Corridor has the action"),
    "observations in a Dict": (
        lambda: play(observation_space=gym.spaces.Dict({"a": Discrete(2)})),
        "env Corridor has the observation space",
    ),
    "images": (
        lambda: play(observation_space=Box(0, 255, (8, 8, 3), np.uint8)),
        r"env Corridor has observations of shape \(8, 8, 3\), the default network takes one axis: q_network must be",
    ),
    "reset of the old API": (lambda: train(OldReset(), verbose=0), r"env OldReset: reset\(\) must return"),
    "step of the old API": (lambda: train(OldStep(), verbose=0), r"env OldStep: step\(\) must return"),
    "a vector environment": (lambda: train(gym.make_vec("CartPole-v1", 2), verbose=0), "env must be a gymnasium.Env"),
    "a name for an environment": (lambda: train("CartPole-v1", verbose=0), "env must be a gymnasium.Env"),
    "a seed that is none": (lambda: train(CartPole(), seed=-1), "seed must be a whole number"),
    "a reward of shape [B, 1], which broadcasts": (lambda: learn_from(rewards=np.zeros((8, 1))), "rewards must have"),
    "an action that is not one": (lambda: learn_from(actions=np.full(8, 2)), "actions must lie in 0..1"),
    "a terminal state of 2": (lambda: learn_from(terminal_states=np.full(8, 2.0)), "terminal_states must be 0 or 1"),
    "a state of NaN": (lambda: learn_from(states=np.full((8, 2), NAN)), "states must be finite"),
    "networks of two shapes": (
        lambda: learn_from(q_hat_network=network(num_actions=3)),
        "q_hat_network must have",
    ),
    "weights of NaN": (lambda: evaluate(Corridor(), network(weight=NAN)), "q_network must have finite weights"),
    "a network for another environment": (lambda: evaluate(Corridor(), network(num_features=3)), "q_network must map"),
    "Q-values of two states": (lambda: action(np.zeros((2, 2)), 0.1, np.random.default_rng(0)), "q_values must be"),
    "a memory of no transitions": (lambda: ReplayMemory(0, (4,)), "memory_size must be"),
    "no hidden layer": (lambda: check_counts("hidden_units", []), "hidden_units must hold"),
    "a file that is no network": (lambda: load_q_network(__file__), "path .* is not a network"),
}


@pytest.mark.parametrize(("call", "message"), OTHERS.values(), ids=OTHERS.keys())
def test_a_bad_input_is_an_error_that_names_it(call, message):
    with pytest.raises((TypeError, ValueError), match=f"^{message}"):
        call()
