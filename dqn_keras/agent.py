"""The agent: everything that a run changes, and the record of one of its episodes."""

import dataclasses
from collections.abc import Hashable
from typing import Any, NamedTuple

import numpy as np

from dqn_keras._tensorflow import keras
from dqn_keras.config import Config, count
from dqn_keras.networks import copy, make_networks, renew_weights
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
    """Mean over its updates, as are the next three but for max_q; NaN if it had none."""
    mean_q: float
    """Mean over a batch of max_a Q(s, a)."""
    max_q: float
    """The highest Q-value in any of its batches."""
    td_error: float
    """Mean over a batch of |y - Q(s, a)|."""
    max_reward: float
    """The highest of one step."""
    terminated: bool
    """Whether the environment ended it, not time."""


class DivergedError(ValueError):
    """The loss or a weight is not finite any more."""


def make_agent(
    state_shape: tuple[int, ...],
    num_actions: int,
    config: Config,
    seed: int,
    q_network: keras.Model | None = None,
    dtype: Any = np.float32,
) -> Agent:
    """An agent that has seen nothing.

    Weights and random stream follow from `seed` alone, but for the weights of a network that is given.
    """
    if q_network is not None:
        learner = _adopt(q_network, config)
    elif learner := _recycled.pop((state_shape, num_actions, config.hidden_units), None):  # type: ignore[arg-type]
        _renew(learner, config, seed)
    else:
        learner = _make_learner(state_shape, num_actions, config, seed)
    return Agent(
        seed=seed,
        q_network=learner.q_network,
        q_hat_network=learner.q_hat_network,
        optimizer=learner.optimizer,
        memory=ReplayMemory(config.memory_size, state_shape, dtype),
        rng=np.random.default_rng(_derived(seed, 1)),
        epsilon=config.epsilon,
    )


def _make_learner(state_shape: tuple[int, ...], num_actions: int, config: Config, seed: int) -> Learner:
    (num_features,) = state_shape
    networks = make_networks(num_features, num_actions, config.hidden_units, _derived(seed, 0))
    return _with_optimizer(*networks, config)


def _adopt(q_network: keras.Model, config: Config) -> Learner:
    """A network of someone else's: Q-hat starts as its equal."""
    if not q_network.trainable_variables:
        raise ValueError("q_network must have weights that can be trained, got none")
    try:
        q_hat_network = copy(q_network)
    except Exception as error:  # whatever a layer's own code says
        raise ValueError(f"q_network must be one that Keras can copy, but: {error}") from error
    return _with_optimizer(q_network, q_hat_network, config)


def _with_optimizer(q_network: keras.Model, q_hat_network: keras.Model, config: Config) -> Learner:
    optimizer = keras.optimizers.Adam(learning_rate=config.alpha, name="adam")
    q_network.compile(optimizer=optimizer, loss="mse")  # Keras' callbacks and .keras files look for it there
    optimizer.build(q_network.trainable_variables)
    return Learner(q_network, q_hat_network, optimizer)


_recycled: dict[Hashable, Learner] = {}


def recycle(agent: Agent, config: Config) -> None:
    """Give up an agent, and have the next one of its shape made in its networks: to build them takes a while."""
    _recycled[agent.memory.state_shape, agent.q_network.output_shape[-1], config.hidden_units] = agent.learner


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
