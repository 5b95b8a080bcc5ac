"""Nonsense from an environment is never silent: it is an error or a warning that names it."""

import datetime
import fractions
import itertools
import warnings
from types import SimpleNamespace

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf
from gymnasium import spaces

from dqn_keras import Config, evaluate, make_q_network, study, train
from dqn_keras.checks.environments import CheckedEnv, check_spaces
from dqn_keras.checks.observations import StateWatch, as_float
from dqn_keras.cli.run_folder import EnvOptions
from dqn_keras.environments import Acrobot, CartPole, MountainCar
from dqn_keras.rendering import record_episode
from dqn_keras.replay import Experience, ReplayMemory
from tests.helpers.environments import Corridor

NOT_NUMBERS = {
    "text": np.array(["1", "2"]),
    "a list of text": ["1", "2"],
    "bytes": np.array([b"1", b"2"]),
    "dates": np.array(["2020-01-01", "2020-01-02"], "datetime64[s]"),
    "durations": np.array([1, 2], "timedelta64[s]"),
    "complex numbers": np.array([1 + 2j, 2]),
    "objects": np.array([1.0, 2.0], object),
    "None": [1.0, None],
    "a masked entry": np.ma.masked_array([1.0, 2.0], [False, True]),
    "rows of different lengths": [[1.0], [1.0, 2.0]],
    "a dictionary": {"a": 1.0},
}
NO_NUMBER = {
    "text": "1",
    "NumPy's text": np.str_("1"),
    "bytes": b"1",
    "NumPy's bytes": np.bytes_(b"1"),
    "a complex number": 1j,
    "NumPy's complex number": np.complex128(1),
    "None": None,
    "an array of one number": np.array([1.0]),
    "a list of one number": [1.0],
    "a tensor of one number": tf.constant([1.0]),
    "a masked number": np.ma.masked,
    "a duration": np.timedelta64(1, "s"),
    "a date": datetime.date(2020, 1, 1),
    "an array of one object": np.array(1.0, object),
}


@pytest.mark.parametrize("observation", NOT_NUMBERS.values(), ids=NOT_NUMBERS)
def test_an_observation_that_is_not_an_array_of_numbers_is_one_clear_error(observation):
    at_reset = CheckedEnv(Corridor(observe=lambda position, t: observation))
    wanted = r"^env Corridor: the observation must be an array of numbers, got .* in episode 3, "
    with pytest.raises(ValueError, match=wanted + "at the reset$"):
        at_reset.reset(0, episode=3)
    later = CheckedEnv(Corridor(observe=lambda position, t: observation if t else np.zeros(2)))
    later.reset(0, episode=3)
    with pytest.raises(ValueError, match=wanted + "step 0$"):
        later.step(1)


@pytest.mark.parametrize("reward", NO_NUMBER.values(), ids=NO_NUMBER)
def test_a_reward_that_is_not_a_number_is_one_clear_error(reward):
    env = CheckedEnv(Corridor(reward=lambda t: reward))
    env.reset(0, episode=3)
    with pytest.raises(ValueError, match=r"^env Corridor: the reward must be a number, got .* in episode 3, step 0$"):
        env.step(1)


def test_a_reward_beyond_all_floats_is_not_finite():
    env = CheckedEnv(Corridor(reward=lambda t: 10**400))
    env.reset(0, 0)
    with pytest.raises(ValueError, match=r"^env Corridor: the reward must be finite in float32, got inf in episode 0"):
        env.step(1)


def test_an_evaluation_and_a_recording_refuse_the_same():
    env, q_network = Corridor(reward=lambda t: np.array([1.0])), make_q_network(2, 2, seed=0)
    env.render_mode, env.render = "rgb_array", lambda: np.zeros((2, 2, 3), np.uint8)
    for play in evaluate, record_episode:
        with pytest.raises(
            ValueError, match=r"the reward must be a number, got array\(\[1\.\]\) in episode 0, step 0$"
        ):
            play(env, q_network, seed=0)


@pytest.mark.parametrize(
    "reward",
    [2, 2.0, np.float32(2), np.int8(2), np.uint64(2), np.array(2.0), tf.constant(2.0), fractions.Fraction(2)],
    ids=repr,
)
def test_any_single_number_is_a_reward(reward):
    assert as_float(reward) == 2.0


@pytest.mark.parametrize(
    "observation",
    [
        [2, 1],
        (2.0, np.float64(1)),
        np.array([2, 1], np.int8),
        np.array([2, 1], np.float16),
        np.ma.masked_array([2, 1]),
        tf.constant([2, 1], tf.bfloat16),
    ],
    ids=repr,
)
def test_any_array_of_numbers_is_an_observation(observation):
    state = CheckedEnv(Corridor(observe=lambda position, t: observation)).reset(0, 0)
    assert type(state) is np.ndarray
    assert state.dtype == np.float32
    assert state.tolist() == [2, 1]


def test_a_large_observation_is_named_but_not_printed_whole():
    observation = np.arange(10_000.0).reshape(100, 100)
    observation[3, 40] = np.nan
    space = spaces.Box(-np.inf, np.inf, (100, 100))
    for wanted, returned in {
        "must be an array of numbers": observation.astype(str),
        r"\(3, 40\) is not": observation,
    }.items():
        env = CheckedEnv(Corridor(observation_space=space, observe=lambda position, t, returned=returned: returned))
        with pytest.raises(ValueError, match=wanted) as caught:
            env.reset(0, 0)
        assert len(str(caught.value)) < 400


BOX = spaces.Box(-np.inf, np.inf, (2,))
FEW = Config(num_episodes=3, batch_size=16)


def warnings_in(env, config=FEW, **parts):
    """Returns the warnings of a short run."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        train(env, config, seed=0, verbose=0, **parts)
    return [str(x.message) for x in caught if x.category is UserWarning]


def warnings_about(states, space, is_default_network=False):
    """Returns the warnings of a StateWatch that sees these states."""
    watch, memory = StateWatch("name", space, is_default_network), ReplayMemory(len(states) - 1, space.shape)
    for state, next_state in itertools.pairwise(states):
        memory.append(Experience(state, 0, 0.0, next_state, False))
        watch.see(state, {})
    last = SimpleNamespace(number=0)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert list(watch.over([last], SimpleNamespace(memory=memory, is_done=bool), True)) == [last]
    return [str(x.message) for x in caught]


def moving(second, space=BOX, limit=50):
    """Returns an environment whose feature 1 is `second(t)`, where t counts all steps."""
    env = Corridor(length=10**6, limit=limit, observation_space=space)
    env.num_seen = 0

    def observe(position, t):
        env.num_seen += 1
        return np.array([position / 50, second(env.num_seen)])

    env._observe = observe
    return env


def own_network(scale=1.0):
    return keras.Sequential([keras.Input((2,)), keras.layers.Rescaling(scale), keras.layers.Dense(2)])


class Functional(CartPole):
    """CartPole with feature 1 multiplied by a factor."""

    def __init__(self, factor, observation_space=None):
        super().__init__()
        self.factor = factor
        self.observation_space = observation_space or self.observation_space

    def observation(self, state, rng, params=None):
        return super().observation(state, rng, params) * [1.0, self.factor, 1.0, 1.0]


def test_an_observation_far_outside_its_space_is_one_warning():
    (message,) = warnings_in(moving(lambda t: 42.0 + (t == 60), spaces.Box(0, np.array([5, 3.0]), dtype=np.float64)))
    assert message.startswith("env Corridor: feature 1 was 43 in an observation, far outside the bounds 0 and 3 of env")


@pytest.mark.parametrize(
    ("low", "high", "value", "is_far"),
    [
        (-1, 1, 20.9, False),
        (-1, 1, 21.1, True),
        (-1, 1, -21.1, True),
        (0, np.inf, -9, False),
        (0, np.inf, -11, True),
        (-np.inf, 20, 219, False),
        (-np.inf, 20, 221, True),
        (5, 5, 54, False),
        (5, 5, 56, True),
        (-np.inf, np.inf, 1e30, False),
        (-3.4e38, 3.4e38, -3e38, False),
    ],
)
def test_far_is_ten_times_the_distance_between_the_bounds(low, high, value, is_far):
    space = spaces.Box(np.array([-1, low]), np.array([1, high]), dtype=np.float64)
    inside = np.array([0.0, np.clip(0, low, high)])
    messages = warnings_about([inside, np.array([0, value]), inside], space)
    assert [("feature 1 was" in message) for message in messages] == [True] * is_far


NEVER_TOLD = ["CartPole-v1", "Acrobot-v1", "MountainCar-v0", "Pendulum-v1", "LunarLander-v3"]
NEVER_TOLD_FLATTENED = ["FrozenLake-v1", "Blackjack-v1"]


@pytest.mark.parametrize("name", NEVER_TOLD + NEVER_TOLD_FLATTENED)
def test_gymnasiums_environments_give_no_warning(name):
    if "Lander" in name:
        pytest.importorskip("Box2D")
    env = gym.make(name)
    if name in NEVER_TOLD_FLATTENED:
        env = gym.wrappers.FlattenObservation(env)
    env.action_space.seed(0)
    last = env.action_space.high if name == "Pendulum-v1" else env.action_space.n - 1
    for choose in env.action_space.sample, lambda: 0 * last, lambda: last:
        states, is_over = [], True
        while len(states) < 1_000:
            if is_over:
                state, is_over = env.reset(seed=len(states))[0], False
            else:
                state, _, terminated, truncated, _ = env.step(choose())
                is_over = terminated or truncated
            states.append(state)
        assert not warnings_about(states, env.observation_space, is_default_network=True)


def test_a_lander_that_flies_away_gives_no_warning():
    pytest.importorskip("Box2D")
    env = gym.make("LunarLander-v3")
    highest = 0
    for seed in range(20):
        states, is_over = [env.reset(seed=seed)[0]], False
        while not is_over:
            state, _, terminated, truncated, _ = env.step(2)  # its main engine
            is_over = terminated or truncated
            states.append(state)
        highest = max(highest, *(state[1] for state in states))
        assert not warnings_about(states, env.observation_space, is_default_network=True)
    assert highest > 10  # the bound is 2.5


@pytest.mark.slow
@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("twin", [CartPole, Acrobot, MountainCar])
def test_the_twins_give_no_warning(twin):
    train(twin(), Config(num_episodes=100, max_steps=100), seed=0, verbose=0)


ROUNDED = {
    "seconds since 1970": (lambda t: 1.7e9 + t, True),
    "minutes in seconds since 1970": (lambda t: 1.7e9 + 60.0 * t, True),
    "nanoseconds since 1970": (lambda t: 1.7e18 + 1e9 * t, True),
    "small steps around 1": (lambda t: 1 + 1e-8 * np.sin(t), True),
    "a clock from 0": (lambda t: 0.02 * t, False),
    "a value that converges": (lambda t: 1 + np.exp(-t), False),
    "a constant": (lambda t: 1.7e9, False),
    "a constant up to rounding": (lambda t: np.sin(t) ** 2 + np.cos(t) ** 2, False),
    "noise": (lambda t: 1000 + np.sin(t**2), False),
}


@pytest.mark.parametrize(("second", "is_lost"), ROUNDED.values(), ids=ROUNDED)
def test_changes_that_float32_loses_are_one_warning(second, is_lost):
    messages = warnings_about([np.array([t % 50, second(t)]) for t in range(1_000)], BOX)
    assert len(messages) == is_lost
    for message in messages:
        assert message.startswith("env name: feature 1 of the observations changes in steps that are lost in float32")
        assert "subtract an offset from it" in message


def test_a_run_on_a_clock_is_one_warning():
    (message,) = warnings_in(moving(lambda t: 1.7e9 + t), q_network=own_network(0.0))
    assert message.startswith("env Corridor: feature 1 of the observations changes in steps that are lost in float32")


@pytest.mark.parametrize("dtype", [np.float32, np.int16, np.uint8, bool])
def test_numbers_that_float32_holds_exactly_are_not_collected(dtype):
    watch = StateWatch("name", BOX, is_default_network=True)
    watch.see(np.zeros(2, dtype), {})
    assert not watch._precise


def test_unscaled_observations_in_the_default_network_are_one_warning():
    (message,) = warnings_in(moving(lambda t: 101.0))
    assert message.startswith("env Corridor: observations are beyond 100 in size (feature 1), but the default network")
    assert "keras.layers.Rescaling" in message
    assert not warnings_in(moving(lambda t: 99.0))
    assert not warnings_in(moving(lambda t: 101.0), q_network=own_network())


def test_uint8_observations_in_the_default_network_are_one_warning():
    space = spaces.Box(0, 255, (5,), np.uint8)
    (message,) = warnings_in(
        Corridor(limit=50, observation_space=space, observe=lambda position, t: np.full(5, t, np.uint8))
    )
    assert message.startswith("env Corridor: observations are uint8 (feature 0, feature 1, feature 2, ...), but the")
    assert not warnings_in(
        Corridor(limit=50, observation_space=space, observe=lambda p, t: np.full(5, t % 2, np.uint8))
    )


@pytest.mark.slow
def test_the_states_of_compiled_episodes_are_looked_at_too():
    with pytest.warns(UserWarning, match="^env Functional: ") as caught:
        train(Functional(500.0, spaces.Box(-1, 1, (4,))), Config(num_episodes=60), seed=0, verbose=0)
    outside, unscaled = (str(x.message) for x in caught)
    assert "feature 1 was" in outside
    assert "far outside the bounds -1 and 1 of env.observation_space" in outside
    assert "observations are beyond 100 in size (feature 1), but the default network" in unscaled


def test_a_run_that_diverges_before_that_is_warned_first():
    env = moving(lambda t: 1e30)
    with pytest.warns(UserWarning, match="beyond 100 in size"), pytest.raises(ValueError, match="diverged"):
        train(env, Config(num_episodes=50, batch_size=16), seed=0, verbose=0)


class Masked(Corridor):
    """Returns an action mask, at the reset or at the steps."""

    def __init__(self, at_reset):
        super().__init__(limit=50)
        self.at_reset = at_reset

    def reset(self, *, seed=None, options=None):
        observation, info = super().reset(seed=seed)
        return observation, {"action_mask": np.ones(2)} if self.at_reset else info

    def step(self, action):
        *others, info = super().step(action)
        return *others, info if self.at_reset else {"action_mask": np.ones(2)}


@pytest.mark.parametrize("at_reset", [True, False])
def test_an_action_mask_is_one_warning_that_it_is_ignored(at_reset):
    (message,) = warnings_in(Masked(at_reset))
    assert message == "env Masked: info['action_mask'] is ignored: any action may be taken in any state"


def test_only_the_first_thousand_states_are_watched():
    seen = []

    class Counting(StateWatch):
        def see(self, observation, info):
            seen.append(observation)
            return super().see(observation, info)

    env = CheckedEnv(moving(lambda t: 0.0), Counting("name", BOX, is_default_network=True))
    for episode in range(30):
        env.reset(0, episode)
        for _ in range(50):
            env.step(0)
    assert len(seen) == 1_000


def test_the_warnings_point_at_the_line_that_calls_train_or_study():
    listener, env = keras.callbacks.Callback(), moving(lambda t: 101.0)
    calls = [
        lambda: train(env, FEW, seed=0, verbose=0),
        lambda: train(env, FEW, seed=0, verbose=0, callbacks=listener),
        lambda: train(Masked(at_reset=False), FEW, seed=0, verbose=0),
        lambda: study(env, Config(num_episodes=50, batch_size=16), [0], num_workers=1, verbose=0),
    ]
    for call in calls:
        with pytest.warns(UserWarning, match=r"beyond 100|is ignored") as caught:
            call()
        assert [(x.filename, x.lineno) for x in caught] == [(__file__, call.__code__.co_firstlineno)]


class Mission(gym.Space):
    """A space that Gymnasium does not know, such as MiniGrid's."""

    def __init__(self):
        super().__init__((), str)

    is_np_flattenable = False

    def sample(self, mask=None, probability=None):
        return "go to the door"


class Grid(gym.Env):
    """An environment with any observations."""

    action_space = spaces.Discrete(3)

    def __init__(self, observation_space):
        self.observation_space = observation_space

    def reset(self, *, seed=None, options=None):
        return self.observation_space.sample(), {}


IMAGE = spaces.Box(0, 255, (7, 7, 3), np.uint8)
FLATTEN = "gymnasium.wrappers.FlattenObservation(env)"
WAYS = {
    "MiniGrid's": (
        spaces.Dict(image=IMAGE, direction=spaces.Discrete(4), mission=Mission()),
        "gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FilterObservation(env, ['image', 'direction']))",
    ),
    "a Dict with Text": (
        spaces.Dict(image=IMAGE, mission=spaces.Text(20)),
        "gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FilterObservation(env, ['image']))",
    ),
    "a Tuple with a Sequence": (
        spaces.Tuple([spaces.Sequence(spaces.Discrete(2)), spaces.Discrete(3)]),
        "gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FilterObservation(env, [1]))",
    ),
    "a Dict with an empty Box": (
        spaces.Dict(a=spaces.Box(0, 1, (0,)), b=IMAGE),
        "gymnasium.wrappers.FlattenObservation(gymnasium.wrappers.FilterObservation(env, ['b']))",
    ),
    "Discrete": (spaces.Discrete(5), FLATTEN),
    "a Box of no axis": (spaces.Box(0, 1, ()), FLATTEN),
    "Text": (spaces.Text(5), FLATTEN),
    "a Dict of numbers": (spaces.Dict(a=spaces.MultiBinary(3), b=IMAGE), FLATTEN),
    "an empty Box": (spaces.Box(0, 1, (0,)), None),
    "an empty Dict": (spaces.Dict({}), None),
    "a Sequence": (spaces.Sequence(spaces.Discrete(2)), None),
    "a huge Discrete": (spaces.Discrete(10**12), None),
    "an unknown space": (Mission(), None),
    "a Dict of nothing useful": (spaces.Dict(a=Mission(), b=spaces.Box(0, 1, (0,))), None),
}


@pytest.mark.parametrize(("space", "way"), WAYS.values(), ids=WAYS)
def test_the_wrapper_that_is_named_for_a_space_works(space, way):
    env = Grid(space)
    with pytest.raises(ValueError, match=r"^env Grid has the observation space") as caught:
        check_spaces("Grid", env.observation_space, env.action_space)
    if way is None:
        assert "a gymnasium.ObservationWrapper of your own can" in str(caught.value)
        assert "FlattenObservation" not in str(caught.value)
        return
    assert f"(use {way}" in str(caught.value)
    wrapped = CheckedEnv(eval(way, {"gymnasium": gym, "env": env}))
    assert wrapped.reset(0, 0).shape == wrapped.spaces.state_shape


@pytest.mark.parametrize("name", [name for name in WAYS if name != "an empty Dict"])  # gymnasium.make refuses that one
def test_the_command_line_flattens_what_can_be_flattened_and_says_what_cannot(name, monkeypatch):
    monkeypatch.setitem(gym.registry, "Grid-v0", gym.envs.registration.EnvSpec("Grid-v0", entry_point=Grid))
    space, way = WAYS[name]
    plain, flat = (EnvOptions("Grid-v0", {"observation_space": space}, flatten, compiled=False) for flatten in (0, 1))
    is_possible = way is not None and name not in ("MiniGrid's", "a Tuple with a Sequence")
    if is_possible:
        assert len(flat.make().observation_space.shape) == 1
    else:
        with pytest.raises(ValueError, match=r"^Grid-v0 has the observation space .*; (use gymnasium\.|no wrapper)"):
            flat.make()
    if not isinstance(space, spaces.Box):
        hint = "use --flatten$" if is_possible else r"(use gymnasium\.|no wrapper)"
        with pytest.raises(ValueError, match=rf"^Grid-v0 has the observation space .*; {hint}"):
            plain.make()


NO_ENVS = {
    "a name": ("CartPole-v1", r"'CartPole-v1'; use gymnasium\.make\(\"CartPole-v1\"\)$"),
    "a spec": (gym.spec("CartPole-v1"), r"the EnvSpec of CartPole-v1; use gymnasium\.make\(spec\)$"),
    "a class": (Corridor, r"the class Corridor; use Corridor\(\)$"),
    "a functional class": (CartPole, r"the class CartPole; use CartPole\(\)$"),
    "a vector environment": (
        gym.make_vec("CartPole-v1", 2),
        r"the vector environment .*; use gymnasium\.make: only one environment is played at a time$",
    ),
    "nothing": (None, "None$"),
}


@pytest.mark.parametrize(("thing", "hint"), NO_ENVS.values(), ids=NO_ENVS)
def test_what_is_not_an_environment_is_an_error_that_says_how_to_make_one(thing, hint):
    with pytest.raises(TypeError, match=r"^env must be a gymnasium\.Env or a FuncEnv, got " + hint):
        train(thing)
    with pytest.raises(TypeError, match=r"^env must be a gymnasium\.Env, got " + hint):
        evaluate(thing, make_q_network(4, 2, seed=0))


FUNCTIONS = {
    "complex observations": (
        "observation",
        lambda: tf.zeros([4], tf.complex64),
        "observation must be of numbers, got c",
    ),
    "text as reward": ("reward", lambda: tf.constant("1"), "reward must be of numbers, got string"),
}


@pytest.mark.parametrize(("part", "value", "message"), FUNCTIONS.values(), ids=FUNCTIONS)
def test_a_functional_environment_must_return_numbers(part, value, message):
    env = Functional(1.0)
    setattr(env, part, lambda *args: value())
    with pytest.raises(ValueError, match=f"^env Functional: {message}"):
        train(env, verbose=0)


def test_a_functional_environment_must_return_uint8_if_its_space_says_so():
    network = make_q_network(4, 2, seed=0)
    with pytest.raises(
        ValueError, match=r"^env Functional: observation must be of dtype uint8, as its space says, got fl"
    ):
        train(Functional(1.0, spaces.Box(0, 255, (4,), np.uint8)), q_network=network, verbose=0)
