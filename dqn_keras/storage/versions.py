"""The software versions and the processor that a result was made with."""

import platform
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from dqn_keras._engine.machine import processor
from dqn_keras._engine.tensorflow import keras, tf
from dqn_keras.version import __version__


def versions() -> dict[str, str]:
    """Returns the versions and the processor, on which the last bits of a result may depend."""
    modules = {"tensorflow": tf, "keras": keras, "numpy": np, "gymnasium": gym}
    versions = {name: module.__version__ for name, module in modules.items()}
    return {"dqn_keras": __version__, "python": platform.python_version(), **versions, "processor": processor()}


def warn_of_other_versions(path: Path | str, theirs: dict[str, Any], ours: dict[str, Any], stacklevel: int) -> None:
    """Warns once, naming all versions that differ."""
    theirs, ours = theirs["versions"], ours["versions"]
    others = [f"{name} {theirs.get(name)} (here {ours[name]})" for name in ours if theirs.get(name) != ours[name]]
    if others:
        warnings.warn(
            f"{path} was saved with {', '.join(others)}: new results may differ in their last bits",
            stacklevel=stacklevel,
        )
