r"""The pictures of a view, pixel for pixel, with their captions; sheet and page only lay them out.

Flow as colour: the direction is the hue, the length the saturation (white: no motion).

The wheel of Baker et al., "A Database and Evaluation Methodology for Optical Flow", IJCV 2011: six sectors between red,
yellow, green, cyan, blue and magenta whose widths (15, 6, 4, 11, 13, 6 of 55) match what the eye tells apart; right is
red, down is yellow. With hue :math:`h(θ)`, :math:`θ = atan2(V, U)`, and :math:`r = |flow| / scale`:

.. math::  c = 1 - r (1 - h(θ)) \quad (r ≤ 1), \qquad c = 0.75\, h(θ) \quad (r > 1)

so what is longer than the scale is dark, not lost. NaN is grey.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray, Pixels
from synth.dataset.images import Raster
from synth.flow.field import FlowArray
from synth.inspect.text import percent, short
from synth.inspect.view import View

Rgb: TypeAlias = NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""
CLOSURE_RANGE_PX, SIGMA_RANGE_PX = (1e-5, 1.0), (0.01, 10.0)
"""Ends of the logarithmic colour scales, the same everywhere, so that pictures can be compared."""
_VISIBLE, _HIDDEN = (245, 245, 245), (200, 60, 50)


@dataclass(frozen=True)
class Arrows:
    """A thinned flow to draw over an image: from start to start + magnification * flow, both (n, 2) px."""

    start: Pixels
    tip: Pixels
    magnification: float


@dataclass(frozen=True)
class Panel:
    """One picture, (H, W, 3) uint8: its caption with numbers, arrows, and whether the wheel explains its colours.

    Where there is a `film`, it gives the frames of a moving picture, and `rate` says how many are shown in a second.
    """

    caption: str
    picture: Rgb
    has_wheel: bool = False
    arrows: Arrows | None = None
    film: Callable[[], list[Rgb]] | None = None
    rate: float = 1.0


def panels_of(view: View, numbers: Mapping[str, Any]) -> list[Panel]:
    """All pictures that there is something to show in; `numbers` is `numbers_of(view)`, for the captions."""
    panels = []
    if view.image1 is not None and view.image2 is not None:
        panels += [Panel("image 1", image_picture(view.image1)), Panel("image 2", image_picture(view.image2))]
    background = np.full((*view.size, 3), 235, np.uint8) if view.image1 is None else image_picture(view.image1)
    arrows, paled = arrows_of(view), (0.55 * background + 0.45 * 255).astype(np.uint8)
    panels.append(Panel(f"forward flow, arrows {arrows.magnification:g} times as long", paled, arrows=arrows))
    for name, flow in (("forward", view.flow.forward), ("backward", view.flow.backward)):
        if flow is not None:
            scale = robust_scale(flow)
            caption = f"{name} flow; the wheel's rim is {scale:.3g} px"
            panels.append(Panel(caption, flow_colours(flow, scale), has_wheel=True))
    share = numbers["forward"]["visible_share"]
    seen = percent(share) if view.visible_known else "not given"
    panels.append(Panel(f"visible in image 2: {seen} (red: hidden or outside)", _visibility(view)))
    for name, values, limits in (("closure", view.closure, CLOSURE_RANGE_PX), ("sigma", view.sigma, SIGMA_RANGE_PX)):
        if values is not None:
            found = f"median {short(numbers[name]['median_px'])}, max {short(numbers[name]['max_px'])} px"
            panels.append(
                Panel(f"{name}, log {limits[0]:g} to {limits[1]:g} px: {found}", _logarithmic(values, limits))
            )
    if view.differences is not None:
        known = np.abs(view.differences[0][np.isfinite(view.differences[0])])
        limit = (float(np.percentile(known, 99)) if known.size else 0.0) or 1.0  # one colour scale for both
        titles = (("image 2 − image 1", "before_rmse"), ("warped image 2 − image 1", "after_rmse"))
        for (title, key), values in zip(titles, view.differences, strict=True):
            caption = f"{title} (±{100 * limit:.2g} %): RMS {percent(numbers['difference'][key])}"
            # The mean over the channels: blue below 0, red above, to +-limit.
            panels.append(Panel(caption, _mapped("RdBu_r", 0.5 + 0.5 * values.mean(axis=-1) / limit)))
    return panels


def arrows_of(view: View) -> Arrows:
    """About 18 arrows in a row; all but the longest 1 % are at most 1.6 times as long as their spacing."""
    height, width = view.size
    spacing = max(1, round(width / 18))
    columns, rows = np.meshgrid(np.arange(spacing // 2, width, spacing), np.arange(spacing // 2, height, spacing))
    flow = view.flow.forward[rows.ravel(), columns.ravel()].astype(np.float64)
    known = np.isfinite(flow).all(axis=-1)
    start = np.column_stack([columns.ravel(), rows.ravel()])[known].astype(np.float64) + 0.5
    wanted = 1.6 * spacing / robust_scale(view.flow.forward)
    unit = 10.0 ** np.floor(np.log10(wanted))
    magnification = float(unit * next(step for step in (7, 5, 3, 2, 1) if step <= wanted / unit * (1 + 1e-9)))
    return Arrows(start, start + magnification * flow[known], magnification)


def image_picture(image: Raster) -> Rgb:
    small = image.astype(np.uint8) if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    return np.ascontiguousarray(small if small.ndim == 3 else np.repeat(small[..., None], 3, axis=-1))


def _visibility(view: View) -> Rgb:
    picture = np.where(view.visible[..., None], np.array(_VISIBLE, np.uint8), np.array(_HIDDEN, np.uint8))
    return np.where(view.gel[..., None], picture, np.array(NO_GEL, np.uint8))


def _logarithmic(values: FloatArray, limits: tuple[float, float]) -> Rgb:
    low, high = np.log10(limits)
    return _mapped("viridis", (np.log10(np.clip(values, *limits)) - low) / (high - low))


def _mapped(name: str, share: FloatArray) -> Rgb:
    """Colours of shares of [0, 1], clipped; grey for NaN."""
    import matplotlib

    known = np.isfinite(share)
    colours = matplotlib.colormaps[name](np.clip(np.where(known, share, 0.0), 0, 1), bytes=True)[..., :3]
    return np.where(known[..., None], colours, np.array(NO_GEL, np.uint8))


NO_GEL = (128, 128, 128)
_KNOTS = np.cumsum([0, 15, 6, 4, 11, 13, 6]) / 55
_HUES = np.array([(1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 1, 1), (0, 0, 1), (1, 0, 1), (1, 0, 0)], np.float64)


def flow_colours(flow: FlowArray | FloatArray, scale: float) -> Rgb:
    """Colours of a flow (H, W, 2) px, NaN where there is none; `scale` is the length at full saturation, px."""
    known = np.asarray(np.isfinite(flow).all(axis=-1))
    u, v = (np.where(known, flow[..., axis], 0.0).astype(np.float64) for axis in (0, 1))
    turn = np.arctan2(v, u) / (2 * np.pi) % 1.0
    hue = np.stack([np.interp(turn, _KNOTS, _HUES[:, channel]) for channel in range(3)], axis=-1)
    radius = (np.hypot(u, v) / scale)[..., None]
    colour = np.where(radius <= 1, 1 - radius * (1 - hue), 0.75 * hue)
    return np.where(known[..., None], np.rint(255 * colour).astype(np.uint8), np.array(NO_GEL, np.uint8))


def wheel_legend(size: int) -> NDArray[np.uint8]:
    """The wheel itself, (size, size, 4) RGBA, transparent outside; its rim is the scale."""
    centre = (size - 1) / 2
    axis = (np.arange(size) - centre) / (size / 2)
    u, v = np.meshgrid(axis, axis)
    inside = np.hypot(u, v) <= 1
    colour = flow_colours(np.stack([u, v], axis=-1), 1.0)
    return np.dstack([colour, np.where(inside, 255, 0).astype(np.uint8)])


def robust_scale(flow: FlowArray) -> float:
    """The 99th percentile of the length, px, rounded up to two digits, at least 1e-6: no outlier pales a small flow."""
    length = np.hypot(flow[..., 0].astype(np.float64), flow[..., 1].astype(np.float64))
    finite = length[np.isfinite(length)]
    high = float(np.percentile(finite, 99)) if finite.size else 0.0
    if high <= 1e-6:
        return 1e-6
    unit = 10.0 ** (np.floor(np.log10(high)) - 1)
    return float(f"{np.ceil(round(high / unit, 6)) * unit:.3g}")
