"""Where the error is: endpoint errors sorted by the length of the true motion, by the distance to the contact's edge,
by pattern, and by scene and pattern.

Each kind sorts the compared pixels of a pair into bins; sums over pixels are kept, so that bins of many pairs add up
with every pixel counting the same. The distance to the contact's edge is signed, negative inside the contact, and
needs the channel contact.Y (synth: `--set outputs.contact=true`); pairs without it, or without a contact, have no such
bins. Between pictures of a gel without a pattern nothing but shading can be followed, and errors are as large as the
motion: such pairs have bins of motion and distance of their own, so that they do not hide all others.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from gelflow.arrays import FlowArray, MaskArray
from gelflow.data.record import PatternedScene
from gelflow.methods.name import MethodName

MOTION_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, np.inf)
EDGE_PX = (-np.inf, -16.0, -4.0, 0.0, 4.0, 16.0, 64.0, np.inf)
MOTION, EDGE, PATTERN, SCENE = "motion", "distance to contact edge", "pattern", "scene and pattern"
BARE = ", bare gel"
"""End of the kinds of bins of gels without a pattern."""
LIMITS: dict[str, Sequence[float]] = {
    MOTION: MOTION_PX, EDGE: EDGE_PX, PATTERN: (), SCENE: (), MOTION + BARE: MOTION_PX, EDGE + BARE: EDGE_PX
}  # fmt: skip
"""Kinds of bins in their order, and the limits of those that have some."""


@dataclass(frozen=True)
class Stratum:
    """Sums over the pixels of one bin: their number, their errors, and how many err by more than 1 px and 0.1 px."""

    kind: str
    bin: str
    pixels: int
    error_px: float
    above_1px: int
    above_01px: int


def pair_strata(
    error: NDArray[np.float64],
    truth: FlowArray,
    compared: MaskArray,
    contact: MaskArray | None = None,
    scene: PatternedScene | None = None,
) -> tuple[Stratum, ...]:
    """The bins of one pair that hold pixels.

    `error` is the endpoint error (H, W) in px, `compared` where it counts, `contact` where the gel touches the indenter
    in the second state, at pixels of image 1, and `scene` that of a synthetic pair.
    """
    motion = np.hypot(truth[..., 0], truth[..., 1])[compared]
    chosen = error[compared]
    apart = BARE if scene is not None and scene.bare else ""
    strata = _binned(MOTION + apart, MOTION_PX, motion, chosen)
    if contact is not None and contact.any() and not contact.all():
        strata += _binned(EDGE + apart, EDGE_PX, signed_distance(contact)[compared], chosen)
    if scene is not None:
        strata += [_stratum(PATTERN, scene.pattern, chosen), _stratum(SCENE, str(scene), chosen)]
    return tuple(strata)


def signed_distance(region: MaskArray) -> NDArray[np.float64]:
    """Distance of each pixel's centre to the nearest edge between a region and the rest, px; negative inside.

    The edge lies half a px beyond the last pixel's centre.
    """
    outside = np.asarray(distance_transform_edt(~region), np.float64)
    inside = np.asarray(distance_transform_edt(region), np.float64)
    return np.where(region, 0.5 - inside, outside - 0.5)


def _binned(
    kind: str, limits: Sequence[float], values: NDArray[np.floating], error: NDArray[np.float64]
) -> list[Stratum]:
    places = np.digitize(values, limits[1:-1])
    return [
        _stratum(kind, _name(low, high), error[places == place])
        for place, (low, high) in enumerate(pairwise(limits))
        if (places == place).any()
    ]


def _name(low: float, high: float) -> str:
    if np.isinf(high):
        return f"above {low:g} px"
    return f"below {high:g} px" if np.isinf(low) else f"{low:g} to {high:g} px"


def _stratum(kind: str, name: str, error: NDArray[np.float64]) -> Stratum:
    above = [int(np.count_nonzero(~(error <= limit))) for limit in (1.0, 0.1)]
    return Stratum(kind, name, int(error.size), float(error.sum()), *above)


def merged(strata: Iterable[Stratum]) -> list[Stratum]:
    """Bins of many pairs added up; kinds and bins in their own order, patterns and scenes by name."""
    sums: dict[tuple[str, str], Stratum] = {}
    for one in strata:
        so_far = sums.get((one.kind, one.bin))
        if so_far is not None:
            added = [now + before for now, before in zip(astuple(one)[2:], astuple(so_far)[2:], strict=True)]
            one = Stratum(one.kind, one.bin, *added)
        sums[one.kind, one.bin] = one
    return sorted(sums.values(), key=_order)


def pooled(strata: Mapping[MethodName, Sequence[Stratum]]) -> dict[MethodName, list[Stratum]]:
    """Bins by method with those of trainings that differ in their seed alone added up, under one name."""
    bins: dict[MethodName, list[Stratum]] = {}
    for method, own in strata.items():
        bins.setdefault(method.group, []).extend(own)
    return {name: merged(own) for name, own in bins.items()}


def _order(stratum: Stratum) -> tuple[int, int, str]:
    names = [_name(low, high) for low, high in pairwise(LIMITS[stratum.kind])]
    place = names.index(stratum.bin) if names else 0
    return list(LIMITS).index(stratum.kind), place, stratum.bin
