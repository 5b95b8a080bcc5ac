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
from dqn_keras.learn import DEFAULT_FORMULAS, Metrics, known_formulas
from dqn_keras.loops.draws import (
    draw_bits,
    episode_key,
    further_draws,
    reset_rng,
    sample_indices,
    step_rng,
    to_integer,
    to_uniform,
)
from dqn_keras.loops.updates import checked_step, is_all_finite, num_before_updates
from dqn_keras.metrics import Episode
from dqn_keras.policy import epsilon_at, epsilon_of_next_episode
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
    that a run can be interrupted. It returns early, after the episode at which the stop rule may hold. The results do
    not depend on `episodes_per_call`.
    """
    memory = agent.memory
    rows = tf.Variable(memory.rows)
    num_appended = tf.Variable(memory.num_appended, dtype=tf.int64)
    num_updates = tf.Variable(agent.num_updates, dtype=tf.int64)
    program = _bind_program(env, spaces, agent, config, formulas, (rows, num_appended, num_updates))

    at_once = 1
    while not agent.is_done(config):
        start, first, first_step = time.perf_counter(), len(agent.episodes), memory.num_appended
        epsilons = [agent.epsilon]
        while len(epsilons) < _CAPACITY:
            epsilons.append(epsilon_of_next_episode(epsilons[-1], config))
        numbers = _numbers(env, agent, config, epsilons, min(at_once, config.num_episodes - first))
        played, *columns, fault = [x.numpy() for x in program(*map(tf.constant, numbers))]
        totals = _Totals(*(x[:played] for x in columns))
        memory.rows[:] = rows.read_value()
        memory.num_appended = int(num_appended.numpy())
        agent.num_updates += int(totals.updates.sum())
        agent.epsilon = epsilon_of_next_episode(epsilons[played - 1], config)
        if fault:
            steps = totals.steps[played - 1]
            raise (DivergedError if fault == _DIVERGED else ValueError)(
                f"env {type(env).__name__}: {_FAULTS[fault]} was not finite in episode {first + played - 1}, "
                + (f"step {steps - 1}" if steps else "at the reset")
            )
        agent.episodes += _records(totals, first, first_step, epsilons, config, int(numbers.max_steps))
        seconds = time.perf_counter() - start
        at_once = max(1, min(episodes_per_call, int(played * _SECONDS_PER_CALL / seconds)))
        yield from agent.episodes[first:]


_SECONDS_PER_CALL = 0.25


_MOST_STEPS = 2**31 - 1


_CAPACITY = 100
"""Maximum number of episodes in one call."""


class _Numbers(NamedTuple):
    """The inputs of the program at each call; other values need no new compilation."""

    key: Any  # int64, the source of all draws
    first: Any  # int32, the number of the first episode
    num_episodes: Any  # int32
    num_steps: Any  # int64, of the run
    max_steps: Any  # int32, of an episode
    epsilons: Any  # [_CAPACITY] float32
    line: Any  # [3] float32, the first and the lowest epsilon of a linear fall, and its number of steps
    learning_starts: Any  # int64
    num_before_updates: Any  # int64
    gradient_steps_per_target: Any  # int64
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
        num_steps=np.int64(config.num_steps or _NO_LIMIT),
        max_steps=np.int32(min(config.max_steps, getattr(env, "max_episode_steps", config.max_steps))),
        epsilons=np.array(epsilons, np.float32),
        line=np.array([config.epsilon, config.epsilon_min, config.epsilon_steps or 1], np.float32),
        learning_starts=np.int64(config.learning_starts),
        num_before_updates=np.int64(num_before_updates(config)),
        gradient_steps_per_target=np.int64(config.gradient_steps_per_target),
        recent=recent,
        solved_reward=np.float64(math.inf if config.solved_reward is None else config.solved_reward),
        gamma=np.float32(config.gamma),
        tau=np.float32(config.tau),
    )


_NO_LIMIT = 2**62


def _bind_program(
    env: FuncEnv,
    spaces: Spaces,
    agent: Agent,
    config: Config,
    formulas: Formulas,
    variables: tuple[tf.Variable, ...],
) -> Callable[..., list[tf.Tensor]]:
    def make_program(learner: Learner, variables: Sequence[tf.Variable]) -> Callable:
        def play(*numbers: tf.Tensor) -> tuple[tf.Tensor, ...]:
            return _Loop(env, spaces, config, formulas, learner, variables, _Numbers(*numbers)).play()

        return play

    numbers = _numbers(env, agent, config, [0.0] * _CAPACITY, 0)
    specs = [tf.TensorSpec(x.shape, x.dtype) for x in numbers]
    environment = key_of_twin(env)
    known = known_formulas(formulas)
    return bind(
        make_program,
        specs,
        agent.learner,
        variables,
        key=("episodes", environment, _shape_of_program(config), known),
        has_own_parts=environment is None or known is None,
        jit_compile=True,
    )


def _shape_of_program(config: Config) -> tuple:
    """Returns the values that the traced program depends on; all other numbers are its inputs."""
    sizes = (config.memory_size, config.batch_size, config.steps_per_update, config.gradient_steps)
    has_line, has_warm_up = config.epsilon_steps is not None, config.learning_starts > 0
    return (*sizes, config.steps_count_from, config.gradient_steps_per_target > 1, has_line, has_warm_up)


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


def _records(
    columns: _Totals, first: int, first_step: int, epsilons: list[float], config: Config, max_steps: int
) -> list[Episode]:
    """Returns the records of several episodes; `first` is the number of the first one, `first_step` its first step."""
    records = []
    for i, totals in enumerate(zip(*(x.tolist() for x in columns), strict=True)):
        reward, steps, sums, max_q, max_reward, updates, terminated = totals
        loss, mean_q, td_error = (x / updates if updates else math.nan for x in sums)
        measures = (loss, mean_q, max_q if updates else math.nan, td_error, max_reward)
        epsilon = epsilon_at(first_step, epsilons[i], config)
        first_step += steps
        if first_step == config.num_steps and not (terminated or steps == max_steps):
            reward = math.nan  # the episode is cut short
        records.append(Episode(first + i, reward, steps, epsilon, *measures, terminated))
    return records


class _Loop:
    """The program that TensorFlow traces."""

    def __init__(
        self,
        env: FuncEnv,
        spaces: Spaces,
        config: Config,
        formulas: Formulas,
        learner: Learner,
        variables: Sequence[tf.Variable],
        numbers: _Numbers,
    ) -> None:
        self._env, self._spaces, self._config, self._formulas, self._learner = env, spaces, config, formulas, learner
        self._rows, self._num_appended, self._num_updates = variables
        self._numbers = numbers

    def play(self) -> tuple[tf.Tensor, ...]:
        """Plays the episodes -> number of episodes played, the _Totals of each, the fault."""
        key, first, num_episodes = self._numbers.key, self._numbers.first, self._numbers.num_episodes
        recent, window = self._numbers.recent, self._numbers.recent.shape[0]

        def must_continue(i: tf.Tensor, totals: _Totals, fault: tf.Tensor) -> tf.Tensor:
            # `train` decides whether to stop. The bound here is a little lower, in case the two round differently.
            may_be_solved = tf.reduce_mean(totals.reward[i : i + window]) > self._numbers.solved_reward - 1e-6
            is_left = (i < num_episodes) & (self._num_appended < self._numbers.num_steps)
            return is_left & (fault == 0) & ~((i > 0) & may_be_solved)

        def play_one(i: tf.Tensor, totals: _Totals, _: tf.Tensor) -> tuple[tf.Tensor, _Totals, tf.Tensor]:
            new, fault = self._play_episode(episode_key(key, first + i), self._numbers.epsilons[i])
            places = _Totals(*[i] * len(new))._replace(reward=i + window)
            parts = zip(totals, places, new, strict=True)
            return i + 1, _Totals(*(tf.tensor_scatter_nd_update(x, [[k]], [y]) for x, k, y in parts)), fault

        integers, floats = tf.zeros([_CAPACITY], tf.int32), tf.zeros([_CAPACITY])
        rewards = tf.concat([recent, tf.zeros([_CAPACITY], tf.float64)], axis=0)
        totals = _Totals(rewards, integers, tf.zeros([_CAPACITY, 3]), floats, floats, integers, integers > 0)
        played, totals, fault = tf.while_loop(must_continue, play_one, (tf.constant(0), totals, tf.constant(0)))
        return played, *totals._replace(reward=totals.reward[window:]), fault

    def _play_episode(self, key: tf.Tensor, epsilon: tf.Tensor) -> tuple[_Totals, tf.Tensor]:
        """Plays an episode -> its _Totals, and an index of _FAULTS: what was not finite in it."""
        rng = reset_rng(key)
        state = self._env.initial(rng)
        observation = self._observation(state, rng)
        fault = tf.where(is_all_finite(observation), 0, 1)
        zero, least = tf.constant(0), tf.constant(-math.inf)
        totals = _Totals(tf.constant(0, tf.float64), zero, tf.zeros([3]), least, least, zero, tf.constant(False))
        start = ((state, observation), fault > 0, totals, fault)
        steps_left = tf.cast(tf.minimum(self._numbers.num_steps - self._num_appended, _MOST_STEPS), tf.int32)
        most_steps = tf.minimum(self._numbers.max_steps, steps_left)
        turn = functools.partial(self._turn, key, epsilon, most_steps, self._steps_since_update())
        _, _, totals, fault = tf.while_loop(lambda state, is_over, *_: ~is_over, turn, start)
        return totals, fault

    def _steps_since_update(self) -> Any:
        """Returns, at the start of an episode, the env steps since the last multiple of `steps_per_update`."""
        if self._config.steps_count_from == "episode":
            return 0
        return tf.cast(self._num_appended % self._config.steps_per_update, tf.int32)

    def _turn(
        self,
        key: tf.Tensor,
        epsilon: tf.Tensor,
        most_steps: tf.Tensor,
        before: Any,
        state: Any,
        is_over: tf.Tensor,
        totals: _Totals,
        fault: tf.Tensor,
    ) -> tuple[Any, ...]:
        """Takes the env steps up to the next update, then updates -> state, is_over, totals, fault."""
        n, batch_size = self._config.steps_per_update, self._config.batch_size
        number = (before + totals.steps + n - 1) // n  # turn 0 is step 0; turn k is the n steps that end with step k n
        bits = draw_bits(2 * n + batch_size, key, number)

        def step(
            state: Any, is_over: tf.Tensor, reward: tf.Tensor, most: tf.Tensor, t: tf.Tensor, *_: tf.Tensor
        ) -> tuple[Any, ...]:
            j = (before + t + n - 1) % n
            rng = step_rng(key, t)
            # With bits[j], XLA would compile again for each number of steps before the episode.
            random_bits, action_bits = tf.gather(bits, j), tf.gather(bits, n + j)
            state, new_reward, terminated, fault = self._step(state, epsilon, random_bits, action_bits, rng)
            is_over = terminated | (t + 1 >= most_steps) | (fault > 0)
            reward, most = reward + tf.cast(new_reward, tf.float64), tf.maximum(most, new_reward)
            return state, is_over, reward, most, t + 1, (before + t) % n == 0, terminated, fault

        start = (state, is_over, totals.reward, totals.max_reward, totals.steps, False, totals.terminated, fault)
        state, is_over, reward, max_reward, steps, is_update, terminated, fault = tf.while_loop(
            lambda state, is_over, reward, most, t, is_update, *_: ~is_over & ~is_update,
            step,
            tf.nest.map_structure(tf.convert_to_tensor, start),
        )

        is_update &= (fault == 0) & (self._num_appended >= self._numbers.num_before_updates)
        loss, mean_q, max_q, td_error = tf.cond(
            is_update, lambda: self._updates(bits[2 * n :], key, number), lambda: _NO_UPDATE
        )
        fault = tf.where(tf.math.is_finite(loss), fault, _DIVERGED)
        totals = _Totals(
            reward,
            steps,
            totals.sums + tf.stack([loss, mean_q, td_error]),
            tf.maximum(totals.max_q, max_q),
            max_reward,
            totals.updates + tf.where(is_update, self._config.gradient_steps, 0),
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
        is_random = to_uniform(bits) < self._epsilon(epsilon)
        a = tf.where(is_random, to_integer(action_bits, self._spaces.num_actions), greedy)

        next_state = env.transition(state, a + first_action, rng)
        next_observation = self._observation(next_state, rng)
        reward = tf.cast(env.reward(state, a + first_action, next_state, rng), tf.float32)
        terminated = tf.cast(env.terminal(next_state, rng), tf.bool)

        row = pack(Experience(observation, a, reward, next_observation, terminated))
        self._rows.scatter_nd_update([[self._num_appended % self._config.memory_size]], row[None])
        self._num_appended.assign_add(1)

        fault = tf.where(is_all_finite(next_observation), tf.where(tf.math.is_finite(reward), 0, 2), 1)
        return (next_state, next_observation), reward, terminated, fault

    def _epsilon(self, epsilon: tf.Tensor) -> tf.Tensor:
        """Returns `policy.epsilon_at` of the next step."""
        step = self._num_appended
        if self._config.epsilon_steps is not None:
            first, lowest, num_steps = tf.unstack(self._numbers.line)
            epsilon = lowest + (first - lowest) * tf.maximum(0.0, 1 - tf.cast(step, tf.float32) / num_steps)
        if self._config.learning_starts:
            epsilon = tf.where(step < self._numbers.learning_starts, 1.0, epsilon)
        return epsilon

    def _observation(self, state: Any, rng: tf.Tensor) -> tf.Tensor:
        return tf.cast(self._env.observation(state, rng), self._spaces.state_dtype)

    def _updates(self, bits: tf.Tensor, key: tf.Tensor, number: tf.Tensor) -> Metrics:
        """Takes the gradient steps of one update -> the sums of their metrics, and the highest max_q."""
        if self._config.gradient_steps == 1:
            return self._update(bits, key, number)

        def one_more(k: tf.Tensor, sums: Metrics) -> tuple[tf.Tensor, Metrics]:
            counter = further_draws(number, k)
            new = self._update(draw_bits(self._config.batch_size, key, counter), key, counter)
            max_q = tf.maximum(sums.max_q, new.max_q)
            return k + 1, Metrics(*(x + y for x, y in zip(sums, new, strict=True)))._replace(max_q=max_q)

        start = tf.constant(0, tf.int64), Metrics(*map(tf.constant, _NO_UPDATE))
        return tf.while_loop(lambda k, _: k < self._config.gradient_steps, one_more, start)[1]

    def _update(self, bits: tf.Tensor, key: tf.Tensor, counter: tf.Tensor) -> Metrics:
        size = tf.cast(tf.minimum(self._num_appended, self._config.memory_size), tf.int32)
        indices = sample_indices(bits, key, counter, size, self._config.memory_size)
        batch = unpack(tf.gather(self._rows, indices), self._spaces.state_shape)
        return checked_step(batch, self._learner, self._numbers.gamma, self._tau(), self._formulas)

    def _tau(self) -> tf.Tensor:
        """Returns the share of Q in the next update of Q-hat; 0 if no update is due."""
        if self._config.gradient_steps_per_target == 1:
            return self._numbers.tau
        num_updates = self._num_updates.assign_add(1, read_value=True)
        return tf.where(num_updates % self._numbers.gradient_steps_per_target == 0, self._numbers.tau, 0.0)


_NO_UPDATE = Metrics(loss=0.0, mean_q=0.0, max_q=-math.inf, td_error=0.0)
