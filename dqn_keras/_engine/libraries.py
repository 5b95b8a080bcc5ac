"""The difference between library code, which stays the same while the process runs, and the user's code."""

import functools
import sys
import sysconfig
from pathlib import Path
from types import FunctionType, ModuleType


def is_of_a_library(code: FunctionType | type | ModuleType) -> bool:
    """Returns whether a function, class or module is part of Python, of an installed package or of this package.

    The source file of the code decides. Names are not reliable: functools.wraps copies them.
    """
    if isinstance(code, FunctionType):
        return _is_installed(code.__code__.co_filename)
    module = code if isinstance(code, ModuleType) else sys.modules.get(code.__module__)
    if (file := getattr(module, "__file__", None)) is not None:
        return _is_installed(file)
    name = module.__name__ if isinstance(module, ModuleType) else code.__module__
    if isinstance(code, type) and any(
        isinstance(x, FunctionType) and not is_of_a_library(x) for x in vars(code).values()
    ):
        return False  # made by exec, without a module
    return name.partition(".")[0] in sys.stdlib_module_names


_FOLDERS = (sysconfig.get_path("stdlib"), sysconfig.get_path("platstdlib"), str(Path(__file__).parents[1]), "<frozen ")


@functools.cache
def _is_installed(file: str) -> bool:
    return file.startswith(_FOLDERS) or not {"site-packages", "dist-packages"}.isdisjoint(Path(file).parts)
