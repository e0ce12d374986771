"""Sparse direct solution: Pardiso through pypardiso where there is one, else SuperLU.

The pattern is analysed once per mesh. Pardiso runs on one thread in its reproducible mode: two presses side by side use
two cores better than one press on both, and the same numbers come out on every run.
"""

from functools import cache
from typing import Protocol

import numpy as np

from synth.arrays import FloatArray


class DirectSolver(Protocol):
    """Solves A x = b for matrices of one pattern."""

    def solve(self, values: FloatArray, right: FloatArray) -> FloatArray:
        """x for the matrix whose CSR data are `values`; both (n,) or (nnz,) float64."""


def direct_solver(indptr: np.ndarray, indices: np.ndarray, symmetric: bool) -> DirectSolver:
    """The best solver there is for this CSR pattern (upper triangle only where symmetric)."""
    return PardisoSolver(indptr, indices, symmetric) if has_pardiso() else SuperLUSolver(indptr, indices, symmetric)


@cache
def has_pardiso() -> bool:
    """Whether pypardiso and its MKL can be loaded."""
    try:
        import pypardiso  # noqa: F401
    except ImportError:
        return False
    return True


class PardisoSolver:
    """MKL Pardiso, symmetric indefinite (mtype -2) or structurally symmetric (mtype 1)."""

    ANALYSE, FACTOR, SOLVE, RELEASE = 11, 22, 33, -1

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, symmetric: bool) -> None:
        import scipy.sparse as sp
        from pypardiso.pardiso_wrapper import PyPardisoSolver

        self._solver = PyPardisoSolver(mtype=-2 if symmetric else 11)
        library = self._solver.libmkl
        library.MKL_Set_Num_Threads(1)
        library.MKL_CBWR_Set(2)  # MKL_CBWR_AUTO: same result whatever the memory alignment
        for index, value in ((1, 1), (2, 3), (8, 2), (10, 8), (11, 0), (13, 0), (21, 1), (24, 0)):
            self._solver.set_iparm(index, value)
        if not symmetric:
            self._solver.set_iparm(10, 13)
            self._solver.set_iparm(11, 1)
            self._solver.set_iparm(13, 1)
        size = len(indptr) - 1
        self._matrix = sp.csr_matrix((np.ones(len(indices)), indices, indptr), shape=(size, size))
        self._analysed = False

    def solve(self, values: FloatArray, right: FloatArray) -> FloatArray:
        """See DirectSolver."""
        self._matrix.data[:] = values
        if not self._analysed:
            self._phase(self.ANALYSE, right)
            self._analysed = True
        self._phase(self.FACTOR, right)
        return self._phase(self.SOLVE, right)

    def _phase(self, phase: int, right: FloatArray) -> FloatArray:
        self._solver.set_phase(phase)
        return np.asarray(self._solver._call_pardiso(self._matrix, right))

    def __del__(self) -> None:
        if getattr(self, "_analysed", False):
            self._solver.free_memory(everything=True)


class SuperLUSolver:
    """SciPy's SuperLU: everywhere, and several times slower."""

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, symmetric: bool) -> None:
        import scipy.sparse as sp

        size = len(indptr) - 1
        self._matrix = sp.csr_matrix((np.zeros(len(indices)), indices, indptr), shape=(size, size))
        self._symmetric = symmetric

    def solve(self, values: FloatArray, right: FloatArray) -> FloatArray:
        """See DirectSolver."""
        import scipy.sparse as sp
        from scipy.sparse.linalg import splu

        self._matrix.data[:] = values
        full = self._matrix + sp.triu(self._matrix, k=1).T if self._symmetric else self._matrix
        return np.asarray(splu(full.tocsc()).solve(right))
