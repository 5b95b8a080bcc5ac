"""train: a whole run, from fresh networks to the stop rule."""

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

from dqn_keras import compiled_loop, gymnasium_loop
from dqn_keras._tensorflow import keras
from dqn_keras.agent import (
    Agent,
    DivergedError,
    Episode,
    checked_seed,
    make_agent,
    optimizer_shown,
    owners_optimizer,
)
from dqn_keras.checkpoint import Checkpoints, save_agent
from dqn_keras.config import Config, count
from dqn_keras.diagnostics import Log, Logged, history
from dqn_keras.environment import CheckedEnv, Spaces, some_states
from dqn_keras.interruption import stop_requests
from dqn_keras.learn import Formulas, td_targets
from dqn_keras.networks import check_fits, warn_of_inference_mode
from dqn_keras.programs import check_optimizer
from dqn_keras.progress import tqdm


@dataclasses.dataclass(repr=False)
class Run:
    """What came of `train`."""

    config: Config
    agent: Agent
    """Networks, optimizer, memory and random state, as the last episode left them."""
    interrupted: bool = False
    """Whether Ctrl-C or SIGTERM came: it has then ended at the end of that episode."""
    diverged: bool = False
    """Whether learning diverged, and a callback (keras.callbacks.TerminateOnNaN) ended the run without an error."""
    steps_per_second: Sequence[float] = ()
    """Environment steps, learning included, of each episode; NaN for those that were played before a resume."""

    @property
    def solved_at(self) -> int | None:
        """The number (from 0) of the episode at whose end the stop rule held; None if it never did."""
        return len(self.episodes) - 1 if _is_solved(self.episodes, self.config) else None

    @property
    def episodes(self) -> list[Episode]:
        """What happened, episode by episode."""
        return self.agent.episodes

    @property
    def rewards(self) -> np.ndarray:
        """[num_episodes] float64, each episode's undiscounted sum."""
        return np.array([episode.reward for episode in self.episodes], np.float64)

    @property
    def history(self) -> dict[str, list[float]]:
        """What callbacks were told, a list for each name, as `history` of what Keras' `model.fit` returns."""
        return history(self.episodes, self.config, self.steps_per_second)

    @property
    def seed(self) -> int:
        """With it, `train` gives this run again."""
        return self.agent.seed

    @property
    def q_network(self) -> keras.Sequential:
        """The network that acts; a plain Keras model."""
        return self.agent.q_network

    @property
    def q_hat_network(self) -> keras.Sequential:
        """The slow copy that the targets were computed from."""
        return self.agent.q_hat_network

    def save(self, path: str | os.PathLike) -> None:
        """Save the network that acts, alone, as a .keras file; `load_agent`, or Keras anywhere, loads it."""
        save_agent(path, self.q_network)

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
    callbacks: keras.callbacks.Callback | Sequence[keras.callbacks.Callback] = (),
    checkpoint: str | os.PathLike | None = None,
    checkpoint_every: int = 100,
    resume: bool = False,
    verbose: int = 1,
) -> Run:
    """Trains a Deep Q-Network until it solves `env` or `config.num_episodes` are over.

    What you pass in is what runs: your network, optimizer, targets, loss and environment are used as the objects they
    are, and compiled again at each call of `train`, so that a change you made since is seen.

    Args:
        env: a gymnasium.Env with a Box observation space and a Discrete action space; or a functional one
            (gymnasium.experimental.functional.FuncEnv) written in TensorFlow, whose episodes are compiled whole, such
            as `dqn_keras.environments.CartPole()`.
        config: the parameters; by default the original notebook's.
        seed: a whole number. One seed, one result, bit for bit, on one machine; None draws one (see `run.seed`).
        q_network: a network of your own, states [B, *S] -> Q-values [B, A] float32: a built Sequential or functional
            model, trained in place from the weights it has; Q-hat starts as its equal copy. Its layers are called in
            inference mode, and its regularization losses are added to the loss. By default that of `make_q_network`,
            for observations of one axis. Where observations are uint8, as images are, they stay that in the memory, and
            the network scales them (keras.layers.Rescaling(1 / 255)).
        optimizer: a Keras optimizer. By default that of a `q_network` which you have compiled, or else Adam with
            `config.alpha`. With an optimizer of your own, `config.alpha` must be left as it is.
        targets: the formula for y: `td_targets`, `double_td_targets`, or a function of the same form. No gradient flows
            through it.
        loss: what Keras takes in `compile`: a name, a `keras.losses.Loss`, or a function of (y, q), both [B] -> a
            scalar or [B], which is averaged. By default that of a `q_network` which you have compiled, or else "mse".
        callbacks: Keras callbacks; an episode is an epoch of one batch, and its logs are what `run.history` holds.
            They see the network as the episode left it, may change it, and may set `model.stop_training`. So compiled
            episodes are then played one at a time, unless all callbacks are plain keras.callbacks.CSVLogger.
        checkpoint: a folder for this run's checkpoints, each its whole state; None saves none. If the disk refuses
            one on the way, that is a warning, and the run goes on. What is put into the environment after it was made,
            or kept under other names than the constructor's, is not noticed to differ.
        checkpoint_every: episodes between two of them, or a few more where episodes are compiled; the start and the
            end of the run are saved too.
        resume: go on from the newest checkpoint in the folder that is whole, or start if there is none yet. The
            result is that of a run that was never interrupted, bit for bit; everything else must be the same, but for a
            num_episodes that may be larger. What callbacks remember is theirs to save. With a checkpoint, functions and
            classes of your own need a name that can be imported; that and their source tell whether they are the same.
        verbose: 1 prints a line every 100 episodes and one when solved, 2 shows a progress bar beside them, 0 nothing.

    Ctrl-C, an interrupted notebook cell and SIGTERM end the run at the end of an episode, saved if there is a
    checkpoint, and `train` returns what there is, marked `interrupted`; a second one raises KeyboardInterrupt.

    Raises:
        TypeError, ValueError: an argument or a space is not supported; the network does not fit the environment; the
            environment returned a NaN, an infinity or another shape than promised (the message names episode and
            step); learning diverged.
    """
    check_arguments(env, config, verbose)
    callbacks = [callbacks] if isinstance(callbacks, keras.callbacks.Callback) else list(callbacks)
    for callback in callbacks:
        if not isinstance(callback, keras.callbacks.Callback):
            raise TypeError(f"callbacks must be Keras callbacks, got {callback!r}")
    if resume and checkpoint is None:
        raise ValueError("resume needs a folder to resume from: checkpoint, got None")
    checkpoint_every = count("checkpoint_every", checkpoint_every)
    spaces = check_environment(env, q_network)
    formulas = _check_own_parts(config, q_network, optimizer, targets, loss)
    if checkpoint is not None:
        checkpoints = Checkpoints(checkpoint, env, config, q_network, optimizer, formulas)
    else:
        checkpoints = None
    agent = make_agent(
        spaces.state_shape,
        spaces.num_actions,
        config,
        checked_seed(seed),
        q_network,
        optimizer,
        some_states(env.observation_space, spaces.state_dtype),
        spaces.state_dtype,
    )
    if checkpoints:
        _start_or_resume(checkpoints, agent, seed, resume, verbose)

    if isinstance(env, FuncEnv):
        # A callback may change the agent between episodes, and sees it as it then is.
        only_logs = all(type(callback) is keras.callbacks.CSVLogger for callback in callbacks)
        episodes_per_call = min(100, checkpoint_every) if only_logs else 1
        episodes = compiled_loop.episodes(env, spaces, agent, config, episodes_per_call, formulas)
    else:
        episodes = gymnasium_loop.episodes(CheckedEnv(env), agent, config, formulas)
    saved_at = len(agent.episodes)
    speeds = [math.nan] * saved_at
    played = _timed(episodes, agent, speeds)
    if callbacks:
        played = _with_callbacks(played, agent, config, callbacks, speeds)

    is_over, diverged = _is_solved(agent.episodes, config), False  # a resumed run may be solved
    bar = tqdm(total=config.num_episodes, initial=saved_at, unit="episode", disable=verbose < 2)
    say = bar.write if verbose == 2 else print
    with stop_requests() as is_asked_to_stop, bar, optimizer_shown(agent):
        with contextlib.closing(played):
            while not is_over:
                try:
                    episode = next(played, None)
                except DivergedError:
                    if not (callbacks and agent.q_network.stop_training):
                        raise
                    diverged = True
                    break
                if episode is None:
                    break
                bar.update()
                if verbose and episode.number % 100 == 0:
                    last = [e.reward for e in agent.episodes[max(0, episode.number - 99) : episode.number + 1]]
                    average = round(float(np.mean(last)), 2)
                    say(f"Episode {episode.number}, Reward: {episode.reward}, Last 100 Average: {average}")
                if len(agent.episodes) > episode.number + 1:
                    continue  # compiled episodes: the agent is already further
                if checkpoints and len(agent.episodes) >= saved_at + checkpoint_every:
                    _save_or_warn(checkpoints, agent)
                    saved_at = len(agent.episodes)
                is_over = _is_solved(agent.episodes, config) or is_asked_to_stop()
        if checkpoints and not diverged and (callbacks or len(agent.episodes) > saved_at):
            _save_or_warn(checkpoints, agent)  # after on_train_end, in which a callback may change the agent
        interrupted = is_asked_to_stop()
    agent.optimizer.finalize_variable_values(agent.q_network.trainable_variables)  # as `fit` does: averages, if it has

    run = Run(config, agent, interrupted, diverged, speeds)
    if verbose and run.solved_at is not None:
        average = round(float(np.mean(run.rewards[-config.solved_window :])), 2)
        print(f"Solved with {average} reward in {run.solved_at} episodes!")
    elif verbose and interrupted:
        kept = f", kept in {checkpoints.folder}" if checkpoints else ""
        print(f"Interrupted after {len(agent.episodes)} episodes{kept}")
    if not (agent.num_updates or interrupted or diverged):
        warnings.warn(
            f"train ended without an update: the memory holds {len(agent.memory)} transitions, "
            f"batch_size is {config.batch_size}",
            stacklevel=2,
        )
    return run


def check_arguments(env: gym.Env | FuncEnv, config: Config, verbose: int) -> None:
    """TypeError or ValueError that names the one which cannot be used."""
    if not isinstance(env, gym.Env | FuncEnv):
        raise TypeError(f"env must be a gymnasium.Env or a FuncEnv, got {env!r}")
    if not isinstance(config, Config):
        raise TypeError(f"config must be a Config, got {config!r}")
    if verbose not in (0, 1, 2):
        raise ValueError(f"verbose must be 0, 1 or 2, got {verbose!r}")
    if isinstance(env, FuncEnv) and not config.jit_compile:
        raise ValueError("jit_compile must be True for a functional environment, got False: its loop needs XLA")


def check_environment(env: gym.Env | FuncEnv, q_network: keras.Model | None = None) -> Spaces:
    """The sizes of its spaces; ValueError if they are not supported, or not by the network (None: the default one)."""
    if isinstance(env, FuncEnv):
        name, spaces = type(env).__name__, compiled_loop.check_functional(env)
    else:
        door = CheckedEnv(env)
        name, spaces = door.name, door.spaces
    if q_network is not None:
        check_fits(q_network, spaces.state_shape, spaces.num_actions)
    elif len(spaces.state_shape) != 1:
        raise ValueError(
            f"env {name} has observations of shape {spaces.state_shape}, the default network takes one axis: "
            "q_network must be a network of your own, got None (or wrap env in gymnasium.wrappers.FlattenObservation)"
        )
    return spaces


def _check_own_parts(
    config: Config,
    q_network: keras.Model | None,
    optimizer: keras.Optimizer | None,
    targets: Callable,
    loss: str | Callable | None,
) -> Formulas:
    """The formulas to learn by; TypeError, ValueError or a warning for what cannot be used, or not as it is meant."""
    if optimizer is not None:
        check_optimizer(optimizer)
    owners = None if q_network is None else owners_optimizer(q_network)
    if owners is not None:
        if loss is None:
            loss = getattr(q_network, "loss", None)
        config_of_compile = getattr(getattr(q_network, "_compile_config", None), "config", {})
        ignored = [x for x in ("metrics", "weighted_metrics", "loss_weights") if config_of_compile.get(x)]
        if ignored:
            warnings.warn(f"{', '.join(ignored)} of q_network.compile are not used by train", stacklevel=3)
    formulas = Formulas(targets, "mse" if loss is None else loss)
    formulas.check()
    if (in_use := optimizer or owners) is not None:
        _check_learning_rate(in_use, config)
    if q_network is not None:
        warn_of_inference_mode(q_network)
    return formulas


def _check_learning_rate(optimizer: keras.Optimizer, config: Config) -> None:
    """ValueError if alpha says something else; a warning if it is a Python function, which is not called each time."""
    rate = optimizer.learning_rate
    is_alpha = isinstance(rate, keras.Variable) and math.isclose(rate.numpy(), config.alpha, rel_tol=1e-6)
    if config.alpha != Config.alpha and not is_alpha:
        raise ValueError(
            f"alpha must be left at its default of {Config.alpha} with an optimizer of your own, whose learning rate "
            f"counts, got {config.alpha}"
        )
    if isinstance(rate, int | float):
        warnings.warn(
            f"the learning rate of {optimizer.name!r} is a Python function, which is called once, when the learning "
            f"step is compiled: it stays at {rate}; a keras.optimizers.schedules.LearningRateSchedule would change",
            stacklevel=4,
        )


def _is_solved(episodes: Sequence[Episode], config: Config) -> bool:
    """The stop rule, at the end of the last episode.

    The original also takes the mean of fewer episodes than the window, so that one lucky first episode could stop it.
    """
    last = [episode.reward for episode in episodes[-config.solved_window :]]
    return len(last) == config.solved_window and float(np.mean(last)) > config.solved_reward


def _start_or_resume(checkpoints: Checkpoints, agent: Agent, seed: int | None, resume: bool, verbose: int) -> None:
    """Bring the agent to where the run is, and have a checkpoint there before any work starts."""
    if not resume and (paths := checkpoints.paths()):
        raise ValueError(
            f"checkpoint {paths[0]} is there already; resume=True goes on from it, another folder starts anew"
        )
    path = checkpoints.restore(agent, seed) if resume else None
    if path is None:
        checkpoints.save(agent)
    if verbose and resume:
        print(f"Resumed at episode {len(agent.episodes)} from {path}" if path else "Nothing to resume: starting anew")


def _save_or_warn(checkpoints: Checkpoints, agent: Agent) -> None:
    try:
        checkpoints.save(agent)
    except OSError as error:
        warnings.warn(
            f"checkpoint after episode {len(agent.episodes) - 1} could not be saved ({error}); the last one stays",
            stacklevel=3,
        )


def _timed(episodes: Iterator[Episode], agent: Agent, steps_per_second: list[float]) -> Generator[Episode, None, None]:
    """The same episodes; the speed of each is appended. Those that are played in one call have that of the call."""
    while True:
        start = time.perf_counter()
        episode = next(episodes, None)
        if episode is None:
            return
        if len(steps_per_second) <= episode.number:
            new = agent.episodes[episode.number :]
            speed = sum(e.steps for e in new) / (time.perf_counter() - start)
            steps_per_second += [speed] * len(new)
        yield episode


def _with_callbacks(
    episodes: Iterator[Episode],
    agent: Agent,
    config: Config,
    callbacks: Sequence[keras.callbacks.Callback],
    steps_per_second: list[float],
) -> Generator[Episode, None, None]:
    """The same episodes, each told to the callbacks as an epoch of one batch, until one of them asks to stop."""
    network, log = agent.q_network, Log(config)
    network.stop_training = False
    listeners = keras.callbacks.CallbackList(callbacks, model=network, epochs=config.num_episodes, steps=1, verbose=0)

    def tell(event: str, number: int, logs: dict[str, float]) -> None:
        for callback in listeners.callbacks:  # the list's own methods take 50 us: they look for tensors in the logs
            getattr(callback, event)(number, logs)

    for episode, speed in zip(agent.episodes, steps_per_second, strict=True):
        log.add(episode, speed)
    listeners.on_train_begin()
    for callback in listeners.callbacks:
        if isinstance(callback, keras.callbacks.CSVLogger):
            callback.keys = sorted(Logged._fields)  # or it adds an empty column val_NAME to each, which costs as much
    try:
        for number in range(len(agent.episodes), config.num_episodes):
            tell("on_epoch_begin", number, {})
            tell("on_train_batch_begin", 0, {})
            try:
                episode = next(episodes)
            except DivergedError:
                tell("on_train_batch_end", 0, {"loss": math.nan})
                raise
            logs = log.add(episode, steps_per_second[number])._asdict()
            tell("on_train_batch_end", 0, {} if math.isnan(episode.loss) else {"loss": episode.loss})
            tell("on_epoch_end", number, logs)
            yield episode
            if network.stop_training:
                break
    finally:
        listeners.on_train_end()
