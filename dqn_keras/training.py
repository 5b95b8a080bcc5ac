"""train: a whole run, from fresh networks to the stop rule."""

import dataclasses
import warnings
from collections.abc import Iterator, Sequence

import gymnasium as gym
import keras
import numpy as np

from dqn_keras import gymnasium_loop
from dqn_keras.agent import Agent, Episode, checked_seed, make_agent
from dqn_keras.config import Config
from dqn_keras.environment import CheckedEnv


@dataclasses.dataclass(repr=False)
class Run:
    """What came of `train`."""

    config: Config
    agent: Agent
    """Networks, optimizer, memory and random state, as the last episode left them."""
    episodes: list[Episode]
    solved_at: int | None
    """The number (from 0) of the episode at whose end the stop rule held; None if it never did."""

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
    env: gym.Env,
    config: Config = Config(),
    seed: int | None = None,
    *,
    verbose: int = 1,
    callbacks: Sequence[keras.callbacks.Callback] = (),
) -> Run:
    """Train a Deep Q-Network from scratch until it solves `env` or `config.num_episodes` are over.

    Args:
        env: a gymnasium.Env with a Box observation space of one axis and a Discrete action space.
        config: the parameters; by default the original notebook's.
        seed: a whole number. One seed, one result, bit for bit, on one machine; None draws one (see `run.seed`).
        verbose: 1 prints a line every 100 episodes and one when solved, 0 nothing.
        callbacks: Keras callbacks; an episode is an epoch, and its logs are reward, steps, epsilon, loss.

    Raises:
        TypeError, ValueError: an argument or a space is not supported; the environment returned a NaN,
            an infinity or another shape than promised (the message names episode and step); learning diverged.
    """
    checked_env = CheckedEnv(env)
    if not isinstance(config, Config):
        raise TypeError(f"config must be a Config, got {config!r}")
    if verbose not in (0, 1):
        raise ValueError(f"verbose must be 0 or 1, got {verbose!r}")
    agent = make_agent(checked_env.num_features, checked_env.num_actions, config, checked_seed(seed))
    played: list[Episode] = []
    solved_at = None

    for episode in _with_callbacks(gymnasium_loop.episodes(checked_env, agent, config), agent, config, callbacks):
        played.append(episode)
        recent = [e.reward for e in played[-max(100, config.solved_window) :]]
        if verbose and episode.number % 100 == 0:
            average = round(float(np.mean(recent[-100:])), 2)
            print(f"Episode {episode.number}, Reward: {episode.reward}, Last 100 Average: {average}")
        average = float(np.mean(recent[-config.solved_window :]))
        # The original also takes the mean of fewer episodes, so that one lucky first episode could stop it.
        if len(played) >= config.solved_window and average > config.solved_reward:
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
    return Run(config, agent, played, solved_at)


def _with_callbacks(
    episodes: Iterator[Episode], agent: Agent, config: Config, callbacks: Sequence[keras.callbacks.Callback]
) -> Iterator[Episode]:
    """The same episodes, each told to the callbacks as an epoch, until one of them asks to stop."""
    agent.q_network.stop_training = False
    listeners = keras.callbacks.CallbackList(callbacks, model=agent.q_network, epochs=config.num_episodes)
    listeners.on_train_begin()
    try:
        while agent.num_episodes < config.num_episodes and not agent.q_network.stop_training:
            listeners.on_epoch_begin(agent.num_episodes)
            episode = next(episodes)
            listeners.on_epoch_end(episode.number, episode._asdict())
            yield episode
    finally:
        listeners.on_train_end()
