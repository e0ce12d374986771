"""Sparse direct solution: Pardiso through pypardiso where there is one, else SuperLU.

The pattern is analysed once per mesh. Pardiso runs on one thread in its reproducible mode: two presses side by side use
two cores better than one press on both, and the same numbers come out on every run.
"""

import copy
import weakref
from functools import cache
from typing import Any, Protocol

import numpy as np

from synth.arrays import FloatArray


class DirectSolver(Protocol):
    """Solves A x = b for matrices of one pattern."""

    def solve(self, values: FloatArray, right: FloatArray) -> FloatArray:
        """The (n,) float64 solution for CSR data `values` (nnz,) and right side `right` (n,); NaN if A is singular."""


def direct_solver(indptr: np.ndarray, indices: np.ndarray, symmetric: bool) -> DirectSolver:
    """The best solver there is for this CSR pattern (upper triangle only where symmetric)."""
    if not has_pardiso():
        return SuperLUSolver(indptr, indices, symmetric)
    return PardisoSolver(indptr, indices, symmetric)


@cache
def has_pardiso() -> bool:
    """Whether pypardiso and its MKL can be loaded."""
    try:
        _loaded()
    except ImportError:
        return False
    return True


@cache
def _loaded() -> Any:
    """One PyPardisoSolver to copy: each construction searches the whole environment for MKL, half a second."""
    from pypardiso.pardiso_wrapper import PyPardisoSolver

    solver = PyPardisoSolver()
    solver.libmkl.MKL_Set_Num_Threads(1)
    solver.libmkl.MKL_CBWR_Set(2)  # MKL_CBWR_AUTO: same result whatever the memory alignment
    return solver


class PardisoSolver:
    """MKL Pardiso, symmetric indefinite (mtype -2) or structurally symmetric (mtype 1).

    Matching and scaling are off: they would make the analysis, and so the last bits of every later solution, depend on
    the values of the first matrix, that is on which sample of a batch came first.
    """

    ANALYSE, FACTOR, SOLVE = 11, 22, 33

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, symmetric: bool) -> None:
        import scipy.sparse as sp

        self._analysed = False
        self._solver = copy.copy(_loaded())
        self._solver.mtype = -2 if symmetric else 1
        self._solver.pt, self._solver.iparm = np.zeros_like(self._solver.pt), np.zeros_like(self._solver.iparm)
        for index, value in ((1, 1), (2, 2), (8, 0), (10, 8 if symmetric else 13), (11, 0), (13, 0), (21, 1), (24, 0)):
            self._solver.set_iparm(index, value)
        size = len(indptr) - 1
        self._matrix = sp.csr_matrix((np.ones(len(indices)), indices, indptr), shape=(size, size))

    def solve(self, values: FloatArray, right: FloatArray) -> FloatArray:
        """See DirectSolver."""
        from pypardiso.pardiso_wrapper import PyPardisoError

        self._matrix.data[:] = values
        right = np.ascontiguousarray(right)  # pypardiso hands over the bare pointer
        try:
            if not self._analysed:
                self._phase(self.ANALYSE, right)
                self._analysed = True
                weakref.finalize(self, self._solver.free_memory, everything=True)
            self._phase(self.FACTOR, right)
            return self._phase(self.SOLVE, right)
        except PyPardisoError:
            return np.full_like(right, np.nan)

    def _phase(self, phase: int, right: FloatArray) -> FloatArray:
        self._solver.set_phase(phase)
        return np.asarray(self._solver._call_pardiso(self._matrix, right))


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
        try:
            return np.asarray(splu(full.tocsc()).solve(right))
        except RuntimeError:  # exactly singular
            return np.full_like(right, np.nan)
