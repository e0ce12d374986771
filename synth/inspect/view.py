"""What can be seen of one sample or flow file, and the fields derived from it for looking at.

Closure by interpolation at pixel x of image 1, zero for exact continuous fields where x is visible:

.. math::  e(x) = |forward(x) + backward(x + forward(x))|

`backward` is interpolated between pixel centres, so e includes the interpolation's error (third order, large where the
flow has kinks); `verify` traces rays and has none. Warped difference: I2(x + forward(x)) - I1(x), as a share of full
scale; noise and shading that changes with the surface's tilt remain in it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray
from synth.dataset.exr import flow_of, read_channels
from synth.dataset.images import Raster
from synth.dataset.sample import Layout
from synth.dataset.sample_reader import META_FILE, ClipData, read_clip, read_meta, read_pair
from synth.flow.field import FlowField


@dataclass(frozen=True)
class View:
    """One sample, or one flow file (then there are no images and `meta` is its header, else meta.json).

    `visible_known` is False for a flow file that does not tell (an estimate); the name is for titles. A clip is seen as
    the pair of its first and its last frame.
    """

    name: str
    flow: FlowField
    visible_known: bool = True
    image1: Raster | None = None
    image2: Raster | None = None
    meta: Mapping[str, Any] = field(default_factory=dict)
    clip: ClipData | None = None

    @property
    def size(self) -> tuple[int, int]:
        height, width = self.flow.forward.shape[:2]
        return height, width

    @cached_property
    def gel(self) -> BoolArray:
        """(H, W): the pixel sees gel."""
        return np.asarray(np.isfinite(self.flow.forward).all(axis=-1))

    @cached_property
    def visible(self) -> BoolArray:
        """(H, W): and its point is seen in image 2."""
        return self.gel & (self.flow.forward_visible > 0.5)

    @cached_property
    def target(self) -> tuple[FloatArray, FloatArray]:
        """X + forward(x): two (H, W) float64 px; NaN where the pixel sees no gel."""
        height, width = self.size
        rows, columns = np.mgrid[:height, :width]
        forward = self.flow.forward.astype(np.float64)
        return columns + 0.5 + forward[..., 0], rows + 0.5 + forward[..., 1]

    @property
    def sigma(self) -> FloatArray | None:
        """(H, W) px, what an estimate says of its error."""
        sigma = self.flow.extras.get("forward.sigma")
        return None if sigma is None else sigma.astype(np.float64)

    @cached_property
    def closure(self) -> FloatArray | None:
        """(H, W) px, NaN where the pixel is not visible or interpolation meets an edge; None without backward flow."""
        if self.flow.backward is None:
            return None
        back = sample_at(self.flow.backward, *self.target)
        error = np.linalg.norm(self.flow.forward + back, axis=-1)
        return np.where(self.visible, error, np.nan)

    @cached_property
    def differences(self) -> tuple[FloatArray, FloatArray] | None:
        """I2(x) - I1(x) and I2(x + forward(x)) - I1(x): (H, W, C), shares of full scale, NaN where not visible."""
        if self.image1 is None or self.image2 is None:
            return None
        first, second = (_linear(image) for image in (self.image1, self.image2))
        visible = self.visible[..., None]
        warped = sample_at(second, *self.target)
        known = visible & np.isfinite(warped)
        return np.where(known, second - first, np.nan), np.where(known, warped - first, np.nan)


def view_sample(folder: Path) -> View:
    """The view of a sample's or a further camera's folder; InputError where files are missing or damaged."""
    is_further = not (folder / META_FILE).exists() and (folder.parent / META_FILE).exists()
    home, camera = (folder.parent, folder.name) if is_further else (folder, "")
    name, meta = f"{home.name}/{camera}" if camera else home.name, read_meta(home)
    if (layout := Layout.of(meta["scene"])).is_of_clips:
        clip = read_clip(home, camera)
        last = clip.pair(0, len(clip) - 1)
        return View(name, last.flow, True, last.image1, last.image2, last.meta, clip)
    pair = read_pair(folder, layout)
    return View(name, pair.flow, image1=pair.image1, image2=pair.image2, meta=meta)


def view_flow(path: Path) -> View:
    """The view of a flow file, with or without visibility; InputError where it is missing or damaged or has no flow."""
    channels, header = read_channels(path)
    known = "forward.visible" in channels
    for direction in ("forward", "backward"):
        parts = [channels.get(f"{direction}.{part}") for part in ("U", "V")]
        if f"{direction}.visible" not in channels and parts[0] is not None and parts[1] is not None:
            channels[f"{direction}.visible"] = np.isfinite(parts[0] + parts[1]).astype(np.float32)
    kinds = {"index": int, "trajectory": int, "frames": str}
    numbers = {key: header[key] for key, kind in kinds.items() if isinstance(header.get(key), kind)}
    return View(path.name, flow_of(path, channels), known, meta=numbers)


def _linear(image: Raster) -> FloatArray:
    """(H, W, C) in [0, 1]."""
    values = image.astype(np.float64) / np.iinfo(image.dtype).max
    return values[..., None] if values.ndim == 2 else values


def sample_at(values: NDArray[np.floating], x: FloatArray, y: FloatArray) -> FloatArray:
    """Values (..., C) at image positions x, y (...) px, by cubic convolution of pixels (H, W, C).

    It is local (4 x 4 pixels), so that a NaN or a border spoils only what touches it: NaN where the position is NaN, a
    pixel with weight is NaN, or such a pixel is outside. OpenCV's `remap` would round positions to 1/32 px.

    Reference: R. Keys, IEEE TASSP 29, 1981 (a = -1/2).
    """
    height, width = values.shape[:2]
    column, row = x - 0.5, y - 0.5
    left, top = np.floor(column), np.floor(row)
    # A position on a pixel centre needs only that pixel in its direction, so it may lie at the image's border.
    inside = _fits(column, left, width) & _fits(row, top, height)
    left, top = (np.where(inside, corner, 0).astype(np.intp) for corner in (left, top))
    across = _weights(np.where(inside, column - left, 0.0))
    down = _weights(np.where(inside, row - top, 0.0))
    total = np.zeros((*x.shape, values.shape[2]))
    for j in range(4):
        r = np.clip(top + j - 1, 0, height - 1)
        for i in range(4):
            weight = (down[j] * across[i])[..., None]
            tap = values[r, np.clip(left + i - 1, 0, width - 1)]
            total += np.where(weight == 0, 0.0, weight * tap)
    return np.where(inside[..., None], total, np.nan)


def _fits(place: FloatArray, first: FloatArray, count: int) -> NDArray[np.bool_]:
    """The pixels that have a weight are inside the image; False for NaN."""
    on_centre = (place == first) & (place >= 0) & (place <= count - 1)
    return on_centre | ((first >= 1) & (first + 2 <= count - 1))


def _weights(t: FloatArray) -> list[FloatArray]:
    """Weights of the pixels at -1, 0, 1, 2 for a position at t in [0, 1)."""
    return [
        ((-0.5 * t + 1.0) * t - 0.5) * t,
        (1.5 * t - 2.5) * t * t + 1.0,
        ((-1.5 * t + 2.0) * t + 0.5) * t,
        (0.5 * t - 0.5) * t * t,
    ]
