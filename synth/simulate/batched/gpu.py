"""What a GPU does differently: dense matrices, by cuBLAS and cuSOLVER on an NVIDIA GPU and by NumPy elsewhere.

All else of a batch is Warp's kernels, the same on every device. Products and transposes take and give float32, and sums
are float32. A GPU takes the factors of a product as bfloat16, so callers round them to that before
(`synth.simulate.batched.krylov`).

NVIDIA's mathematical libraries, loaded through ctypes: nothing of torch is imported, which brings them along. They come
with the CUDA builds of torch (packages nvidia-cublas, nvidia-cusolver) or with the CUDA toolkit.
"""

import ctypes
import ctypes.util
import importlib.util
import weakref
from collections.abc import Iterator
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import scipy.sparse
import warp as wp

from synth.errors import InputError
from synth.simulate.batched.krylov import padded, round_rows, scatter, shorten

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
        with suppress(OSError):
            return ctypes.CDLL(path)
    return None


def _places(name: str) -> Iterator[str]:
    spec = importlib.util.find_spec("nvidia")
    for folder in (spec.submodule_search_locations or []) if spec else []:
        yield from sorted(map(str, Path(folder).glob(f"**/lib{name}.so.*")), reverse=True)
    if system := ctypes.util.find_library(name):
        yield system


FLOAT64 = 1  # CUDA_R_64F
COLUMNS = 1024  # of the inverse that are found at a time on a GPU, to save memory
WORKSPACE = 32 << 20
"""Bytes given to cuBLAS, so that it allocates none of its own: NVIDIA's recommendation for Hopper."""
_REAL, _SHORT, _SINGLE, _DEFAULT, _PLAIN, _TURNED = 0, 14, 68, -1, 0, 1
"""CUDA_R_32F, CUDA_R_16BF, CUBLAS_COMPUTE_32F, CUBLAS_GEMM_DEFAULT, CUBLAS_OP_N, CUBLAS_OP_T."""
_AMPERE = 80
"""Architecture from which on GPUs multiply bfloat16."""


class Dense(Protocol):
    """What a device offers; arrays float32, row by row."""

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """Give c = x A for symmetric A (n, n), of `inverse`, and x, c (b, n), at least in rows where wanted (b,) is 1.

        Numbers of x that bfloat16 does not have are rounded on a GPU and not elsewhere.
        """

    def transpose(self, x: wp.array, c: wp.array) -> None:
        """Give c (n, m) = x^T for x (m, n)."""


def dense(device: str) -> Dense:
    """The operations of a Warp device; InputError for CUDA without cuBLAS."""
    return Cublas(device) if wp.get_device(device).is_cuda else Host()


class Host:
    """See Dense. A product takes one row after the other, so that its numbers do not depend on its neighbours."""

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        matrix, given, found = a.numpy(), x.numpy(), c.numpy()
        for s in np.flatnonzero(wanted.numpy() == 1):
            found[s] = matrix @ given[s]

    def transpose(self, x: wp.array, c: wp.array) -> None:
        c.numpy()[...] = x.numpy().T


class Cublas:
    """See Dense. Queued on Warp's present stream; may be captured in a graph."""

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._handle = ctypes.c_void_p()
        self._workspace = wp.empty(WORKSPACE, dtype=wp.uint8, device=device)
        with wp.ScopedDevice(self._device):
            call("cublas", "cublasCreate_v2", ctypes.byref(self._handle))
        weakref.finalize(self, call, "cublas", "cublasDestroy_v2", self._handle).atexit = False
        self._one, self._zero = ctypes.c_float(1.0), ctypes.c_float(0.0)
        self._short: dict[tuple[int, ...], wp.array] = {}

    def product(self, a: wp.array, x: wp.array, c: wp.array, wanted: wp.array) -> None:
        """See Dense; all rows."""
        b, n = x.shape
        if a.dtype == wp.bfloat16:
            x = self._shortened(x)
        self._join()
        kind = _SHORT if a.dtype == wp.bfloat16 else _REAL
        # cuBLAS counts by columns: what it sees is C^T = A^T X^T. Summation runs along memory in both factors, the
        # order that suits tensor cores.
        call(
            "cublas", "cublasGemmEx", self._handle, _TURNED, _PLAIN, n, b, n, ctypes.byref(self._one),
            ctypes.c_void_p(a.ptr), kind, n, ctypes.c_void_p(x.ptr), kind, n, ctypes.byref(self._zero),
            ctypes.c_void_p(c.ptr), _REAL, n, _SINGLE, _DEFAULT,
        )  # fmt: skip

    def _shortened(self, x: wp.array) -> wp.array:
        """In bfloat16, in memory of its own for each shape: a graph that is captured keeps its place."""
        if x.shape not in self._short:
            self._short[x.shape] = wp.empty(x.shape, dtype=wp.bfloat16, device=self._device)
        wp.launch(shorten, x.shape, inputs=[x, self._short[x.shape]], device=self._device)
        return self._short[x.shape]

    def transpose(self, x: wp.array, c: wp.array) -> None:
        m, n = x.shape
        self._join()
        given, found = ctypes.c_void_p(x.ptr), ctypes.c_void_p(c.ptr)
        call(
            "cublas", "cublasSgeam", self._handle, _TURNED, _PLAIN, m, n, ctypes.byref(self._one), given, n,
            ctypes.byref(self._zero), found, m, found, m,
        )  # fmt: skip

    def _join(self) -> None:
        stream, workspace = (ctypes.c_void_p(p) for p in (self._device.stream.cuda_stream, self._workspace.ptr))
        call("cublas", "cublasSetStream_v2", self._handle, stream)
        call("cublas", "cublasSetWorkspace_v2", self._handle, workspace, ctypes.c_size_t(WORKSPACE))


def inverse(matrix: scipy.sparse.csr_array, device: str) -> wp.array:
    """(rows, rows) of a symmetric matrix (k, k): its inverse in bfloat16, then zeros to the length of Krylov vectors.

    It is stored as float32 where a device does not multiply bfloat16. 2 k³ flops in float64: on a CPU 15 s for 13,000
    unknowns at 300 GFLOP/s. InputError where memory does not suffice, or for CUDA without cuSOLVER;
    numpy.linalg.LinAlgError for a singular matrix.
    """
    k, where = matrix.shape[0], wp.get_device(device)
    try:
        full = filled(matrix, where)
        short = where.is_cuda and where.arch >= _AMPERE
        found = wp.zeros((padded(k), padded(k)), dtype=wp.bfloat16 if short else wp.float32, device=where)
        if where.is_cuda:
            _invert_by_cusolver(full, found)
        else:
            rows = wp.array(np.linalg.inv(full.numpy()), device=where, copy=False)
            wp.launch(round_rows, (k, k), inputs=[rows, 0, found], device=where)
    except (MemoryError, RuntimeError) as error:
        raise InputError(
            f"the batched solver inverts a matrix of {k:,} unknowns, which takes {12e-9 * k * k:.1f} GB: {error}; "
            'simulate with numerics.solver = "single"'
        ) from error
    return found


def filled(matrix: scipy.sparse.csr_array, device: wp.Device) -> wp.array:
    """(k, k) float64 on a device of a sparse matrix; each entry is stored once. The host holds no dense copy."""
    entries, full = matrix.tocoo(), wp.zeros(matrix.shape, dtype=wp.float64, device=device)
    places = (wp.array(each, dtype=wp.int32, device=device) for each in (entries.row, entries.col))
    values = wp.array(entries.data, dtype=wp.float64, device=device)
    wp.launch(scatter, entries.nnz, inputs=[*places, values, full], device=device)
    return full


def unit_rows(count: int, length: int, first: int, device: wp.Device) -> wp.array:
    """(count, length) float64 on a device: rows of the identity matrix, from a first one on."""
    rows = wp.zeros((count, length), dtype=wp.float64, device=device)
    rows.flatten()[first :: length + 1].fill_(1.0)
    return rows


def _invert_by_cusolver(factors: wp.array, found: wp.array) -> None:
    """LU factors, then unit vectors as right sides. cuSOLVER counts by columns, which symmetry makes the same."""
    n, device = len(factors), factors.device
    handle, settings, here, there = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_size_t()
    pivots, info = wp.empty(n, dtype=wp.int64, device=device), wp.zeros(1, dtype=wp.int32, device=device)
    left, order, told = (ctypes.c_void_p(each.ptr) for each in (factors, pivots, info))
    size, run = ctypes.c_int64(n), partial(call, "cusolver")
    with wp.ScopedDevice(device):
        run("cusolverDnCreate", ctypes.byref(handle))
        run("cusolverDnCreateParams", ctypes.byref(settings))
        run("cusolverDnSetStream", handle, ctypes.c_void_p(device.stream.cuda_stream))
        try:
            given = (handle, settings, size, size, FLOAT64, left, size)
            run("cusolverDnXgetrf_bufferSize", *given, FLOAT64, ctypes.byref(here), ctypes.byref(there))
            room, host = wp.empty(here.value, dtype=wp.uint8, device=device), ctypes.create_string_buffer(there.value)
            run("cusolverDnXgetrf", *given, order, FLOAT64, ctypes.c_void_p(room.ptr), here, host, there, told)
            if info.numpy()[0]:
                raise np.linalg.LinAlgError("Singular matrix")
            for first in range(0, n, COLUMNS):
                columns = unit_rows(min(COLUMNS, n - first), n, first, device)
                right, count = ctypes.c_void_p(columns.ptr), ctypes.c_int64(len(columns))
                wanted = (size, count, FLOAT64, left, size, order, FLOAT64, right, size, told)
                run("cusolverDnXgetrs", handle, settings, 0, *wanted)
                wp.launch(round_rows, columns.shape, inputs=[columns, first, found], device=device)
            wp.synchronize_device(device)
        finally:
            run("cusolverDnDestroyParams", settings)
            run("cusolverDnDestroy", handle)
