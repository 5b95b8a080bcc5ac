import gymnasium as gym
import numpy as np
import psutil
import pytest
import tensorflow as tf
from gymnasium.experimental.functional import FuncEnv
from scipy import stats

from dqn_keras import Config, learn, train
from dqn_keras._engine.tensorflow import require_xla
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import Spaces
from dqn_keras.environments import CartPole
from dqn_keras.loops.compiled import episodes
from dqn_keras.loops.draws import draw_bits, episode_key, reset_rng, sample_indices, to_integer, to_uniform
from dqn_keras.policy import decay_epsilon
from dqn_keras.replay import unpack
from dqn_keras.seeding import draws_key
from tests.helpers.runs import QUICK, SpoiledVelocity, Tape, fingerprint

OTHERS = {
    "steps_per_update": 3,
    "alpha": 0.005,
    "gamma": 0.8,
    "tau": 0.2,
    "batch_size": 16,
    "epsilon": 0.9,
    "decay": 0.97,
    "epsilon_min": 0.2,
    "hidden_units": (8, 8),
}


PUBLISHED = {
    "steps_per_update": 5,
    "steps_count_from": "run",
    "gradient_steps": 3,
    "gradient_steps_per_target": 4,
    "tau": 1.0,
    "learning_starts": 300,
    "epsilon_steps": 1_500,
    "num_steps": 2_503,
    "solved_reward": None,
}


@pytest.fixture(
    scope="module", params=[{}, OTHERS, PUBLISHED], ids=["the original's parameters", "others", "a published rhythm"]
)
def run(request):
    """Returns a run of 120 episodes whose memory holds every transition."""
    config = Config(**{"num_episodes": 120, "solved_reward": 1e9, **request.param})
    return train(CartPole(), config, seed=0, verbose=0)


def transitions(run):
    """Returns the memory, oldest first, cut into episodes."""
    batch = unpack(run.agent.memory.rows[: len(run.agent.memory)], run.agent.memory.state_shape)
    ends = np.cumsum([episode.steps for episode in run.episodes])
    assert ends[-1] == len(run.agent.memory)
    return [type(batch)(*(field[i:j] for field in batch)) for i, j in zip([0, *ends], ends, strict=False)]


@pytest.mark.slow
def test_whole_episodes_replayed_in_gymnasium_agree(run, cartpole):
    played = transitions(run)
    num_steps = run.config.num_steps
    assert len(played) == 120 if num_steps is None else len(run.agent.memory) == num_steps
    initial = tf.function(CartPole().initial, jit_compile=True)  # XLA draws other float64 numbers than TensorFlow
    for number, episode in enumerate(played):
        cartpole.reset(seed=0)
        key = episode_key(tf.constant(draws_key(0)), tf.constant(number))
        cartpole.unwrapped.state = initial(reset_rng(key)).numpy()
        np.testing.assert_array_equal(episode.state[0], cartpole.unwrapped.state.astype(np.float32))
        for t, a in enumerate(episode.action):
            observation, reward, terminated, truncated, _ = cartpole.step(int(a))
            np.testing.assert_allclose(episode.next_state[t], observation, rtol=0, atol=1e-5)
            assert (reward, terminated) == (episode.reward[t], episode.terminal_state[t])
        is_cut = num_steps is not None and number == len(played) - 1
        assert (terminated or truncated) != is_cut
        assert run.episodes[number].steps == len(episode.action)
        np.testing.assert_equal(run.episodes[number].reward, np.nan if is_cut else episode.reward.sum())


@pytest.mark.slow
def test_its_draws_actions_and_updates_replayed_step_by_step_through_learn_agree(run):
    config, agent = run.config, make_agent((4,), 2, run.config, 0)
    rows, num_steps, epsilon, updates = run.agent.memory.rows, 0, config.epsilon, 0
    n, batch_size = config.steps_per_update, config.batch_size
    draw, sample, q_function = (tf.function(x) for x in (draw_bits, sample_indices, agent.q_network))
    close_calls = 0
    for number, episode in enumerate(transitions(run)):
        key = episode_key(tf.constant(draws_key(0)), tf.constant(number))
        first = num_steps % n if config.steps_count_from == "run" else 0
        for t, a in enumerate(episode.action, start=first):
            turn, j = (t + n - 1) // n, (t + n - 1) % n
            if j == 0 or t == first:
                bits = draw(2 * n + batch_size, key, tf.constant(turn)).numpy()
                uniform, integer = to_uniform(bits).numpy(), to_integer(bits, 2).numpy()
            if config.epsilon_steps:
                epsilon = 1 - 0.9 * min(1, num_steps / config.epsilon_steps)
            if num_steps < config.learning_starts:
                epsilon = 1
            if t == first:
                assert run.episodes[number].epsilon == pytest.approx(epsilon)
            if uniform[j] < np.float32(epsilon):
                assert a == integer[n + j]
            else:
                q_values = q_function(tf.constant(episode.state[t - first][None])).numpy()[0]
                close_calls += a != q_values.argmax()
                assert q_values[a] >= q_values.max() - 1e-3
            num_steps += 1
            if t % n == 0 and num_steps >= batch_size and num_steps > config.learning_starts:
                for k in range(config.gradient_steps):
                    counter, draws = tf.constant(turn + k * 2**44, tf.int64), tf.constant(bits[2 * n :])
                    if config.gradient_steps > 1:
                        draws = draw(batch_size, key, counter)
                    indices = sample(draws, key, counter, tf.constant(num_steps), config.memory_size).numpy()
                    updates += 1
                    tau = config.tau if updates % config.gradient_steps_per_target == 0 else 0
                    learn(unpack(rows[indices], (4,)), config.gamma, *agent.learner, tau=tau)
        epsilon = decay_epsilon(epsilon, config)
    assert updates == run.agent.num_updates > 400
    assert close_calls <= 2
    for ours, theirs in [(run.q_network, agent.q_network), (run.q_hat_network, agent.q_hat_network)]:
        for a, b in zip(ours.get_weights(), theirs.get_weights(), strict=True):
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("batch_size", "size", "memory_size"),
    [
        *[(64, 64, 5_000), (64, 65, 5_000), (64, 100, 5_000), (64, 5_000, 5_000)],  # repeats are drawn again
        *[(64, 64, 64), (64, 65, 65), (64, 90, 100), (64, 255, 255)],  # a large part of the memory
        *[(130, 130, 5_000), (130, 520, 5_000), (130, 521, 5_000)],  # a large batch of an almost empty memory
    ],
)
def test_a_batch_has_no_repeats_and_is_uniform(batch_size, size, memory_size):
    @tf.function(jit_compile=True)
    def draw(key):
        def one(i):
            return sample_indices(draw_bits(batch_size, key, i), key, i, size, memory_size)

        return tf.map_fn(one, tf.range(2_000), fn_output_signature=tf.int32)

    batches = draw(tf.constant(1, tf.int64)).numpy()
    assert all(len(set(batch)) == batch_size for batch in batches)
    counts = np.bincount(batches.ravel(), minlength=size)
    assert len(counts) == size
    if size == batch_size:
        assert (counts == 2_000).all()
    else:  # without replacement the counts vary less than a multinomial's, by this factor
        statistic = ((counts - counts.mean()) ** 2 / counts.mean()).sum() / (1 - batch_size / size)
        assert 1e-4 < stats.chi2.sf(statistic, size - 1) < 1 - 1e-4
    for place in (0, -1):
        assert stats.chisquare(np.bincount(batches[:, place], minlength=size)).pvalue > 1e-4


@pytest.mark.parametrize(("batch_size", "memory_size"), [(3_000, 3_000), (2_700, 3_000), (1_000, 3_000)])
def test_a_batch_that_is_a_large_part_of_the_memory_is_drawn_without_attempts(batch_size, memory_size):
    @tf.function
    def draw(counter):
        key = tf.constant(1, tf.int64)
        return sample_indices(draw_bits(batch_size, key, counter), key, counter, memory_size, memory_size)

    operations = {x.type for x in draw.get_concrete_function(tf.TensorSpec((), tf.int32)).graph.get_operations()}
    assert not any("While" in x for x in operations)
    first, second = draw(tf.constant(0)).numpy(), draw(tf.constant(1)).numpy()
    assert len(set(first)) == len(set(second)) == batch_size
    assert not np.array_equal(first, second)


@pytest.mark.slow
def test_draws_are_uniform_and_differ_from_turn_to_turn_and_episode_to_episode():
    keys = [episode_key(tf.constant(draws_key(seed)), tf.constant(k)) for seed in (0, 1) for k in range(50)]
    bits = np.array([draw_bits(72, key, turn) for key in keys for turn in range(4)])
    assert len(np.unique(bits)) > 0.9999 * bits.size
    assert stats.kstest(to_uniform(tf.constant(bits.ravel())).numpy(), "uniform").pvalue > 1e-4
    assert stats.chisquare(np.bincount(to_integer(tf.constant(bits.ravel()), 7).numpy())).pvalue > 1e-4


def test_xla_draws_what_tensorflow_draws():
    key = tf.constant(7, tf.int64)
    np.testing.assert_array_equal(
        tf.function(draw_bits, jit_compile=True)(8, key, tf.constant(3)), draw_bits(8, key, tf.constant(3))
    )


def test_one_seed_gives_the_same_bits_however_many_episodes_a_call_plays():
    prints = []
    for episodes_per_call in (1, 7, 100):
        agent = make_agent((4,), 2, QUICK, 3)
        played = list(episodes(CartPole(), Spaces((4,), np.dtype(np.float32), 2, 0), agent, QUICK, episodes_per_call))
        assert [e.number for e in played] == list(range(30))
        prints.append([w.tobytes() for w in agent.q_network.get_weights()] + [[e.reward for e in played]])
    assert prints[0] == prints[1] == prints[2]


def test_a_run_depends_on_its_seed_and_not_on_a_run_before_it():
    alone = fingerprint(train(CartPole(), QUICK, seed=1, verbose=0))
    assert fingerprint(train(CartPole(), QUICK, seed=2, verbose=0)) != alone
    assert fingerprint(train(CartPole(), QUICK, seed=1, verbose=0)) == alone


@pytest.mark.slow
def test_the_stop_rule_holds_after_each_episode_with_the_weights_of_that_moment():
    config = Config(solved_reward=30.0, solved_window=5)
    run = train(CartPole(), config, seed=0, verbose=0)
    means = np.convolve(run.rewards, np.full(5, 1 / 5), mode="valid")
    assert run.solved_at == len(run.rewards) - 1
    assert means[-1] > 30
    assert (means[:-1] <= 30).all()
    # the same episodes and none after them: weights, memory and counters belong to that moment
    stopped = train(CartPole(), Config(num_episodes=len(run.rewards), solved_reward=1e9), seed=0, verbose=0)
    assert fingerprint(run) == fingerprint(stopped)
    assert run.agent.num_updates == run.agent.optimizer.iterations.numpy()
    assert run.agent.memory.num_appended == run.rewards.sum()


def test_callbacks_see_every_episode():
    tape = Tape(stop_after=4)
    run = train(CartPole(), QUICK, seed=0, verbose=0, callbacks=[tape])
    assert [call for call in tape.calls if call[0] == "ends"] == [("ends", k) for k in range(5)]
    assert len(run.episodes) == 5
    assert run.agent.memory.num_appended == run.rewards.sum()


@pytest.mark.slow
def test_a_full_memory_forgets_the_oldest():
    run = train(CartPole(), Config(num_episodes=60, memory_size=200, solved_reward=1e9), seed=0, verbose=0)
    memory = run.agent.memory
    assert memory.num_appended == run.rewards.sum() > 200 == len(memory)
    newest = (memory.num_appended - 1) % 200
    follows = np.roll(np.arange(200), -1)
    state, next_state = memory.rows[:, :4], memory.rows[:, 4:8]
    goes_on = (memory.rows[:, 10] == 0) & (np.arange(200) != newest)
    np.testing.assert_array_equal(next_state[goes_on], state[follows[goes_on]])


class Counter(FuncEnv):
    """Counts up to 10, with actions 5 and 6. Written as a user would write it; options replace its parts."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,))
    action_space = gym.spaces.Discrete(2, start=5)

    def initial(self, rng, params=None):
        return {"count": tf.constant(0), "actions": tf.constant(0)}

    def transition(self, state, action, rng, params=None):
        return {"count": state["count"] + 1, "actions": state["actions"] + action}

    def observation(self, state, rng, params=None):
        count = tf.cast(state["count"], tf.float32)
        return tf.where(count == getattr(self, "bad_count", -1), self.__dict__.get("bad", 0.0), count)[None]

    def reward(self, state, action, next_state, rng, params=None):
        return tf.cast(action, tf.float32)

    def terminal(self, state, rng, params=None):
        return state["count"] >= 10


@pytest.mark.slow
def test_any_functional_environment_trains():
    run = train(Counter(), Config(num_episodes=20, solved_reward=1e9), seed=0, verbose=0)
    assert [e.steps for e in run.episodes] == [10] * 20
    assert set(np.unique(run.agent.memory.rows[:200, 3])) == {5.0, 6.0}  # rewards are the env's own actions
    assert set(np.unique(run.agent.memory.rows[:200, 2])) == {0.0, 1.0}
    short = train(Counter(), Config(num_episodes=20, max_steps=4, solved_reward=1e9), seed=0, verbose=0)
    assert [e.steps for e in short.episodes] == [4] * 20
    assert not short.agent.memory.rows[:, 4].any()  # cut short, not terminated


@pytest.mark.slow
@pytest.mark.parametrize(("bad", "count", "where"), [(np.nan, 7.0, "step 6"), (np.inf, 0.0, "at the reset")])
def test_a_bad_number_stops_the_run_and_says_where(bad, count, where):
    env = Counter({"bad": float(bad), "bad_count": count})
    with pytest.raises(ValueError, match=rf"env Counter: an observation was not finite in episode 0, {where}"):
        train(env, Config(num_episodes=20), seed=0, verbose=0)


class Paying(Counter):
    """Gives a fourth reward that is too large for float32."""

    def reward(self, state, action, next_state, rng, params=None):
        return tf.where(next_state["count"] == 4, tf.constant(1e39, tf.float64), 1.0)


@pytest.mark.slow
def test_a_bad_reward_and_a_bad_observation_have_different_errors():
    with pytest.raises(ValueError, match=r"^env Paying: a reward was not finite in episode 0, step 3"):
        train(Paying(), Config(num_episodes=20), seed=0, verbose=0)


@pytest.mark.slow
@pytest.mark.parametrize("make_env", [CartPole, lambda: gym.make("CartPole-v1")])
def test_a_weight_that_becomes_nan_stops_the_run_in_the_same_update(make_env):
    with pytest.raises(ValueError, match=r"the loss or a weight (was|is) not finite in episode 12, step 0"):
        train(make_env(), Config(num_episodes=20), seed=0, verbose=0, callbacks=[SpoiledVelocity()])


class Noisy(Counter):
    """Gives random observations."""

    def observation(self, state, rng, params=None):
        return tf.cast(state["count"], tf.float32)[None] + tf.random.stateless_normal([1], rng)


@pytest.mark.slow
def test_a_random_observation_is_made_once_for_each_state():
    run = train(Noisy(), Config(num_episodes=20, solved_reward=1e9), seed=0, verbose=0)
    for episode in transitions(run):
        np.testing.assert_array_equal(episode.next_state[:-1], episode.state[1:])
    assert len(np.unique(run.agent.memory.rows[:200, 0])) == 200


WRONG = {
    "observation": lambda self, state, rng, params=None: tf.zeros([2]),
    "reward": lambda self, state, action, next_state, rng, params=None: tf.zeros([1]),
    "terminal": lambda self, state, rng, params=None: tf.constant([False]),
    "transition": lambda self, state, action, rng, params=None: state["count"],
}


@pytest.mark.parametrize("part", WRONG)
def test_a_part_of_the_wrong_shape_is_named(part):
    env = type("Broken", (Counter,), {part: WRONG[part]})()
    with pytest.raises(ValueError, match=rf"env Broken: {part} must"):
        train(env, QUICK, seed=0, verbose=0)


def test_without_xla_the_error_says_what_works(monkeypatch, cartpole):
    with pytest.raises(ValueError, match=r"jit_compile must be True for a functional environment"):
        train(CartPole(), Config(jit_compile=False), seed=0, verbose=0)
    assert train(cartpole, Config(num_episodes=9, batch_size=8, jit_compile=False), seed=0, verbose=0).agent.num_updates

    def no_compiler():
        raise tf.errors.UnimplementedError(None, None, "Could not find compiler for platform Host")

    require_xla.cache_clear()
    monkeypatch.setattr("dqn_keras._engine.tensorflow._compile_something", no_compiler)
    config = Config(num_episodes=9, batch_size=8, gamma=0.123)  # no program was compiled for it yet
    for env in (CartPole(), cartpole):
        with pytest.raises(RuntimeError, match=r"XLA cannot compile on this machine; Config\(jit_compile=False\)"):
            train(env, config, seed=0, verbose=0)


@pytest.mark.slow
def test_resident_memory_stays_flat_over_half_a_million_steps():
    config = Config(num_episodes=100_000, solved_reward=1e9, epsilon=0.1)
    agent = make_agent((4,), 2, config, 0)
    loop = episodes(CartPole(), Spaces((4,), np.dtype(np.float32), 2, 0), agent, config)

    def play(num_steps):
        end = agent.memory.num_appended + num_steps
        while agent.memory.num_appended < end:
            next(loop)
        return psutil.Process().memory_info().rss / 1e6

    before = play(50_000)
    assert play(500_000) - before < 10  # MB; the replay memory has 2.2
