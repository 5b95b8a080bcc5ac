import gymnasium as gym
import numpy as np
import psutil
import pytest

from dqn_keras import Config
from dqn_keras.agent import make_agent
from dqn_keras.checks.environments import CheckedEnv
from dqn_keras.loops.gymnasium import episodes
from dqn_keras.policy import epsilon_at
from dqn_keras.seeding import episode_seed
from tests.helpers import original_algorithm
from tests.helpers.environments import Corridor


class Recorded(gym.Wrapper):
    """Records every action."""

    def __init__(self, env):
        super().__init__(env)
        self.actions = []

    def step(self, action):
        self.actions.append(int(action))
        return super().step(action)


def play(env, config, seed, num_steps):
    """Plays whole episodes of the loop until at least `num_steps` are played."""
    checked = CheckedEnv(env)
    agent = make_agent(checked.spaces.state_shape, checked.spaces.num_actions, config, seed)
    played = []
    for episode in episodes(checked, agent, config):
        played.append(episode)
        if sum(e.steps for e in played) >= num_steps:
            break
    return agent, played


OTHERS = {
    "steps_per_update": 3,
    "alpha": 0.01,
    "gamma": 0.8,
    "tau": 0.2,
    "batch_size": 16,
    "epsilon": 0.9,
    "decay": 0.97,
    "epsilon_min": 0.2,
    "max_steps": 40,
}
PUBLISHED = {
    "steps_per_update": 7,
    "steps_count_from": "run",
    "gradient_steps": 3,
    "gradient_steps_per_target": 5,
    "tau": 1.0,
    "learning_starts": 300,
    "epsilon_steps": 1_200,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "parameters", "jit_compile"),
    [
        pytest.param(0, {}, True, id="seed 0"),
        pytest.param(1, {}, True, id="seed 1"),
        pytest.param(2, {"memory_size": 500}, True, id="full memory"),
        pytest.param(3, OTHERS, True, id="other parameters"),
        pytest.param(4, PUBLISHED, True, id="a published rhythm"),
        pytest.param(0, {}, False, id="seed 0, no jit"),
        pytest.param(3, OTHERS, False, id="other parameters, no jit"),
    ],
)
def test_the_loop_is_the_originals_algorithm_step_for_step(cartpole, seed, parameters, jit_compile):
    env = Recorded(cartpole)
    config = Config(**parameters, jit_compile=jit_compile)
    agent, played = play(env, config, seed, 2_000)
    actions = env.actions

    twin = make_agent((4,), 2, config, seed)
    env.actions = []
    original = original_algorithm.run(
        env, twin.q_network, twin.q_hat_network, twin.rng, lambda k: episode_seed(seed, k), **parameters
    )
    rewards, total = [], 0.0
    while len(rewards) < len(played):
        _, reward, over = next(original)
        total += reward
        if over:
            rewards.append(total)
            total = 0.0

    assert len(actions) >= 2_000
    assert actions == env.actions
    assert [e.reward for e in played] == rewards
    for ours, theirs in [(agent.q_network, twin.q_network), (agent.q_hat_network, twin.q_hat_network)]:
        for a, b in zip(ours.get_weights(), theirs.get_weights(), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-4, rtol=0)
    assert agent.rng.bit_generator.state == twin.rng.bit_generator.state


def test_updates_fall_on_every_fourth_step_of_an_episode_once_a_batch_is_there():
    # episodes of 6 steps learn at t = 0 and 4; the memory holds 8 transitions from step 1 of episode 1 on
    env = Corridor(length=100, limit=6)
    agent, played = play(env, Config(batch_size=8), 0, 18)
    assert [np.isnan(e.loss) for e in played] == [True, False, False]
    assert agent.num_updates == 1 + 2
    assert agent.optimizer.iterations.numpy() == 3


def test_updates_can_follow_the_steps_of_the_run_and_start_late():
    # episodes of 6 steps; updates after the run's steps 8, 12, 16, ..., the first with more than 10 steps at step 12
    env = Corridor(length=100, limit=6)
    config = Config(batch_size=2, steps_count_from="run", learning_starts=10, gradient_steps=3, num_steps=18)
    agent, played = play(env, config, 0, 18)
    assert [np.isnan(e.loss) for e in played] == [True, True, False]
    assert agent.num_updates == agent.optimizer.iterations.numpy() == 2 * 3


def test_q_hat_is_a_copy_that_stays_the_same_for_a_number_of_gradient_steps():
    config = Config(batch_size=2, steps_per_update=1, gradient_steps_per_target=5, tau=1.0, num_steps=40)
    checked = CheckedEnv(Corridor(length=100, limit=1))  # after step k, k - 1 gradient steps
    agent = make_agent((2,), 2, config, 0)
    q, q_hat = [agent.q_network.get_weights()], []
    for _ in episodes(checked, agent, config):
        q_hat.append(agent.q_hat_network.get_weights())
        if agent.num_updates:
            q.append(agent.q_network.get_weights())
    for num_updates, weights in enumerate(q_hat[1:], start=1):
        for a, b in zip(weights, q[num_updates - num_updates % 5], strict=True):
            np.testing.assert_array_equal(a, b)


def test_epsilon_falls_in_a_straight_line_after_random_steps():
    config = Config(epsilon_steps=10, epsilon_min=0.5, learning_starts=4, batch_size=1)
    assert [epsilon_at(step, 0.3, config) for step in (0, 3, 4, 5, 10, 99)] == [1, 1, 0.8, 0.75, 0.5, 0.5]
    assert epsilon_at(4, 0.3, Config(learning_starts=4)) == 0.3


def test_truncation_keeps_the_bootstrap_and_termination_does_not():
    truncated, _ = play(Corridor(length=100, limit=3), Config(), 0, 9)
    assert truncated.memory.sample(9, np.random.default_rng(0)).terminal_state.tolist() == [0.0] * 9
    terminated, _ = play(Corridor(length=1), Config(), 0, 20)
    batch = terminated.memory.sample(len(terminated.memory), np.random.default_rng(0))
    np.testing.assert_array_equal(batch.terminal_state, batch.next_state[:, 0] >= 1)
    assert batch.terminal_state.any()


def test_an_episode_is_left_after_max_steps():
    _, played = play(Corridor(length=100), Config(max_steps=7), 0, 14)
    assert [e.steps for e in played] == [7, 7]


def test_epsilon_falls_once_an_episode():
    _, played = play(Corridor(limit=2), Config(epsilon=0.5, decay=0.5, epsilon_min=0.2), 0, 6)
    assert [e.epsilon for e in played] == [0.5, 0.25, 0.2]


def test_each_reset_is_seeded_from_the_run_and_the_episode():
    env = Corridor(length=1)
    play(env, Config(), 3, 8)
    assert env.reset_seeds == [episode_seed(3, k) for k in range(len(env.reset_seeds))]
    assert len(set(env.reset_seeds)) == len(env.reset_seeds)
    assert episode_seed(3, 1) != episode_seed(4, 1)
    assert type(env.reset_seeds[0]) is int


def test_actions_are_counted_from_where_the_space_starts():
    env = Corridor(length=3, action_space=gym.spaces.Discrete(2, start=1))
    agent, _ = play(env, Config(), 0, 20)
    assert set(env.actions) == {1, 2}
    assert set(agent.memory.sample(20, np.random.default_rng(0)).action) == {0, 1}


def test_a_reused_observation_buffer_does_no_harm():
    buffer = np.zeros(2, np.float32)

    def observe(position, t):
        buffer[:] = position, t
        return buffer

    agent, _ = play(Corridor(length=100, limit=5, observe=observe), Config(), 0, 10)
    batch = agent.memory.sample(10, np.random.default_rng(0))
    np.testing.assert_array_equal(batch.next_state[:, 1] - batch.state[:, 1], 1)


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e39])
def test_a_bad_number_stops_the_run_at_once_and_says_where(bad):
    reward = Corridor(limit=4, reward=lambda t: bad if t == 2 else 1.0)
    with pytest.raises(ValueError, match=r"env Corridor: the reward must be finite.* in episode 0, step 2"):
        play(reward, Config(), 0, 100)
    observation = Corridor(length=100, limit=4, observe=lambda position, t: np.array([bad if t == 3 else 0.0, 0.0]))
    with pytest.raises(ValueError, match=r"env Corridor: the observation must be finite.* in episode 0, step 2"):
        play(observation, Config(), 0, 100)
    at_reset = Corridor(observe=lambda position, t: np.array([bad, 0.0]))
    with pytest.raises(ValueError, match=r"must be finite.* in episode 0, at the reset"):
        play(at_reset, Config(), 0, 100)


@pytest.mark.filterwarnings("error")
def test_large_but_finite_numbers_pass():
    env = Corridor(length=100, limit=5, observe=lambda p, t: np.array([1e9, -1e9], np.float32), reward=lambda t: 1e8)
    agent, _ = play(env, Config(batch_size=2), 0, 10)
    assert agent.num_updates == 3
    play(Corridor(length=1, observe=lambda position, t: np.array([3e38, 3e38], np.float32)), Config(), 0, 5)


def test_weights_that_become_nan_stop_the_run_in_the_same_update(cartpole):
    checked, config = CheckedEnv(cartpole), Config()
    agent = make_agent((4,), 2, config, 0)
    loop = episodes(checked, agent, config)
    for _ in range(10):
        next(loop)
    agent.q_hat_network.weights[0].assign(np.full((4, 64), np.nan))
    with pytest.raises(ValueError, match=r"not finite in episode 10, step 0: learning has diverged"):
        next(loop)


@pytest.mark.slow
def test_resident_memory_stays_flat_over_60_000_steps(cartpole):
    config = Config(num_episodes=100_000, epsilon=0.1, memory_size=5_000)
    agent = make_agent((4,), 2, config, 0)
    loop = episodes(CheckedEnv(cartpole), agent, config)

    def after(num_steps):
        while agent.memory.num_appended < num_steps:
            next(loop)
        return psutil.Process().memory_info().rss / 1e6

    before = after(20_000)  # the replay memory is full
    assert after(80_000) - before < 3  # MB
