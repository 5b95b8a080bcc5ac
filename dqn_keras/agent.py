"""The agent: everything that a run changes, and the record of one of its episodes."""

import dataclasses
from collections.abc import Hashable
from typing import NamedTuple

import keras
import numpy as np

from dqn_keras.config import Config, count
from dqn_keras.networks import make_networks, renew_weights
from dqn_keras.programs import Learner
from dqn_keras.replay import ReplayMemory


@dataclasses.dataclass
class Agent:
    """What learns, and all that it carries from one episode to the next."""

    seed: int
    q_network: keras.Sequential
    q_hat_network: keras.Sequential
    optimizer: keras.Optimizer
    memory: ReplayMemory
    rng: np.random.Generator
    """The source of every random draw of acting and sampling."""
    epsilon: float
    """Probability of a random action in the next episode."""
    episodes: list["Episode"] = dataclasses.field(default_factory=list)
    """The record so far; its length is the number of the next episode."""
    num_updates: int = 0
    """Gradient steps taken."""

    @property
    def learner(self) -> Learner:
        """What a gradient step changes."""
        return Learner(self.q_network, self.q_hat_network, self.optimizer)


class Episode(NamedTuple):
    """What happened in one episode."""

    number: int
    """Counted from 0."""
    reward: float
    """Sum of its rewards, undiscounted."""
    steps: int
    epsilon: float
    """With which it was played."""
    loss: float
    """Mean over its updates; NaN if it had none."""


def make_agent(num_features: int, num_actions: int, config: Config, seed: int) -> Agent:
    """An agent that has seen nothing; weights and random stream follow from `seed` alone."""
    learner = _recycled.pop((num_features, num_actions, config.hidden_units), None)
    if learner is None:
        learner = _make_learner(num_features, num_actions, config, seed)
    else:
        _renew(learner, config, seed)
    return Agent(
        seed=seed,
        q_network=learner.q_network,
        q_hat_network=learner.q_hat_network,
        optimizer=learner.optimizer,
        memory=ReplayMemory(config.memory_size, num_features),
        rng=np.random.default_rng(_derived(seed, 1)),
        epsilon=config.epsilon,
    )


def _make_learner(num_features: int, num_actions: int, config: Config, seed: int) -> Learner:
    q_network, q_hat_network = make_networks(num_features, num_actions, config.hidden_units, _derived(seed, 0))
    optimizer = keras.optimizers.Adam(learning_rate=config.alpha, name="adam")
    q_network.compile(optimizer=optimizer, loss="mse")  # Keras' callbacks and .keras files look for it there
    optimizer.build(q_network.trainable_variables)
    return Learner(q_network, q_hat_network, optimizer)


_recycled: dict[Hashable, Learner] = {}


def recycle(agent: Agent, config: Config) -> None:
    """Give up an agent, and have the next one of its shape made in its networks: to build them takes a while."""
    _recycled[agent.memory.num_features, agent.q_network.output_shape[-1], config.hidden_units] = agent.learner


def _renew(learner: Learner, config: Config, seed: int) -> None:
    """Put networks and optimizer back to how `_make_learner` makes them for `seed`."""
    renew_weights(learner.q_network, _derived(seed, 0))
    learner.q_hat_network.set_weights(learner.q_network.get_weights())
    for variable in learner.optimizer.variables:
        variable.assign(np.zeros(variable.shape, variable.dtype))
    learner.optimizer.learning_rate = config.alpha


def episode_seed(seed: int, episode: int) -> int:
    """The seed of `env.reset` for one episode of a run, so that any episode can be begun again exactly."""
    return int(_derived(seed, 2, episode).generate_state(1)[0])


def evaluation_seed(seed: int, episode: int) -> int:
    """The same for an episode of `evaluate`, which so starts where no episode of `train` did."""
    return int(_derived(seed, 3, episode).generate_state(1)[0])


def draws_key(seed: int) -> np.int64:
    """The number that all draws of a compiled run follow from."""
    return _derived(seed, 4).generate_state(1, np.uint64).view(np.int64)[0]


def checked_seed(seed: int | None) -> int:
    """`seed` as an int; a fresh random one for None."""
    if seed is None:
        return int(np.random.SeedSequence().generate_state(1)[0] >> 1)
    return count("seed", seed, at_least=0)


def _derived(seed: int, *key: int) -> np.random.SeedSequence:
    """One of the independent streams that belong to `seed`."""
    return np.random.SeedSequence(seed, spawn_key=key)
