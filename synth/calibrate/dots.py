"""Dots of a frame, darker or brighter than the coating: where they are, and the coating's brightness around them."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels
from synth.errors import InputError

_FEWEST = 9
"""Whole dots that a frame must show."""
SMALLEST_PX = 1.0
"""Radius of dots whose edge can be told from the blur, which `synth.calibrate.profile` at first takes for 1 px."""
_CLEAREST = 0.75
"""A dot's middle has at most this share of the linear brightness around it, or is as much brighter."""


@dataclass(frozen=True, eq=False)
class FoundDots:
    """Dots that lie wholly in the image: centres (n, 2) px of contrast to the coating, and radii (n,) px.

    The radii are of disks of the same integrated contrast. `ratio` (H, W, 3) is the linear brightness over that of the
    coating around; `covered` (H, W) whether a pixel may hold some of a dot, at the image's border as well.
    """

    centres: Pixels
    radii: FloatArray
    ratio: FloatArray
    covered: BoolArray


def find_dots(linear: FloatArray, pitch_px: float) -> FoundDots:
    """Find dots, about `pitch_px` apart in a linear frame (H, W, 3), and measure them against the coating around.

    InputError for fewer than nine whole dots, or dots of about a pixel.
    """
    middle, extreme = _middles(linear.mean(axis=2), pitch_px)
    _, labels, table, _ = cv2.connectedComponentsWithStats(middle)
    area = table[1:, cv2.CC_STAT_AREA].astype(np.float64)
    marks = area[area > (0.1 * pitch_px) ** 2]
    if not len(marks):
        raise _too_few(0, pitch_px)
    typical = float(np.median(area[area > 0.3 * np.median(marks)]))
    radius = float(np.sqrt(typical / np.pi))
    check_size(radius)
    margin = max(2, round(0.45 * radius))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    covered = cv2.dilate((np.isin(labels, 1 + np.flatnonzero(area > 0.05 * typical))).astype(np.uint8), kernel) > 0
    around = np.maximum(_around(linear, covered, 0.35 * pitch_px), 1e-6)
    relative = linear.sum(axis=2) / around.sum(axis=2)  # weighs channels by their light
    contrast = (1 - relative) / (1.0 if extreme < 1 else 1 - extreme)
    whole = [k for k in np.flatnonzero((area > 0.5 * typical) & (area < 2 * typical)) if _inside(table[k + 1], labels)]
    found = [_measure(contrast, labels == k + 1, radius) for k in whole]
    found = [dot for dot in found if np.isfinite([*dot[0], dot[1]]).all()]
    if len(found) < _FEWEST:
        raise _too_few(len(found), pitch_px)
    centres, radii = (np.array(part) for part in zip(*found, strict=True))
    return FoundDots(centres, radii, linear / around, covered)


def _middles(grey: FloatArray, pitch_px: float) -> tuple[NDArray[np.uint8], float]:
    """The pixels (H, W) nearer to the marks' brightness than to the coating's, and the marks' over the coating's.

    InputError where nothing stands out.
    """
    window = 2 * int(pitch_px / 2) + 1
    coarse = cv2.medianBlur(np.round(255 * np.sqrt(np.clip(grey, 0, 1))).astype(np.uint8), window)
    ratio = grey / np.maximum((coarse / 255.0) ** 2, 1e-4)
    dark, bright = np.percentile(ratio, [1, 99])
    extreme = float(dark if dark * bright < 1 else np.median(ratio[ratio > np.sqrt(bright)]))
    if _CLEAREST < extreme < 1 / _CLEAREST:
        raise _too_few(0, pitch_px)
    return ((1 - ratio) / (1 - extreme) > 0.5).astype(np.uint8), extreme


def check_size(radius_px: float) -> None:
    """Refuses dots that are too small to be measured."""
    if not radius_px > SMALLEST_PX:
        raise InputError(
            f"the dots found in the frame have a radius of {radius_px:.2g} px, needed is more than {SMALLEST_PX:g} px; "
            "give larger frames"
        )


def _around(linear: FloatArray, covered: BoolArray, sigma: float) -> FloatArray:
    """The coating's brightness, continued beneath the dots: a Gaussian-weighted plane fitted to bare pixels."""
    rows, columns = np.mgrid[: covered.shape[0], : covered.shape[1]].astype(np.float64)
    bare = (~covered).astype(np.float64)

    def smooth(field: FloatArray) -> FloatArray:
        return np.asarray(cv2.GaussianBlur(field * bare, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT))

    weight = np.maximum(smooth(np.ones_like(bare)), 1e-9)
    x, y = smooth(columns) / weight - columns, smooth(rows) / weight - rows
    xx = smooth(columns**2) / weight - (x + columns) ** 2 + 1e-6
    yy = smooth(rows**2) / weight - (y + rows) ** 2 + 1e-6
    xy = smooth(columns * rows) / weight - (x + columns) * (y + rows)
    determinant = xx * yy - xy * xy
    planes = []
    for channel in np.moveaxis(linear, 2, 0):
        mean = smooth(channel) / weight
        xv = smooth(channel * columns) / weight - (x + columns) * mean
        yv = smooth(channel * rows) / weight - (y + rows) * mean
        slope_x, slope_y = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
        planes.append(mean - x * slope_x - y * slope_y)
    return np.stack(planes, axis=2)


def _inside(box: FloatArray, labels: FloatArray) -> bool:
    left, top, width, height = box[:4]
    return bool(left > 1 and top > 1 and left + width < labels.shape[1] - 1 and top + height < labels.shape[0] - 1)


def _measure(contrast: FloatArray, member: BoolArray, radius: float) -> tuple[FloatArray, float]:
    """Centroid (2,) px of a dot's contrast, and the radius of the disk of its integrated contrast."""
    rows, columns = np.nonzero(member)
    centre = np.array([columns.mean() + 0.5, rows.mean() + 0.5])
    reach = 1.5 * radius + 1.5
    top, left = (int(max(0, np.floor(c - reach))) for c in centre[::-1])
    patch = contrast[top : int(centre[1] + reach) + 1, left : int(centre[0] + reach) + 1]
    y, x = np.mgrid[: patch.shape[0], : patch.shape[1]] + 0.5
    x, y = x + left, y + top
    depth = float(np.median(contrast[member & (contrast > np.median(contrast[member]))]))
    for _ in range(3):
        share = np.where(np.hypot(x - centre[0], y - centre[1]) < reach, np.clip(patch, -0.1, max(depth, 1)), 0)
        weight = np.where(share > 0.08 * depth, share, 0)  # what is fainter is noise of the coating
        centre = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
    return centre, float(np.sqrt(max(share.sum(), 0.0) / depth / np.pi))


def _too_few(count: int, pitch_px: float) -> InputError:
    return InputError(
        f"{count} whole dots were found in the frame, at least {_FEWEST} are needed; dots were expected about "
        f"{pitch_px:.0f} px apart: check sensor.pattern.spacing_mm of the preset (--set), or take a preset without dots"
    )
