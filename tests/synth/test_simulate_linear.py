"""Direct factors and GMRES against dense solutions of saddle-point matrices; what makes their answers repeatable."""

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import csr_matrix, triu

import synth.simulate.linear as linear
from synth.arrays import FloatArray
from synth.simulate.linear import Factor, LinearSolver, PardisoFactor, SuperLUFactor, gmres, has_pardiso

SIZE = 120
needs_mkl = pytest.mark.skipif(not has_pardiso(), reason="no MKL")
FACTORS = [
    SuperLUFactor,
    pytest.param(partial(PardisoFactor, single=False), marks=needs_mkl, id="double"),
    pytest.param(partial(PardisoFactor, single=True), marks=needs_mkl, id="single"),
]
each_factor = pytest.mark.parametrize("kind", FACTORS)


def saddle(seed: int) -> csr_matrix:
    """Upper triangle; indefinite, as displacement and pressure make it: [[A, B], [B^T, -C]]."""
    rng = np.random.default_rng(seed)
    keep = np.random.default_rng(0).random((SIZE, SIZE)) < 0.1  # one pattern for all seeds
    keep |= keep.T | np.eye(SIZE, dtype=bool)
    full = rng.standard_normal((SIZE, SIZE))
    full = full + full.T + np.diag(np.where(np.arange(SIZE) < 90, 20.0, -20.0))
    rows, columns = np.nonzero(keep)
    return triu(csr_matrix((full[rows, columns], (rows, columns)), shape=(SIZE, SIZE)), format="csr")


def whole(upper: csr_matrix) -> FloatArray:
    return np.asarray((upper + triu(upper, 1).T).toarray())


def remainder(rows: int, size: float = 5.0) -> csr_matrix:
    """Unsymmetric, of rank `rows`: what friction of a few faces leaves over."""
    rng = np.random.default_rng(9)
    rest = np.zeros((SIZE, SIZE))
    chosen = rng.choice(90, rows, replace=False)
    rest[chosen] = size * rng.standard_normal((rows, SIZE)) * (rng.random((rows, SIZE)) < 0.1)
    return csr_matrix(rest)


def make(kind: Any, matrix: csr_matrix) -> Factor:
    return kind(matrix.indptr, matrix.indices)


def right_side(seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal(SIZE)


def rounding(kind: Any) -> float:
    """Of the factor's precision, times a condition number of some 10 to 100 and the size."""
    return 1e-3 if isinstance(kind, partial) and kind.keywords["single"] else 1e-11


@each_factor
def test_factor_is_the_inverse(kind: Any) -> None:
    factor = make(kind, saddle(1))
    for seed in (1, 2, 3):
        matrix, b = saddle(seed), right_side(seed)
        assert factor.factorise(matrix.data)
        expected = np.linalg.solve(whole(matrix), b)
        assert np.linalg.norm(factor.apply(b) - expected) < rounding(kind) * np.linalg.norm(expected)


@each_factor
def test_answer_does_not_depend_on_what_was_solved_before(kind: Any) -> None:
    """Else a press's last bits would depend on the presses before it."""
    matrix, b = saddle(1), right_side(1)
    fresh, used = make(kind, matrix), make(kind, matrix)
    fresh.factorise(matrix.data)
    for seed, scale in ((2, 1.0), (3, 1e6)):
        used.factorise(scale * saddle(seed).data)
        used.apply(right_side(seed))
    used.factorise(matrix.data)
    assert (used.apply(b) == fresh.apply(b)).all()


@each_factor
@pytest.mark.parametrize("values", [0.0, np.nan])
def test_matrix_without_inverse_gives_no_step_to_trust(kind: Any, values: float) -> None:
    """Refused, NaN, or, where Pardiso perturbs the pivots, a direction that leaves the residual where it was."""
    matrix, b = saddle(1), right_side(1)
    matrix.data[:] = values
    factor = make(kind, matrix)
    if factor.factorise(matrix.data):
        x = gmres(matrix, None, factor, b)[0]
        assert not np.isfinite(x).all() or np.linalg.norm(whole(matrix) @ x - b) >= 0.999 * np.linalg.norm(b)


@each_factor
@pytest.mark.parametrize("rest", [None, remainder(12)], ids=["symmetric", "unsymmetric"])
def test_gmres_solves_with_the_remainder(kind: Any, rest: csr_matrix | None) -> None:
    matrix, b = saddle(1), right_side(1)
    full = whole(matrix) if rest is None else whole(matrix) + rest.toarray()
    factor = make(kind, matrix)
    factor.factorise(matrix.data)
    x = gmres(matrix, rest, factor, b)[0]
    # The residual that the Arnoldi relation predicts is the true one but for rounding.
    assert np.linalg.norm(full @ x - b) < 1.001 * linear.GMRES_TOLERANCE * np.linalg.norm(b)
    exact = np.linalg.solve(full, b)
    # 1e-12 of the residual, times a condition number of some 100; single precision too.
    np.testing.assert_allclose(gmres(matrix, rest, factor, b, 1e-12)[0], exact, atol=1e-9 * np.abs(exact).max())


def test_gmres_ends_after_the_remainders_rank_at_its_limit_without_right_side_or_in_nan() -> None:
    """(S + R) S^-1 is the identity but for a matrix of R's rank: one iteration more than that is enough."""
    matrix, b = saddle(1), right_side(1)
    factor = SuperLUFactor(matrix.indptr, matrix.indices)
    factor.factorise(matrix.data)
    for rank in (1, 5, 12):
        assert gmres(matrix, remainder(rank), factor, b, 1e-10)[1] <= rank + 1
    assert gmres(matrix, None, factor, b, 1e-10)[1] == 1
    x, iterations, _ = gmres(matrix, remainder(5), factor, np.zeros(SIZE))
    assert not x.any()
    assert iterations == 0
    broken: Any = SimpleNamespace(apply=lambda right: np.full_like(right, np.nan))
    assert np.isnan(gmres(matrix, None, broken, b)[0]).all()
    # A remainder too large for so few iterations: the best direction so far, not an endless loop.
    rest = remainder(60, 50.0)
    x, iterations, told = gmres(matrix, rest, factor, b, limit=3)
    assert iterations == 3
    left = np.linalg.norm((whole(matrix) + rest.toarray()) @ x - b) / np.linalg.norm(b)
    assert linear.GMRES_TOLERANCE < left < 1
    assert told == pytest.approx(left, rel=1e-6)


def nearly(matrix: csr_matrix, rank: int) -> csr_matrix:
    """The upper triangle changed in so many diagonal entries, as where contact changed."""
    changed = matrix.copy()
    diagonal = changed.diagonal()
    diagonal[:rank] += 30.0 * np.arange(1, rank + 1)
    changed.setdiag(diagonal)
    return changed


def test_factor_is_reused_while_it_serves_and_made_anew_where_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(linear, "MAX_REUSE_ITERATIONS", 4)
    first, b = saddle(1), right_side(1)
    factor = SuperLUFactor(first.indptr, first.indices)
    one = LinearSolver(factor, reuse=True)
    one.solve(first, None, b)
    near = nearly(first, 1)  # with the remainder of rank 2 GMRES ends after 4 iterations
    full = whole(near) + remainder(2).toarray()
    for rough, tolerance in ((True, linear.ROUGH_TOLERANCE), (False, linear.GMRES_TOLERANCE)):
        x = one.solve(near, remainder(2), b, rough, reuse=True)
        assert factor.made == 1
        assert np.linalg.norm(full @ x - b) < 1.001 * tolerance * np.linalg.norm(b)
    far = nearly(first, 30)  # takes GMRES more iterations
    y = one.solve(far, None, b, rough=True, reuse=True)
    assert factor.made == 2
    assert np.linalg.norm(whole(far) @ y - b) < 1.001 * linear.ROUGH_TOLERANCE * np.linalg.norm(b)
    # What another press left in the factor would make the bits depend on it.
    alone = LinearSolver(SuperLUFactor(first.indptr, first.indices), reuse=True)
    LinearSolver(factor, reuse=True).solve(first, None, b)
    np.testing.assert_array_equal(one.solve(near, None, b, True, True), alone.solve(near, None, b, True, True))
    factor = SuperLUFactor(first.indptr, first.indices)
    never, one = (LinearSolver(factor, reuse=reuse) for reuse in (False, True))
    for solver, reuse, made in ((never, True, 1), (never, True, 2), (one, True, 3), (one, False, 4), (one, True, 4)):
        solver.solve(first, None, b, reuse=reuse)
        assert factor.made == made
    one.forget()
    for _ in range(2):
        one.solve(first, None, b, rough=True, reuse=True)
        assert factor.made == 5


def test_gmres_ends_early_where_its_rate_does_not_do() -> None:
    first, b = saddle(1), right_side(1)
    factor = SuperLUFactor(first.indptr, first.indices)
    factor.factorise(first.data)
    far = nearly(first, 30)
    _, patient, left = gmres(far, None, factor, b, limit=40)
    assert left < linear.GMRES_TOLERANCE
    assert patient > 12
    _, hasty, left = gmres(far, None, factor, b, limit=8, hopeless_after=4)
    assert left > linear.GMRES_TOLERANCE
    assert 4 <= hasty < 8
    assert gmres(far, None, factor, b, limit=40, hopeless_after=4)[1] == patient
