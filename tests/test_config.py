import copy
import dataclasses
import inspect
import pickle
import re
from functools import partial

import numpy as np
import pytest
from hypothesis import given

from dqn_keras import Config
from dqn_keras.checks.fields import OTHER_NAMES
from tests.helpers.bad_configs import SHARES, bad_fields, bad_hidden_units, refused

ZERO_IS_FINE = ["gamma", "epsilon", "epsilon_min"]


def test_defaults_are_the_originals_numbers():
    assert dataclasses.asdict(Config()) == {
        "memory_size": 50_000,
        "steps_per_update": 4,
        "alpha": 0.001,
        "gamma": 0.95,
        "tau": 0.01,
        "batch_size": 64,
        "epsilon": 1.0,
        "decay": 0.995,
        "epsilon_min": 0.1,
        "num_episodes": 2_000,
        "max_steps": 1_000,
        "solved_reward": 225.0,
        "solved_window": 50,
        "hidden_units": (64,),
        "jit_compile": True,
        # not in the original, and off
        "num_steps": None,
        "learning_starts": 0,
        "steps_count_from": "episode",
        "gradient_steps": 1,
        "gradient_steps_per_target": 1,
        "epsilon_steps": None,
    }


@given(bad_fields)
def test_a_bad_field_is_an_error_that_names_it(field):
    refused(*field)


@given(bad_hidden_units)
def test_bad_units_are_an_error_that_names_them(value):
    with pytest.raises((TypeError, ValueError), match=r"^hidden_units"):
        Config(hidden_units=value)


@pytest.mark.parametrize("name", [name for name in SHARES if name not in ZERO_IS_FINE])
def test_zero_is_refused_where_nothing_would_be_learned(name):
    refused(name, 0.0)


@pytest.mark.parametrize(
    "value", [64, None, "64", (), [], (0,), (64, -1), (64.0,), (True,), ("64",), {64}, np.ones((2, 2))]
)
def test_bad_hidden_units_are_an_error_that_names_them(value):
    with pytest.raises((TypeError, ValueError), match=r"^hidden_units"):
        Config(hidden_units=value)


def test_rules_that_join_two_fields():
    with pytest.raises(ValueError, match=r"^batch_size .*memory_size=63, got 64"):
        Config(memory_size=63)
    with pytest.raises(ValueError, match=r"^batch_size .*= 60, got 64"):
        Config(num_episodes=6, max_steps=10)
    with pytest.raises(ValueError, match=r"^epsilon_min .* 0.05, got 0.1"):
        Config(epsilon=0.05)
    with pytest.raises(ValueError, match=r"^batch_size .*num_steps = 63, got 64"):
        Config(num_steps=63)
    with pytest.raises(ValueError, match=r"^learning_starts .*num_steps = 100, got 100"):
        Config(num_steps=100, learning_starts=100)
    with pytest.raises(ValueError, match=r"^decay .*epsilon_steps=10.* got 0.9"):
        Config(epsilon_steps=10, decay=0.9)


def test_numpy_scalars_become_pythons():
    config = Config(
        batch_size=np.int64(32),
        gamma=np.float32(0.5),
        solved_reward=np.int32(100),
        hidden_units=np.array([8, 9]),
        jit_compile=np.bool_(False),
    )
    assert config == Config(batch_size=32, gamma=0.5, solved_reward=100.0, hidden_units=(8, 9), jit_compile=False)
    assert [type(x) for x in (config.batch_size, config.gamma, config.hidden_units[0], config.jit_compile)] == [
        int,
        float,
        int,
        bool,
    ]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("learning_rate", "Config has no field learning_rate; the learning rate is alpha"),
        ("lr", "Config has no field lr; the learning rate is alpha"),
        ("buffer_size", "Config has no field buffer_size; the size of the replay memory is memory_size"),
        ("batchsize", "Config has no field batchsize; did you mean batch_size?"),
        ("xyz", "Config has no field xyz"),
    ],
)
def test_an_unknown_field_is_an_error_that_hints_at_the_right_one(name, message):
    for make in (Config, partial(dataclasses.replace, Config())):
        with pytest.raises(TypeError, match=f"^{re.escape(message)}$"):
            make(**{name: 1})


def test_every_hint_is_a_field():
    assert {name for _, name in OTHER_NAMES.values()} <= {field.name for field in dataclasses.fields(Config)}


def test_an_assignment_is_an_error_that_says_how_to_make_a_changed_copy():
    message = "Config is frozen; dataclasses.replace(config, gamma=0.5) makes a changed copy"
    with pytest.raises(dataclasses.FrozenInstanceError, match=f"^{re.escape(message)}$"):
        Config().gamma = 0.5
    with pytest.raises(dataclasses.FrozenInstanceError, match="the learning rate is alpha"):
        Config().learning_rate = 0.5


def test_a_config_is_copied_and_pickled_and_shows_its_fields():
    config = Config(gamma=0.5)
    for other in (copy.copy(config), pickle.loads(pickle.dumps(config)), dataclasses.replace(config)):
        assert other == config
    assert list(inspect.signature(Config).parameters) == [field.name for field in dataclasses.fields(Config)]


def test_a_subclass_may_have_attributes_of_its_own():
    class Named(Config):
        def __init__(self, name, **fields):
            super().__init__(**fields)
            self.name = name

    named = Named("a", gamma=0.9)
    assert (named.name, named.gamma) == ("a", 0.9)
    with pytest.raises(dataclasses.FrozenInstanceError, match=r"dataclasses\.replace"):
        named.gamma = 0.5
