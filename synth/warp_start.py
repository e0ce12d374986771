"""How Warp is started, before a module that defines kernels is imported."""

import ctypes
import os
import sys

import warp


def start_warp() -> None:
    """Start Warp without a word, for kernels that nothing differentiates.

    Where there is no NVIDIA driver its native code says so on the process's error output, whatever the log level.
    """
    warp.config.log_level = warp.LOG_ERROR  # no banner, no compiler chatter in the user's output
    warp.config.enable_backward = False
    try:
        ctypes.CDLL("libcuda.so.1")
        return
    except OSError:
        if sys.__stderr__ is None:  # closed: there is nothing to keep clean
            return
    shown = os.dup(2)
    try:
        with open(os.devnull, "wb") as null:
            os.dup2(null.fileno(), 2)
            warp.init()
    finally:
        os.dup2(shown, 2)
        os.close(shown)
