import gc
import importlib
import weakref

import gymnasium as gym
import keras
import numpy as np
import pytest
import tensorflow as tf

from dqn_keras import Config, Experience, learn, loss_values, make_networks, train, update_q_hat
from dqn_keras._engine.programs import _shared
from dqn_keras.environments import CartPole
from tests.helpers.oracle import Oracle


def agent(seed=0, alpha=0.001):
    q_network, q_hat_network = make_networks(4, 2, seed=seed)
    return q_network, q_hat_network, keras.optimizers.Adam(alpha)


def linear_network(kernel):
    network = keras.Sequential([keras.Input((len(kernel),)), keras.layers.Dense(len(kernel[0]), use_bias=False)])
    network.set_weights([np.array(kernel, np.float32)])
    return network


# Q(s) = (s, 2 s) and Q_hat(s) = (-s, 3 s) for a state of one number
Q, Q_HAT = [[1.0, 2.0]], [[-1.0, 3.0]]


@pytest.mark.parametrize(
    ("action", "terminal", "expected"),
    [
        (0, 0.0, (1 + 0.5 * 6 - 1) ** 2),  # y = 1 + 0.5 max(-2, 6) = 4, Q(1)[0] = 1
        (1, 0.0, (1 + 0.5 * 6 - 2) ** 2),  # Q(1)[1] = 2
        (0, 1.0, (1 - 1) ** 2),  # terminated: y = r
    ],
)
def test_loss_against_targets_worked_out_by_hand(action, terminal, expected):
    batch = ([[1.0]], [action], [1.0], [[2.0]], [terminal])
    assert loss_values(batch, 0.5, linear_network(Q), linear_network(Q_HAT)).numpy() == expected


def test_loss_is_the_mean_over_the_batch():
    batch = ([[1.0], [1.0]], [0, 1], [1.0, 1.0], [[2.0], [2.0]], [0.0, 1.0])
    assert loss_values(batch, 0.5, linear_network(Q), linear_network(Q_HAT)).numpy() == (9 + 1) / 2


@pytest.mark.slow
def test_loss_values_is_the_same_in_a_tf_function(random_batch):
    q_network, q_hat_network, _ = agent()
    batch = random_batch()
    compiled = tf.function(lambda *fields: loss_values(fields, 0.95, q_network, q_hat_network))
    np.testing.assert_allclose(compiled(*batch), loss_values(batch, 0.95, q_network, q_hat_network), rtol=1e-6)


@pytest.mark.parametrize("tau", [0.25, np.float32(0.25), np.float64(0.25), tf.constant(0.25)])
@pytest.mark.parametrize("wrap", [lambda f: f, tf.function])
def test_update_q_hat_worked_out_by_hand(tau, wrap):
    q_network, q_hat_network = linear_network(Q), linear_network(Q_HAT)
    wrap(lambda: update_q_hat(q_network, q_hat_network, tau))()
    np.testing.assert_array_equal(q_hat_network.get_weights()[0], [[-0.5, 2.75]])
    np.testing.assert_array_equal(q_network.get_weights()[0], Q)


@pytest.mark.parametrize("jit_compile", [True, False])
def test_learn_agrees_with_a_float64_oracle_over_200_batches(jit_compile, random_batch):
    q_network, q_hat_network, optimizer = agent()
    oracle = Oracle(q_network.get_weights(), q_hat_network.get_weights(), 0.001)
    worst = 0.0
    for _ in range(200):
        batch = random_batch()
        # Each step starts from the same float32 weights, so that rounding does not add up over the steps.
        oracle.q = [w.astype(np.float64) for w in q_network.get_weights()]
        oracle.q_hat = [w.astype(np.float64) for w in q_hat_network.get_weights()]
        slots = [v.numpy().astype(np.float64) for v in optimizer.variables[2:]]
        oracle.m, oracle.v = slots[0::2] or oracle.m, slots[1::2] or oracle.v

        loss = learn(batch, 0.95, q_network, q_hat_network, optimizer, tau=0.01, jit_compile=jit_compile)
        expected, _, _ = oracle.learn(batch, 0.95, 0.01)

        slots = [v.numpy() for v in optimizer.variables[2:]]
        pairs = [([loss.numpy()], [expected])]
        for ours, theirs in [
            (q_network.get_weights(), oracle.q),
            (q_hat_network.get_weights(), oracle.q_hat),
            (slots[0::2], oracle.m),
            (slots[1::2], oracle.v),
        ]:
            pairs += zip(ours, theirs, strict=True)
        worst = max(worst, *(np.linalg.norm(np.subtract(a, b)) / np.linalg.norm(b) for a, b in pairs))
    assert worst < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("num_actions", [1, 2, 3, 4, 5])
def test_narrow_layers_learn_the_same_whether_compiled_or_not(num_actions):
    rng = np.random.default_rng(0)
    states, next_states = rng.normal(size=(2, 32, 3)).astype(np.float32)
    batch = (states, rng.integers(num_actions, size=32), rng.normal(size=32), next_states, np.zeros(32))
    results = []
    for jit_compile in (True, False):
        q_network, q_hat_network = make_networks(3, num_actions, (8, 3), seed=0)
        learn(batch, 0.95, q_network, q_hat_network, keras.optimizers.Adam(0.1), jit_compile=jit_compile)
        results.append(q_network.get_weights())
    start = make_networks(3, num_actions, (8, 3), seed=0)[0].get_weights()
    for compiled, eager, before in zip(*results, start, strict=True):
        assert (eager != before).any()
        np.testing.assert_allclose(compiled, eager, rtol=1e-5, atol=1e-6)


def test_a_narrow_layer_on_whole_numbers_learns(random_batch):
    networks = [keras.Sequential([keras.Input((4,), dtype="int32"), keras.layers.Dense(2)]) for _ in range(2)]
    before = networks[0].get_weights()[0]
    learn(random_batch(), 0.95, *networks, keras.optimizers.SGD(0.1))
    assert (networks[0].get_weights()[0] != before).any()


def test_the_gradient_agrees_with_the_oracle_and_is_qs_alone(random_batch):
    q_network, q_hat_network, _ = agent()
    q_hat_network.set_weights([w + 0.1 for w in q_hat_network.get_weights()])
    batch = random_batch()
    with tf.GradientTape() as tape:
        loss = loss_values(batch, 0.95, q_network, q_hat_network)
    ours = tape.gradient(loss, q_network.trainable_variables)
    _, _, theirs = Oracle(q_network.get_weights(), q_hat_network.get_weights(), 0.001).learn(batch, 0.95, 0.01)
    for a, b in zip(ours, theirs, strict=True):
        assert np.linalg.norm(a.numpy() - b) < 1e-5 * np.linalg.norm(b)


def test_any_five_arrays_are_accepted_and_learn_the_same(random_batch):
    arrays = random_batch()
    kinds = [
        arrays,
        Experience(*arrays),
        [tf.constant(x) for x in arrays],
        [x.astype(np.int64 if i == 1 else np.float64) for i, x in enumerate(arrays)],
        (*arrays[:4], arrays[4].astype(bool)),
        tuple(x.tolist() for x in arrays),
    ]
    results = []
    for kind in kinds:
        q_network, q_hat_network, optimizer = agent()
        learn(kind, 0.95, q_network, q_hat_network, optimizer)
        results.append(np.concatenate([w.ravel() for w in q_network.get_weights()]))
    for result in results[1:]:
        np.testing.assert_array_equal(result, results[0])


@pytest.mark.parametrize("optimizer", [keras.optimizers.SGD(0.1), keras.optimizers.RMSprop(), keras.optimizers.AdamW()])
def test_any_optimizer_works(optimizer, random_batch):
    q_network, q_hat_network, _ = agent()
    batch = random_batch()
    losses = [learn(batch, 0.0, q_network, q_hat_network, optimizer).numpy() for _ in range(20)]
    assert losses[-1] < losses[0]


def test_agents_do_not_touch_one_another(random_batch):
    batch = random_batch()
    alone = agent()
    for _ in range(3):
        learn(batch, 0.95, *alone)
    together, others = agent(), [agent(seed) for seed in (1, 2)]
    for _ in range(3):
        for other in others:
            learn(batch, 0.95, *other)
        learn(batch, 0.95, *together)
    for a, b in zip(alone[0].get_weights(), together[0].get_weights(), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_equal_agents_share_one_trace_for_all_batch_sizes(random_batch):
    learn(random_batch(), 0.95, *agent())
    before = len(_shared)
    for i, batch_size in enumerate([64, 64, 32, 1, 64, 64, 64]):
        networks = agent(seed=i, alpha=0.001 * (i + 1))
        learn(random_batch(batch_size), 0.9 + i / 100, *networks, tau=0.1 * (i + 1))
        learn([tf.constant(x) for x in random_batch(batch_size)], np.float32(0.9), *networks)
    assert len(_shared) == before


def test_agents_that_differ_in_more_than_numbers_have_their_own_programs(random_batch):
    batch, updates = random_batch(), []
    for optimizer in (keras.optimizers.Adam(0.01), keras.optimizers.Adam(0.01, beta_1=0.0, clipnorm=1e-3)):
        q_network, q_hat_network, _ = agent()
        for _ in range(2):
            learn(batch, 0.95, q_network, q_hat_network, optimizer)
        updates.append(q_network.get_weights()[0])
    assert not np.array_equal(*updates)


def test_a_layer_frozen_between_two_calls_stays_as_it_is(random_batch):
    q_network, q_hat_network, optimizer = agent()
    learn(random_batch(), 0.95, q_network, q_hat_network, optimizer)
    q_network.layers[0].trainable = False
    before = q_network.get_weights()
    learn(random_batch(), 0.95, q_network, q_hat_network, optimizer)
    kernel, _, output, _ = q_network.get_weights()
    np.testing.assert_array_equal(kernel, before[0])
    assert not np.array_equal(output, before[2])


def test_an_agent_that_is_dropped_is_forgotten(random_batch):
    networks, batch = agent(), random_batch()
    learn(batch, 0.95, *networks)
    watched = [weakref.ref(x) for x in networks]
    del networks
    gc.collect()
    assert [reference() for reference in watched] == [None, None, None]


def test_learn_can_be_called_in_a_tf_function(random_batch):
    inside, outside = agent(), agent()
    batch = random_batch()
    tf.function(lambda *fields: learn(fields, 0.95, *inside))(*batch)
    learn(batch, 0.95, *outside)
    for a, b in zip(inside[0].get_weights(), outside[0].get_weights(), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)


WRONG = {
    "four fields": (lambda b: b[:4], "experiences must be the five fields"),
    "states without features": (lambda b: (b[0][:, 0], *b[1:]), "states must have shape"),
    "states of three features": (lambda b: (b[0][:, :3], *b[1:]), "states must have shape"),
    "next_states of one less": (lambda b: (*b[:3], b[3][1:], b[4]), "next_states must have shape"),
    "rewards in a column": (
        lambda b: (*b[:2], b[2][:, None], *b[3:]),
        r"rewards must have shape \[64\], got \(64, 1\)",
    ),
    "terminal_states in a column": (lambda b: (*b[:4], b[4][:, None]), "terminal_states must have shape"),
    "one action": (lambda b: (b[0], b[1][0], *b[2:]), "actions must have shape"),
    "actions in float": (lambda b: (b[0], b[1] + 0.5, *b[2:]), "actions must be whole numbers"),
    "an action too high": (lambda b: (b[0], b[1] + 1, *b[2:]), r"actions must lie in 0\.\.1, got 1\.\.2"),
    "an action below zero": (lambda b: (b[0], b[1] - 1, *b[2:]), r"actions must lie in 0\.\.1, got -1\.\.0"),
    "an action beyond int32": (lambda b: (b[0], b[1].astype(np.int64) + 2**32, *b[2:]), "actions must lie in 0"),
    "a terminal state of 255": (lambda b: (*b[:4], b[4] * 255), "terminal_states must be 0 or 1, got 255"),
    "rewards in words": (lambda b: (*b[:2], ["one"] * 64, *b[3:]), "rewards must be numbers"),
    "ragged states": (lambda b: ([[1.0], [1.0, 2.0]], *b[1:]), "states must be an array"),
    "nothing for rewards": (lambda b: (*b[:2], None, *b[3:]), "rewards must have shape"),
    "a reward of 1e39": (lambda b: (*b[:2], b[2] * 0 + np.float64(1e39), *b[3:]), "rewards must be finite in float32"),
    "no transition": (lambda b: tuple(x[:0] for x in b), "at least one transition"),
    "a NaN reward": (lambda b: (*b[:2], b[2] * np.nan, *b[3:]), "rewards must be finite in float32, got nan"),
    "an infinite state": (lambda b: (b[0] / 0, *b[1:]), "states must be finite in float32, got -?inf"),
}


@pytest.mark.filterwarnings("ignore:divide by zero")
@pytest.mark.parametrize(("spoil", "message"), WRONG.values(), ids=WRONG.keys())
def test_what_would_be_silently_wrong_is_refused_and_changes_nothing(spoil, message, random_batch):
    networks = agent()
    before = networks[0].get_weights()
    with pytest.raises(ValueError, match=message):
        learn(spoil(random_batch()), 0.95, *networks)
    assert all(map(np.array_equal, before, networks[0].get_weights()))


def test_networks_that_do_not_match_are_refused(random_batch):
    q_network, q_hat_network, optimizer = agent()
    batch = random_batch()
    with pytest.raises(ValueError, match="a second network"):
        learn(batch, 0.95, q_network, q_network, optimizer)
    with pytest.raises(ValueError, match="q_hat_network must have weights"):
        learn(batch, 0.95, q_network, make_networks(4, 2, (32,))[1], optimizer)
    with pytest.raises(ValueError, match="Input layer"):
        learn(batch, 0.95, keras.Sequential([keras.layers.Dense(2)]), q_hat_network, optimizer)
    learn(batch, 0.95, q_network, q_hat_network, optimizer)
    for gamma in (np.nan, 7, -0.1, "0.9", None, np.ones((64, 1))):
        with pytest.raises((TypeError, ValueError), match=r"^gamma must be a finite number"):
            learn(batch, gamma, q_network, q_hat_network, optimizer)
        with pytest.raises((TypeError, ValueError), match=r"^tau must be a finite number"):
            learn(batch, 0.95, q_network, q_hat_network, optimizer, tau=gamma)
    with pytest.raises(TypeError, match=r"^optimizer must be a Keras optimizer .*, got 'adam'"):
        learn(batch, 0.95, q_network, q_hat_network, "adam")
    with pytest.raises(TypeError, match=r"^q_network must be a Keras model, got None"):
        learn(batch, 0.95, None, q_hat_network, optimizer)
    with pytest.raises(ValueError, match=r"^optimizer must be new or built for this q_network, got"):
        learn(batch, 0.95, *make_networks(4, 2), optimizer)


@pytest.mark.slow
def test_without_private_api_the_numbers_are_the_same(random_batch, monkeypatch):
    programs = importlib.import_module("dqn_keras._engine.programs")

    def run():
        networks, rng = agent(), np.random.default_rng(1)
        losses = [float(learn(tuple(rng.permutation(x) for x in batch), 0.95, *networks)) for _ in range(5)]
        env, config = gym.make("CartPole-v1"), Config(num_episodes=20, batch_size=16)
        rewards = [train(x, config, seed=0, verbose=0).rewards for x in (env, CartPole())]
        return losses, np.concatenate([w.ravel() for w in networks[0].get_weights()]), rewards

    batch = random_batch()
    assert programs.can_swap_variables()
    fast = run()
    monkeypatch.setattr(programs, "can_swap_variables", lambda: False)
    slow = run()
    np.testing.assert_allclose(fast[0], slow[0], rtol=1e-4)
    np.testing.assert_allclose(fast[1], slow[1], atol=1e-5)
    for a, b in zip(fast[2], slow[2], strict=True):
        np.testing.assert_array_equal(a[:10], b[:10])


@pytest.mark.slow
def test_a_version_without_the_fast_calls_gives_the_same_bits(monkeypatch):
    def run():
        runs = [train(env, Config(num_episodes=20, batch_size=16), seed=0, verbose=0) for env in environments]
        return [np.concatenate([w.ravel() for w in run.q_network.get_weights()]) for run in runs]

    environments = gym.make("CartPole-v1"), CartPole()
    fast = run()
    programs = importlib.import_module("dqn_keras._engine.programs")
    monkeypatch.setattr(programs, "caller", lambda concrete: concrete.inference_fn.call_flat)
    monkeypatch.setattr(programs, "_shared", {})
    monkeypatch.setattr("dqn_keras.loops.gymnasium.tensor_maker", lambda: tf.constant)
    np.testing.assert_array_equal(fast, run())
