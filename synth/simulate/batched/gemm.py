"""Dense matrix operations of a batch: a product and a transpose, by cuBLAS on an NVIDIA GPU and by NumPy elsewhere.

cuBLAS comes with the CUDA builds of torch (package nvidia-cublas) or with the CUDA toolkit; it is called through ctypes
on Warp's stream. Nothing of torch is imported. float32 in and out; on a GPU the factors of a product are rounded to
TF32 (10 bits), sums are float32.
"""

import ctypes
import ctypes.util
import importlib.util
from functools import cache
from pathlib import Path
from typing import Protocol

import numpy as np
import warp as wp

from synth.errors import InputError

WORKSPACE = 32 << 20
"""Bytes given to cuBLAS, so that it allocates none of its own: NVIDIA's recommendation for Hopper."""
_REAL, _TF32, _DEFAULT, _PLAIN, _TURNED = 0, 77, -1, 0, 1
"""CUDA_R_32F, CUBLAS_COMPUTE_32F_FAST_TF32, CUBLAS_GEMM_DEFAULT, CUBLAS_OP_N, CUBLAS_OP_T."""


class Dense(Protocol):
    """What a device offers; all arrays float32, row by row."""

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """Give c = x A for symmetric A (n, n) and x, c (b, n), at least in rows where wanted (b,) is 1."""

    def transpose(self, x: wp.array, c: wp.array) -> None:
        """Give c (n, m) = x^T for x (m, n)."""


def dense(device: str) -> Dense:
    """Of a Warp device.

    Raises:
        InputError: CUDA without cuBLAS.
    """
    return Cublas(device) if wp.get_device(device).is_cuda else Host()


class Host:
    """See Dense. A product takes one row after the other, so that its numbers do not depend on its neighbours."""

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """See Dense."""
        matrix, given, found = a.numpy(), x.numpy(), c.numpy()
        for s in np.flatnonzero(wanted.numpy() == 1):
            found[s] = matrix @ given[s]

    def transpose(self, x: wp.array, c: wp.array) -> None:
        """See Dense."""
        c.numpy()[...] = x.numpy().T


@cache
def _library() -> ctypes.CDLL:
    """The newest cuBLAS of this Python environment, else the system's.

    Raises:
        InputError: there is none.
    """
    found: list[str] = []
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        found += sorted(map(str, Path(folder).glob("**/libcublas.so.*")), reverse=True)
    named = ctypes.util.find_library("cublas")
    for name in [*found, *([named] if named else [])]:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    raise InputError(
        "the batched solver on CUDA needs cuBLAS, and none was found: install a CUDA build of torch or the package "
        "nvidia-cublas, or simulate with --device cpu"
    )


class Cublas:
    """See Dense. Queued on Warp's present stream; may be captured in a graph."""

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._blas = _library()
        self._handle = ctypes.c_void_p()
        self._workspace = wp.empty(WORKSPACE, dtype=wp.uint8, device=device)
        with wp.ScopedDevice(self._device):
            self._check(self._blas.cublasCreate_v2(ctypes.byref(self._handle)))
        self._one, self._zero = ctypes.c_float(1.0), ctypes.c_float(0.0)

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """See Dense; all rows."""
        b, n = x.shape
        self._join()
        # cuBLAS counts by columns: what it sees is C^T = A^T X^T. Summation runs along memory in both factors, the
        # only order that Hopper's TF32 instructions take.
        self._check(
            self._blas.cublasGemmEx(
                self._handle, _TURNED, _PLAIN, n, b, n, ctypes.byref(self._one),
                ctypes.c_void_p(a.ptr), _REAL, n, ctypes.c_void_p(x.ptr), _REAL, n, ctypes.byref(self._zero),
                ctypes.c_void_p(c.ptr), _REAL, n, _TF32, _DEFAULT,
            )
        )  # fmt: skip

    def transpose(self, x: wp.array, c: wp.array) -> None:
        """See Dense."""
        m, n = x.shape
        self._join()
        given, found = ctypes.c_void_p(x.ptr), ctypes.c_void_p(c.ptr)
        self._check(
            self._blas.cublasSgeam(
                self._handle, _TURNED, _PLAIN, m, n, ctypes.byref(self._one), given, n,
                ctypes.byref(self._zero), found, m, found, m,
            )
        )  # fmt: skip

    def _join(self) -> None:
        pointer = ctypes.c_void_p
        self._check(self._blas.cublasSetStream_v2(self._handle, pointer(self._device.stream.cuda_stream)))
        self._check(
            self._blas.cublasSetWorkspace_v2(self._handle, pointer(self._workspace.ptr), ctypes.c_size_t(WORKSPACE))
        )

    @staticmethod
    def _check(status: int) -> None:
        if status != 0:
            raise RuntimeError(f"cuBLAS reported status {status}")
