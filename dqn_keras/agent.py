"""The agent: everything that a run changes, and the record of one of its episodes."""

import contextlib
import dataclasses
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
from dqn_keras.seeding import _derived


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


class DivergedError(ValueError):
    """The loss or a weight is not finite any more."""


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
    """An agent that has seen nothing.

    Weights and random stream follow from `seed` alone, but for the weights of a network that is given. That learns
    with its owner's optimizer if it was compiled, or else is compiled with `loss`. `some_states` [B, *S] are what its
    copy is compared on.
    """
    sizes = (*state_shape, *config.hidden_units, num_actions)
    is_default = q_network is None and optimizer is None and loss == "mse"
    learner = recycled(sizes, config.alpha, _derived(seed, 0)) if is_default else None
    if learner is None:
        if q_network is None:
            (num_features,) = state_shape
            networks = make_networks(num_features, num_actions, config.hidden_units, _derived(seed, 0))
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
        rng=np.random.default_rng(_derived(seed, 1)),
        epsilon=config.epsilon,
    )


_compiled_with_our_adam: weakref.WeakKeyDictionary[keras.Model, keras.Optimizer] = weakref.WeakKeyDictionary()


def owners_optimizer(q_network: keras.Model | None) -> keras.Optimizer | None:
    """The optimizer that the network was compiled with, if somebody chose it; None for none, or for our own Adam."""
    if q_network is None or not q_network.compiled or q_network.optimizer is _compiled_with_our_adam.get(q_network):
        return None
    return q_network.optimizer


def _optimizer_for(
    q_network: keras.Model, optimizer: keras.Optimizer | None, loss: str | Callable, config: Config
) -> keras.Optimizer:
    """The given one, or else Adam. A network that its owner has not compiled is compiled with it and with the loss.

    Keras' callbacks and .keras files look for both there.
    """
    if optimizer is not None:
        if owners_optimizer(q_network) is None:
            q_network.compile(optimizer=optimizer, loss=loss, auto_scale_loss=False)
        return optimizer
    # In mixed precision, Keras puts a LossScaleOptimizer around it, as it does for `model.fit`.
    q_network.compile(optimizer=keras.optimizers.Adam(learning_rate=config.alpha, name="adam"), loss=loss)
    _compiled_with_our_adam[q_network] = q_network.optimizer
    return q_network.optimizer


def keeps_averages(optimizer: keras.Optimizer) -> bool:
    """Whether it averages the weights, and puts the averages in their place at the end."""
    return getattr(getattr(optimizer, "inner_optimizer", optimizer), "use_ema", False)


@contextlib.contextmanager
def optimizer_shown(agent: Agent) -> Iterator[None]:
    """Within, callbacks find the agent's optimizer in its network, whatever the owner has compiled it with."""
    network, owners = agent.q_network, agent.q_network.optimizer
    network.optimizer = agent.optimizer
    try:
        yield
    finally:
        network.optimizer = owners
