"""Direct solvers against dense solutions of saddle-point matrices; what makes their answers repeatable.

Each comment "fails with" names a change of `synth.simulate.linear` that was tried.
"""

import numpy as np
import pytest
from scipy.sparse import csr_matrix, triu

from synth.arrays import FloatArray
from synth.simulate.linear import DirectSolver, PardisoSolver, SuperLUSolver, direct_solver, has_pardiso

SIZE = 120
SOLVERS = [SuperLUSolver, pytest.param(PardisoSolver, marks=pytest.mark.skipif(not has_pardiso(), reason="no MKL"))]


def saddle(seed: int, symmetric: bool) -> csr_matrix:
    """Indefinite, as displacement and pressure make it: [[A, B], [B^T, -C]], some rows of A unsymmetric if asked."""
    rng = np.random.default_rng(seed)
    keep = np.random.default_rng(0).random((SIZE, SIZE)) < 0.1  # one pattern for all seeds
    keep |= keep.T | np.eye(SIZE, dtype=bool)
    full = rng.standard_normal((SIZE, SIZE))
    full = full + full.T + np.diag(np.where(np.arange(SIZE) < 90, 20.0, -20.0))
    if not symmetric:
        full[:10] += rng.standard_normal((10, SIZE))
    rows, columns = np.nonzero(keep)
    return csr_matrix((full[rows, columns], (rows, columns)), shape=(SIZE, SIZE))


def stored(matrix: csr_matrix, symmetric: bool) -> csr_matrix:
    return triu(matrix, format="csr") if symmetric else matrix


def make(kind: type, matrix: csr_matrix, symmetric: bool) -> DirectSolver:
    kept = stored(matrix, symmetric)
    return kind(kept.indptr, kept.indices, symmetric)


def right_side(seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(SIZE)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("kind", SOLVERS)
def test_solution_is_the_dense_one(kind: type, symmetric: bool) -> None:
    solver = make(kind, saddle(1, symmetric), symmetric)
    for seed in (1, 2, 3):
        matrix, b = saddle(seed, symmetric), right_side(seed)
        x = solver.solve(stored(matrix, symmetric).data, b)
        # Rounding 1e-16 times a condition number of some 10 to 100 and the size.
        np.testing.assert_allclose(x, np.linalg.solve(matrix.toarray(), b), rtol=0, atol=1e-11)


@pytest.mark.parametrize("kind", SOLVERS)
def test_strided_right_side(kind: type) -> None:
    """A row of a batch may be strided."""
    # Fails without ascontiguousarray: pypardiso hands over the bare pointer.
    matrix, b = saddle(1, True), np.asfortranarray(np.stack([right_side(1), right_side(2)]))
    solver = make(kind, matrix, True)
    assert not b[1].flags.c_contiguous
    x = solver.solve(stored(matrix, True).data, b[1])
    np.testing.assert_allclose(x, np.linalg.solve(matrix.toarray(), right_side(2)), rtol=0, atol=1e-11)


@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("kind", SOLVERS)
def test_answer_does_not_depend_on_what_was_solved_before(kind: type, symmetric: bool) -> None:
    """Else a sample's last bits would depend on its batch."""
    # Fails with Pardiso's matching and scaling on: its analysis then uses the values of the first matrix.
    matrix, b = stored(saddle(1, symmetric), symmetric), right_side(1)
    fresh = make(kind, saddle(1, symmetric), symmetric).solve(matrix.data, b)
    used = make(kind, saddle(1, symmetric), symmetric)
    for seed, scale in ((2, 1.0), (3, 1e6)):
        used.solve(scale * stored(saddle(seed, symmetric), symmetric).data, right_side(seed))
    assert (used.solve(matrix.data, b) == fresh).all()


@pytest.mark.parametrize("kind", SOLVERS)
def test_singular_matrix_gives_no_numbers_to_trust(kind: type) -> None:
    """NaN, or, where Pardiso perturbs the pivots, a step so large that no line search takes it."""
    matrix = saddle(1, False)
    x = make(kind, matrix, False).solve(np.zeros_like(matrix.data), right_side(1))
    assert not np.isfinite(x).all() or np.abs(x).max() > 1e6


def test_best_solver_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    import synth.simulate.linear as linear

    kept = stored(saddle(1, True), True)
    expected = PardisoSolver if has_pardiso() else SuperLUSolver
    assert isinstance(direct_solver(kept.indptr, kept.indices, True), expected)
    monkeypatch.setattr(linear, "has_pardiso", lambda: False)
    assert isinstance(direct_solver(kept.indptr, kept.indices, True), SuperLUSolver)
