"""The linear solver of the batched simulation by itself."""

from typing import Any

import numpy as np
import pytest
import scipy.sparse
import warp as wp
from pads import SIZE, brick, scene

from synth.press.press import Press
from synth.simulate.batched import krylov as kernels
from synth.simulate.batched.gpu import dense, inverse, unit_rows
from synth.simulate.batched.krylov import Krylov, arnoldi, block_size, flat, padded, round_rows, shorten
from synth.simulate.batched.lane import Lane
from synth.simulate.batched.lane_orders import Number, Order, Seen, select
from synth.simulate.linear import GMRES_LIMIT
from synth.simulate.options import STANDARD
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.policy.requests import Solve


def _systems(batch: int, device: str = "cpu", residual: np.ndarray | None = None) -> Krylov:
    """Lanes at the start of a linear solve, for residuals (batch, 150) that are told to be of norm 1."""
    rows = padded(150)
    krylov = kernels.waiting(rows, batch, device)
    residual = np.zeros((batch, 150)) if residual is None else residual
    numbers = np.zeros((batch, len(Number)))
    numbers[:, [Number.NORM, Number.GOAL]] = 1.0, 1e-3
    free = np.append(np.arange(150), np.full(rows - 150, -1))
    given = (np.ones(batch), wp.int32), (numbers, wp.float64), (free, wp.int32), (residual, wp.float64)
    inputs = [wp.array(values, dtype=dtype, device=device) for values, dtype in given]
    wp.launch(kernels.begin_solves, (batch, rows // 4), inputs=[*inputs, krylov], device=device)
    return krylov


def test_lanes_are_selected_by_their_orders() -> None:
    orders, mask = (wp.array(values, dtype=wp.int32, device="cpu") for values in (np.arange(8), np.zeros(8)))
    wp.launch(select, 8, inputs=[orders, Order.RESTORE_PASS | Order.REPEAT, mask], device="cpu")
    assert mask.numpy().tolist() == [0, 0, 1, 1, 1, 1, 1, 1]


def test_linear_solves_are_as_exact_as_newton_needs() -> None:
    """The first; after a fall to a twentieth 0.9 / 400; near the tolerance 0.3 times what is left; the most."""
    posed = scene()
    press = Press.of(posed, brick())
    steps = LoadSteps(press.path, SIZE, False, posed.numerics, STANDARD)

    def goals(forcing: float, *solves: tuple[float, int]) -> list[float]:
        lane = Lane(0, press, steps, np.zeros(len(Number)), forcing)
        return [lane._goal(Solve(relative, 1e-4, iteration), 1 / 20) for relative, iteration in solves]

    given = ((1.0, 0), (1.0, 1), (5e-3, 1), (2e-4, 1))
    assert goals(0.03, *given) == pytest.approx([0.03, 0.00225, 0.006, 0.03], rel=1e-12)
    assert goals(1e-5, *given) == [1e-5] * 4


@pytest.mark.parametrize(("device", "batch"), [("cpu", 3), pytest.param("cuda", 600, marks=pytest.mark.cuda)])
def test_every_lane_solves_its_own_system(device: str, batch: int) -> None:
    """Unsymmetric matrices of 150 unknowns, preconditioned, to goals of their own, together and alone."""
    if device == "cuda" and not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    rng = np.random.default_rng(2)
    size = 150
    goals = np.resize(np.array([1e-1, 1e-4, 1e-2], dtype=np.float32), batch)
    scale = np.geomspace(1, 1e3, size)
    spreads = np.resize([1.0, 3.0, 10.0], batch)
    matrices = np.diag(scale) + 0.02 * spreads[:, None, None] * rng.standard_normal((batch, size, size))
    rights = rng.standard_normal((batch, size))
    rights /= np.linalg.norm(rights, axis=1, keepdims=True)

    def solved(which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        krylov = _systems(len(which), device)
        krylov.goal.assign(goals[which])
        first = np.zeros(flat(krylov.current).shape, dtype=np.float32)
        first[:, :size] = rights[which]
        flat(krylov.current).assign(first)
        basis = krylov.basis.numpy()
        basis[:, 0] = krylov.current.numpy()
        krylov.basis.assign(basis)
        rows = first.shape[1]
        launch: dict[str, Any] = {"dim": [len(which)], "block_dim": block_size(rows), "device": device}
        while (krylov.running.numpy() == kernels.RUNNING).any():
            preconditioned, product = np.zeros_like(first), np.zeros_like(first)
            preconditioned[:, :size] = flat(krylov.current).numpy()[:, :size] / scale
            product[:, :size] = np.einsum("bij,bj->bi", matrices[which], preconditioned[:, :size])
            flat(krylov.preconditioned).assign(preconditioned)
            flat(krylov.product).assign(product)
            wp.launch_tiled(arnoldi(rows), inputs=[krylov], **launch)
        seen = wp.zeros((len(which), len(Seen)), dtype=wp.float64, device=device)
        wp.launch_tiled(kernels.solution(rows), inputs=[krylov, seen], **launch)
        assert (seen.numpy()[:, [Seen.DONE, Seen.FINITE]] == 1).all()
        count = krylov.k.numpy()
        return flat(krylov.step).numpy(), np.abs(krylov.residual.numpy()[np.arange(len(which)), count])

    together_found, left = solved(np.arange(batch))
    for i, found in enumerate(together_found):
        true = np.linalg.norm(matrices[i] @ found[:size].astype(np.float64) - rights[i])
        assert true < goals[i]
        # Rounding of some 20 products of norm 1000 / 1000 and solutions of norm 1 to 6e-8 each.
        assert true == pytest.approx(left[i], abs=2e-6)
    for i in range(3):
        assert (solved(np.array([i]))[0][0] == together_found[i]).all()


def test_a_solve_that_misses_its_goal_ends_at_the_limit() -> None:
    krylov = _systems(1)
    krylov.goal.fill_(0.0)
    krylov.k.fill_(GMRES_LIMIT - 2)
    product = flat(krylov.product)
    product.assign(np.random.default_rng(0).standard_normal(product.shape).astype(np.float32))
    rows = product.shape[1]
    for then in (kernels.RUNNING, kernels.DONE):
        wp.launch_tiled(arnoldi(rows), dim=[1], inputs=[krylov], block_dim=block_size(rows), device="cpu")
        assert krylov.running.numpy() == then


def _bits(numbers: np.ndarray) -> np.ndarray:
    """The 16 bits of single precision that bfloat16 does not have."""
    return np.ascontiguousarray(numbers).view(np.uint32) & 0xFFFF


def _single(numbers: wp.array) -> np.ndarray:
    """Of bfloat16, of which NumPy gets the bits, or the numbers where ml_dtypes is installed."""
    return (numbers.numpy().view(np.uint16).astype(np.uint32) << 16).view(np.float32)


@pytest.mark.filterwarnings("ignore:bfloat16 arrays")
@pytest.mark.parametrize("kind", [wp.float32, wp.bfloat16])
def test_numbers_are_rounded_to_the_nearest_of_bfloat16(kind: type) -> None:
    """1 + k / 128 are neighbours; of two as near, the even one is taken."""
    given = np.array([1 + 0.4 / 128, 1 + 0.6 / 128, -1 - 1.5 / 128, 3e38, 0.0, np.inf, -np.inf, np.nan])
    most = np.array([0x7FFFFFFF], dtype=np.uint32).view(np.float32)  # what CUDA returns of 0 / 0
    numbers = np.append(given.astype(np.float32), most)[None].astype(np.float64)
    matrix = wp.zeros(numbers.shape, dtype=kind, device="cpu")
    wp.launch(round_rows, matrix.shape, inputs=[wp.array(numbers, device="cpu"), 0, matrix], device="cpu")
    found = matrix.numpy()[0] if kind == wp.float32 else _single(matrix)[0]
    np.testing.assert_array_equal(found[:3], [1, 1 + 1 / 128, -1 - 2 / 128])
    assert found[3] == pytest.approx(3e38, rel=1 / 256)
    np.testing.assert_array_equal(found[4:], [0, np.inf, -np.inf, np.nan, np.nan])
    assert (_bits(found[:-1]) == 0).all()


def test_a_preconditioner_takes_bfloat16_from_the_first_vector_on() -> None:
    """Else a GPU would round what a CPU does not."""
    rng = np.random.default_rng(3)
    matrix = rng.standard_normal((150, 150))
    found = inverse(scipy.sparse.csr_array(matrix + matrix.T), "cpu").numpy()
    np.testing.assert_allclose(found[:150, :150], np.linalg.inv(matrix + matrix.T), rtol=1 / 250)
    assert np.count_nonzero(found) == np.count_nonzero(found[:150, :150])
    assert (_bits(found) == 0).all()
    krylov = _systems(2, residual=rng.standard_normal((2, 150)))
    rows = flat(krylov.current).shape[1]
    first = flat(krylov.current).numpy().copy()
    flat(krylov.product).assign(rng.standard_normal((2, rows)).astype(np.float32))
    wp.launch_tiled(arnoldi(rows), dim=[2], inputs=[krylov], block_dim=block_size(rows), device="cpu")
    second = flat(krylov.current).numpy()
    for vector, k in ((first, 0), (second, 1)):
        exact = krylov.basis.numpy()[:, k].reshape(2, rows)
        assert (_bits(vector) == 0).all()
        assert (_bits(exact) != 0).mean() > 0.8 * 150 / rows
        np.testing.assert_allclose(vector, exact, rtol=1 / 256)


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [5, 16, 256, 2048])
@pytest.mark.parametrize("rows", [128, 1792, 10752])
def test_dense_operations_on_a_gpu(rows: int, batch: int) -> None:
    """Products of numbers in bfloat16 are exact; what an H200 cut off its sums was 3.2e-9 of them for each term."""
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    rng = np.random.default_rng(0)
    a, x = (rng.standard_normal(shape).astype(np.float32) for shape in ((rows, rows), (batch, rows)))
    a += a.T
    left, right, product = (wp.array(v, dtype=wp.float32, device="cuda") for v in (a, x, np.zeros_like(x)))
    for factor, given in ((left, a), (right, x)):
        numbers = wp.array(given, dtype=wp.float64, device="cuda")
        wp.launch(round_rows, factor.shape, inputs=[numbers, 0, factor], device="cuda")
    a, x = left.numpy(), right.numpy()
    turned = wp.zeros((rows, batch), dtype=wp.float32, device="cuda")
    short = wp.zeros((rows, rows), dtype=wp.bfloat16, device="cuda")
    wp.launch(shorten, short.shape, inputs=[left, short], device="cuda")
    operations = dense("cuda")
    operations.product(short, right, product, wp.ones(batch, dtype=wp.int32, device="cuda"))
    operations.transpose(right, turned)
    assert (turned.numpy() == x.T).all()
    some = slice(0, 64)
    true = x[some].astype(np.float64) @ a.astype(np.float64)
    off = np.linalg.norm(product.numpy()[some] - true, axis=1) / np.linalg.norm(true, axis=1)
    assert (off < 4e-9 * rows).all()


def test_right_sides_of_an_inverse_are_unit_vectors() -> None:
    """A full block of them, and what is left over at the end."""
    for count, first in ((4, 0), (4, 4), (2, 8)):
        np.testing.assert_array_equal(unit_rows(count, 10, first, wp.get_device("cpu")), np.eye(count, 10, first))


@pytest.mark.cuda
def test_the_inverse_of_a_gpu() -> None:
    """A symmetric indefinite matrix, as that of displacements and pressures is."""
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device")
    rng = np.random.default_rng(4)
    turn = np.linalg.qr(rng.standard_normal((700, 700)))[0]
    matrix = turn @ np.diag(np.geomspace(1e-3, 1e3, 700) * np.where(np.arange(700) % 3, 1, -1)) @ turn.T
    matrix = (matrix + matrix.T) / 2
    found, known = _single(inverse(scipy.sparse.csr_array(matrix), "cuda"))[:700, :700], np.linalg.inv(matrix)
    np.testing.assert_allclose(found, known, rtol=1 / 250, atol=1e-9 * np.abs(known).max())  # bfloat16 has 7 digits
