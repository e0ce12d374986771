"""Where the time of a press goes, by a profiler that knows the solver's parts.

Python's profiling hook reports every call; of nested calls that belong to a part the outermost counts. Kernel launches
on a CPU return when the kernel has run, and are told apart by the kernel's name.
"""

import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

FACTORISATION, GMRES, ASSEMBLY, CONTACT = "factorisation", "GMRES and triangular solves", "assembly", "contact"
OTHER = "the rest (copies, line search, recording)"
FUNCTIONS = {
    ("linear.py", "factorise"): FACTORISATION,
    ("linear.py", "gmres"): GMRES,
    ("system.py", "_unsymmetric"): CONTACT,
}
"""Solver functions by file and name."""
KERNELS = ("contact", "settle", "augment")
"""Beginnings of the names of contact's kernels; the others assemble the gel's residual and tangent."""


def time_shares(run: Callable[[], object]) -> dict[str, float]:
    """Share of the wall time of `run()` that each part takes; their sum is 1. Profiling adds a few percent.

    Args:
        run: what to take apart; runs once.
    """
    spent = dict.fromkeys((FACTORISATION, ASSEMBLY, CONTACT, GMRES), 0.0)
    inside: list[tuple[FrameType, str, float]] = []

    def observe(frame: FrameType, event: str, _: Any) -> None:
        if event == "call" and not inside:
            part = _part(frame)
            if part:
                inside.append((frame, part, time.perf_counter()))
        elif event == "return" and inside and inside[-1][0] is frame:
            _, part, started = inside.pop()
            spent[part] += time.perf_counter() - started

    before, started = sys.getprofile(), time.perf_counter()
    sys.setprofile(observe)
    try:
        run()
    finally:
        sys.setprofile(before)
    total = time.perf_counter() - started
    spent[OTHER] = total - sum(spent.values())
    return {part: seconds / total for part, seconds in spent.items()}


def _part(frame: FrameType) -> str:
    """The part that a call belongs to, or nothing."""
    code = frame.f_code
    file = code.co_filename.replace("\\", "/").rpartition("/")[2]
    if code.co_name == "launch" and "kernel" in frame.f_locals:
        return CONTACT if str(frame.f_locals["kernel"].key).startswith(KERNELS) else ASSEMBLY
    return FUNCTIONS.get((file, code.co_name), "")
