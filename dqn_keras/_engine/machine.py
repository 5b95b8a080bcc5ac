"""The kind of processor, on which compiled code and the last bits of results depend."""

import platform
import re
from pathlib import Path


def processor() -> str:
    """Returns the kind of processor, with its vector instructions if the system lists them."""
    try:
        flags = re.search(r"^flags\s*:(.*)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        flags = None
    vector = sorted(x for x in flags[1].split() if x.startswith(("sse4", "avx", "fma", "amx"))) if flags else []
    return " ".join([platform.machine(), *vector])
