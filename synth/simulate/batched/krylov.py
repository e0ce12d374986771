"""Flexible GMRES without restart for many systems at once, each at its own iteration, as Warp kernels.

Saad, SIAM J. Sci. Comput. 14, 1993; modified Gram-Schmidt and Givens rotations, in single precision: what is solved
to a lane's goal is a correction, and Newton's residual is in double precision. A lane's solve begins when its matrix
is ready, goes on through as many cycles as it takes, and ends when the next cycle finds it DONE; no lane waits for
another.

Memory decides the time, so one block of threads has a lane's vector in its registers and reads every basis vector once
an iteration: vectors of a lane lie together, in fours, (B, ..., rows / 4), and each lane goes through as many as it
has. The tangent's product wants lanes next to each other, (rows, B); `synth.simulate.batched.gpu` turns its argument
and its result. Sums are taken by a block in a fixed order, so that nothing here depends on other lanes (what
goes in does on a GPU: see `synth.simulate.batched.solver`).

What goes into the preconditioner is rounded before to bfloat16, 8 bits for the exponent and 7 after the point, by the
same kernels on every device. Products of two such numbers are exact in single precision, so that only their sums are
left between a GPU and a CPU.
"""

from functools import cache
from typing import Any

import warp as wp

from synth.simulate.batched.lane_orders import Number, Order, Seen
from synth.simulate.linear import GMRES_LIMIT
from synth.simulate.tables import zeros_of

WAITING, RUNNING, DONE = wp.constant(0), wp.constant(1), wp.constant(2)
LIMIT = wp.constant(GMRES_LIMIT)
ZERO = wp.constant(wp.float32(0.0))
ONE = wp.constant(wp.float32(1.0))
MAX_PER_THREAD = 84
"""Numbers of a vector that one thread holds, at most, so that two vectors fit its 255 registers."""
SMALLEST_BLOCK, LARGEST_BLOCK = 64, 512
RESIDENT_THREADS = 256
"""Threads that are to run side by side on a multiprocessor: so few keep its memory busy, and each has its registers."""


@wp.struct
class Krylov:
    """One system a lane.

    Attributes:
        running: (B,) WAITING, RUNNING or DONE.
        k: (B,) iterations done.
        size: (B,) norm of the right side; goal: of the residual, relative to it.
        basis: (B, LIMIT + 1, rows / 4); corrections: (B, LIMIT, rows / 4), the preconditioned basis.
        current: (B, rows / 4) the last basis vector, in bfloat16; preconditioned: K_0^{-1} times it.
        corrected: the same, (rows, B).
        image: (rows, B) the tangent times corrected; product: the same, (B, rows / 4).
        triangle: (B, LIMIT, LIMIT) rotated Hessenberg matrices by columns.
        cosine, sine: (B, LIMIT); residual: (B, LIMIT + 1) of the rotated right side.
        step: (B, rows / 4) the solution.
    """

    running: wp.array(dtype=wp.int32)
    k: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.float64)
    goal: wp.array(dtype=wp.float32)
    basis: wp.array3d(dtype=wp.vec4f)
    corrections: wp.array3d(dtype=wp.vec4f)
    current: wp.array2d(dtype=wp.vec4f)
    preconditioned: wp.array2d(dtype=wp.vec4f)
    corrected: wp.array2d(dtype=wp.float32)
    image: wp.array2d(dtype=wp.float32)
    product: wp.array2d(dtype=wp.vec4f)
    triangle: wp.array3d(dtype=wp.float32)
    cosine: wp.array2d(dtype=wp.float32)
    sine: wp.array2d(dtype=wp.float32)
    residual: wp.array2d(dtype=wp.float32)
    step: wp.array2d(dtype=wp.vec4f)


def waiting(rows: int, batch: int, device: str) -> Krylov:
    """So many lanes that wait, for vectors of so many rows."""
    lanes, turned, each, limit = (batch,), (rows, batch), (batch, rows // 4), GMRES_LIMIT
    shapes = {
        "running": lanes, "k": lanes, "size": lanes, "goal": lanes,
        "basis": (batch, limit + 1, rows // 4), "corrections": (batch, limit, rows // 4),
        "current": each, "preconditioned": each, "corrected": turned, "image": turned, "product": each,
        "triangle": (batch, limit, limit), "cosine": (batch, limit), "sine": (batch, limit),
        "residual": (batch, limit + 1), "step": each,
    }  # fmt: skip
    return zeros_of(Krylov, lambda name: shapes[name], device)


def flat(vectors: wp.array) -> wp.array:
    """(B, rows) view of (B, rows / 4) vectors."""
    return vectors.view(wp.float32).reshape((vectors.shape[0], -1))


def block_size(unknowns: int) -> int:
    """Threads that share a vector: the smallest power of two with at most MAX_PER_THREAD numbers each."""
    block = SMALLEST_BLOCK
    while block * MAX_PER_THREAD < unknowns and block < LARGEST_BLOCK:
        block *= 2
    return block


def padded(unknowns: int) -> int:
    """Rows of a vector: as many fours for each thread of a block, so that none has to ask where the vector ends.

    A multiple of 64, which matrix products on a GPU want, too.
    """
    share = 4 * block_size(unknowns)
    return -(-unknowns // share) * share


@wp.kernel
def begin_solves(
    mask: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    free: wp.array(dtype=wp.int32),
    residual: wp.array2d(dtype=wp.float64),
    krylov: Krylov,
):
    """One thread per (lane, four rows): iterations begin, with minus the residual over its norm as first basis vector.

    free: (rows,) number of the value in a residual (B, 3 n + k), or -1 for rows that fill up.
    """
    s, i = wp.tid()
    if mask[s] == 0:
        return
    size = numbers[s, Number.NORM]
    found = wp.vec4f()
    for k in range(4):
        unknown = free[4 * i + k]
        if unknown >= 0 and size > wp.float64(0.0):
            found[k] = wp.float32(-residual[s, unknown] / size)
    krylov.basis[s, 0, i] = found
    krylov.current[s, i] = four_in_bfloat16(found)
    if i == 0:
        krylov.goal[s] = wp.float32(numbers[s, Number.GOAL])
        krylov.size[s] = size
        krylov.k[s] = 0
        krylov.residual[s, 0] = ONE
        krylov.running[s] = wp.where(size == wp.float64(0.0), DONE, RUNNING)


@cache
def arnoldi(rows: int) -> wp.Kernel:
    """The kernel of an iteration from the product on; one block per lane, for vectors of so many rows.

    The new basis vector, the Givens rotation of its column of the Hessenberg matrix, and whether the solve ends.
    """
    count = wp.constant(rows // 4)
    bounds = (block_size(rows), max(1, RESIDENT_THREADS // block_size(rows)))

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=bounds)
    def iteration(krylov: Krylov):
        s, thread = wp.tid()
        if krylov.running[s] != RUNNING:
            return
        k = krylov.k[s]
        w = wp.tile_load(krylov.product[s], shape=count, bounds_check=False)
        above = wp.float32(0.0)
        for j in range(k + 1):
            v = wp.tile_load(krylov.basis[s, j], shape=count, bounds_check=False)
            along = wp.tile_extract(wp.tile_dot(v, w), 0)
            wp.tile_axpy(-along, v, w)
            if j == 0:
                above = along
            else:
                cosine = krylov.cosine[s, j - 1]
                sine = krylov.sine[s, j - 1]
                if thread == 0:
                    krylov.triangle[s, k, j - 1] = cosine * above + sine * along
                above = cosine * along - sine * above
        below = wp.sqrt(wp.tile_extract(wp.tile_dot(w, w), 0))
        scale = wp.float32(0.0)
        if below > ZERO:
            scale = ONE / below
        z = wp.tile_load(krylov.preconditioned[s], shape=count, bounds_check=False)
        wp.tile_store(krylov.corrections[s, k], z, bounds_check=False)
        v = w * scale
        wp.tile_store(krylov.basis[s, k + 1], v, bounds_check=False)
        wp.tile_store(krylov.current[s], wp.tile_map(four_in_bfloat16, v), bounds_check=False)
        if thread == 0:
            length = wp.sqrt(above * above + below * below)
            cosine = wp.float32(1.0)
            sine = wp.float32(0.0)
            if length > ZERO:
                cosine = above / length
                sine = below / length
            krylov.cosine[s, k] = cosine
            krylov.sine[s, k] = sine
            krylov.triangle[s, k, k] = length
            left = krylov.residual[s, k]
            krylov.residual[s, k] = cosine * left
            krylov.residual[s, k + 1] = -sine * left
            krylov.k[s] = k + 1
            over = wp.abs(sine * left) < krylov.goal[s] or below == ZERO or k + 1 == LIMIT
            if over or not wp.isfinite(length):
                krylov.running[s] = DONE

    return iteration


@cache
def solution(rows: int) -> wp.Kernel:
    """The kernel that finds the solution where a solve is done, and tells that it is; one block per lane.

    Each thread substitutes backwards by itself, since threads do not wait for each other to read a tile before it
    changes in shared memory.
    """
    count = wp.constant(rows // 4)
    coefficients = wp.types.vector(length=GMRES_LIMIT, dtype=wp.float32)
    bounds = (block_size(rows), max(1, RESIDENT_THREADS // block_size(rows)))

    @wp.kernel(module="unique", enable_backward=False, launch_bounds=bounds)
    def finish(krylov: Krylov, seen: wp.array2d(dtype=wp.float64)):
        s, thread = wp.tid()
        if thread == 0:
            seen[s, Seen.DONE] = wp.float64(0.0)
        if krylov.running[s] != DONE:
            return
        k = krylov.k[s]
        right = coefficients()
        for i in range(k):
            right[i] = krylov.residual[s, i]
        total = wp.tile_zeros(shape=count, dtype=wp.vec4f)
        finite = wp.int32(1)
        for back in range(k):
            j = k - 1 - back
            pivot = krylov.triangle[s, j, j]
            weight = ZERO
            if pivot != ZERO:
                weight = right[j] / pivot
            if not wp.isfinite(weight):
                finite = wp.int32(0)
            for i in range(j):
                right[i] -= weight * krylov.triangle[s, j, i]
            z = wp.tile_load(krylov.corrections[s, j], shape=count, bounds_check=False)
            wp.tile_axpy(weight, z, total)
        wp.tile_store(krylov.step[s], total * wp.float32(krylov.size[s]), bounds_check=False)
        if thread == 0:
            seen[s, Seen.DONE] = wp.float64(1.0)
            seen[s, Seen.FINITE] = wp.float64(finite)

    return finish


@wp.kernel
def release(
    krylov: Krylov,
    orders: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float64),
    share: wp.array(dtype=wp.float64),
    mask: wp.array(dtype=wp.int32),
):
    """One thread per lane: whether it is evaluated, and at which share of the step from the iterate.

    A solution leaves the lane waiting, and its whole step is tried.
    """
    s = wp.tid()
    mask[s] = wp.where((orders[s] & (Order.EVALUATE | Order.TRY)) != 0, 1, 0)
    share[s] = wp.where((orders[s] & Order.TRY) != 0, numbers[s, Number.SHARE], wp.float64(0.0))
    if krylov.running[s] == DONE:
        krylov.running[s] = WAITING
        mask[s] = 1
        share[s] = wp.float64(1.0)


@wp.func
def in_bfloat16(x: wp.float32) -> wp.float32:
    """To the nearest bfloat16; what is not finite stays."""
    return wp.float32(wp.bfloat16(x))


@wp.func
def four_in_bfloat16(x: wp.vec4f) -> wp.vec4f:
    return wp.vec4f(in_bfloat16(x[0]), in_bfloat16(x[1]), in_bfloat16(x[2]), in_bfloat16(x[3]))


@wp.kernel
def round_rows(rows: wp.array2d(dtype=wp.float64), first: int, matrix: wp.array2d(dtype=Any)):
    """Rows of a matrix in bfloat16, from a first one on, as numbers of the matrix's type; one thread per number."""
    i, j = wp.tid()
    matrix[first + i, j] = matrix.dtype(in_bfloat16(wp.float32(rows[i, j])))


@wp.kernel
def shorten(x: wp.array2d(dtype=wp.float32), found: wp.array2d(dtype=wp.bfloat16)):
    """One thread per number, which is rounded already."""
    i, j = wp.tid()
    found[i, j] = wp.bfloat16(x[i, j])


@wp.kernel
def scatter(
    row: wp.array(dtype=wp.int32),
    column: wp.array(dtype=wp.int32),
    value: wp.array(dtype=wp.float64),
    matrix: wp.array2d(dtype=wp.float64),
):
    """The entries of a sparse matrix in a dense one; one thread per entry that is stored."""
    i = wp.tid()
    matrix[row[i], column[i]] = value[i]
