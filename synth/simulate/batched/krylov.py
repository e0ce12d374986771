"""Flexible GMRES without restart for many systems at once, each at its own iteration, as Warp kernels.

Saad, SIAM J. Sci. Comput. 14, 1993; classical Gram-Schmidt and Givens rotations, in single precision: what is solved
to TOLERANCE is a correction, and Newton's residual is in double precision. A slot's solve begins when its matrix
is ready, goes on through as many cycles as it takes, and ends when the next cycle finds it DONE; no slot waits for
another. Vectors are (rows, B).
"""

# Kernels are written in Warp's own language; their annotations only look like Python's.
# mypy: disable-error-code="valid-type, no-untyped-def"

import warp as wp

from synth.simulate.batched.slots import CARRY, CARRY_READY, LINEAR, LOST, READY, SEARCH, START, Slots
from synth.simulate.linear import GMRES_LIMIT

wp.set_module_options({"enable_backward": False, "fast_math": False})

WAITING, RUNNING, DONE = wp.constant(0), wp.constant(1), wp.constant(2)
LIMIT = wp.constant(GMRES_LIMIT)
ROWS = wp.constant(32)
"""Rows of a vector that one thread sums."""
NONE = wp.constant(wp.float32(0.0))
UNIT = wp.constant(wp.float32(1.0))


@wp.struct
class Krylov:
    """One system a slot.

    Attributes:
        running: (B,) WAITING, RUNNING or DONE.
        k: (B,) iterations done.
        size: (B,) norm of the right side.
        basis: (LIMIT + 1, rows, B); corrections: (LIMIT, rows, B), the preconditioned basis.
        current: (rows, B) the basis' last vectors; corrected: preconditioned; image: times the tangent.
        hessenberg: (LIMIT + 1, B) the present column; triangle: (LIMIT, LIMIT, B) rotated.
        cosine, sine: (LIMIT, B); residual: (LIMIT + 1, B) of the rotated right side.
        weight: (LIMIT, B) of the corrections in the solution.
        partial: (chunks, LIMIT + 1, B) sums over ROWS rows.
        step: (rows, B) the solution.
    """

    running: wp.array(dtype=wp.int32)
    k: wp.array(dtype=wp.int32)
    size: wp.array(dtype=wp.float64)
    basis: wp.array3d(dtype=wp.float32)
    corrections: wp.array3d(dtype=wp.float32)
    current: wp.array2d(dtype=wp.float32)
    corrected: wp.array2d(dtype=wp.float32)
    image: wp.array2d(dtype=wp.float32)
    hessenberg: wp.array2d(dtype=wp.float32)
    triangle: wp.array3d(dtype=wp.float32)
    cosine: wp.array2d(dtype=wp.float32)
    sine: wp.array2d(dtype=wp.float32)
    residual: wp.array2d(dtype=wp.float32)
    weight: wp.array2d(dtype=wp.float32)
    partial: wp.array3d(dtype=wp.float32)
    step: wp.array2d(dtype=wp.float32)


@wp.kernel
def begin_vectors(
    slots: Slots,
    free: wp.array(dtype=wp.int32),
    force: wp.array2d(dtype=wp.vec3d),
    volume: wp.array2d(dtype=wp.float64),
    krylov: Krylov,
):
    """One thread per (row, slot): the first basis vector, minus the residual over its norm.

    free: (rows,) number of the unknown, displacements of all nodes first, or -1 for rows that fill up.
    """
    i, s = wp.tid()
    if slots.phase[s] != READY and slots.phase[s] != CARRY_READY:
        return
    value = wp.float64(0.0)
    size = slots.norm[s]
    unknown = free[i]
    if unknown >= 0 and size > wp.float64(0.0):
        moves = 3 * force.shape[1]
        if unknown < moves:  # noqa: SIM108 (Warp evaluates both sides of a conditional expression)
            value = -force[s, unknown // 3][unknown % 3] / size
        else:
            value = -volume[s, unknown - moves] / size
    krylov.basis[0, i, s] = wp.float32(value)
    krylov.current[i, s] = wp.float32(value)


@wp.kernel
def begin(slots: Slots, krylov: Krylov):
    """One thread per slot."""
    s = wp.tid()
    phase = slots.phase[s]
    if phase == READY:
        slots.phase[s] = LINEAR
    elif phase == CARRY_READY:
        slots.phase[s] = CARRY
    else:
        return
    krylov.k[s] = 0
    krylov.size[s] = slots.norm[s]
    krylov.residual[0, s] = UNIT
    krylov.running[s] = RUNNING
    if slots.norm[s] == wp.float64(0.0):
        krylov.running[s] = DONE


@wp.kernel
def keep_corrected(krylov: Krylov):
    """One thread per (row, slot): put the preconditioned vector by, and clear its image."""
    i, s = wp.tid()
    if krylov.running[s] == RUNNING:
        krylov.corrections[krylov.k[s], i, s] = krylov.corrected[i, s]
        krylov.image[i, s] = NONE


@wp.kernel
def partial_products(krylov: Krylov):
    """One thread per (chunk, slot): of the image with every basis vector."""
    c, s = wp.tid()
    if krylov.running[s] != RUNNING:
        return
    last = wp.min((c + 1) * ROWS, krylov.image.shape[0])
    for j in range(krylov.k[s] + 1):
        total = wp.float32(0.0)
        for i in range(c * ROWS, last):
            total += krylov.basis[j, i, s] * krylov.image[i, s]
        krylov.partial[c, j, s] = total


@wp.kernel
def products(krylov: Krylov):
    """One thread per (basis vector, slot)."""
    j, s = wp.tid()
    if krylov.running[s] != RUNNING or j > krylov.k[s]:
        return
    total = wp.float32(0.0)
    for c in range(krylov.partial.shape[0]):
        total += krylov.partial[c, j, s]
    krylov.hessenberg[j, s] = total


@wp.kernel
def orthogonalise(krylov: Krylov):
    """One thread per (chunk, slot): the image without its parts along the basis, and the squares of what is left."""
    c, s = wp.tid()
    if krylov.running[s] != RUNNING:
        return
    count = krylov.k[s] + 1
    total = wp.float32(0.0)
    for i in range(c * ROWS, wp.min((c + 1) * ROWS, krylov.image.shape[0])):
        value = krylov.image[i, s]
        for j in range(count):
            value -= krylov.hessenberg[j, s] * krylov.basis[j, i, s]
        krylov.image[i, s] = value
        total += value * value
    krylov.partial[c, 0, s] = total


@wp.kernel
def rotate(krylov: Krylov, tolerance: wp.float32):
    """One thread per slot: the Givens rotation of the new column; the solve ends where the residual is small."""
    s = wp.tid()
    if krylov.running[s] != RUNNING:
        return
    square = wp.float32(0.0)
    for chunk in range(krylov.partial.shape[0]):
        square += krylov.partial[chunk, 0, s]
    k = krylov.k[s]
    below = wp.sqrt(square)
    above = krylov.hessenberg[0, s]
    for j in range(k):
        following = krylov.hessenberg[j + 1, s]
        krylov.triangle[j, k, s] = krylov.cosine[j, s] * above + krylov.sine[j, s] * following
        above = krylov.cosine[j, s] * following - krylov.sine[j, s] * above
    length = wp.sqrt(above * above + below * below)
    cosine = wp.float32(1.0)
    sine = wp.float32(0.0)
    if length > NONE:
        cosine = above / length
        sine = below / length
    krylov.cosine[k, s] = cosine
    krylov.sine[k, s] = sine
    krylov.triangle[k, k, s] = length
    left = krylov.residual[k, s]
    krylov.residual[k, s] = cosine * left
    left = -sine * left
    krylov.residual[k + 1, s] = left
    krylov.hessenberg[k + 1, s] = below
    krylov.k[s] = k + 1
    if wp.abs(left) < tolerance or below == NONE or k + 1 == LIMIT or not wp.isfinite(length):
        krylov.running[s] = DONE


@wp.kernel
def extend(krylov: Krylov):
    """One thread per (row, slot): the next basis vector."""
    i, s = wp.tid()
    if krylov.running[s] != RUNNING:
        return
    k = krylov.k[s]
    value = krylov.image[i, s] / krylov.hessenberg[k, s]
    krylov.basis[k, i, s] = value
    krylov.current[i, s] = value


@wp.kernel
def finish(slots: Slots, krylov: Krylov, begun: wp.array(dtype=wp.int32)):
    """One thread per slot: the weights of the solution where a solve is done, and the slot's next phase.

    begun: (B,) 1 where the solution is that of a carried first iterate.
    """
    s = wp.tid()
    begun[s] = 0
    if krylov.running[s] != DONE:
        return
    k = krylov.k[s]
    finite = wp.int32(1)
    for back in range(k):
        j = k - 1 - back
        total = krylov.residual[j, s]
        for i in range(j + 1, k):
            total -= krylov.triangle[j, i, s] * krylov.weight[i, s]
        pivot = krylov.triangle[j, j, s]
        value = NONE
        if pivot != NONE:
            value = total / pivot
        krylov.weight[j, s] = value
        if not wp.isfinite(value):
            finite = wp.int32(0)
    if slots.phase[s] == CARRY:
        slots.phase[s] = START
        if finite == 1:
            slots.predicted[s] = 1
            begun[s] = 1
    elif finite == 1:
        slots.phase[s] = SEARCH
        slots.scale[s] = wp.float64(1.0)
    else:
        slots.phase[s] = LOST


@wp.kernel
def combine(krylov: Krylov):
    """One thread per (row, slot): the solution where a solve is done."""
    i, s = wp.tid()
    if krylov.running[s] != DONE:
        return
    total = wp.float32(0.0)
    for j in range(krylov.k[s]):
        total += krylov.weight[j, s] * krylov.corrections[j, i, s]
    krylov.step[i, s] = wp.float32(krylov.size[s]) * total


@wp.kernel
def rest(krylov: Krylov):
    """One thread per slot: a solution that was taken leaves the slot waiting."""
    s = wp.tid()
    if krylov.running[s] == DONE:
        krylov.running[s] = WAITING
