"""Checks of the arguments of `train` and `study`."""

import math
import os
import warnings
from collections.abc import Callable, Sequence
from numbers import Integral
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.private import arguments_of_compile
from dqn_keras._engine.tensorflow import keras
from dqn_keras.agent import owners_optimizer
from dqn_keras.checks.environments import check_same_sizes, env_name, not_an_env, spaces_of
from dqn_keras.checks.formulas import Formulas
from dqn_keras.checks.networks import check_optimizer, warn_of_inference_mode
from dqn_keras.checks.numbers import check_count, check_flag, check_instance, check_path, check_sequence, shown
from dqn_keras.config import Config
from dqn_keras.evaluation import Evaluation


def check_arguments(env: gym.Env | FuncEnv, config: Config, verbose: int) -> None:
    """Raises TypeError or ValueError if an argument is wrong; the message names it."""
    if not isinstance(env, gym.Env | FuncEnv):
        raise TypeError(f"env must be a gymnasium.Env or a FuncEnv, got {not_an_env(env)}")
    spaces_of(env)
    check_instance("config", config, Config, "a Config")
    if not isinstance(verbose, Integral | np.bool_) or verbose not in (0, 1, 2):
        raise ValueError(f"verbose must be 0, 1 or 2, got {shown(verbose)}")
    if isinstance(env, FuncEnv) and not config.jit_compile:
        raise ValueError("jit_compile must be True for a functional environment, got False: its loop needs XLA")


def check_callbacks(
    callbacks: keras.callbacks.Callback | Sequence[keras.callbacks.Callback] | None, env: gym.Env | FuncEnv
) -> list[keras.callbacks.Callback]:
    """Returns no, one or several callbacks as a list.

    Raises:
        TypeError: one is not a Keras callback.
        ValueError: there are two Evaluations, or one that does not fit the environment `env` of the run.
    """
    if callbacks is None or isinstance(callbacks, keras.callbacks.Callback):
        callbacks = [] if callbacks is None else [callbacks]
    check_instance("callbacks", callbacks, list | tuple, "a Keras callback or a list of them")
    for callback in callbacks:
        check_instance("callbacks", callback, keras.callbacks.Callback, "Keras callbacks")
    evaluations = [callback for callback in callbacks if isinstance(callback, Evaluation)]
    if len(evaluations) > 1:
        raise ValueError(f"callbacks must hold only one Evaluation: each logs greedy_return, got {len(evaluations)}")
    for evaluation in evaluations:
        _check_evaluation(evaluation, env)
    return list(callbacks)


def _check_evaluation(evaluation: Evaluation, env: gym.Env | FuncEnv) -> None:
    """Raises ValueError unless the evaluation has a second environment with the states and actions of `env`."""
    if isinstance(env, gym.Env) and isinstance(evaluation.env, gym.Env) and env.unwrapped is evaluation.env.unwrapped:
        raise ValueError(
            f"callbacks must evaluate in an environment of their own, got an Evaluation in env {env_name(env)} itself: "
            "make a second one"
        )
    check_same_sizes("callbacks must evaluate in an environment like env", spaces_of(env), evaluation.spaces)


def check_checkpoint(checkpoint: str | os.PathLike | None, checkpoint_every: int, resume: bool) -> int:
    """Returns `checkpoint_every` as an int; raises TypeError or ValueError if an argument is wrong."""
    if checkpoint is not None:
        check_path("checkpoint", checkpoint)
    if check_flag("resume", resume) and checkpoint is None:
        raise ValueError("resume needs a folder to resume from: checkpoint must be a path, got None")
    return check_count("checkpoint_every", checkpoint_every)


def check_seeds(seeds: Any) -> list[int]:
    """Returns the seeds of a study as a list; raises TypeError or ValueError if one is wrong or repeated."""
    checked = [check_count("seeds", seed, at_least=0) for seed in check_sequence("seeds", seeds, "whole numbers")]
    if len(set(checked)) < len(checked):
        raise ValueError(f"seeds must name each seed once, got {shown(seeds)}")
    return checked


def check_own_parts(
    config: Config,
    q_network: keras.Model | None,
    optimizer: keras.Optimizer | None,
    targets: Callable,
    loss: str | Callable | None,
) -> Formulas:
    """Returns the formulas to learn with; raises TypeError or ValueError if one of the parts cannot be used.

    Warns of settings that have no effect, or another effect than in `model.fit`.
    """
    if optimizer is not None:
        check_optimizer(optimizer)
    owners = owners_optimizer(q_network)
    if loss is None and q_network is not None and q_network.compiled:
        loss = getattr(q_network, "loss", None)
        if isinstance(loss, list | tuple | dict):
            raise ValueError(f"q_network must be compiled with one loss, got {shown(loss)}; or pass loss to train")
    if owners is not None:
        config_of_compile = arguments_of_compile(q_network)
        ignored = [x for x in _IGNORED if config_of_compile.get(x)]
        if ignored:
            warnings.warn(f"{', '.join(ignored)} of q_network.compile are not used by train", stacklevel=4)
    formulas = Formulas(targets, "mse" if loss is None else loss)
    formulas.check()
    if (in_use := optimizer or owners) is not None:
        check_learning_rate(in_use, config)
    if q_network is not None:
        warn_of_inference_mode(q_network)
    return formulas


_IGNORED = ("metrics", "weighted_metrics", "loss_weights", "run_eagerly")


def check_learning_rate(optimizer: keras.Optimizer, config: Config) -> None:
    """Raises ValueError if `config.alpha` was set to another value than the optimizer's learning rate.

    Warns if the learning rate is a Python function, because that is called only once.
    """
    rate = optimizer.learning_rate
    is_alpha = isinstance(rate, keras.Variable) and math.isclose(rate.numpy(), config.alpha, rel_tol=1e-6)
    if config.alpha != Config.alpha and not is_alpha:
        raise ValueError(
            f"alpha must be left at its default of {Config.alpha} with an optimizer of your own, because the "
            f"optimizer's learning rate is used, got {config.alpha}"
        )
    if isinstance(rate, int | float):
        warnings.warn(
            f"the learning rate of {optimizer.name!r} is a Python function, which is called only once, so it stays at "
            f"{rate}: use a keras.optimizers.schedules.LearningRateSchedule for a rate that changes",
            stacklevel=5,
        )
