"""The trained network alone, in Keras' own format."""

import os
import zipfile
from pathlib import Path

import numpy as np

from dqn_keras._engine.copies import check_is_equal, finalize_layers, python_random_kept
from dqn_keras._engine.tensorflow import keras
from dqn_keras.checks.networks import check_network
from dqn_keras.storage.files import replacing


def save_q_network(path: str | os.PathLike, q_network: keras.Model) -> None:
    """Save the network alone, in Keras' own format; an older file of that name is replaced at once.

    Raises:
        ValueError: `path` does not end in .keras; the network has a layer of an unregistered class.
        OSError: the disk does not take it.
    """
    path = Path(path)
    if path.suffix != ".keras":
        raise ValueError(f"path must end in .keras, got {str(path)!r}")
    try:
        with python_random_kept():
            network = type(q_network).from_config(q_network.get_config())  # which has no optimizer to save
    except (TypeError, ValueError) as error:
        raise ValueError(
            "q_network has a layer that no file can name: keras.saving.register_keras_serializable() on its class, and "
            f"get_config in it, make it one ({error})"
        ) from error
    network.set_weights(q_network.get_weights())
    finalize_layers(network)
    check_is_equal("q_network cannot be saved", q_network, network)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        network.save(temporary)


def load_q_network(path: str | os.PathLike) -> keras.Model:
    """The network that `run.save` saved, for `evaluate`, or whatever a Keras model is good for.

    It is Keras' own format, in Keras' safe mode: a file that would run code of its own is refused.

    Raises:
        FileNotFoundError: there is none.
        ValueError: it is damaged or not a Q-network; the message names the file.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            if (broken := archive.testzip()) is not None:  # Keras reads parts, and so checks no sum
                raise ValueError(f"{broken} in it is damaged")
        network = keras.saving.load_model(path, compile=False, safe_mode=True)
        check_network("it", network)
        if not all(np.isfinite(w).all() for w in network.get_weights()):
            raise ValueError("one of its weights is not finite")
    except FileNotFoundError:
        raise
    except Exception as error:  # whatever Keras, h5py or zipfile say of bytes that are not theirs
        raise ValueError(f"path {path} is not a network that can be loaded: {error}") from error
    return network
