import gymnasium as gym
import numpy as np
import pytest

from dqn_keras import train
from dqn_keras.checks.environments import CheckedEnv
from tests.helpers.environments import Corridor, OldReset, OldStep

MISBEHAVING = {
    "reset of the old API": (OldReset(), r"env OldReset: reset\(\) must return \(observation, info\)"),
    "step of the old API": (OldStep(), r"env OldStep: step\(\) must return \(observation, reward, terminated, trunc"),
    "no reward": (
        Corridor(reward=lambda t: None),
        r"env Corridor: the reward must be a number, got None in episode 0, step 0",
    ),
    "no end": (Corridor(end=lambda t: None), r"terminated and truncated must be booleans, got \(None, False\)"),
    "a word as reward": (Corridor(reward=lambda t: "one"), r"the reward must be a number, got 'one'"),
    "another shape, late": (
        Corridor(length=9, observe=lambda position, t: np.zeros(3 if t == 2 else 2)),
        r"the observation must have shape \(2,\), not \(3,\), got array.* in episode 0, step 1",
    ),
    "no observation": (Corridor(observe=lambda position, t: {"a": 1}), r"the observation must be an array of numbers"),
}


@pytest.mark.parametrize(("env", "message"), MISBEHAVING.values(), ids=MISBEHAVING.keys())
def test_a_misbehaving_environment_is_named(env, message):
    with pytest.raises(ValueError, match=message):
        train(env, seed=0, verbose=0)


Box, Discrete = gym.spaces.Box, gym.spaces.Discrete
UNSUPPORTED = [
    ("observation_space", Discrete(5)),
    ("observation_space", Box(0, 1, ())),
    ("observation_space", Box(0, 1, (0,))),
    ("observation_space", gym.spaces.Dict({"a": Box(0, 1, (2,))})),
    ("observation_space", gym.spaces.Tuple([Box(0, 1, (2,))])),
    ("action_space", Box(0, 1, (2,))),
    ("action_space", gym.spaces.MultiBinary(2)),
    ("action_space", gym.spaces.MultiDiscrete([2, 2])),
]


@pytest.mark.parametrize(("field", "space"), UNSUPPORTED)
def test_an_unsupported_space_is_an_error_that_says_what_is_supported(field, space):
    with pytest.raises(ValueError, match=rf"env Corridor has the {field.replace('_', ' ')} .*; it must be"):
        CheckedEnv(Corridor(**{field: space}))


def test_an_error_of_the_environments_own_says_where():
    def reward(t):
        if t == 3:
            raise RuntimeError("the simulator died")
        return 1.0

    with pytest.raises(RuntimeError, match="the simulator died") as caught:
        train(Corridor(length=9, reward=reward), seed=0, verbose=0)
    assert caught.value.__notes__ == ["raised by env Corridor in episode 0, step 3"]


def test_what_is_not_an_environment_is_refused():
    for thing in ("CartPole-v1", None, gym.make_vec("CartPole-v1", num_envs=2)):
        with pytest.raises(TypeError, match=r"^env must be a gymnasium\.Env, got"):
            CheckedEnv(thing)


def test_a_registered_environment_is_called_by_its_id(cartpole):
    assert CheckedEnv(cartpole).name == "CartPole-v1"
