r"""Does image 2, warped by the recorded flow, meet image 1 within the noise?

Both images are linearised, image 2 is fetched at x + F(x) by bicubic interpolation, then both are smoothed (Gaussian,
σ = 1 px; before, a stretched image 2 would be smoothed more or less than image 1), and the local brightness of image 2
is matched to image 1's (ratio of means over a Gaussian of σ = 3 px): the motion changes the shading, but not the
pattern's reflectance. At textured pixels the remaining difference, divided by image 1's gradient, is a motion that the
flow fails to explain:

.. math::  e = |w(I_2) - I_1| / |∇I_1|   \text{in px}

The image is cut into blocks with a median of e each, and the quarter of them is taken that changes most when nothing
is moved, i.e. where the images themselves show motion; the median of those is the figure. For a right flow it is what
noise leaves, 0.6745 σ_d / |∇I|, with σ_d from the scene's read and shot noise and bit depth, and a remainder of
shading, rendering noise and interpolation. A flow that is wrong by d gives about 0.5 d while d is smaller than the
pattern's details, and for larger d half the width of the pattern's edges, 0.7 px or more. Medians leave aside the
places where shadows and highlights pass.

Where the surface bends within the reach of the matching, the shading changes there, too, and a mean cannot match it.
The flow tells, wrong in its sign, axes or offset or not: a block is bent where its second difference over 3 px,

.. math::  b = \max_{h = 3 e_x, 3 e_y} |F(x + h) - 2 F(x) + F(x - h)|

has a median above 0.1 px. Where most blocks are, in images too small for the contact, the check does not apply.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median

from synth.arrays import BoolArray, FloatArray
from synth.dataset.images import Raster
from synth.flow.field import FlowArray
from synth.scene import Camera, NoPattern, Sensor
from synth.verify.report import Check

NAME = "image 2 warped to image 1"
ALLOWANCE_PX = 0.15
"""Allowance for what is not the sensor's noise: shading, rendering noise and interpolation."""
_NOISE_FACTOR = 1.5
"""The median of 60 values scatters by 15 % of itself: three standard deviations."""
_FEWEST = 60
_BLOCKS = 6
"""Blocks along the image's shorter side."""
_SMOOTHING_PX = 1.0
_SHADING_PX = 3.0
_BENT_PX = 0.1
_MOST_BENT = 0.5
"""The check applies if at most this share of the textured blocks bends so."""
_TEXTURE_IN_NOISE = 6.0
"""A pixel is textured if moving by 1 px changes it by more than so many standard deviations of the difference..."""
_TEXTURE_IN_EDGES = 0.25
"""... and by more than this share of what the pattern's strongest edges change, relative to the brightness around."""

Textured = tuple[FloatArray, FloatArray, NDArray[np.intp], NDArray[np.intp]]


def check_photometry(sensor: Sensor, image1: Raster, image2: Raster, flow: FlowArray, visible: FlowArray) -> Check:
    """Compares the images, (H, W) or (H, W, 3), through the forward flow (H, W, 2) px with its visibility (H, W).

    Of the sensor its pattern, and its camera's response and noise, count.
    """
    if isinstance(sensor.pattern, NoPattern):
        return _not_applicable(ALLOWANCE_PX, "the coating is bare")
    usable = _usable(flow, visible)
    if not usable.any():
        return _not_applicable(ALLOWANCE_PX, "no pixel is seen in both images")
    side = min(usable.shape) // _BLOCKS
    pairs = _channels(image1, image2)
    moved, still = (
        _block_medians([_unexplained(sensor.camera, one, two, motion, usable) for one, two in pairs], side)
        for motion in (flow, np.zeros_like(flow))
    )
    common = sorted(moved.keys() & still.keys(), key=lambda block: -still[block][0])
    if not common:
        return _not_applicable(ALLOWANCE_PX, "no block has enough texture that stands out of the noise")
    bent = len(_bent_blocks(flow, usable, side) & set(common))
    if bent > _MOST_BENT * len(common):
        found = f"in {bent} of {len(common)} textured blocks the motion bends too fast for the image's resolution"
        return _not_applicable(ALLOWANCE_PX, found)
    most = common[: max(1, len(common) // 4)]
    figure, noise, unmoved = (
        float(np.median([column[b][i] for b in most])) for column, i in ((moved, 0), (moved, 1), (still, 0))
    )
    detail = f"{len(most)} of {len(common)} textured blocks; without motion {unmoved:.2g} px"
    tolerance = ALLOWANCE_PX + _NOISE_FACTOR * 0.6745 * noise
    if figure > tolerance and unmoved < 2 * tolerance:
        return _not_applicable(tolerance, f"too little motion to tell ({detail})")
    return Check(NAME, figure, tolerance, "px", detail)


def _not_applicable(tolerance: float, why: str) -> Check:
    return Check(NAME, None, tolerance, "px", f"not applicable: {why}")


def _bent_blocks(flow: FlowArray, usable: BoolArray, side: int) -> set[tuple[int, int]]:
    """Blocks (row, column) in which the shading changes within the reach of the matching."""
    reach = round(_SHADING_PX)
    bends = [np.roll(flow, reach, axis) - 2 * flow + np.roll(flow, -reach, axis) for axis in (0, 1)]
    bend = np.linalg.norm(bends, axis=3).max(axis=0)
    places = np.argwhere(usable)
    blocks, member = np.unique(places // side, axis=0, return_inverse=True)
    bent = median(bend[usable], member, np.arange(len(blocks))) > _BENT_PX
    return {(row, column) for row, column in blocks[bent].tolist()}


def _block_medians(channels: list[Textured], side: int) -> dict[tuple[int, int], tuple[float, float]]:
    """Medians of error and noise in the blocks of `side` px with enough textured values, by (row, column)."""
    error, noise, row, column = (np.concatenate(part) for part in zip(*channels, strict=True))
    blocks, member, count = np.unique(
        np.column_stack([row, column]) // side, axis=0, return_inverse=True, return_counts=True
    )
    kept = np.flatnonzero(count >= _FEWEST)
    medians = (median(part, member, kept).tolist() for part in (error, noise))
    return {(r, c): (e, n) for (r, c), e, n in zip(blocks[kept].tolist(), *medians, strict=True)}


def _unexplained(camera: Camera, one: FloatArray, two: FloatArray, flow: FlowArray, usable: BoolArray) -> Textured:
    """Error and standard deviation of its noise (n,) px at textured pixels, and their rows and columns."""
    row, column = np.mgrid[: one.shape[0], : one.shape[1]]
    at = [(base + np.nan_to_num(flow[..., i])).astype(np.float32) for i, base in enumerate((column, row))]
    linear = [image**camera.gamma for image in (one, two)]
    fetched = cv2.remap(linear[1], at[0], at[1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    smooth, warped = (cv2.GaussianBlur(image, (0, 0), _SMOOTHING_PX) for image in (linear[0], fetched))
    share = cv2.GaussianBlur(usable.astype(np.float64), (0, 0), _SHADING_PX) + 1e-12
    means = [cv2.GaussianBlur(np.where(usable, image, 0), (0, 0), _SHADING_PX) / share for image in (smooth, warped)]
    gain = np.divide(means[0], means[1], out=np.ones_like(means[0]), where=means[1] > 1e-6)
    # A Gaussian of σ = s smooths independent noise by a factor 1 / (2 √π s); both images carry it.
    deviation = np.sqrt(1 + gain**2) * _noise(linear[0], camera) / (2 * np.sqrt(np.pi) * _SMOOTHING_PX)
    slope = np.hypot(*(cv2.Sobel(smooth, cv2.CV_64F, 1 - y, y, scale=1 / 8) for y in (0, 1)))
    relative = slope / np.maximum(means[0], 1e-6)
    loud = usable & (slope > _TEXTURE_IN_NOISE * deviation)
    if loud.any():
        loud &= relative > _TEXTURE_IN_EDGES * np.quantile(relative[loud], 0.95)
    rows, columns = np.nonzero(loud)
    return np.abs(gain * warped - smooth)[loud] / slope[loud], deviation[loud] / slope[loud], rows, columns


def _channels(image1: Raster, image2: Raster) -> list[tuple[FloatArray, FloatArray]]:
    """Each channel of both images, (H, W), full scale 1."""
    planes = [np.atleast_3d(image).astype(np.float64) / np.iinfo(image.dtype).max for image in (image1, image2)]
    return [(planes[0][..., i], planes[1][..., i]) for i in range(planes[0].shape[2])]


def _noise(linear: FloatArray, camera: Camera) -> FloatArray:
    """Standard deviation of the linear signal: read and shot noise, and the rounding of the encoded value."""
    clipped = np.maximum(linear, 1e-4)
    step = camera.gamma * clipped ** (1 - 1 / camera.gamma) / (2**camera.bit_depth - 1)
    return np.sqrt(camera.read_noise**2 + camera.shot_noise**2 * clipped + step**2 / 12)


def _usable(flow: FlowArray, visible: FlowArray) -> BoolArray:
    """Pixels whose neighbourhood in image 1 is seen in image 2, away from the border by the filters' reach."""
    seen = (visible > 0.5) & np.isfinite(flow).all(2)
    seen[[0, -1]] = seen[:, [0, -1]] = False
    return cv2.erode(seen.astype(np.uint8), np.ones((9, 9), np.uint8), borderValue=0) > 0
