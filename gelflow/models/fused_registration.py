"""Equations of `evidence`, `registration` and `propagation` as kernels for CUDA devices, see `gelflow.ops.kernels`.

Each stands for the operations of the function that it is named after, or for those between two of its windows' sums,
where shading is ignored.
"""

import warp as wp
from torch import Tensor

from gelflow.arrays import Flow, Images
from gelflow.ops.kernels import Field, bilinear, is_inside, launch

TINY = wp.constant(1e-6)


def counted(flow: Flow, first: Images, moved: Images, both: bool) -> Tensor:
    """Residual, with `both` also the mean of the images, and 1, each zero where the flow leaves: (B, C + 1, H, W)."""
    batch, colours, height, width = first.shape
    out = first.new_empty(batch, (1 + both) * colours + 1, height, width)
    return launch(_counted, out, flow, first, moved)


@wp.kernel
def _counted(flow: Field, first: Field, moved: Field, out: Field):
    b, y, x = wp.tid()
    counts, colours, last = is_inside(flow, b, y, x), first.shape[1], out.shape[1] - 1
    for c in range(colours):
        out[b, c, y, x] = counts * (moved[b, c, y, x] - first[b, c, y, x])
        if last > colours:
            out[b, colours + c, y, x] = counts * (moved[b, c, y, x] + first[b, c, y, x]) / 2.0
    out[b, last, y, x] = counts


@wp.func
def _local_mean(sums: Field, b: int, c: int, y: int, x: int):
    """The mean that windows at every second pixel hold of channel c, at a pixel; their weight is the last channel."""
    column, row = wp.max(float(x) / 2.0 - 0.25, 0.0), wp.max(float(y) / 2.0 - 0.25, 0.0)
    left, top, last = int(column), int(row), sums.shape[1] - 1
    mean = wp.float32(0.0)
    for i in range(2):
        for j in range(2):
            m, n = wp.min(top + i, sums.shape[2] - 1), wp.min(left + j, sums.shape[3] - 1)
            down, across = row - float(top), column - float(left)
            share = wp.where(i == 1, down, 1.0 - down) * wp.where(j == 1, across, 1.0 - across)
            mean += share * sums[b, c, m, n] / wp.max(sums[b, last, m, n], TINY)
    return mean


def moments(first: Images, moved: Images, weighted: Tensor, sums: Tensor) -> Tensor:
    """`evidence.moments` of `counted` values and their windows' sums, (B, 7, H, W)."""
    batch, _, height, width = first.shape
    return launch(_moments, first.new_empty(batch, 7, height, width), first, moved, weighted, sums)


@wp.kernel
def _moments(first: Field, moved: Field, weighted: Field, sums: Field, out: Field):
    b, y, x = wp.tid()
    above, below = wp.max(y - 1, 0), wp.min(y + 1, first.shape[2] - 1)
    before, after = wp.max(x - 1, 0), wp.min(x + 1, first.shape[3] - 1)
    colours = first.shape[1]
    products = wp.vector(length=6, dtype=wp.float32)
    for c in range(colours):
        r = moved[b, c, y, x] - first[b, c, y, x] - _local_mean(sums, b, c, y, x)
        right = moved[b, c, y, after] + first[b, c, y, after] - moved[b, c, y, before] - first[b, c, y, before]
        down = moved[b, c, below, x] + first[b, c, below, x] - moved[b, c, above, x] - first[b, c, above, x]
        gx, gy = right / 4.0, down / 4.0
        products += wp.vector(gx * gx, gx * gy, gx * r, gy * gy, gy * r, r * r)
    counts = weighted[b, colours, y, x]
    for i in range(6):
        out[b, i, y, x] = counts * products[i]
    out[b, 6, y, x] = counts * float(colours)


def posterior(sums: Tensor, found: Flow, start: Flow, noise: float, prior_px: float, most_px: float) -> Flow:
    """The flow `found` after the step of `registration._posterior`, which is at most `most_px` long along each axis."""
    return launch(_posterior, found.new_empty(found.shape), sums, found, start, noise**2, prior_px**-2, most_px)


@wp.kernel
def _posterior(sums: Field, found: Field, start: Field, noise: float, prior: float, most: float, out: Field):
    b, y, x = wp.tid()
    weight = (sums[b, 5, y, x] / wp.max(sums[b, 6, y, x], TINY) + noise) * prior
    xx, xy, yy = sums[b, 0, y, x] + weight, sums[b, 1, y, x], sums[b, 3, y, x] + weight
    u = -sums[b, 2, y, x] - weight * (found[b, 0, y, x] - start[b, 0, y, x])
    v = -sums[b, 4, y, x] - weight * (found[b, 1, y, x] - start[b, 1, y, x])
    determinant = xx * yy - xy * xy
    out[b, 0, y, x] = found[b, 0, y, x] + wp.clamp((yy * u - xy * v) / determinant, -most, most)
    out[b, 1, y, x] = found[b, 1, y, x] + wp.clamp((xx * v - xy * u) / determinant, -most, most)


def evidence(first: Images, moved: Images, weighted: Tensor, sums: Tensor) -> Tensor:
    """`evidence.evidence` (B, 8, H, W) of `counted` values of both, and their sums, but for z z^T, its channels 3 to 5.

    `add_squares` fills these.
    """
    batch, _, height, width = first.shape
    return launch(_evidence, first.new_empty(batch, 8, height, width), first, moved, weighted, sums)


@wp.func
def _without_mean(first: Field, moved: Field, sums: Field, b: int, c: int, y: int, x: int):
    """Residual and mean of the images in colour c, less what they are around the pixel."""
    one, other = first[b, c, y, x], moved[b, c, y, x]
    mean = _local_mean(sums, b, first.shape[1] + c, y, x)
    return wp.vec2(other - one - _local_mean(sums, b, c, y, x), (other + one) / 2.0 - mean)


@wp.kernel
def _evidence(first: Field, moved: Field, weighted: Field, sums: Field, out: Field):
    b, y, x = wp.tid()
    above, below = wp.max(y - 1, 0), wp.min(y + 1, first.shape[2] - 1)
    before, after = wp.max(x - 1, 0), wp.min(x + 1, first.shape[3] - 1)
    found = wp.vector(length=5, dtype=wp.float32)
    for c in range(first.shape[1]):
        r = _without_mean(first, moved, sums, b, c, y, x)[0]
        right = _without_mean(first, moved, sums, b, c, y, after) - _without_mean(first, moved, sums, b, c, y, before)
        down = _without_mean(first, moved, sums, b, c, below, x) - _without_mean(first, moved, sums, b, c, above, x)
        nx, ny, gx, gy = right[0] / 4.0, down[0] / 4.0, right[1] / 2.0, down[1] / 2.0
        found += wp.vector(gx * gx - nx * nx, gx * gy - nx * ny, gy * gy - ny * ny, gx * r, gy * r)
    counts = weighted[b, weighted.shape[1] - 1, y, x]
    for i in range(3):
        out[b, i, y, x] = counts * found[i]
    out[b, 6, y, x] = counts * found[3]
    out[b, 7, y, x] = counts * found[4]


def add_squares(out: Tensor, z: Flow, factor: float) -> Tensor:
    """Writes `factor` z z^T into channels 3 to 5 of `out`, which it returns."""
    return launch(_squares, out, z, factor)


@wp.kernel
def _squares(z: Field, factor: float, out: Field):
    b, y, x = wp.tid()
    right, down = z[b, 0, y, x], z[b, 1, y, x]
    out[b, 3, y, x] = factor * right * right
    out[b, 4, y, x] = factor * right * down
    out[b, 5, y, x] = factor * down * down


def solved(sums: Tensor, most: float) -> Tensor:
    """Step (2), variance and trace of `evidence.solved`, (B, 4, h, w), of its windows' sums."""
    batch, _, height, width = sums.shape
    return launch(_solved, sums.new_empty(batch, 4, height, width), sums, most)


@wp.kernel
def _solved(sums: Field, most: float, out: Field):
    b, y, x = wp.tid()
    xx, xy, yy = sums[b, 0, y, x], sums[b, 1, y, x], sums[b, 2, y, x]
    one, two, three = sums[b, 3, y, x] / 2.0, sums[b, 4, y, x] / 2.0, sums[b, 5, y, x] / 2.0
    right, down = sums[b, 6, y, x], sums[b, 7, y, x]
    determinant, trace = xx * yy - xy * xy, xx + yy
    variance = one * (yy * yy + xy * xy) - 2.0 * two * xy * trace + three * (xx * xx + xy * xy)
    variance = variance / (determinant * determinant)
    enough = determinant > 0.0 and trace > 0.0 and variance >= 0.0 and variance < most
    out[b, 0, y, x] = wp.where(enough, (xy * down - yy * right) / determinant, 0.0)
    out[b, 1, y, x] = wp.where(enough, (xy * right - xx * down) / determinant, 0.0)
    out[b, 2, y, x] = wp.where(enough, variance, most)
    out[b, 3, y, x] = trace


def residual_terms(flow: Flow, image1: Images, image2: Images) -> Tensor:
    """Of N B flows of B pairs, N of each: 1, the residual's mean square and itself; zero where the flow leaves.

    (N B, 2 + C, H, W).
    """
    out = flow.new_empty(len(flow), 2 + image1.shape[1], *flow.shape[-2:])
    return launch(_residual_terms, out, flow, image1, image2)


@wp.kernel
def _residual_terms(flow: Field, image1: Field, image2: Field, out: Field):
    b, y, x = wp.tid()
    counts, colours, pair = is_inside(flow, b, y, x), image1.shape[1], b % image1.shape[0]
    square = wp.float32(0.0)
    for c in range(colours):
        there = bilinear(image2, pair, c, float(x) + flow[b, 0, y, x], float(y) + flow[b, 1, y, x])
        r = there - image1[pair, c, y, x]
        square += r * r / float(colours)
        out[b, 2 + c, y, x] = counts * r
    out[b, 0, y, x] = counts
    out[b, 1, y, x] = counts * square


def spread(sums: Tensor, whole: Tensor, share: float) -> Tensor:
    """E of `propagation.windowed_residual`, (N, 1, h, w), of the sums of `residual_terms`."""
    return launch(_spread, sums.new_empty(len(sums), 1, *sums.shape[-2:]), sums, whole, share)


@wp.kernel
def _spread(sums: Field, whole: Field, share: float, out: Field):
    b, y, x = wp.tid()
    weight, colours = sums[b, 0, y, x], sums.shape[1] - 2
    square = wp.float32(0.0)
    for c in range(colours):
        mean = sums[b, 2 + c, y, x] / weight
        square += mean * mean / float(colours)
    enough = weight > share * whole[0, 0, y, x]
    out[b, 0, y, x] = wp.where(enough, sums[b, 1, y, x] / weight - square, wp.inf)
