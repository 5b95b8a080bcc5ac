"""Writes files whole or not at all, and checks their SHA-256 when it reads them."""

import contextlib
import hashlib
import io
import json
import math
import os
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import filelock
import numpy as np

from dqn_keras.version import __version__

FORMAT = 6


class DamagedError(ValueError):
    """The error for a file that is damaged, or is not a checkpoint of this version."""


def to_bytes(arrays: Mapping[str, Any], facts: dict[str, Any]) -> bytes:
    """Returns the content of a checkpoint file."""
    file = io.BytesIO()
    np.savez(file, facts=np.frombuffer(json.dumps(facts).encode(), np.uint8), **arrays)
    body = file.getvalue()
    return body + hashlib.sha256(body).digest()


def from_bytes(content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Returns the arrays and facts in `content`; raises DamagedError if it is damaged or has another format."""
    body, digest = content[:-32], content[-32:]
    if hashlib.sha256(body).digest() != digest:
        raise DamagedError("its SHA-256 does not match its content: it was cut short or changed")
    try:
        with zipfile.ZipFile(io.BytesIO(body)) as archive:
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                raise ValueError("a part is compressed")  # it could be of any size
            arrays = {part.removesuffix(".npy"): _read_array(archive.read(part)) for part in archive.namelist()}
        facts = json.loads(arrays.pop("facts").tobytes())
        file_format = facts["format"]
    except (KeyError, TypeError, ValueError, OSError, RecursionError, zipfile.BadZipFile) as error:
        raise DamagedError(f"it is not a checkpoint ({error})") from None
    if file_format != FORMAT:
        raise DamagedError(f"its format is {file_format!r}, but dqn_keras {__version__} reads {FORMAT}")
    return arrays, facts


def _read_array(content: bytes) -> np.ndarray:
    """Returns the array in the content of an .npy file; raises ValueError if its header does not fit its size."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if dtype.hasobject or math.prod(shape) * dtype.itemsize != len(content) - file.tell():
        raise ValueError("the shape of an array does not fit its data")
    return np.load(io.BytesIO(content), allow_pickle=False)


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yields a temporary path; its file replaces `path` in one step when the block ends without an error."""
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.partial{path.suffix}")
    try:
        yield temporary
        with temporary.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    if os.name == "posix":  # also flushes the folder's list of names
        descriptor = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


@contextlib.contextmanager
def locked(path: Path, what: str) -> Iterator[None]:
    """Holds a lock file while the block runs; makes the file and its folder if necessary.

    The system releases the lock of a process that dies. A folder that cannot be written gets no lock, because there is
    nothing to protect.

    Raises:
        ValueError: another process or thread holds the lock; the message begins with `what`.
        OSError: the folder can be written, but not the lock file, which may belong to another user.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock: contextlib.AbstractContextManager = filelock.FileLock(path, timeout=0).acquire()
    except filelock.Timeout:
        raise ValueError(f"{what} is in use: another process or thread writes there") from None
    except OSError as error:
        if path.parent.is_dir() and os.access(path.parent, os.W_OK):
            raise OSError(f"{what} cannot be locked: {error}") from error
        lock = contextlib.nullcontext()
    with lock:
        yield
