"""`train`: a whole run, from new networks to the stop rule."""

import contextlib
import dataclasses
import math
import os
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Sequence

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv
from numpy.typing import ArrayLike

from dqn_keras._engine.numpy_acting import q_values_now
from dqn_keras._engine.tensorflow import keras
from dqn_keras.agent import Agent, keeps_averages, make_agent, optimizer_shown, owners_optimizer
from dqn_keras.callbacks import Listeners
from dqn_keras.checks.environments import CheckedEnv, Spaces, check_environment, env_name, some_states
from dqn_keras.checks.formulas import Formulas
from dqn_keras.checks.observations import StateWatch, check_state
from dqn_keras.checks.run import check_arguments, check_callbacks, check_checkpoint, check_own_parts
from dqn_keras.config import Config
from dqn_keras.interruption import TrainingInterrupted, stop_requests
from dqn_keras.learn import td_targets
from dqn_keras.loops import compiled, gymnasium
from dqn_keras.metrics import Episode, history
from dqn_keras.progress import Progress
from dqn_keras.seeding import checked_seed
from dqn_keras.storage.checkpoint import Checkpoints
from dqn_keras.storage.identity import identity
from dqn_keras.storage.networks import save_q_network


@dataclasses.dataclass(repr=False)
class Run:
    """The result of `train`.

    It can be pickled, for example to send it to another process, but Keras then drops the optimizer's state. Use
    `checkpoint` to continue a run.
    """

    config: Config
    agent: Agent
    """Networks, optimizer, memory and random state after the last episode."""
    interrupted: bool = False
    """Whether Ctrl-C or SIGTERM stopped the run (at the end of an episode)."""
    diverged: bool = False
    """Whether learning diverged and a callback (keras.callbacks.TerminateOnNaN) stopped the run without an error."""
    steps_per_second: list[float] = dataclasses.field(default_factory=list)
    """Environment steps per second of each episode, learning included; NaN for episodes from before a resume."""
    first_action: int = 0
    """The environment's number for the action of index 0."""
    added_logs: dict[str, list] = dataclasses.field(default_factory=dict)
    """What callbacks added to the logs, such as `greedy_return`."""

    @property
    def solved_at(self) -> int | None:
        """The number (from 0) of the episode after which the stop rule held; None if it never did."""
        return len(self.episodes) - 1 if _is_solved(self.episodes, self.config) else None

    @property
    def episodes(self) -> list[Episode]:
        """The record of each episode."""
        return self.agent.episodes

    @property
    def rewards(self) -> np.ndarray:
        """Each episode's undiscounted sum of rewards, [num_episodes] float64; NaN if `num_steps` cut it short."""
        return np.array([episode.reward for episode in self.episodes], np.float64)

    @property
    def history(self) -> dict[str, list[float]]:
        """The logged values of all episodes, one list for each name, like `history` in the result of `model.fit`.

        Values that a callback added to the logs are included, with NaN for episodes in which it added nothing.
        """
        num_episodes = len(self.episodes)
        added = {name: [*values, *[math.nan] * num_episodes][:num_episodes] for name, values in self.added_logs.items()}
        return history(self.episodes, self.config, self.steps_per_second) | added

    @property
    def seed(self) -> int:
        """The seed of the run; with it, `train` repeats the run exactly."""
        return self.agent.seed

    @property
    def q_network(self) -> keras.Sequential:
        """The network that acts: a plain Keras model."""
        return self.agent.q_network

    @property
    def q_hat_network(self) -> keras.Sequential:
        """The slow copy, which gave the targets."""
        return self.agent.q_hat_network

    def act(self, state: ArrayLike) -> int:
        """Returns the greedy action in one state, as the environment numbers its actions: `env.step(run.act(state))`.

        Args:
            state: an observation of the environment, [*S].

        Raises:
            TypeError, ValueError: `state` is not an array of finite numbers of shape [*S].
        """
        memory = self.agent.memory
        checked = check_state("state", state, memory.state_shape, memory.rows.dtype)
        return self.first_action + int(q_values_now(self.q_network, checked).argmax())

    def save(self, path: str | os.PathLike) -> None:
        """Saves only the network that acts, as a .keras file, which `load_q_network` or Keras itself loads."""
        save_q_network(path, self.q_network)

    def __repr__(self) -> str:
        outcome = "not solved" if self.solved_at is None else f"solved_at={self.solved_at}"
        return f"<Run: seed={self.seed}, {len(self.episodes)} episodes, {outcome}>"


def train(
    env: gym.Env | FuncEnv,
    config: Config = Config(),
    seed: int | None = None,
    *,
    q_network: keras.Model | None = None,
    optimizer: keras.Optimizer | None = None,
    targets: Callable = td_targets,
    loss: str | Callable | None = None,
    callbacks: keras.callbacks.Callback | Sequence[keras.callbacks.Callback] | None = (),
    checkpoint: str | os.PathLike | None = None,
    checkpoint_every: int = 100,
    resume: bool = False,
    verbose: int = 1,
) -> Run:
    """Trains a Deep Q-Network until it solves `env` or has played all the episodes or steps that `config` allows.

    `train` uses your network, optimizer, targets, loss and environment themselves, not copies of them. It compiles them
    at each call, so it sees your changes.

    Args:
        env: a gymnasium.Env with a Box observation space and a Discrete action space; or a functional environment
            (gymnasium.experimental.functional.FuncEnv) written in TensorFlow, such as
            `dqn_keras.environments.CartPole()`, whose whole episodes are compiled.
        config: the parameters; the defaults are the original notebook's.
        seed: a whole number. The same seed gives the same result, bit for bit, on one machine. None draws a seed (see
            `run.seed`).
        q_network: a network of your own, states [B, *S] -> Q-values [B, A] float32: a built Sequential or functional
            model. It is trained in place, from the weights it has; Q-hat starts as an equal copy. Its layers are called
            in inference mode, and its regularization losses are added to the loss. The default is a network of
            `make_q_network`, for observations with one axis. uint8 observations, such as images, stay uint8 in the
            memory; the network scales them (keras.layers.Rescaling(1 / 255)).
        optimizer: a Keras optimizer. The default is the one that you compiled `q_network` with, or else Adam with
            `config.alpha`. With an optimizer of your own, leave `config.alpha` at its default.
        targets: the formula for y: `td_targets`, `double_td_targets`, or a function of the same form. No gradient flows
            through it.
        loss: any loss that Keras takes in `compile`: a name, a `keras.losses.Loss`, or a function of (y, q), both [B].
            The function returns a scalar, or [B], which is averaged. The default is the loss that you compiled
            `q_network` with, or else "mse".
        callbacks: Keras callbacks, called as `fit` calls them; None for none. An episode is an epoch of one batch. Its
            logs are the values in `run.history`. Callbacks see the network after each episode, may change it, and may
            set `model.stop_training`. Therefore compiled episodes are played one at a time, unless all callbacks are
            plain keras.callbacks.CSVLogger.
        checkpoint: a folder for the checkpoints of this run, each with its whole state; None saves none. If one cannot
            be written during the run, a warning says so and the run continues. A resumed run does not notice every
            change of the environment: it misses values that were set after the environment was made, and constructor
            arguments that the environment keeps under other names.
        checkpoint_every: number of episodes between checkpoints, or a few more if episodes are compiled. The start and
            the end of the run are saved too.
        resume: continue from the newest undamaged checkpoint in the folder; start a new run if there is none yet. The
            result equals, bit for bit, the result of a run without interruption. All other arguments must be the same,
            except that num_episodes may be larger. Callbacks must save their own state. With a checkpoint, your own
            functions and classes need a name that can be imported; they count as the same if they compute the same.
        verbose: 1 prints a line every 100 episodes and one when solved; 2 also shows a progress bar; 0 prints nothing.

    Raises:
        TrainingInterrupted: after Ctrl-C, an interrupted notebook cell or SIGTERM. `train` first finishes the episode,
            and saves the run if there is a checkpoint folder; the exception's `run` holds the run. A second signal
            raises KeyboardInterrupt at once.
        TypeError, ValueError: an argument or a space is not supported; the network does not fit the environment; the
            environment returned a NaN, an infinity or a wrong shape (the message names episode and step); learning
            diverged.
    """
    check_arguments(env, config, verbose)
    callbacks = check_callbacks(callbacks, env)
    checkpoint_every = check_checkpoint(checkpoint, checkpoint_every, resume)
    spaces, formulas, agent = prepare(env, config, checked_seed(seed), q_network, optimizer, targets, loss)
    checkpoints = None
    if checkpoint is not None:
        saved_as = identity(env, config, agent, formulas, q_network, optimizer or owners_optimizer(q_network))
        checkpoints = Checkpoints(checkpoint, saved_as, checkpoint_every)
    with checkpoints.alone() if checkpoints else contextlib.nullcontext():
        if checkpoints:
            resumed_from = checkpoints.begin(agent, seed, resume)
            if verbose and resume:
                print(f"Resumed at episode {len(agent.episodes)} from {resumed_from}" if resumed_from else "A new run")
        run = Run(config, agent, steps_per_second=[math.nan] * len(agent.episodes), first_action=spaces.first_action)
        episodes_per_call = min(100, checkpoint_every) if checkpoints else 100
        watch = StateWatch(env_name(env), env.observation_space, is_default_network=q_network is None)
        played = _timed(_episodes(env, spaces, run, formulas, callbacks, episodes_per_call, watch), run)
        with Progress(run, verbose) as progress, stop_requests() as is_asked_to_stop, optimizer_shown(agent):
            listeners = Listeners(run, callbacks)
            listeners.begin()
            reported = listeners.reported(played) if callbacks else played
            _play_until_over(run, reported, progress, checkpoints, is_asked_to_stop)
            _finish(run, listeners, checkpoints)
    progress.show_end()
    if is_asked_to_stop():
        raise TrainingInterrupted(run, checkpoints.folder if checkpoints else None)
    _warn_of_an_early_end(run)
    return run


def _warn_of_an_early_end(run: Run) -> None:
    """Warns if a limit ended the run before its first update, or before `num_steps` steps."""
    agent, config = run.agent, run.config
    num_steps = agent.memory.num_appended
    if not (agent.num_updates or run.diverged):
        warnings.warn(
            f"train ended without an update: the memory holds {len(agent.memory)} transitions, "
            f"batch_size is {config.batch_size}, learning_starts is {config.learning_starts}",
            stacklevel=3,
        )
    if len(run.episodes) == config.num_episodes and run.solved_at is None and num_steps < (config.num_steps or 0):
        warnings.warn(
            f"train ended after num_episodes={config.num_episodes} episodes and {num_steps} of "
            f"num_steps={config.num_steps} environment steps",
            stacklevel=3,
        )


def prepare(
    env: gym.Env | FuncEnv,
    config: Config,
    seed: int,
    q_network: keras.Model | None,
    optimizer: keras.Optimizer | None,
    targets: Callable,
    loss: str | Callable | None,
) -> tuple[Spaces, Formulas, Agent]:
    """Checks the parts of a run; returns the environment's sizes, the formulas and a new agent."""
    spaces = check_environment(env, q_network)
    formulas = check_own_parts(config, q_network, optimizer, targets, loss)
    some = some_states(env.observation_space, spaces.state_dtype)
    sizes = spaces.state_shape, spaces.num_actions
    agent = make_agent(*sizes, config, seed, q_network, optimizer, formulas.loss, some, spaces.state_dtype)
    return spaces, formulas, agent


def _episodes(
    env: gym.Env | FuncEnv,
    spaces: Spaces,
    run: Run,
    formulas: Formulas,
    callbacks: Sequence[keras.callbacks.Callback],
    episodes_per_call: int,
    watch: StateWatch,
) -> Iterator[Episode]:
    """Returns the episodes, played by the loop for this kind of environment."""
    if not isinstance(env, FuncEnv):
        played = gymnasium.episodes(CheckedEnv(env, watch), run.agent, run.config, formulas)
        return watch.over(played, run.agent, run.config)
    # Other callbacks may read and change the agent after each episode.
    only_logs = all(type(callback) is keras.callbacks.CSVLogger for callback in callbacks)
    at_once = episodes_per_call if only_logs else 1
    played = compiled.episodes(env, spaces, run.agent, run.config, at_once, formulas)
    return watch.over(played, run.agent, run.config)


def _play_until_over(
    run: Run,
    played: Generator[Episode, None, None],
    progress: Progress,
    checkpoints: Checkpoints | None,
    is_asked_to_stop: Callable[[], bool],
) -> None:
    """Plays until the stop rule holds, the last episode ends or a stop is requested; saves checkpoints."""
    if run.solved_at is not None:  # a resumed run may be solved already
        return
    with contextlib.closing(played):
        for episode in played:
            progress.show(episode)
            if len(run.episodes) > episode.number + 1:
                continue  # compiled episodes: the agent has played later ones already
            if checkpoints:
                checkpoints.save_when_due(run.agent)
            if run.solved_at is not None:
                return
            if is_asked_to_stop():
                run.interrupted = not run.agent.is_done(run.config)
                return


def _finish(run: Run, listeners: Listeners, checkpoints: Checkpoints | None) -> None:
    """Ends a run as `fit` does: weight averages replace the weights, then the callbacks' `on_train_end` is called.

    An interrupted run ends without either, as `fit` does after an exception. A checkpoint holds the weights, not the
    averages, because a resumed run continues from the weights.
    """
    agent, keeper = run.agent, None if run.diverged else checkpoints
    averages = keeps_averages(agent.optimizer)
    if keeper and (run.interrupted or averages):
        keeper.save_the_end(agent)
    if run.interrupted:
        return
    if agent.num_updates:
        agent.optimizer.finalize_variable_values(agent.q_network.trainable_variables)
    listeners.end()
    if keeper and not averages:
        keeper.save_the_end(agent, may_have_changed=bool(listeners.callbacks))


def _timed(episodes: Iterator[Episode], run: Run) -> Generator[Episode, None, None]:
    """Yields the episodes and notes their speed; all episodes of one compiled call get the speed of that call."""
    while True:
        start = time.perf_counter()
        episode = next(episodes, None)
        if episode is None:
            return
        if len(run.steps_per_second) <= episode.number:
            new = run.episodes[episode.number :]
            speed = sum(e.steps for e in new) / (time.perf_counter() - start)
            run.steps_per_second += [speed] * len(new)
        yield episode


def _is_solved(episodes: Sequence[Episode], config: Config) -> bool:
    """Returns whether the stop rule holds after the last episode.

    If you change the rule, also change `_Loop.play`, where compiled episodes stop as soon as the rule may hold. The
    original also takes the mean of fewer episodes than the window, so that one lucky first episode could stop it.
    """
    if config.solved_reward is None:
        return False
    last = [episode.reward for episode in episodes[-config.solved_window :]]
    return len(last) == config.solved_window and float(np.mean(last)) > config.solved_reward
