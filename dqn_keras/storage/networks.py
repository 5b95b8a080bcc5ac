"""Files that hold only the trained network, in Keras' own format."""

import os
import zipfile

import h5py
import numpy as np

from dqn_keras._engine.copies import check_is_equal, finalize_layers, python_random_kept
from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.networks import check_network
from dqn_keras.checks.numbers import check_path
from dqn_keras.storage.files import replacing


def save_q_network(path: str | os.PathLike, q_network: keras.Model) -> None:
    """Saves only the network, in Keras' own format; replaces an older file in one step.

    Raises:
        ValueError: `path` does not end in .keras, or the network has a layer of an unregistered class.
        OSError: the file cannot be written.
    """
    path = check_path("path", path)
    if path.suffix != ".keras":
        raise ValueError(f"path must end in .keras, got {str(path)!r}")
    try:
        with python_random_kept():
            network = type(q_network).from_config(q_network.get_config())  # without the optimizer
    except (TypeError, ValueError) as error:
        raise ValueError(
            "q_network has a layer that cannot be saved: decorate its class with "
            f"keras.saving.register_keras_serializable(), and define get_config in it ({error})"
        ) from error
    network.set_weights(q_network.get_weights())
    finalize_layers(network)
    check_is_equal("q_network cannot be saved", q_network, network)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        network.save(temporary)


def _check_weights(group: h5py.Group) -> None:
    """Raises ValueError if an array is a link, or larger than its data in the file."""
    for name in group:
        is_here = isinstance(group.get(name, getlink=True), h5py.HardLink)
        if is_here and isinstance(group[name], h5py.Group):
            _check_weights(group[name])
        elif not (is_here and group[name].id.get_storage_size() == group[name].nbytes):
            raise ValueError(f"{group.name}/{name} in model.weights.h5 is not as Keras writes it")


def load_q_network(path: str | os.PathLike) -> keras.Model:
    """Returns the network saved by `run.save`, for `evaluate` or any other use of a Keras model.

    The file is read in Keras' safe mode, which rejects files that would run their own code.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the file is damaged or does not hold a Q-network; the message names the file.
    """
    path = check_path("path", path)
    try:
        with zipfile.ZipFile(path) as archive:
            for part in archive.infolist():
                if part.compress_type != zipfile.ZIP_STORED:  # Keras never does; it could unpack to any size
                    raise ValueError(f"{part.filename} in it is compressed")
            if (broken := archive.testzip()) is not None:  # Keras reads only parts, and so checks no checksum
                raise ValueError(f"{broken} in it is damaged")
            with archive.open("model.weights.h5") as file, h5py.File(file, "r") as weights:
                _check_weights(weights)
        network = keras.saving.load_model(path, compile=False, safe_mode=True)
        check_network("it", network)
        if not all(np.isfinite(w).all() for w in network.get_weights()):
            raise ValueError("one of its weights is not finite")
    except FileNotFoundError:
        raise
    except Exception as error:  # Keras, h5py and zipfile raise many kinds of errors for a damaged file
        raise ValueError(f"path {path} is not a network that can be loaded: {error}") from error
    return network
