"""The agent: all state that a run changes."""

import contextlib
import dataclasses
import math
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from dqn_keras._engine.copies import copy
from dqn_keras._engine.programs import Learner
from dqn_keras._engine.recycling import recycled
from dqn_keras._engine.tensorflow import keras
from dqn_keras.config import Config
from dqn_keras.metrics import Episode
from dqn_keras.networks import make_networks
from dqn_keras.replay import ReplayMemory
from dqn_keras.seeding import acting_rng, weights_seed


@dataclasses.dataclass
class Agent:
    """The networks and all other state that a run keeps from one episode to the next."""

    seed: int
    q_network: keras.Sequential
    q_hat_network: keras.Sequential
    optimizer: keras.Optimizer
    memory: ReplayMemory
    rng: np.random.Generator
    """Source of the random draws for acting and sampling in a gymnasium.Env."""
    epsilon: float
    """Probability of a random action in the next episode; `policy.epsilon_at` gives the probability at one step."""
    episodes: list["Episode"] = dataclasses.field(default_factory=list)
    """Records of the episodes so far. The length of the list is the number of the next episode."""
    num_updates: int = 0
    """Number of gradient steps taken."""

    def is_done(self, config: Config) -> bool:
        """Returns whether the run has played all its episodes or all its steps."""
        num_steps = self.memory.num_appended
        return len(self.episodes) >= config.num_episodes or num_steps >= (config.num_steps or math.inf)

    @property
    def learner(self) -> Learner:
        """The networks and the optimizer, which a gradient step changes."""
        return Learner(self.q_network, self.q_hat_network, self.optimizer)


class DivergedError(ValueError):
    """The error for a loss or a weight that is no longer finite."""


def make_agent(
    state_shape: tuple[int, ...],
    num_actions: int,
    config: Config,
    seed: int,
    q_network: keras.Model | None = None,
    optimizer: keras.Optimizer | None = None,
    loss: str | Callable = "mse",
    some_states: np.ndarray | None = None,
    dtype: Any = np.float32,
) -> Agent:
    """Returns an untrained agent.

    Its weights and random numbers depend on `seed` alone, except that a given `q_network` keeps its own weights. If the
    owner of `q_network` compiled it, that optimizer is used, unless `optimizer` is given. A network
    that is not compiled is compiled here, with `loss`. `some_states` [B, *S] are used to compare it with its copy.
    """
    sizes = (*state_shape, *config.hidden_units, num_actions)
    is_default = q_network is None and optimizer is None and loss == "mse"
    learner = recycled(sizes, config.alpha, weights_seed(seed)) if is_default else None
    if learner is None:
        if q_network is None:
            (num_features,) = state_shape
            networks = make_networks(num_features, num_actions, config.hidden_units, weights_seed(seed))
        else:
            networks = q_network, copy(q_network, some_states)
            optimizer = optimizer or owners_optimizer(q_network)
        learner = Learner(*networks, _optimizer_for(networks[0], optimizer, loss, config))
        learner.prepare()
    return Agent(
        seed=seed,
        q_network=learner.q_network,
        q_hat_network=learner.q_hat_network,
        optimizer=learner.optimizer,
        memory=ReplayMemory(config.memory_size, state_shape, dtype),
        rng=acting_rng(seed),
        epsilon=config.epsilon,
    )


_compiled_with_our_adam: weakref.WeakKeyDictionary[keras.Model, keras.Optimizer] = weakref.WeakKeyDictionary()


def owners_optimizer(q_network: keras.Model | None) -> keras.Optimizer | None:
    """Returns the optimizer that the network's owner compiled it with; None if there is none, or only our own Adam."""
    if q_network is None or not q_network.compiled or q_network.optimizer is _compiled_with_our_adam.get(q_network):
        return None
    return q_network.optimizer


def _optimizer_for(
    q_network: keras.Model, optimizer: keras.Optimizer | None, loss: str | Callable, config: Config
) -> keras.Optimizer:
    """Returns the given optimizer, or else Adam; compiles the network with it and `loss`, if its owner has not.

    Keras' callbacks and .keras files take both from the network.
    """
    if optimizer is not None:
        if owners_optimizer(q_network) is None:
            q_network.compile(optimizer=optimizer, loss=loss, auto_scale_loss=False)
        return optimizer
    # In mixed precision, Keras wraps Adam in a LossScaleOptimizer, as it does for `model.fit`.
    q_network.compile(optimizer=keras.optimizers.Adam(learning_rate=config.alpha, name="adam"), loss=loss)
    _compiled_with_our_adam[q_network] = q_network.optimizer
    return q_network.optimizer


def keeps_averages(optimizer: keras.Optimizer) -> bool:
    """Returns whether the optimizer averages the weights and replaces them with the averages at the end."""
    return getattr(getattr(optimizer, "inner_optimizer", optimizer), "use_ema", False)


@contextlib.contextmanager
def optimizer_shown(agent: Agent) -> Iterator[None]:
    """Sets the agent's optimizer in its network, where callbacks look for it; restores the owner's at the end."""
    network, owners = agent.q_network, agent.q_network.optimizer
    network.optimizer = agent.optimizer
    try:
        yield
    finally:
        network.optimizer = owners
