"""Evaluation: how well a network plays without exploration, after a run or during it."""

import math
import os
import warnings

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.numpy_acting import q_function
from dqn_keras._engine.tensorflow import keras
from dqn_keras.agent import keeps_averages
from dqn_keras.checks.environments import CheckedEnv, Spaces, check_functional
from dqn_keras.checks.networks import check_fits
from dqn_keras.checks.numbers import check_count, check_path, shown
from dqn_keras.loops.greedy import greedy_returns
from dqn_keras.seeding import checked_seed, evaluation_seed
from dqn_keras.storage.networks import load_q_network, save_q_network


def evaluate(
    env: gym.Env | FuncEnv,
    q_network: keras.Model,
    num_episodes: int = 100,
    seed: int | None = None,
    max_steps: int = 1_000,
) -> np.ndarray:
    """Plays greedy episodes and returns the undiscounted return of each, [num_episodes] float64.

    Args:
        env: an environment, as for `train`. All episodes of a functional one are compiled into one call.
        q_network: a network, states [B, *S] -> Q-values [B, A].
        num_episodes: number of episodes.
        seed: a whole number; None draws one. The start state of episode k depends on (seed, k) alone, and differs
            from all start states in training.
        max_steps: maximum number of environment steps per episode.

    Raises:
        TypeError, ValueError: as for `train`; or the network does not fit the environment.
    """
    spaces = _spaces(env)
    check_fits(q_network, spaces.state_shape, spaces.num_actions)
    num_episodes, max_steps = check_count("num_episodes", num_episodes), check_count("max_steps", max_steps)
    seed = checked_seed(seed)
    if isinstance(env, FuncEnv):
        return greedy_returns(env, spaces, q_network, num_episodes, seed, max_steps)
    checked_env = CheckedEnv(env)
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


def _spaces(env: gym.Env | FuncEnv) -> Spaces:
    return check_functional(env) if isinstance(env, FuncEnv) else CheckedEnv(env).spaces


class Evaluation(keras.callbacks.Callback):
    """Evaluates the network during a run and keeps the best one: a Keras callback for `train`.

    `train` explores, and it learns between the steps of an episode. So an episode's reward does not measure any one
    network. This callback plays greedily in its own environment: at the start of the run, after each episode in which
    the number of environment steps reaches a multiple of `every_steps`, and at the end of the run. The seeds are the
    same each time, so that two evaluations differ only by their networks. Training gives the same result, bit for bit,
    as without the callback. With it, as with most callbacks, compiled episodes are played one at a time.

    The mean return is logged as `greedy_return`: in `run.history`, and for all other callbacks, wherever they are in
    the list. An episode without an evaluation logs the latest mean return, not NaN: if a NaN came first, Keras'
    callbacks would keep it as their best value. So `EarlyStopping("greedy_return", mode="max", patience=...)` counts
    its patience in episodes. The evaluation at the end comes after the last episode's log.

    A new run replaces the file `best`. A resumed run first evaluates the network in the file, and replaces it only with
    a better one.

    Args:
        env: a second environment with the same states and actions, not the object that `train` gets: wrappers and
            environments may keep state from one episode to the next. (A functional environment may be the same object.)
        every_steps: number of environment steps of the run between evaluations.
        num_episodes: number of episodes per evaluation.
        best: a .keras file for the network with the highest mean return, for `load_q_network`; of equal networks, the
            first is kept. The file is written whole or not at all. If it cannot be written during the run, a warning
            says so and the run continues. None keeps no network.
        seed: a whole number, as for `evaluate`; None draws one.
        max_steps: maximum number of environment steps per episode.

    Attributes:
        steps: environment steps of the run at each evaluation since `train` was called.
        returns: mean return of each evaluation, undiscounted.
        best_return: mean return of the network in `best`; without a file, the highest so far.

    Raises:
        TypeError, ValueError: an argument is not supported. From `train`: the environment does not fit, the network
            cannot be saved, or `best` holds a network that is not from the resumed run.
    """

    def __init__(
        self,
        env: gym.Env | FuncEnv,
        every_steps: int,
        num_episodes: int = 10,
        best: str | os.PathLike | None = None,
        *,
        seed: int | None = 0,
        max_steps: int = 1_000,
    ) -> None:
        super().__init__()
        self.spaces = _spaces(env)
        self.env = env
        self.every_steps = check_count("every_steps", every_steps)
        self.num_episodes = check_count("num_episodes", num_episodes)
        self.best = None if best is None else check_path("best", best)
        if self.best is not None and self.best.suffix != ".keras":
            raise ValueError(f"best must end in .keras, got {shown(str(best))}")
        self.seed, self.max_steps = checked_seed(seed), check_count("max_steps", max_steps)
        self.num_steps = 0  # environment steps of the run; `train` sets the number that a resumed run begins with
        self.steps: list[int] = []
        self.returns: list[float] = []
        self.best_return = -math.inf

    def on_train_begin(self, logs: dict | None = None) -> None:
        """Evaluates the network that the run starts with."""
        self.steps, self.returns, self.best_return = [], [], -math.inf
        if self.num_steps and self.best is not None and self.best.exists():
            try:
                self.best_return = self._mean_return(load_q_network(self.best))
            except ValueError as error:
                raise ValueError(
                    f"best {self.best} must hold a network of the resumed run, or not exist: {error}"
                ) from error
        self._evaluate()

    def on_epoch_end(self, epoch: int, logs: dict) -> None:
        """Evaluates the network if it is due, and logs the latest mean return."""
        if _has_diverged(logs):
            logs["greedy_return"] = math.nan
            return
        num_due = self.num_steps // self.every_steps
        self.num_steps += logs["steps"]
        if self.num_steps // self.every_steps > num_due:
            self._evaluate()
        logs["greedy_return"] = self.returns[-1]

    def on_train_end(self, logs: dict | None = None) -> None:
        """Evaluates the final network, unless it was evaluated after the last episode."""
        is_another = self.num_steps > self.steps[-1] or keeps_averages(self.model.optimizer)
        if is_another and not _has_diverged(logs):
            self._evaluate()

    def _evaluate(self) -> None:
        mean_return = self._mean_return(self.model)
        self.steps.append(self.num_steps)
        self.returns.append(mean_return)
        if mean_return > self.best_return and self._keep():
            self.best_return = mean_return

    def _mean_return(self, q_network: keras.Model) -> float:
        """Returns the mean return of a network and restores the network's state, such as the seed of a noisy layer."""
        variables = q_network.non_trainable_variables
        before = [variable.numpy() for variable in variables]
        try:
            return float(evaluate(self.env, q_network, self.num_episodes, self.seed, self.max_steps).mean())
        finally:
            for variable, value in zip(variables, before, strict=True):
                variable.assign(value)

    def _keep(self) -> bool:
        """Saves the network; returns False, with a warning, if the file cannot be written during the run."""
        if self.best is None:
            return True
        try:
            save_q_network(self.best, self.model)
        except OSError as error:
            if len(self.returns) == 1:
                raise OSError(f"best {self.best} cannot be written: {error}") from error
            warnings.warn(f"best {self.best} could not be written ({error}); the earlier file stays", stacklevel=2)
            return False
        return True


def _has_diverged(logs: dict | None) -> bool:
    """Returns whether these are the logs of an episode in which learning diverged: all are NaN."""
    return logs is not None and math.isnan(logs["steps"])
