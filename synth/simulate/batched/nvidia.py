"""NVIDIA's mathematical libraries, loaded through ctypes: nothing of torch is imported, which brings them along.

They come with the CUDA builds of torch (packages nvidia-cublas, nvidia-cusolver) or with the CUDA toolkit.
"""

import ctypes
import ctypes.util
import importlib.util
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from synth.errors import InputError

NEEDS = {"cublas": ("cublasLt",), "cusolver": ("nvJitLink", "cusparse", "cublas")}
"""Libraries that are loaded before, since a wheel's library does not always know where the others are."""


@cache
def library(name: str) -> ctypes.CDLL:
    """The newest cublas or cusolver of this Python environment, else the system's; InputError where there is none."""
    for other in NEEDS[name]:
        _load(other)
    found = _load(name)
    if found is None:
        raise InputError(
            f"the batched solver on CUDA needs lib{name}, and none was found: install a CUDA build of torch or the "
            "packages nvidia-cublas and nvidia-cusolver, or simulate with --device cpu"
        )
    return found


def call(name: str, function: str, *arguments: Any) -> None:
    """Call a function of a library by its C name, which returns 0 if it succeeds; RuntimeError if it does not.

    Arguments are pointers wrapped in ctypes' types, int for an int.
    """
    status = getattr(library(name), function)(*arguments)
    if status != 0:
        raise RuntimeError(f"{function} reported status {status}")


@cache
def _load(name: str) -> ctypes.CDLL | None:
    for path in _places(name):
        try:
            return ctypes.CDLL(path)
        except OSError:
            continue
    return None


def _places(name: str) -> Iterator[str]:
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        yield from sorted(map(str, Path(folder).glob(f"**/lib{name}.so.*")), reverse=True)
    if system := ctypes.util.find_library(name):
        yield system
