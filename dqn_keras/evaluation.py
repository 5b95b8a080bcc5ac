"""Greedy episodes: how good a network is without exploration."""

import gymnasium as gym
import numpy as np

from dqn_keras._engine.numpy_acting import q_function
from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.environments import CheckedEnv
from dqn_keras.checks.networks import check_fits
from dqn_keras.checks.numbers import check_count
from dqn_keras.seeding import checked_seed, evaluation_seed


def evaluate(
    env: gym.Env, q_network: keras.Model, num_episodes: int = 100, seed: int | None = None, max_steps: int = 1_000
) -> np.ndarray:
    """Plays greedily without learning, and returns each episode's undiscounted return, [num_episodes] float64.

    Args:
        env: a gymnasium.Env, as for `train`.
        q_network: a network, states [B, *S] -> Q-values [B, A].
        num_episodes: number of episodes.
        seed: a whole number; None draws one. The start of episode k depends on (seed, k) alone; `train` never uses it.
        max_steps: maximum number of environment steps per episode.

    Raises:
        TypeError, ValueError: as for `train`; or the network does not fit the environment.
    """
    checked_env = CheckedEnv(env)
    check_fits(q_network, checked_env.spaces.state_shape, checked_env.spaces.num_actions)
    num_episodes, max_steps = check_count("num_episodes", num_episodes), check_count("max_steps", max_steps)
    seed = checked_seed(seed)
    q_values = q_function(q_network)
    returns = np.zeros(num_episodes)
    for episode in range(num_episodes):
        state = checked_env.reset(evaluation_seed(seed, episode), episode)
        for _ in range(max_steps):
            state, reward, terminated, truncated = checked_env.step(int(q_values(state).argmax()))
            returns[episode] += reward
            if terminated or truncated:
                break
    return returns
