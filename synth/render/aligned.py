"""Memory that Dr.Jit uses in place, on a processor: it compiles other code for arrays that are not aligned."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

_BYTES = 64
"""Of the widest of a processor's registers."""


def aligned(values: Any, kind: Any = np.float32) -> NDArray[Any]:
    """All values (n,) in a row, as numbers of that kind, in aligned memory of their own."""
    values = np.asarray(values)
    size = np.dtype(kind).itemsize
    room = np.empty(values.size + _BYTES // size, dtype=kind)
    start = -room.ctypes.data // size % (_BYTES // size)
    found = room[start : start + values.size]
    found.reshape(values.shape)[...] = values
    return found
