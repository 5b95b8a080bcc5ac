"""train: a whole run, from fresh networks to the stop rule."""

import contextlib
import dataclasses
import warnings
from collections import deque
from collections.abc import Generator, Iterator, Sequence

import gymnasium as gym
import keras
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras import compiled_loop, gymnasium_loop
from dqn_keras.agent import Agent, Episode, checked_seed, make_agent
from dqn_keras.config import Config
from dqn_keras.environment import CheckedEnv


@dataclasses.dataclass(repr=False)
class Run:
    """What came of `train`."""

    config: Config
    agent: Agent
    """Networks, optimizer, memory and random state, as the last episode left them."""
    solved_at: int | None
    """The number (from 0) of the episode at whose end the stop rule held; None if it never did."""

    @property
    def episodes(self) -> list[Episode]:
        """What happened, episode by episode."""
        return self.agent.episodes

    @property
    def rewards(self) -> np.ndarray:
        """[num_episodes] float64, each episode's undiscounted sum."""
        return np.array([episode.reward for episode in self.episodes], np.float64)

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

    def __repr__(self) -> str:
        outcome = "not solved" if self.solved_at is None else f"solved_at={self.solved_at}"
        return f"<Run: seed={self.seed}, {len(self.episodes)} episodes, {outcome}>"


def train(
    env: gym.Env | FuncEnv,
    config: Config = Config(),
    seed: int | None = None,
    *,
    verbose: int = 1,
    callbacks: Sequence[keras.callbacks.Callback] = (),
) -> Run:
    """Train a Deep Q-Network from scratch until it solves `env` or `config.num_episodes` are over.

    Args:
        env: a gymnasium.Env with a Box observation space of one axis and a Discrete action space; or a
            functional one (gymnasium.experimental.functional.FuncEnv) written in TensorFlow, whose episodes are
            compiled whole, such as `dqn_keras.environments.CartPole()`.
        config: the parameters; by default the original notebook's.
        seed: a whole number. One seed, one result, bit for bit, on one machine; None draws one (see `run.seed`).
        verbose: 1 prints a line every 100 episodes and one when solved, 0 nothing.
        callbacks: Keras callbacks; an episode is an epoch, and its logs are number, reward, steps, epsilon, loss.

    Raises:
        TypeError, ValueError: an argument or a space is not supported; the environment returned a NaN,
            an infinity or another shape than promised (the message names episode and step); learning diverged.
    """
    if not isinstance(config, Config):
        raise TypeError(f"config must be a Config, got {config!r}")
    if verbose not in (0, 1):
        raise ValueError(f"verbose must be 0 or 1, got {verbose!r}")
    seed = checked_seed(seed)
    if isinstance(env, FuncEnv):
        spaces = compiled_loop.check_functional(env)
        agent = make_agent(spaces.num_features, spaces.num_actions, config, seed)
        # A callback may change the agent between episodes, and sees it as it then is.
        episodes = compiled_loop.episodes(env, spaces, agent, config, episodes_per_call=1 if callbacks else 100)
    else:
        checked_env = CheckedEnv(env)
        agent = make_agent(checked_env.spaces.num_features, checked_env.spaces.num_actions, config, seed)
        episodes = gymnasium_loop.episodes(checked_env, agent, config)
    solved_at = None

    recent: deque[float] = deque(maxlen=max(100, config.solved_window))
    if callbacks:
        episodes = _with_callbacks(episodes, agent, config, callbacks)
    with contextlib.closing(episodes) as played:
        for episode in played:
            recent.append(episode.reward)
            if verbose and episode.number % 100 == 0:
                average = round(float(np.mean(list(recent)[-100:])), 2)
                print(f"Episode {episode.number}, Reward: {episode.reward}, Last 100 Average: {average}")
            average = float(np.mean(list(recent)[-config.solved_window :]))
            # The original also takes the mean of fewer episodes, so that one lucky first episode could stop it.
            if len(recent) >= config.solved_window and average > config.solved_reward:
                solved_at = episode.number
                if verbose:
                    print(f"Solved with {round(average, 2)} reward in {episode.number} episodes!")
                break

    if not agent.num_updates:
        warnings.warn(
            f"train ended without an update: the memory holds {len(agent.memory)} transitions, "
            f"batch_size is {config.batch_size}",
            stacklevel=2,
        )
    return Run(config, agent, solved_at)


def _with_callbacks(
    episodes: Iterator[Episode], agent: Agent, config: Config, callbacks: Sequence[keras.callbacks.Callback]
) -> Generator[Episode, None, None]:
    """The same episodes, each told to the callbacks as an epoch, until one of them asks to stop."""
    agent.q_network.stop_training = False
    listeners = keras.callbacks.CallbackList(callbacks, model=agent.q_network, epochs=config.num_episodes)
    listeners.on_train_begin()
    try:
        for number in range(len(agent.episodes), config.num_episodes):
            listeners.on_epoch_begin(number)
            episode = next(episodes)
            listeners.on_epoch_end(episode.number, episode._asdict())
            yield episode
            if agent.q_network.stop_training:
                break
    finally:
        listeners.on_train_end()
