"""Matrix products on an NVIDIA GPU by cuBLAS, called through ctypes on Warp's stream.

cuBLAS comes with the CUDA builds of torch (package nvidia-cublas) or with the CUDA toolkit. Nothing of torch is
imported. float32 in and out; factors are rounded to TF32 (10 bits), sums are float32.
"""

import ctypes
import ctypes.util
import importlib.util
from functools import cache
from pathlib import Path

import warp as wp

from synth.errors import InputError

WORKSPACE = 32 << 20
"""Bytes given to cuBLAS, so that it allocates none of its own: NVIDIA's recommendation for Hopper."""
_REAL, _TF32, _DEFAULT, _PLAIN = 0, 77, -1, 0
"""CUDA_R_32F, CUBLAS_COMPUTE_32F_FAST_TF32, CUBLAS_GEMM_DEFAULT, CUBLAS_OP_N."""


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


class Gemm:
    """C = A X for row-major A (n, n) and X, C (n, b) on one device."""

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._blas = _library()
        self._handle = ctypes.c_void_p()
        self._workspace = wp.empty(WORKSPACE, dtype=wp.uint8, device=device)
        with wp.ScopedDevice(self._device):
            self._check(self._blas.cublasCreate_v2(ctypes.byref(self._handle)))
        self._one, self._zero = ctypes.c_float(1.0), ctypes.c_float(0.0)

    def __call__(self, a: wp.array, x: wp.array, c: wp.array) -> None:
        """Queue the product on Warp's present stream; may be captured in a graph."""
        n, b = x.shape
        pointer, blas = ctypes.c_void_p, self._blas
        self._check(blas.cublasSetStream_v2(self._handle, pointer(self._device.stream.cuda_stream)))
        self._check(blas.cublasSetWorkspace_v2(self._handle, pointer(self._workspace.ptr), ctypes.c_size_t(WORKSPACE)))
        # cuBLAS counts by columns: what it sees is X^T A^T = C^T.
        self._check(
            blas.cublasGemmEx(
                self._handle, _PLAIN, _PLAIN, b, n, n, ctypes.byref(self._one),
                pointer(x.ptr), _REAL, b, pointer(a.ptr), _REAL, n, ctypes.byref(self._zero),
                pointer(c.ptr), _REAL, b, _TF32, _DEFAULT,
            )
        )  # fmt: skip

    @staticmethod
    def _check(status: int) -> None:
        if status != 0:
            raise RuntimeError(f"cuBLAS reported status {status}")
