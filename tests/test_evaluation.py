import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf
from gymnasium.experimental.functional import FuncEnv

from dqn_keras import Config, evaluate, make_q_network, train
from dqn_keras.environments import CartPole
from dqn_keras.loops.draws import episode_key, reset_rng
from dqn_keras.seeding import evaluation_key
from tests.helpers.environments import Corridor


def always(action):
    network = make_q_network(2, 2, seed=0)
    network.set_weights([*[np.zeros_like(w) for w in network.get_weights()[:-1]], np.eye(2)[action]])
    return network


def test_returns_are_undiscounted_sums_of_greedy_episodes():
    env = Corridor(length=5, reward=lambda t: t)
    np.testing.assert_array_equal(evaluate(env, always(1), num_episodes=3, seed=0), [10.0, 10.0, 10.0])
    assert env.actions == [1] * 15


def test_an_episode_that_never_ends_is_cut_short():
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


@pytest.mark.slow
def test_greedy_episodes_of_a_functional_environment_replayed_in_gymnasium_agree(cartpole):
    network = train(CartPole(), Config(num_episodes=150), seed=0, verbose=0).q_network
    returns = evaluate(CartPole(), network, 30, seed=4)
    initial = tf.function(CartPole().initial, jit_compile=True)
    replayed = []
    for episode in range(30):
        cartpole.reset(seed=0)
        cartpole.unwrapped.state = initial(reset_rng(episode_key(evaluation_key(4), tf.constant(episode)))).numpy()
        state, total, is_over = np.array(cartpole.unwrapped.state, np.float32), 0.0, False
        while not is_over:
            state, reward, terminated, truncated, _ = cartpole.step(int(network(state[None]).numpy().argmax()))
            total, is_over = total + reward, terminated or truncated
        replayed.append(total)
    assert len(set(returns)) > 5
    assert np.mean(returns == replayed) > 0.9  # the last bits of two Q-values may decide otherwise


def test_functional_episodes_are_cut_by_max_steps_and_repeat():
    network = make_q_network(4, 2, seed=0)
    assert (evaluate(CartPole(), network, 5, seed=0, max_steps=3) == 3).all()
    first, again, other = (evaluate(CartPole(), network, 20, seed=seed) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_an_own_network_and_environment_are_evaluated_as_they_are():
    own = keras.Sequential([keras.Input((1,)), keras.layers.Dense(2, activation="tanh")])
    own.set_weights([np.zeros((1, 2)), np.array([0.0, 1.0])])  # always the action of index 1
    assert evaluate(Paying(), own, 3, seed=0).tolist() == [6.0] * 3
    Paying.amount = 2.0
    assert evaluate(Paying(), own, 3, seed=0).tolist() == [12.0] * 3
    own.set_weights([np.zeros((1, 2)), np.array([1.0, 0.0])])
    assert evaluate(Paying(), own, 3, seed=0, max_steps=9).tolist() == [0.0] * 3


class Paying(FuncEnv):
    """Gives the reward `amount` for action 8 and ends after six of these; the actions are 7 and 8."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(2, start=7)
    amount = 1.0

    def initial(self, rng, params=None):
        return tf.constant(0.0)

    def transition(self, state, action, rng, params=None):
        return state + tf.cast(action == 8, tf.float32)

    def observation(self, state, rng, params=None):
        return state[None]

    def reward(self, state, action, next_state, rng, params=None):
        return self.amount * tf.cast(action == 8, tf.float32)

    def terminal(self, state, rng, params=None):
        return state >= 6


class Bad(Paying):
    def observation(self, state, rng, params=None):
        return tf.where(state >= 2, np.nan, state)[None]


def test_a_bad_number_of_a_functional_environment_says_where():
    with pytest.raises(ValueError, match=r"^env Bad: an observation or a reward was not finite in episode 0, step 1"):
        evaluate(Bad(), make_q_network_that_pays(), 3, seed=0)


def make_q_network_that_pays():
    network = make_q_network(1, 2, seed=0)
    network.set_weights([*[np.zeros_like(w) for w in network.get_weights()[:-1]], np.array([0.0, 1.0])])
    return network
