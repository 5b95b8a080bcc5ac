"""Whole episodes of a functional environment in one program that XLA compiles: act, step, remember, learn.

Three loops are nested: over episodes, over the turns of an episode, and over the env steps of a turn. A turn ends with
an update. The random draws of a turn depend only on the run's seed, the episode and the turn.
"""

import functools
import math
import time
from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.programs import Learner, bind
from dqn_keras._engine.tensorflow import tf
from dqn_keras.agent import Agent, DivergedError
from dqn_keras.checks.environments import Spaces
from dqn_keras.checks.formulas import Formulas
from dqn_keras.config import Config
from dqn_keras.environments import key_of_twin
from dqn_keras.learn import DEFAULT_FORMULAS, Metrics, packages
from dqn_keras.loops.draws import draw_bits, episode_key, reset_rng, sample_indices, step_rng, to_integer, to_uniform
from dqn_keras.loops.updates import checked_step, is_all_finite
from dqn_keras.metrics import Episode
from dqn_keras.policy import decay_epsilon
from dqn_keras.replay import Experience, pack, unpack
from dqn_keras.seeding import draws_key


def episodes(
    env: FuncEnv,
    spaces: Spaces,
    agent: Agent,
    config: Config,
    episodes_per_call: int = 100,
    formulas: Formulas = DEFAULT_FORMULAS,
) -> Generator[Episode, None, None]:
    """Plays and learns until the run's last episode, and yields each episode; `agent` is changed in place.

    One call of the program plays up to `episodes_per_call` episodes (at most 100), or for about `_SECONDS_PER_CALL`, so
    that a run can be interrupted. It returns early if the stop rule may hold. The agent then has the state of the end
    of that episode. The results do not depend on `episodes_per_call`.
    """
    memory = agent.memory
    rows = tf.Variable(memory.rows)
    num_appended = tf.Variable(memory.num_appended, dtype=tf.int64)
    program = _bind_program(env, spaces, agent, config, formulas, (rows, num_appended))

    at_once = 1
    while (first := len(agent.episodes)) < config.num_episodes:
        start = time.perf_counter()
        epsilons = [agent.epsilon]
        while len(epsilons) < _CAPACITY:
            epsilons.append(decay_epsilon(epsilons[-1], config))
        numbers = _numbers(env, agent, config, epsilons, min(at_once, config.num_episodes - first))
        played, *columns, fault = [x.numpy() for x in program(*map(tf.constant, numbers))]
        totals = _Totals(*(x[:played] for x in columns))
        memory.rows[:] = rows.read_value()
        memory.num_appended = int(num_appended.numpy())
        agent.num_updates += int(totals.updates.sum())
        agent.epsilon = decay_epsilon(epsilons[played - 1], config)
        if fault:
            steps = totals.steps[played - 1]
            raise (DivergedError if fault == _DIVERGED else ValueError)(
                f"env {type(env).__name__}: {_FAULTS[fault]} was not finite in episode {first + played - 1}, "
                + (f"step {steps - 1}" if steps else "at the reset")
            )
        agent.episodes += totals.episodes(first, epsilons)
        seconds = time.perf_counter() - start
        at_once = max(1, min(episodes_per_call, int(played * _SECONDS_PER_CALL / seconds)))
        yield from agent.episodes[first:]


_SECONDS_PER_CALL = 0.25


_CAPACITY = 100
"""Maximum number of episodes in one call."""


class _Numbers(NamedTuple):
    """The inputs of the program at each call; other values need no new compilation."""

    key: Any  # int64, the source of all draws
    first: Any  # int32, the number of the first episode
    num_episodes: Any  # int32
    max_steps: Any  # int32
    epsilons: Any  # [_CAPACITY] float32
    recent: Any  # [solved_window] float64, the rewards of the last episodes
    solved_reward: Any  # float64
    gamma: Any  # float32
    tau: Any  # float32


def _numbers(env: FuncEnv, agent: Agent, config: Config, epsilons: list[float], num_episodes: int) -> _Numbers:
    recent = np.full(config.solved_window, -np.inf)  # missing episodes keep the mean below any solved_reward
    rewards_before = [episode.reward for episode in agent.episodes[-config.solved_window :]]
    recent[config.solved_window - len(rewards_before) :] = rewards_before
    return _Numbers(
        key=draws_key(agent.seed),
        first=np.int32(len(agent.episodes)),
        num_episodes=np.int32(num_episodes),
        max_steps=np.int32(min(config.max_steps, getattr(env, "max_episode_steps", config.max_steps))),
        epsilons=np.array(epsilons, np.float32),
        recent=recent,
        solved_reward=np.float64(config.solved_reward),
        gamma=np.float32(config.gamma),
        tau=np.float32(config.tau),
    )


def _bind_program(
    env: FuncEnv,
    spaces: Spaces,
    agent: Agent,
    config: Config,
    formulas: Formulas,
    variables: tuple[tf.Variable, ...],
) -> Callable[..., list[tf.Tensor]]:
    def make_program(learner: Learner, variables: Sequence[tf.Variable]) -> Callable:
        rows, num_appended = variables

        def play(*numbers: tf.Tensor) -> tuple[tf.Tensor, ...]:
            return _Loop(env, spaces, config, formulas, learner, rows, num_appended, _Numbers(*numbers)).play()

        return play

    numbers = _numbers(env, agent, config, [0.0] * _CAPACITY, 0)
    specs = [tf.TensorSpec(x.shape, x.dtype) for x in numbers]
    environment = key_of_twin(env)
    known = packages(formulas)
    return bind(
        make_program,
        specs,
        agent.learner,
        variables,
        key=("episodes", environment, config.steps_per_update, config.batch_size, config.memory_size, known),
        has_own_parts=environment is None or known is None,
        jit_compile=True,
    )


_FAULTS = ("nothing", "an observation", "a reward", "the loss or a weight")


_DIVERGED = 3


class _Totals(NamedTuple):
    """The outputs of the program for one episode or, with a leading axis, for several."""

    reward: Any  # float64
    steps: Any  # int32
    sums: Any  # [3] float32, sums of loss, mean_q, td_error over the updates
    max_q: Any  # float32
    max_reward: Any  # float32
    updates: Any  # int32
    terminated: Any  # bool

    def episodes(self, first: int, epsilons: list[float]) -> list[Episode]:
        """Returns the records of several episodes; `first` is the number of the first one."""
        records = []
        for i, totals in enumerate(zip(*(x.tolist() for x in self), strict=True)):
            reward, steps, sums, max_q, max_reward, updates, terminated = totals
            loss, mean_q, td_error = (x / updates if updates else math.nan for x in sums)
            measures = (loss, mean_q, max_q if updates else math.nan, td_error, max_reward)
            records.append(Episode(first + i, reward, steps, epsilons[i], *measures, terminated))
        return records


class _Loop:
    """The program that is traced."""

    def __init__(
        self,
        env: FuncEnv,
        spaces: Spaces,
        config: Config,
        formulas: Formulas,
        learner: Learner,
        rows: tf.Variable,
        num_appended: tf.Variable,
        numbers: _Numbers,
    ) -> None:
        self._env, self._spaces, self._config, self._formulas, self._learner = env, spaces, config, formulas, learner
        self._rows, self._num_appended, self._numbers = rows, num_appended, numbers

    def play(self) -> tuple[tf.Tensor, ...]:
        """Plays the episodes -> number of episodes played, the _Totals of each, the fault."""
        key, first, num_episodes, _, epsilons, recent, solved_reward, *_ = self._numbers
        window = recent.shape[0]

        def is_to_go_on(i: tf.Tensor, totals: _Totals, fault: tf.Tensor) -> tf.Tensor:
            # `train` decides whether to stop. The bound here is a little lower, in case the two round differently.
            may_be_solved = tf.reduce_mean(totals.reward[i : i + window]) > solved_reward - 1e-6
            return (i < num_episodes) & (fault == 0) & ~((i > 0) & may_be_solved)

        def play_one(i: tf.Tensor, totals: _Totals, _: tf.Tensor) -> tuple[tf.Tensor, _Totals, tf.Tensor]:
            new, fault = self._play_episode(episode_key(key, first + i), epsilons[i])
            places = _Totals(*[i] * len(new))._replace(reward=i + window)
            parts = zip(totals, places, new, strict=True)
            return i + 1, _Totals(*(tf.tensor_scatter_nd_update(x, [[k]], [y]) for x, k, y in parts)), fault

        integers, floats = tf.zeros([_CAPACITY], tf.int32), tf.zeros([_CAPACITY])
        rewards = tf.concat([recent, tf.zeros([_CAPACITY], tf.float64)], axis=0)
        totals = _Totals(rewards, integers, tf.zeros([_CAPACITY, 3]), floats, floats, integers, integers > 0)
        played, totals, fault = tf.while_loop(is_to_go_on, play_one, (tf.constant(0), totals, tf.constant(0)))
        return played, *totals._replace(reward=totals.reward[window:]), fault

    def _play_episode(self, key: tf.Tensor, epsilon: tf.Tensor) -> tuple[_Totals, tf.Tensor]:
        """Plays an episode -> its _Totals, and what was not finite in it, as an index of _FAULTS."""
        rng = reset_rng(key)
        state = self._env.initial(rng)
        observation = self._observation(state, rng)
        fault = tf.where(is_all_finite(observation), 0, 1)
        zero, least = tf.constant(0), tf.constant(-math.inf)
        totals = _Totals(tf.constant(0, tf.float64), zero, tf.zeros([3]), least, least, zero, tf.constant(False))
        start = ((state, observation), fault > 0, totals, fault)
        turn = functools.partial(self._turn, key, epsilon)
        _, _, totals, fault = tf.while_loop(lambda state, is_over, *_: ~is_over, turn, start)
        return totals, fault

    def _turn(
        self, key: tf.Tensor, epsilon: tf.Tensor, state: Any, is_over: tf.Tensor, totals: _Totals, fault: tf.Tensor
    ) -> tuple[Any, ...]:
        """Takes the env steps up to the next update, then updates -> state, is_over, totals, fault."""
        n, batch_size, memory_size = self._config.steps_per_update, self._config.batch_size, self._config.memory_size
        number = (totals.steps + n - 1) // n  # turn 0 is step 0; turn k is the n steps that end with step k n
        bits = draw_bits(2 * n + batch_size, key, number)

        def step(
            state: Any, is_over: tf.Tensor, reward: tf.Tensor, most: tf.Tensor, t: tf.Tensor, *_: tf.Tensor
        ) -> tuple[Any, ...]:
            j = (t + n - 1) % n
            rng = step_rng(key, t)
            state, new_reward, terminated, fault = self._step(state, epsilon, bits[j], bits[n + j], rng)
            is_over = terminated | (t + 1 >= self._numbers.max_steps) | (fault > 0)
            reward, most = reward + tf.cast(new_reward, tf.float64), tf.maximum(most, new_reward)
            return state, is_over, reward, most, t + 1, t % n == 0, terminated, fault

        start = (state, is_over, totals.reward, totals.max_reward, totals.steps, False, totals.terminated, fault)
        state, is_over, reward, max_reward, steps, is_update, terminated, fault = tf.while_loop(
            lambda state, is_over, reward, most, t, is_update, *_: ~is_over & ~is_update,
            step,
            tf.nest.map_structure(tf.convert_to_tensor, start),
        )

        is_update &= (fault == 0) & (self._num_appended >= batch_size)
        size = tf.cast(tf.minimum(self._num_appended, memory_size), tf.int32)
        loss, mean_q, max_q, td_error = tf.cond(
            is_update,
            lambda: self._update(sample_indices(bits[2 * n :], key, number, size, memory_size)),
            lambda: _NO_UPDATE,
        )
        fault = tf.where(tf.math.is_finite(loss), fault, _DIVERGED)
        totals = _Totals(
            reward,
            steps,
            totals.sums + tf.stack([loss, mean_q, td_error]),
            tf.maximum(totals.max_q, max_q),
            max_reward,
            totals.updates + tf.cast(is_update, tf.int32),
            terminated,
        )
        return state, is_over | (fault > 0), totals, fault

    def _step(
        self, state: Any, epsilon: tf.Tensor, bits: tf.Tensor, action_bits: tf.Tensor, rng: tf.Tensor
    ) -> tuple[tuple, tf.Tensor, tf.Tensor, tf.Tensor]:
        """Takes and stores an env step -> next state, reward, terminated, fault. A state comes with its observation."""
        env, first_action = self._env, self._spaces.first_action
        state, observation = state  # [*S]
        greedy = tf.argmax(self._learner.q_network(observation[None])[0], output_type=tf.int32)
        a = tf.where(to_uniform(bits) < epsilon, to_integer(action_bits, self._spaces.num_actions), greedy)

        next_state = env.transition(state, a + first_action, rng)
        next_observation = self._observation(next_state, rng)
        reward = tf.cast(env.reward(state, a + first_action, next_state, rng), tf.float32)
        terminated = tf.cast(env.terminal(next_state, rng), tf.bool)

        row = pack(Experience(observation, a, reward, next_observation, terminated))
        self._rows.scatter_nd_update([[self._num_appended % self._config.memory_size]], row[None])
        self._num_appended.assign_add(1)

        fault = tf.where(is_all_finite(next_observation), tf.where(tf.math.is_finite(reward), 0, 2), 1)
        return (next_state, next_observation), reward, terminated, fault

    def _observation(self, state: Any, rng: tf.Tensor) -> tf.Tensor:
        return tf.cast(self._env.observation(state, rng), self._spaces.state_dtype)

    def _update(self, indices: tf.Tensor) -> Metrics:
        batch = unpack(tf.gather(self._rows, indices), self._spaces.state_shape)
        return checked_step(batch, self._learner, self._numbers.gamma, self._numbers.tau, self._formulas)


_NO_UPDATE = Metrics(loss=0.0, mean_q=0.0, max_q=-math.inf, td_error=0.0)
