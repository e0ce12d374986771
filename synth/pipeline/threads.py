"""How many cores a process may use, and how a worker process is kept to one.

Beside the libraries here nothing starts threads that compute: Pardiso always has one (`synth.simulate.linear`), and so
have Warp's kernels on a CPU.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

from synth.render.variant import Variant

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
"""Read by linear algebra libraries and OpenCV when they are loaded."""


def cores() -> int:
    """That this process may use; on a cluster fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Processes started meanwhile use one thread in every library but the renderer; what this process has loaded keeps
    its own.
    """
    before = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def render_on_one_core(variant: Variant) -> None:
    """Have this process, a worker, render with one thread; Mitsuba's scalar code has its threads from Dr.Jit, too."""
    variant.load()
    import drjit

    drjit.set_thread_count(1)
