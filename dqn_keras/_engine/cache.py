"""A cache on disk of the programs that XLA has compiled, so that other processes need not compile them again.

TensorFlow can keep such a cache, but it trusts every file in the folder. So each process gets its own folder, with
links to the files in the shared folder. Before a file is linked, it is checked by the SHA-256 in its name. `publish`
moves new files to the shared folder, and `fetch` links those of other processes.

TensorFlow finds a program by its contents and by the names in it; `programs.py` gives the same names in each process.

This module does not import TensorFlow, because TensorFlow reads the setting at its import.
"""

import atexit
import contextlib
import hashlib
import importlib.metadata
import os
import re
import shutil
import tempfile
import time
from pathlib import Path

import platformdirs

from dqn_keras._engine.machine import processor

_OPTION = "--tf_xla_persistent_cache_directory="
_MOST_FILES = 300  # of 0.1 to 1.6 MB each
_SMALLEST = 100_000  # bytes; smaller programs are compiled at once, and TensorFlow gives them other names each time
_A_DAY = 24 * 60 * 60  # the folder of a killed process is deleted after this time


_own: Path | None = None
"""This process's folder, if it uses the cache."""


_known: set[str] = set()
"""The names of the shared files that this process has read or written, without the digest."""


def use_cache(choice: str) -> None:
    """Makes TensorFlow, which must not be imported yet, keep compiled programs on disk.

    Does nothing if TF_XLA_FLAGS names a cache of the user, or if the folder cannot be used.

    Args:
        choice: "1" for the user's cache folder, "0" for no cache, or a folder.
    """
    global _own
    flags = re.sub(rf"{_OPTION}\S*/process-\S*", "", os.environ.pop("TF_XLA_FLAGS", "")).strip()  # a parent's folder
    if flags:
        os.environ["TF_XLA_FLAGS"] = flags
    folder = platformdirs.user_cache_dir("dqn_keras") if choice == "1" else choice
    if choice == "0" or _OPTION in flags or any(map(str.isspace, folder)):  # TensorFlow splits its flags at spaces
        return
    try:
        shared = Path(folder) / _kind_of_code()
        shared.mkdir(parents=True, exist_ok=True)
        _own = Path(tempfile.mkdtemp(prefix="process-", dir=shared))
    except (OSError, importlib.metadata.PackageNotFoundError):  # TensorFlow may be installed under another name
        return
    fetch()
    for path in shared.glob("process-*"):
        with contextlib.suppress(OSError):  # another process has deleted it
            if path.stat().st_mtime < time.time() - _A_DAY:
                shutil.rmtree(path)
    os.environ["TF_XLA_FLAGS"] = f"{flags} {_OPTION}{_own}".strip()
    if os.environ.get("TF_CPP_MIN_LOG_LEVEL", "2") == "2":  # the package's own default, or inherited from a parent
        os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"  # TensorFlow logs an error even for a file that it reads well
    atexit.register(_leave, _own, os.getpid())


def fetch() -> None:
    """Gets the programs that other processes have shared, before this process would compile them."""
    if _own is None:
        return
    seen: set[str] = set()
    for path in sorted(_own.parent.glob("*.pb.*")):
        with contextlib.suppress(OSError):  # a full disk, or another process has deleted the file
            if path.stem in seen:  # two processes have stored the same program; all processes delete the same file
                path.unlink()
            elif path.stem in _known:
                seen.add(path.stem)
            elif path.suffix[1:] == _digest(path):
                _link(path, _own / path.stem)
                seen.add(path.stem)
                _known.add(path.stem)
            else:  # it is damaged
                path.unlink()


def _link(path: Path, target: Path) -> None:
    """Makes `target` another name of the same file, or a copy where the file system has no such names."""
    try:
        os.link(path, target)
    except OSError:
        shutil.copyfile(path, target)


def publish() -> None:
    """Shares the programs that this process has compiled with other processes; of many, deletes the oldest."""
    if _own is None:
        return
    with contextlib.suppress(OSError):  # a full disk, or another process has deleted the file
        for path in _own.glob("*.pb"):
            if path.stat().st_size >= _SMALLEST and path.name not in _known:
                _known.add(path.name)
                if not list(_own.parent.glob(f"{path.name}.*")):
                    os.replace(path, _own.parent / f"{path.name}.{_digest(path)}")
        oldest_first = sorted(_own.parent.glob("*.pb.*"), key=lambda path: path.stat().st_mtime)
        for path in oldest_first[:-_MOST_FILES]:
            path.unlink()


def _leave(own: Path, process: int) -> None:
    if os.getpid() == process:  # not in a forked copy
        publish()
        shutil.rmtree(own, ignore_errors=True)


def _kind_of_code() -> str:
    kind = f"{importlib.metadata.version('tensorflow')} {processor()}"
    return f"xla-{hashlib.sha256(kind.encode()).hexdigest()[:16]}"


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
