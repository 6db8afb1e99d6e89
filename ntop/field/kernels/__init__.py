"""The hot loops, compiled by numba; each has a plain torch twin in `ntop.field.twin`.

Every loop is one scalar source over arrays and small structures of arrays, so that a GPU compiler
can take it as it is. Results do not depend on the number of threads: outputs are disjoint, and
sums are kept per block of a fixed number of blocks and reduced in order.

Compiled code is cached below the user's cache folder in a folder named after the sources' digest:
numba's own cache notices an edit of a caller, but not of what it calls.
"""

import hashlib
import os
from collections.abc import Callable
from pathlib import Path

import numba
import numba.core.config

SOURCES = sorted(Path(__file__).parent.glob("*.py"))


def _cache_folder() -> str:
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in SOURCES)).hexdigest()[:16]
    given = os.environ.get("NUMBA_CACHE_DIR")
    home = Path(given) if given else Path.home() / ".cache" / "ntop" / "kernels"
    return str(home / digest)


# read by numba when a function is decorated below; ours alone, as only this package uses numba
numba.core.config.CACHE_DIR = _cache_folder()

# no flag that assumes away NaN or infinity: a broken value must stay visible
MATH = {"contract", "reassoc", "arcp", "nsz", "afn"}


def device(function: Callable) -> Callable:
    """A function that other kernels call."""
    return numba.njit(cache=True, fastmath=MATH, error_model="numpy", forceinline=True)(function)


def kernel(function: Callable) -> Callable:
    """A function that Python calls; its `numba.prange` loop runs on all threads."""
    return numba.njit(cache=True, fastmath=MATH, error_model="numpy", parallel=True)(function)
