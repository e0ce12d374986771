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
from gelflow.compare.seeds import group_name
from gelflow.data.pairs import without_pattern

MOTION_PX = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0, np.inf)
EDGE_PX = (-np.inf, -16.0, -4.0, 0.0, 4.0, 16.0, 64.0, np.inf)
MOTION, EDGE, PATTERN, SCENE = "motion", "distance to contact edge", "pattern", "scene and pattern"
BARE = ", bare gel"
"""End of the kinds of bins of gels without a pattern."""


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
    scene: str | None = None,
) -> tuple[Stratum, ...]:
    """The bins of one pair that hold pixels.

    `error` is the endpoint error (H, W) in px, `compared` where it counts, `contact` where the gel touches the indenter
    in the second state, at pixels of image 1, and `scene` scene and kind of pattern, "gelsight_mini, dots".
    """
    motion = np.hypot(truth[..., 0], truth[..., 1])[compared]
    chosen = error[compared]
    apart = BARE if without_pattern(scene) else ""
    strata = _binned(MOTION + apart, MOTION_PX, motion, chosen)
    if contact is not None and contact.any() and not contact.all():
        strata += _binned(EDGE + apart, EDGE_PX, signed_distance(contact)[compared], chosen)
    if scene is not None:
        strata += [_stratum(PATTERN, scene.rpartition(", ")[2], chosen), _stratum(SCENE, scene, chosen)]
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


def pooled(strata: Mapping[str, Sequence[Stratum]]) -> dict[str, list[Stratum]]:
    """Bins by method with those of trainings that differ in their seed alone added up, under one name."""
    bins: dict[str, list[Stratum]] = {}
    for method, own in strata.items():
        bins.setdefault(group_name(method), []).extend(own)
    return {name: merged(own) for name, own in bins.items()}


def _order(stratum: Stratum) -> tuple[int, int, str]:
    limits = {MOTION: MOTION_PX, EDGE: EDGE_PX}.get(stratum.kind.removesuffix(BARE), ())
    names = [_name(low, high) for low, high in pairwise(limits)]
    place = names.index(stratum.bin) if stratum.bin in names else 0
    kinds = (MOTION, EDGE, PATTERN, SCENE, MOTION + BARE, EDGE + BARE)
    return kinds.index(stratum.kind), place, stratum.bin
