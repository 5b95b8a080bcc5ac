"""The settings of `dqn-keras sweep`, from words such as tau=0.01,0.05."""

import ast
import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import Any

from dqn_keras.cli.run_folder import own_formulas
from dqn_keras.config import Config


def varied(config: Config, words: Sequence[str], formulas: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Returns a setting for `sweep` for each combination of the values in words NAME=VALUE,VALUE.

    A name is a field of Config, `loss` or `double`. `formulas` holds the default values of the last two.
    """
    names = [field.name for field in dataclasses.fields(Config)]
    choices: list[list[tuple[str, str, Any]]] = []
    for word in words:
        name, is_assignment, values = word.partition("=")
        name = name.replace("-", "_")
        if not (is_assignment and name in (*names, *formulas)):
            raise ValueError(f"vary must be of the form NAME=VALUE,VALUE with a name from --help, got {word!r}")
        choices.append([(name, value, _read(name, value)) for value in values.split(",")])
    settings = {}
    for combination in itertools.product(*choices):
        chosen: dict[str, Any] = dict(formulas)
        fields: dict[str, Any] = {}
        for name, _, value in combination:
            (chosen if name in formulas else fields)[name] = value
        label = " ".join(f"{name}={value}" for name, value, _ in combination)
        settings[label] = {"config": dataclasses.replace(config, **fields), **own_formulas(**chosen)}
    return settings


def _read(name: str, value: str) -> Any:
    """Returns the value of a word. 128x128 means two layers; a word that is not a Python value is a string."""
    if name == "hidden_units":
        value = f"({value.replace('x', ',')},)"
    try:
        return ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return value
