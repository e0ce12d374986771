"""The pictures of a view, pixel for pixel, with their captions; sheet and page only lay them out."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from synth.arrays import FloatArray
from synth.dataset.images import Raster
from synth.inspection.arrows import Arrows, arrows_of
from synth.inspection.text import percent, short
from synth.inspection.view import View
from synth.inspection.wheel import NO_GEL, Rgb, flow_colours, robust_scale

Scale = Literal["wheel", "closure"]

CLOSURE_RANGE_PX = (1e-5, 1.0)
"""Of the logarithmic scale, the same everywhere, so that pictures can be compared."""
CLOSURE_MAP = "viridis"
_DIFFERENCE_MAP = "RdBu_r"
_VISIBLE, _HIDDEN = (245, 245, 245), (200, 60, 50)


@dataclass(frozen=True)
class Panel:
    """One picture.

    Attributes:
        name: the same for the same picture of every view.
        caption: what is seen, with its numbers.
        picture: (H, W, 3) uint8.
        scale: what explains its colours, if anything does.
        arrows: drawn over it.
    """

    name: str
    caption: str
    picture: Rgb
    scale: Scale | None = None
    arrows: Arrows | None = None


def panels_of(view: View, numbers: Mapping[str, Any]) -> list[Panel]:
    """All pictures that there is something to show in.

    Args:
        view: what is shown.
        numbers: `numbers_of(view)`, for the captions.
    """
    panels = []
    if view.image1 is not None and view.image2 is not None:
        for name, image in (("image 1", view.image1), ("image 2", view.image2)):
            panels.append(Panel(name, name, image_picture(image)))
    panels.append(_arrows(view))
    for name, flow in (("forward", view.flow.forward), ("backward", view.flow.backward)):
        if flow is not None:
            scale = robust_scale(flow)
            colours = flow_colours(flow, scale)
            panels.append(Panel(name, f"{name} flow; the wheel's rim is {scale:.3g} px", colours, "wheel"))
    share = numbers["forward"]["visible_share"]
    seen = percent(share) if view.visible_known else "not given"
    panels.append(Panel("visible", f"visible in image 2: {seen} (red: hidden or outside)", _visibility(view)))
    if view.closure is not None:
        closure = numbers["closure"]
        caption = f"closure: median {short(closure['median_px'])}, max {short(closure['max_px'])} px"
        panels.append(Panel("closure", caption, _closure(view.closure), "closure"))
    if view.differences is not None:
        limit = _limit(view.differences[0])
        for name, title, key, values in zip(
            ("before", "after"),
            ("image 2 − image 1", "warped image 2 − image 1"),
            ("before_rmse", "after_rmse"),
            view.differences,
            strict=True,
        ):
            caption = f"{title} (±{100 * limit:.2g} %): RMS {percent(numbers['difference'][key])}"
            panels.append(Panel(name, caption, _difference(values, limit)))
    return panels


def image_picture(image: Raster) -> Rgb:
    """8-bit RGB of an image."""
    small = image.astype(np.uint8) if image.dtype == np.uint8 else (image >> 8).astype(np.uint8)
    return np.ascontiguousarray(small if small.ndim == 3 else np.repeat(small[..., None], 3, axis=-1))


def _limit(before: FloatArray) -> float:
    """99th percentile of the unwarped difference: one colour scale for before and after."""
    found = np.abs(before[np.isfinite(before)])
    return (float(np.percentile(found, 99)) if found.size else 0.0) or 1.0


def _arrows(view: View) -> Panel:
    """Image 1, paled, under arrows."""
    background = np.full((*view.size, 3), 235, np.uint8) if view.image1 is None else image_picture(view.image1)
    paled = (0.55 * background + 0.45 * 255).astype(np.uint8)
    arrows = arrows_of(view)
    return Panel("arrows", f"forward flow, arrows {arrows.magnification:g} times as long", paled, arrows=arrows)


def _visibility(view: View) -> Rgb:
    picture = np.where(view.visible[..., None], np.array(_VISIBLE, np.uint8), np.array(_HIDDEN, np.uint8))
    return np.where(view.gel[..., None], picture, np.array(NO_GEL, np.uint8))


def _closure(error: FloatArray) -> Rgb:
    """Logarithmic over `CLOSURE_RANGE_PX`."""
    low, high = np.log10(CLOSURE_RANGE_PX)
    shown = np.log10(np.clip(error, *CLOSURE_RANGE_PX))
    return _mapped(CLOSURE_MAP, (shown - low) / (high - low))


def _difference(difference: FloatArray, limit: float) -> Rgb:
    """The mean over the channels: blue below 0, red above, to +-limit."""
    return _mapped(_DIFFERENCE_MAP, 0.5 + 0.5 * difference.mean(axis=-1) / limit)


def _mapped(name: str, share: FloatArray) -> Rgb:
    """Colours of shares of [0, 1], clipped; grey for NaN."""
    import matplotlib

    known = np.isfinite(share)
    colours = matplotlib.colormaps[name](np.clip(np.where(known, share, 0.0), 0, 1), bytes=True)[..., :3]
    return np.where(known[..., None], colours, np.array(NO_GEL, np.uint8))
