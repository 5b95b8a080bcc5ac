"""Checks of the settings of a study or a sweep, before any work starts."""

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
from gymnasium.experimental.functional import FuncEnv

from dqn_keras._engine.tensorflow import keras
from dqn_keras.agent import owners_optimizer
from dqn_keras.checks.environments import check_functional, check_same_sizes, env_name, spaces_of
from dqn_keras.checks.formulas import called, check_takes
from dqn_keras.checks.numbers import check_instance, shown
from dqn_keras.checks.run import check_arguments
from dqn_keras.config import Config
from dqn_keras.storage.identity import identity, identity_with
from dqn_keras.storage.parts import Part, describe
from dqn_keras.training import prepare
from dqn_keras.workers import Setting


def check_settings(
    env: gym.Env | FuncEnv,
    settings: Mapping[str, Config | Mapping[str, Any]],
    evaluate_on: gym.Env | FuncEnv | None,
    verbose: int,
) -> dict[str, Setting]:
    """Returns the settings of a sweep.

    Raises:
        TypeError, ValueError: a setting is not a Config or a dict of arguments, or a shared argument is wrong.
    """
    check_arguments(env, Config(), verbose)
    if evaluate_on is not None:
        _check_evaluate_on(env, evaluate_on)
    check_instance("settings", settings, Mapping, "a dict with a Config, or a dict of arguments, for each name")
    if not settings:
        raise ValueError("settings must hold at least one setting, got none")
    checked = {}
    for name, setting in settings.items():
        if not isinstance(name, str) or not name:
            raise TypeError(f"settings must have names that are strings and not empty, got {shown(name)}")
        arguments = {"config": setting} if isinstance(setting, Config) else setting
        check_instance(f"settings[{name!r}]", arguments, Mapping, "a Config or a dict of arguments of study")
        for argument in arguments:
            if argument not in _MAY_DIFFER:
                raise TypeError(f"settings[{name!r}] must hold only {', '.join(_MAY_DIFFER)}, got {shown(argument)}")
        checked[name] = Setting(**{"env": env, "evaluate_on": evaluate_on, **arguments})
    return checked


_MAY_DIFFER = ("env", "config", "q_network", "optimizer", "targets", "loss", "evaluate_on")


def check_setting(name: str, setting: Setting, verbose: int, has_file: bool) -> dict[str, Any]:
    """Checks a setting and returns its identity, which is empty without a file.

    Raises:
        TypeError, ValueError: an argument is wrong; in a sweep, the message begins with the setting's name.
    """
    try:
        return _checked(setting, verbose, has_file)
    except (TypeError, ValueError) as error:
        if not name:
            raise
        raise (TypeError if isinstance(error, TypeError) else ValueError)(f"settings[{name!r}]: {error}") from error


def _checked(setting: Setting, verbose: int, has_file: bool) -> dict[str, Any]:
    check_arguments(setting.env, setting.config, verbose)
    _check_makes_new("q_network", ("seed",), setting.q_network, (0,), keras.Model)
    _check_makes_new("optimizer", (), setting.optimizer, (), keras.Optimizer)
    if setting.evaluate_on is not None:
        _check_evaluate_on(setting.env, setting.evaluate_on)
    parts = setting.own_parts(0)
    _, formulas, agent = prepare(setting.env, setting.config, 0, **parts)
    if not has_file:
        return {}
    optimizer = parts["optimizer"] or owners_optimizer(parts["q_network"])
    facts = identity(setting.env, setting.config, agent, formulas, parts["q_network"], optimizer).facts
    where = setting.evaluate_on
    return identity_with(facts, evaluate_on=Part("nothing") if where is None else describe(where)[0])


def _check_makes_new(name: str, takes: tuple[str, ...], function: Any, arguments: tuple, kind: type) -> None:
    """Raises TypeError or ValueError unless the function returns a new object of this kind at each call."""
    if function is None:
        return
    wanted = f"{name} must be a function of ({', '.join(takes)}) that returns a new keras.{kind.__name__}"
    if isinstance(function, kind) or not callable(function):
        raise TypeError(f"{wanted} for each run of a study, got {shown(function)}")
    check_takes(name, function, takes)
    first, second = called(name, function, *arguments), called(name, function, *arguments)
    if not isinstance(first, kind):
        raise TypeError(f"{wanted}, got one that returns {shown(first)}")
    if first is second:
        raise ValueError(f"{wanted}, got one that returns the same object again")


def _check_evaluate_on(env: gym.Env | FuncEnv, evaluate_on: Any) -> None:
    if not isinstance(evaluate_on, gym.Env | FuncEnv):
        raise TypeError(f"evaluate_on must be a gymnasium.Env or a FuncEnv, got {shown(evaluate_on)}")
    spaces = check_functional(evaluate_on) if isinstance(evaluate_on, FuncEnv) else spaces_of(evaluate_on)
    check_same_sizes(f"evaluate_on must be an environment like env {env_name(env)}", spaces_of(env), spaces)
