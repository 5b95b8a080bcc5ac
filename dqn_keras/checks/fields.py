"""Helpful errors for a name that is not a field of Config, and for an assignment to a field."""

import dataclasses
import difflib
import functools
from typing import Any, TypeVar

from dqn_keras.checks.numbers import shown

T = TypeVar("T")

_PER_TARGET = "gradient_steps_per_target"


OTHER_NAMES = {
    "learning_rate": ("learning rate", "alpha"),
    "lr": ("learning rate", "alpha"),
    "discount": ("discount factor", "gamma"),
    "discount_factor": ("discount factor", "gamma"),
    "target_update": ("share of Q in each update of Q-hat", "tau"),
    "target_update_interval": ("number of gradient steps from one update of Q-hat to the next", _PER_TARGET),
    "target_network_frequency": ("number of gradient steps from one update of Q-hat to the next", _PER_TARGET),
    "steps_per_target": ("number of gradient steps from one update of Q-hat to the next", _PER_TARGET),
    "train_freq": ("number of environment steps per update", "steps_per_update"),
    "train_frequency": ("number of environment steps per update", "steps_per_update"),
    "total_timesteps": ("maximum number of environment steps", "num_steps"),
    "exploration_fraction": ("number of environment steps over which epsilon falls", "epsilon_steps"),
    "exploration_initial_eps": ("first value of epsilon", "epsilon"),
    "exploration_final_eps": ("lowest value of epsilon", "epsilon_min"),
    "net_arch": ("number of units of each hidden layer", "hidden_units"),
    "epsilon_start": ("first value of epsilon", "epsilon"),
    "epsilon_max": ("first value of epsilon", "epsilon"),
    "epsilon_end": ("lowest value of epsilon", "epsilon_min"),
    "buffer_size": ("size of the replay memory", "memory_size"),
    "memory": ("size of the replay memory", "memory_size"),
    "episodes": ("number of episodes", "num_episodes"),
    "hidden": ("number of units of each hidden layer", "hidden_units"),
    "hidden_layers": ("number of units of each hidden layer", "hidden_units"),
    "epsilon_decay": ("factor that multiplies epsilon", "decay"),
}
"""Names of fields in other libraries, with a description of the field and its name here."""


def hints_at_fields(cls: type[T]) -> type[T]:
    """Makes the errors of a frozen dataclass say what to write instead of an unknown field or an assignment."""
    names = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    init = cls.__init__

    def hint(name: str) -> str:
        what, meant = OTHER_NAMES.get(name, ("", ""))
        close = difflib.get_close_matches(name, names, n=1, cutoff=0.75)
        end = f"; the {what} is {meant}" if what else f"; did you mean {close[0]}?" if close else ""
        return f"{cls.__name__} has no field {name}{end}"

    @functools.wraps(init)
    def __init__(self: T, *values: Any, **fields: Any) -> None:  # noqa: N807
        for name in fields:
            if name not in names:
                raise TypeError(hint(name))
        init(self, *values, **fields)

    def __setattr__(self: T, name: str, value: Any) -> None:  # noqa: N807
        if name not in names and type(self) is not cls:  # a subclass may have its own attributes
            object.__setattr__(self, name, value)
            return
        if name not in names:
            raise dataclasses.FrozenInstanceError(hint(name))
        raise dataclasses.FrozenInstanceError(
            f"{cls.__name__} is frozen; dataclasses.replace(config, {name}={shown(value)}) makes a changed copy"
        )

    cls.__init__, cls.__setattr__ = __init__, __setattr__  # type: ignore[method-assign, assignment]
    return cls
