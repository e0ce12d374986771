r"""Flow as colour: the direction is the hue, the length the saturation (white: no motion).

The wheel of Baker et al., "A Database and Evaluation Methodology for Optical Flow", IJCV 2011: six sectors between red,
yellow, green, cyan, blue and magenta whose widths (15, 6, 4, 11, 13, 6 of 55) match what the eye tells apart; right is
red, down is yellow. With hue :math:`h(θ)`, :math:`θ = atan2(V, U)`, and :math:`r = |flow| / scale`:

.. math::  c = 1 - r (1 - h(θ)) \quad (r ≤ 1), \qquad c = 0.75\, h(θ) \quad (r > 1)

so what is longer than the scale is dark, not lost. NaN is grey.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from synth.arrays import FloatArray
from synth.flow.field import FlowArray

Rgb: TypeAlias = NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""

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
