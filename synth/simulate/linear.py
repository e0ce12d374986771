"""Linear systems of Newton's method: a sparse direct factor of the symmetric part, and GMRES for what it leaves.

The tangent is A = S + R: S symmetric (its upper triangle is kept), R the unsymmetric remainder of contact, which has
entries at touching faces only. S is factorised in single precision, which halves the time; flexible GMRES (Saad 1993)
in double precision, preconditioned by the factor, takes away the rounding of the factor and R. Pardiso (through
pypardiso's MKL) where there is one, else SuperLU in double precision. The pattern is analysed once per mesh.

Where Newton's method can do with it, the factor of an earlier tangent is used for as long as GMRES gets along with it
(`LinearSolver`).
"""

import ctypes
import weakref
from functools import cache
from importlib.metadata import PackageNotFoundError, files
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp

from synth.arrays import FloatArray

GMRES_TOLERANCE = 1e-3
"""Largest linear residual, relative to the right side; Newton's convergence is then as with an exact solution."""
GMRES_LIMIT = 40
"""Most iterations; where they do not do, the direction is used as it is and the line search decides."""
ROUGH_TOLERANCE = 0.03
"""Largest linear residual of a rough direction, with this tangent's factor or an earlier one's. Far from the solution
changes of the contact set are what counts."""
MAX_REUSE_ITERATIONS, HOPELESS_AFTER = 18, 4
"""An earlier tangent's factor is given up after so many iterations or, from the second number on, as soon as their mean
rate would need more. A new factor takes as long as about fifteen."""


class Factor(Protocol):
    """A factorised symmetric matrix, applied as an approximate inverse; `made` counts matrices that were factorised."""

    made: int

    def factorise(self, values: FloatArray) -> bool:
        """Take new CSR data of the upper triangle; whether it went well."""

    def apply(self, right: FloatArray) -> FloatArray:
        """The approximate solution (n,) float64 for a right side (n,)."""


def direct_factor(indptr: np.ndarray, indices: np.ndarray, single: bool) -> Factor:
    """The best factor there is for this pattern of an upper triangle (CSR, sorted)."""
    if has_pardiso():
        return PardisoFactor(indptr, indices, single)
    return SuperLUFactor(indptr, indices)


class LinearSolver:
    """Solves the linear systems of one press, one after another; without `reuse` always exactly, by new factors.

    Neighbouring tangents differ where contact changed: a few iterations of GMRES with the factor of an earlier one cost
    less than a new factor. If another press has replaced the factor meanwhile, a new one is made.
    """

    def __init__(self, factor: Factor, reuse: bool) -> None:
        self._factor, self._reuse = factor, reuse
        self._own = -1  # number of the factor's matrix that was this press's last

    def forget(self) -> None:
        """Start with a new factor: what is solved next has nothing to do with what was solved before."""
        self._own = -1

    def solve(
        self, matrix: Any, remainder: Any, right: FloatArray, rough: bool = False, reuse: bool = False
    ) -> FloatArray:
        """The solution (n,) of (S + R) x = right; arguments as for `gmres`.

        rough: to ROUGH_TOLERANCE; reuse: by the factor of an earlier matrix if that serves. NaN where a new factor was
        needed and the matrix is singular.
        """
        factor, tolerance = self._factor, ROUGH_TOLERANCE if self._reuse and rough else GMRES_TOLERANCE
        if self._reuse and reuse and factor.made == self._own:
            solution, _, left = gmres(matrix, remainder, factor, right, tolerance, MAX_REUSE_ITERATIONS, HOPELESS_AFTER)
            if left < tolerance:
                return solution
        if not factor.factorise(matrix.data):
            return np.full_like(right, np.nan)
        self._own = factor.made
        return gmres(matrix, remainder, factor, right, tolerance)[0]


def gmres(
    matrix: Any,
    remainder: Any,
    factor: Factor,
    right: FloatArray,
    tolerance: float = GMRES_TOLERANCE,
    limit: int = GMRES_LIMIT,
    hopeless_after: int = GMRES_LIMIT,
) -> tuple[FloatArray, int, float]:
    """Solve (S + R) x = right by flexible GMRES without restart, in at most `limit` iterations.

    `matrix` is the upper triangle of S and `remainder` R or None, both SciPy CSR; the factor is of S, or of a matrix
    like it. The tolerance is of the residual, relative to the right side (n,) float64. From `hopeless_after` iterations
    on it ends where their mean rate does not reach the tolerance within the limit. Returns (n,) the solution, NaN where
    the factor gave no numbers; the iterations; and the relative residual.
    """
    diagonal = matrix.diagonal()
    transposed = matrix.T

    def product(x: FloatArray) -> FloatArray:
        y = matrix @ x + transposed @ x - diagonal * x
        return np.asarray(y if remainder is None else y + remainder @ x)

    size = norm(right)
    if size == 0:
        return np.zeros_like(right), 0, 0.0
    basis: list[FloatArray] = [right / size]
    corrections: list[FloatArray] = []
    hessenberg = np.zeros((limit + 1, limit))
    weights: FloatArray = np.zeros(1)
    left = 1.0
    for k in range(limit):
        corrections.append(factor.apply(basis[k]))
        w = product(corrections[k])
        if not np.isfinite(w).all():
            return np.full_like(right, np.nan), k, np.inf
        for i in range(k + 1):
            hessenberg[i, k] = float(np.sum(w * basis[i]))  # as in `norm`
            w -= hessenberg[i, k] * basis[i]
        hessenberg[k + 1, k] = norm(w)
        small = hessenberg[: k + 2, : k + 1]
        first = np.zeros(k + 2)
        first[0] = size
        weights = np.asarray(np.linalg.lstsq(small, first, rcond=None)[0], dtype=np.float64)
        left = norm(small @ weights - first) / size
        hopeless = k + 1 >= hopeless_after and left ** (limit / (k + 1)) > tolerance
        if left < tolerance or hessenberg[k + 1, k] == 0 or hopeless:
            break
        basis.append(w / hessenberg[k + 1, k])
    solution = np.zeros_like(right)
    for weight, correction in zip(weights, corrections, strict=True):
        solution += weight * correction
    return solution, len(corrections), left


def norm(x: FloatArray) -> float:
    """Euclidean norm of all entries: the same bits whatever the number of BLAS threads."""
    return float(np.sqrt(np.sum(x * x)))


@cache
def has_pardiso() -> bool:
    try:
        _mkl()
    except (ImportError, OSError):  # an MKL that does not load is as good as none
        return False
    return True


@cache
def _mkl() -> Any:
    """MKL, one thread, reproducible: pip's, or what pypardiso finds, which searches the whole environment twice."""
    try:
        packaged = [file.locate() for file in files("mkl") or [] if "mkl_rt" in file.name]
    except PackageNotFoundError:
        packaged = []
    if packaged:
        library = ctypes.CDLL(str(packaged[0]))
    else:
        from pypardiso.pardiso_wrapper import PyPardisoSolver

        library = PyPardisoSolver().libmkl
    library.MKL_Set_Num_Threads(1)
    library.MKL_CBWR_Set(2)  # MKL_CBWR_AUTO: same result whatever the memory alignment
    return library


class PardisoFactor:
    """MKL Pardiso, symmetric indefinite (mtype -2), one thread: two presses side by side use two cores better.

    Matching and scaling are off: they would make the analysis, and so the last bits of every later solution, depend on
    the values of the first matrix, that is on which press came first.
    """

    ANALYSE, FACTORISE, SOLVE, RELEASE = 11, 22, 33, -1

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, single: bool) -> None:
        self._type = np.float32 if single else np.float64
        self._size = len(indptr) - 1
        self._indptr = np.ascontiguousarray(indptr, dtype=np.int32)
        self._indices = np.ascontiguousarray(indices, dtype=np.int32)
        self._values = np.zeros(len(indices), dtype=self._type)
        self._handle = np.zeros(64, dtype=np.int64)
        self._settings = np.zeros(64, dtype=np.int32)
        # own settings; METIS; pivots of 1e-8 (1e-5 in single precision) replace smaller ones; Bunch-Kaufman; single;
        # indices from 0; no refinement of its own
        for place, value in ((1, 1), (2, 2), (8, 0), (10, 5 if single else 8), (21, 1), (28, int(single)), (35, 1)):
            self._settings[place - 1] = value
        self._analysed = False
        self.made = 0

    def factorise(self, values: FloatArray) -> bool:
        self.made += 1
        self._values[:] = values
        if not np.isfinite(self._values).all():  # MKL was seen to crash on a matrix of NaN
            return False
        nothing = np.zeros(self._size, dtype=self._type)
        if not self._analysed:
            if self._call(self.ANALYSE, nothing, nothing) != 0:
                return False
            self._analysed = True
            weakref.finalize(self, _release, self._handle, self._settings, self._size)
        return self._call(self.FACTORISE, nothing, nothing) == 0

    def apply(self, right: FloatArray) -> FloatArray:
        """See Factor; NaN where Pardiso reports an error."""
        b = right.astype(self._type)
        x = np.zeros_like(b)
        if self._call(self.SOLVE, b, x) != 0:
            return np.full(self._size, np.nan)
        return x.astype(np.float64)

    def _call(self, phase: int, right: np.ndarray, solution: np.ndarray) -> int:
        return _pardiso(
            self._handle, phase, self._size, self._values, self._indptr, self._indices, self._settings, right, solution
        )


def _pardiso(handle: np.ndarray, phase: int, size: int, *arrays: np.ndarray) -> int:
    """One call of Pardiso; arrays: values, row pointers, columns, settings, right side, solution. Its error code."""
    state, values, *pattern, settings, right, solution = (a.ctypes.data_as(ctypes.c_void_p) for a in (handle, *arrays))
    error = ctypes.c_int32(0)
    one, kind, stage, count, silent, told = (
        ctypes.byref(number) for number in (*map(ctypes.c_int32, (1, -2, phase, size, 0)), error)
    )
    call = _mkl().pardiso
    call.argtypes, call.restype = None, None
    call(state, one, one, kind, stage, count, values, *pattern, None, one, settings, silent, right, solution, told)
    return int(error.value)


def _release(handle: np.ndarray, settings: np.ndarray, size: int) -> None:
    empty = np.zeros(1, dtype=np.int32)
    _pardiso(handle, PardisoFactor.RELEASE, size, empty, empty, empty, settings, empty, empty)


class SuperLUFactor:
    """SciPy's SuperLU: everywhere, and several times slower."""

    def __init__(self, indptr: np.ndarray, indices: np.ndarray) -> None:
        size = len(indptr) - 1
        self._matrix = sp.csr_matrix((np.zeros(len(indices)), indices, indptr), shape=(size, size))
        self._factor: Any = None
        self.made = 0

    def factorise(self, values: FloatArray) -> bool:
        from scipy.sparse.linalg import splu

        self.made += 1
        self._matrix.data[:] = values
        full = self._matrix + sp.triu(self._matrix, k=1).T
        try:
            self._factor = splu(full.tocsc())
        except RuntimeError:  # exactly singular
            return False
        return True

    def apply(self, right: FloatArray) -> FloatArray:
        return np.asarray(self._factor.solve(right))
