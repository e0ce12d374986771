"""Keeping libraries from writing to the terminal.

libpng, FFmpeg and OpenEXR print their complaints about a broken file straight to the process's output, some of them
many times. gelflow says once, in its own words, which file is broken; what the library printed is dropped.
"""

import io
import logging
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout


@contextmanager
def quiet() -> Iterator[None]:
    """Sends the file descriptors 1 and 2 to the null device while the block runs. Exceptions pass through.

    `sys.stdout` and `sys.stderr` are replaced, too: OpenEXR warns through Python. Works for the whole process, so hold
    it only around a library's call, and not in a thread beside one that prints: its lines would be dropped, too.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    saved = [os.dup(1), os.dup(2)]
    null = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(null, 1)
        os.dup2(null, 2)
        with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
            yield
    finally:
        os.dup2(saved[0], 1)
        os.dup2(saved[1], 2)
        for descriptor in (*saved, null):
            os.close(descriptor)


@contextmanager
def quiet_logger(name: str, module: str = "") -> Iterator[None]:
    """Drops a logger's messages below errors, and the warnings of modules that match a pattern (all, without one)."""
    logger = logging.getLogger(name)
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=module)
            yield
    finally:
        logger.setLevel(level)
