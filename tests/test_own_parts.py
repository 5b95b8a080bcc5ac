"""The user's own environment, network and loss."""

import random

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf
from gymnasium.experimental.functional import FuncEnv
from gymnasium.wrappers import FlattenObservation, TimeLimit

from dqn_keras import Config, Experience, ReplayMemory, evaluate, load_q_network, make_networks, train
from dqn_keras.environments import CartPole
from dqn_keras.replay import pack, unpack
from tests.helpers.environments import Corridor

QUICK = Config(num_episodes=6, batch_size=16, max_steps=40, solved_reward=1e6)


class Beacon(gym.Env):
    """Shows which of three actions gives 1 by one lit pixel of three; an episode is ten such pictures."""

    observation_space = gym.spaces.Box(0, 255, (6, 6, 1), np.uint8)
    action_space = gym.spaces.Discrete(3)

    def _picture(self):
        self.lit = int(self.np_random.integers(3))
        picture = np.zeros((6, 6, 1), np.uint8)
        picture[2 * self.lit : 2 * self.lit + 2] = 255
        return picture

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return self._picture(), {}

    def step(self, action):
        self.t += 1
        reward = float(action == self.lit)
        return self._picture(), reward, self.t == 10, False, {}


def convolutional(num_actions=3, shape=(6, 6, 1)):
    return keras.Sequential(
        [
            keras.Input(shape, dtype="uint8"),
            keras.layers.Rescaling(1 / 255),
            keras.layers.Conv2D(16, 2, strides=2, activation="relu", kernel_initializer=glorot(3)),
            keras.layers.Flatten(),
            keras.layers.Dense(num_actions, kernel_initializer=glorot(2)),
        ]
    )


def glorot(seed):
    return keras.initializers.GlorotUniform(seed=seed)


def tanh_network(num_features=4, num_actions=2):
    """Returns a functional model, which acting in NumPy cannot compute."""
    inputs = keras.Input((num_features,))
    hidden = keras.layers.Dense(16, activation="tanh", kernel_initializer=glorot(1))(inputs)
    both = keras.layers.Concatenate()([hidden, inputs])
    return keras.Model(inputs, keras.layers.Dense(num_actions, kernel_initializer=glorot(2))(both))


def weights(run):
    return np.concatenate([w.ravel() for w in [*run.q_network.get_weights(), *run.q_hat_network.get_weights()]])


# Environments


@pytest.mark.slow
@pytest.mark.parametrize(
    "make_env",
    [
        lambda: gym.make("Acrobot-v1"),
        lambda: gym.make("LunarLander-v3"),
        lambda: FlattenObservation(gym.make("FrozenLake-v1", is_slippery=False)),
        lambda: FlattenObservation(gym.make("Blackjack-v1")),
        lambda: gym.wrappers.RescaleObservation(gym.make("MountainCar-v0"), np.float32(-1), np.float32(1)),
    ],
    ids=["Acrobot", "LunarLander", "FrozenLake", "a tuple of Discretes", "a wrapper"],
)
def test_gymnasiums_environments_train(make_env):
    env = make_env()
    run = train(env, Config(num_episodes=60, batch_size=16, max_steps=40), seed=0, verbose=0)
    assert run.agent.num_updates > 10
    assert np.isfinite(evaluate(env, run.q_network, 2, seed=0, max_steps=40)).all()


@pytest.mark.slow
def test_frozen_lake_is_solved():
    # Without slipping, the way over the ice gives 1 every time; three seeds show that it is not luck.
    config = Config(num_episodes=600, gamma=0.9, epsilon_min=0.01, decay=0.99, solved_reward=0.9, tau=0.05)
    for seed in range(3):
        env = FlattenObservation(gym.make("FrozenLake-v1", is_slippery=False))
        assert train(env, config, seed=seed, verbose=0).solved_at is not None


def test_discrete_observations_are_an_error_that_says_what_to_do():
    with pytest.raises(ValueError, match=r"env FrozenLake-v1 has .* Discrete\(16\); .*FlattenObservation\(env\)"):
        train(gym.make("FrozenLake-v1"))


def test_an_own_time_limit_truncates():
    run = train(TimeLimit(Corridor(length=50), 7), Config(num_episodes=4, batch_size=4), seed=0, verbose=0)
    assert [e.steps for e in run.episodes] == [7] * 4
    assert not any(e.terminated for e in run.episodes)


# Networks


@pytest.mark.slow
@pytest.mark.parametrize("make_env", [lambda: gym.make("CartPole-v1"), CartPole], ids=["Gymnasium", "compiled"])
def test_an_own_network_is_trained_in_place(make_env):
    network = tanh_network()
    before = network.get_weights()
    seen = []
    copies = keras.callbacks.LambdaCallback(on_train_begin=lambda logs: seen.append(network.get_weights()))
    run = train(make_env(), QUICK, seed=0, q_network=network, callbacks=[copies], verbose=0)
    assert run.q_network is network
    assert all(map(np.array_equal, before, seen[0]))
    assert run.agent.num_updates > 0
    assert not any(map(np.array_equal, before, network.get_weights()))
    again = train(make_env(), QUICK, seed=0, q_network=tanh_network(), verbose=0)
    np.testing.assert_array_equal(weights(run), weights(again))


def test_q_hat_starts_as_an_equal_copy_that_does_not_follow_q():
    config = Config(num_episodes=3, max_steps=4, batch_size=2, tau=1e-9)
    run = train(gym.make("CartPole-v1"), config, seed=0, q_network=tanh_network(), verbose=0)
    for start, hat, q in zip(
        tanh_network().get_weights(), run.q_hat_network.get_weights(), run.q_network.get_weights(), strict=True
    ):
        np.testing.assert_allclose(hat, start, atol=1e-8)
        assert not np.array_equal(q, start)


def test_the_default_network_given_from_outside_is_the_default_run(cartpole):
    ours = train(cartpole, QUICK, seed=4, verbose=0)
    q_network, _ = make_networks(4, 2, seed=np.random.SeedSequence(4, spawn_key=(0,)))
    theirs = train(cartpole, QUICK, seed=4, q_network=q_network, verbose=0)
    np.testing.assert_array_equal(weights(ours), weights(theirs))


def test_a_network_that_numpy_cannot_compute_learns_the_same_as_one_that_it_can(cartpole):
    """Compares Dense(relu), which acts in NumPy, with Dense and a ReLU layer, which act in TensorFlow."""
    q_network = keras.Sequential([keras.Input((4,)), keras.layers.Dense(64, "relu"), keras.layers.Dense(2)])
    apart = keras.Sequential(
        [keras.Input((4,)), keras.layers.Dense(64), keras.layers.ReLU(), keras.layers.Dense(2, name="values")]
    )
    apart.set_weights(q_network.get_weights())
    config = Config(num_episodes=30, batch_size=16, solved_reward=1e6)
    first, second = (train(cartpole, config, seed=0, q_network=x, verbose=0) for x in (q_network, apart))
    np.testing.assert_array_equal(first.rewards, second.rewards)
    np.testing.assert_allclose(weights(first), weights(second), atol=1e-4)


@pytest.mark.slow
def test_a_convolutional_network_learns_from_images():
    config = Config(num_episodes=200, steps_per_update=1, decay=0.97, gamma=0.0, alpha=0.003, solved_reward=8.5)
    for seed in range(2):  # chance gives 3.3 of 10, and exploring at 0.1 costs 0.7
        run = train(Beacon(), config, seed=seed, q_network=convolutional(), verbose=0)
        assert run.solved_at is not None
        assert evaluate(Beacon(), run.q_network, 5, seed=0).mean() > 9.5
    assert run.agent.memory.rows.dtype == np.uint8
    assert run.agent.memory.sample(4, np.random.default_rng(0)).state.dtype == np.uint8


class FunctionalBeacon(FuncEnv):
    """The same environment, in TensorFlow."""

    observation_space, action_space, max_episode_steps = Beacon.observation_space, Beacon.action_space, 10

    def initial(self, rng, params=None):
        return tf.random.stateless_uniform([], rng, 0, 3, tf.int32)

    def transition(self, state, action, rng, params=None):
        return tf.random.stateless_uniform([], rng, 0, 3, tf.int32)

    def observation(self, state, rng, params=None):
        return tf.cast(tf.where(tf.range(6)[:, None, None] // 2 == state, tf.ones([6, 6, 1]) * 255, 0), tf.uint8)

    def reward(self, state, action, next_state, rng, params=None):
        return tf.cast(action == state, tf.float32)

    def terminal(self, state, rng, params=None):
        return tf.constant(False)


@pytest.mark.slow
def test_images_of_a_functional_environment_are_learned_from_in_compiled_episodes():
    config = Config(num_episodes=200, steps_per_update=1, decay=0.97, gamma=0.0, alpha=0.003, solved_reward=8.5)
    run = train(FunctionalBeacon(), config, seed=0, q_network=convolutional(), verbose=0)
    assert run.solved_at is not None
    assert evaluate(Beacon(), run.q_network, 5, seed=0).mean() > 9.5
    memory = run.agent.memory
    batch = unpack(memory.rows[: len(memory)], memory.state_shape)
    assert memory.rows.dtype == np.uint8
    np.testing.assert_array_equal(batch.reward, batch.action == batch.state[:, ::2, 0, 0].argmax(axis=1))
    np.testing.assert_array_equal(batch.state[1:10], batch.next_state[:9])


@pytest.mark.slow
def test_a_run_with_an_own_network_is_saved_and_resumed(tmp_path):
    whole = train(Beacon(), QUICK, seed=0, q_network=convolutional(), verbose=0)
    part = Config(**{**vars(QUICK), "num_episodes": 3})
    train(Beacon(), part, seed=0, q_network=convolutional(), checkpoint=tmp_path / "run", verbose=0)
    # The layers of a network that is made later have other names.
    run = train(Beacon(), QUICK, seed=0, q_network=convolutional(), checkpoint=tmp_path / "run", resume=True, verbose=0)
    np.testing.assert_array_equal(weights(run), weights(whole))
    np.testing.assert_array_equal(run.agent.memory.rows, whole.agent.memory.rows)
    run.save(tmp_path / "agent.keras")
    assert evaluate(Beacon(), load_q_network(tmp_path / "agent.keras"), 2, seed=1).tolist() == (
        evaluate(Beacon(), run.q_network, 2, seed=1).tolist()
    )
    other = keras.Sequential([keras.Input((6, 6, 1)), keras.layers.Flatten(), keras.layers.Dense(3)])
    with pytest.raises(ValueError, match=r"^q_network is 'Rescaling, Conv2D, Flatten, Dense .*, got 'Flatten, Dense "):
        train(Beacon(), QUICK, seed=0, q_network=other, checkpoint=tmp_path / "run", resume=True)


def dueling():
    """Returns a dueling network, with an operation that is not a layer."""
    inputs = keras.Input((4,))
    hidden = keras.layers.Dense(8, activation="relu", kernel_initializer=glorot(1))(inputs)
    value, advantage = (keras.layers.Dense(n, kernel_initializer=glorot(n))(hidden) for n in (1, 2))
    return keras.Model(inputs, value + advantage - keras.ops.mean(advantage, axis=-1, keepdims=True))


@pytest.mark.slow
def test_equal_networks_are_the_same_to_a_checkpoint_whatever_they_are_called(cartpole, tmp_path):
    first, second = dueling(), dueling()
    whole = train(cartpole, QUICK, seed=0, q_network=first, verbose=0)
    run = train(cartpole, QUICK, seed=0, q_network=second, checkpoint=tmp_path, verbose=0)
    np.testing.assert_array_equal(weights(run), weights(whole))
    train(cartpole, QUICK, seed=0, q_network=dueling(), checkpoint=tmp_path, resume=True, verbose=0)


@pytest.mark.slow
def test_networks_that_differ_are_told_apart_whatever_they_are_called(cartpole, tmp_path):
    def named(activation):
        hidden = keras.layers.Dense(8, activation, name=activation)
        return keras.Sequential([keras.Input((4,)), hidden, keras.layers.Dense(2)])

    train(cartpole, QUICK, seed=0, q_network=named("tanh"), checkpoint=tmp_path, verbose=0)
    with pytest.raises(ValueError, match=r"^q_network is 'Dense, Dense .*, got one .* computes something else"):
        train(cartpole, QUICK, seed=0, q_network=named("sigmoid"), checkpoint=tmp_path, resume=True, verbose=0)


@pytest.mark.slow
def test_a_layer_that_is_defined_again_is_traced_again(cartpole):
    def train_with(function):
        class Bend(keras.layers.Layer):
            def call(self, inputs):
                return function(inputs)

        network = keras.Sequential(
            [
                keras.Input((4,)),
                keras.layers.Dense(8, kernel_initializer=glorot(1)),
                Bend(),
                keras.layers.Dense(2, kernel_initializer=glorot(2)),
            ]
        )
        return weights(train(cartpole, QUICK, seed=0, q_network=network, verbose=0))

    assert not np.array_equal(train_with(tf.nn.relu), train_with(tf.sin))


def test_a_network_of_an_unregistered_class_is_refused_when_it_is_saved(cartpole, tmp_path):
    class Unregistered(keras.layers.Layer):
        def call(self, inputs):
            return inputs

    network = keras.Sequential([keras.Input((4,)), Unregistered(), keras.layers.Dense(2)])
    run = train(cartpole, QUICK, seed=0, q_network=network, verbose=0)
    with pytest.raises(ValueError, match=r"^q_network has a layer that cannot be saved: .*register_keras_serializable"):
        run.save(tmp_path / "agent.keras")


def test_pythons_random_state_is_left_alone(cartpole, tmp_path):
    network = keras.Sequential([keras.Input((4,)), keras.layers.Dense(8, "tanh"), keras.layers.Dense(2)])
    before = random.getstate()
    train(cartpole, QUICK, seed=0, q_network=network, verbose=0).save(tmp_path / "agent.keras")
    assert random.getstate() == before


def subclassed():
    class Own(keras.Model):
        def call(self, states):
            return states

    return Own()


@pytest.mark.parametrize(
    ("network", "error", "message"),
    [
        (lambda: tanh_network(4, 3), ValueError, r"must map states of shape \(4,\) to 2 actions, got .* output \(3,\)"),
        (lambda: tanh_network(5, 2), ValueError, r"must map states of shape \(4,\) to 2 actions, got input \(5,\)"),
        (lambda: convolutional(2), ValueError, r"must map states of shape \(4,\) .*, got input \(6, 6, 1\)"),
        (lambda: keras.Sequential([keras.layers.Dense(2)]), ValueError, "must be a Sequential or functional model"),
        (subclassed, ValueError, "must be a Sequential or functional model with an Input layer"),
        (lambda: keras.Sequential([keras.Input((2,)), keras.layers.Identity()]), ValueError, "must map states"),
        (
            lambda: keras.Sequential([keras.Input(batch_shape=(64, 4)), keras.layers.Dense(2)]),
            ValueError,
            r"must map .* got input \(64, 4\) and output \(64, 2\)",
        ),
        (lambda: "mlp", TypeError, "must be a Keras model, got 'mlp'"),
        (
            lambda: keras.Sequential([keras.Input((4,)), keras.layers.Dense(2, dtype="float16")]),
            ValueError,
            "must give float32 values, got float16",
        ),
    ],
)
def test_a_network_that_does_not_fit_is_refused(cartpole, network, error, message):
    with pytest.raises(error, match=f"^q_network {message}"):
        train(cartpole, q_network=network())


def test_an_observation_that_is_not_uint8_as_promised_is_an_error():
    class Wrong(Beacon):
        def step(self, action):
            picture, *others = super().step(action)
            return picture / 255, *others

    with pytest.raises(ValueError, match=r"env Wrong: the observation must be of dtype uint8.*float64"):
        train(Wrong(), seed=0, q_network=convolutional(), verbose=0)


@pytest.mark.parametrize("dtype", [np.float32, np.uint8])
def test_rows_hold_images_exactly(dtype, rng):
    memory = ReplayMemory(5, (2, 3), dtype)
    kept = []
    for i in range(8):
        state, next_state = rng.integers(256, size=(2, 2, 3)).astype(dtype)
        kept.append(Experience(state, i % 3, np.float32(rng.normal()), next_state, i % 2))
        memory.append(kept[-1])
    kept = kept[-5:]
    rows = np.roll(memory.rows, -3, axis=0)
    for batch in (unpack(rows, (2, 3)), [x.numpy() for x in unpack(tf.constant(rows), (2, 3))]):
        for column, values in zip(batch, zip(*kept, strict=True), strict=True):
            np.testing.assert_array_equal(column, np.array(values))
    state, a, reward, next_state, terminal = kept[0]
    packed = pack(Experience(tf.constant(state), a, reward, tf.constant(next_state), bool(terminal)))
    np.testing.assert_array_equal(packed.numpy(), rows[0])


def test_bad_memories_are_refused():
    with pytest.raises(ValueError, match=r"^dtype must be np.float32 or np.uint8"):
        ReplayMemory(5, (2,), np.int64)
    with pytest.raises(TypeError, match=r"^state_shape must be a list or tuple"):
        ReplayMemory(5, 2)
