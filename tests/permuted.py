"""Another order of the degrees of freedom, so that tests see what rounding decides: `python -m pytest --permute SEED`.

The sparse factors of this process are made of matrices whose unknowns are numbered at random. They answer to the same
tolerance, with other roundings, as on another processor. Whoever derives a bound runs its test with several seeds, and
with `OMP_NUM_THREADS` 1 and 2. Processes that a test starts number theirs as ever, so tests that compare bits with
theirs (`processes`) are skipped.
"""

import numpy as np

import synth.simulate.linear as linear
import synth.simulate.pattern as pattern
from synth.arrays import FloatArray
from synth.simulate.linear import Factor, direct_factor


class Permuted:
    """A factor (`synth.simulate.linear.Factor`) of the same matrix in another order."""

    def __init__(self, indptr: np.ndarray, indices: np.ndarray, single: bool, seed: int) -> None:
        size = len(indptr) - 1
        self._order = np.random.default_rng(seed).permutation(size)
        self._number = np.argsort(self._order)
        ends = self._number[[np.repeat(np.arange(size), np.diff(indptr)), indices]]
        row, column = np.sort(ends, axis=0)
        self._entries = np.lexsort((column, row))
        starts = np.concatenate([[0], np.cumsum(np.bincount(row, minlength=size))])
        self._factor = direct_factor(starts.astype(np.int32), column[self._entries].astype(np.int32), single)

    @property
    def made(self) -> int:
        return self._factor.made

    def factorise(self, values: FloatArray) -> bool:
        return self._factor.factorise(np.asarray(values)[self._entries])

    def apply(self, right: FloatArray) -> FloatArray:
        return self._factor.apply(right[self._order])[self._number]


def permute(seed: int) -> None:
    """Permute all factors that this process makes from now on."""

    def permuted(indptr: np.ndarray, indices: np.ndarray, single: bool) -> Factor:
        return Permuted(indptr, indices, single, seed)

    linear.direct_factor = pattern.direct_factor = permuted  # type: ignore[assignment]
