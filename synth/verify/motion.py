"""Checks of the recorded flow at every pixel of one direction.

The flow, the visibility and the NaN mask are derived anew with `synth.verify.sheet`. At the silhouette of a fold, at
the border of the gel and at that of the image, they jump, and rounding decides on which side a pixel centre falls: a
pixel that disagrees is excused if the derivation a thousandth of a pixel beside its centre, or its visibility a
thousandth of a pixel beside its flow's end, agrees with it. An error of the flow of more than the tolerance plus that
thousandth is never excused, unless the flow itself jumps there. The closure is excused where a thousandth of a pixel at
the flow's end moves the place it comes from by more than the closure: where image 2 is so compressed, or jumps.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels
from synth.flow.field import FlowArray
from synth.verify.report import Check
from synth.verify.sheet import Seen, Sheet

FLOW_TOLERANCE_PX = 0.005
"""A tenth of the 0.05 px that verification must find; float32 storage and both root searches leave 1e-6 px."""
CLOSURE_TOLERANCE_PX = 1e-3
BAND_PX = 1e-3
"""Width of the band beside silhouettes and borders in which either side is right."""
_MANY = 0.02
"""Beyond this share of disagreeing pixels nothing is excused: silhouettes and borders are lines."""
_HIDDEN_MM = 1e-4
"""A point is hidden if another lies higher by more than this on the way of its light to the camera. Queries are
rounded to float32 (1e-6 px, 1e-7 mm), so heights agree to 1e-4 mm up to slopes of 1000."""
_TOUCHING_MM, _NEAR_MM = 1e-7, 0.01
"""Distance up to which parts of the surface may touch: at one place, and within a thousandth of a px of it."""
_SAME_PLACE_PX = 1e-4
"""Difference up to which the recorded flow stands for the derived one."""
_TILE = 8192
"""Places at once: what they need fits into a processor's cache, and memory hardly grows with the image."""
Indices = NDArray[np.intp]
_AROUND = BAND_PX * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y], dtype=np.float64)


@dataclass(frozen=True)
class Derived:
    """Motion derived at n places of one image.

    Attributes:
        flow: (n, 2) px; NaN where no gel is seen.
        visible: (n,) whether the material point is seen in the other image.
        closure: (n,) px between a place and where its flow's end comes from; NaN where the flow ends out of sight.
        height: (n,) mm, of the material point in the other state.
        path: (n,) by which path of the camera the place sees it.
        touched: (n,) whether another part of the surface covers the point there so closely that it may count as hidden.
    """

    flow: FloatArray
    visible: BoolArray
    closure: FloatArray
    height: FloatArray
    path: Indices
    touched: BoolArray


def check_motion(name: str, near: Sheet, far: Sheet, flow: FlowArray, visible: FlowArray) -> list[Check]:
    """Checks of the recorded motion from the state `near` to the state `far`: flow, missing gel, visibility, closure.

    The name is "forward" or "backward"; flow (H, W, 2) px and visibility (H, W) are as recorded, at the pixels of the
    image of `near`.
    """
    size = (near.height, near.width)
    if flow.shape != (*size, 2) or visible.shape != size:
        return [Check(f"{name} flow", float("nan"), 0, "px", f"{flow.shape[:2]} pixels where the camera has {size}")]
    if not np.isfinite(flow).any():
        return [Check(f"{name} flow", float("nan"), 0, "px", "no pixel of the picture sees the gel")]
    row, column = np.mgrid[: near.height, : near.width]
    places = np.column_stack([column.ravel() + 0.5, row.ravel() + 0.5])
    recorded = flow.reshape(-1, 2).astype(np.float64)
    recorded_visible = visible.ravel()
    derived = derive(near, far, places, recorded)
    missing, unlike, hidden = _differences(derived, recorded, recorded_visible)
    suspects = np.flatnonzero(missing | hidden | (unlike > FLOW_TOLERANCE_PX))
    counted = np.ones(len(places), dtype=np.bool_)
    if len(suspects) <= _MANY * len(places):
        counted[
            suspects[_agrees_beside(near, far, places[suspects], recorded[suspects], recorded_visible[suspects])]
        ] = False
        turning = np.flatnonzero(hidden & counted)
        counted[turning[_turns_beside(far, derived, places, recorded_visible, turning)]] = False
    closure = np.where(counted & ~derived.touched, derived.closure, np.nan)
    open_ = np.flatnonzero(closure > CLOSURE_TOLERANCE_PX)
    ambiguous = open_[:0]
    if len(open_) <= _MANY * len(places):
        ambiguous = open_[_is_ambiguous(near, far, (places + recorded)[open_], closure[open_])]
        closure[ambiguous] = np.nan
    excused = np.count_nonzero(~counted) + len(ambiguous)
    note = f"; {excused} of {len(places)} at a silhouette or border excused" if excused else ""
    return [
        _worst(f"{name} flow", np.where(counted, unlike, np.nan), FLOW_TOLERANCE_PX, near.width, note),
        _number(f"{name} pixels without gel", missing & counted, near.width, note),
        _number(f"{name} visibility", hidden & counted, near.width, note),
        _worst(f"{name} closure", closure, CLOSURE_TOLERANCE_PX, near.width, note),
    ]


def derive(near: Sheet, far: Sheet, places: Pixels, recorded: FloatArray) -> Derived:
    """Derives the motion at places (n, 2) and follows the recorded one (n, 2) there and back."""
    ends = range(0, max(len(places), 1), _TILE)
    tiles = [_derive_tile(near, far, places[at : at + _TILE], recorded[at : at + _TILE]) for at in ends]
    return Derived(*(np.concatenate(part) for part in zip(*(vars(tile).values() for tile in tiles), strict=True)))


def _derive_tile(near: Sheet, far: Sheet, places: Pixels, recorded: FloatArray) -> Derived:
    seen = near.seen(places)
    points = seen.positions(near.triangles, far.positions)
    flow = np.full(places.shape, np.nan)
    on_gel = seen.triangle >= 0
    flow[on_gel] = near.pixels(points[on_gel], seen.path[on_gel]) - places[on_gel]
    with np.errstate(invalid="ignore"):
        same = np.linalg.norm(flow - recorded, axis=1) <= _SAME_PLACE_PX
    target = places + np.where(same[:, None], recorded, flow)
    inside = _is_inside(places + flow, near)
    # One query serves visibility and closure where the recorded flow is right; it may round across the border.
    query = np.flatnonzero(inside)
    end = np.clip(target[query], 0, (near.width, near.height))
    first, origin = _back(near, far, end)
    visible, touched = (np.zeros(len(places), dtype=np.bool_) for _ in range(2))
    height = near.camera.height(points)
    # Nothing higher is found by the same path.
    visible[query] = (first.height <= height[query] + _HIDDEN_MM) | (first.path != seen.path[query])
    visible[query] &= far.reached_by(points[query], seen.path[query])
    touched[query] = (
        visible[query] & (first.height > height[query] + _TOUCHING_MM) & (first.triangle != seen.triangle[query])
    )
    closure = np.full(len(places), np.nan)
    closure[query] = np.linalg.norm(origin - places[query], axis=1)
    closure[~(visible & same)] = np.nan
    astray = np.flatnonzero(~same & _is_inside(places + recorded, near))
    closure[astray] = np.linalg.norm(_back(near, far, places[astray] + recorded[astray])[1] - places[astray], axis=1)
    return Derived(flow, visible, closure, height, seen.path, touched)


def _back(near: Sheet, far: Sheet, ends: Pixels) -> tuple[Seen, Pixels]:
    """The points seen at places of the other image, and their pixels (n, 2) in this one."""
    seen = far.seen(ends)
    found = seen.triangle >= 0
    pixels = np.full(ends.shape, np.nan)
    pixels[found] = near.pixels(seen.positions(far.triangles, near.positions)[found], seen.path[found])
    return seen, pixels


def _is_inside(pixels: Pixels, image: Sheet) -> BoolArray:
    with np.errstate(invalid="ignore"):
        return np.all((pixels >= 0) & (pixels < (image.width, image.height)), axis=1)


def _differences(
    derived: Derived, recorded: FloatArray, recorded_visible: FlowArray
) -> tuple[BoolArray, FloatArray, BoolArray]:
    """Whether the presence of gel differs, the flows' distance (NaN without gel), whether the visibility differs."""
    missing = np.isfinite(derived.flow).all(1) != np.isfinite(recorded).all(1)
    missing |= np.isnan(recorded).any(1) != np.isnan(recorded).all(1)
    hidden = (recorded_visible != derived.visible) & ~(derived.touched & (recorded_visible == 0))
    return missing, np.linalg.norm(derived.flow - recorded, axis=1), hidden


def _agrees_beside(
    near: Sheet, far: Sheet, places: Pixels, recorded: FloatArray, recorded_visible: FlowArray
) -> BoolArray:
    """Whether the derivation a thousandth of a pixel beside the places agrees with what is recorded for them."""
    agreed = np.zeros(len(places), dtype=np.bool_)
    for shift in _AROUND:
        missing, unlike, hidden = _differences(derive(near, far, places + shift, recorded), recorded, recorded_visible)
        agreed |= ~missing & ~hidden & ~(unlike > FLOW_TOLERANCE_PX)
    return agreed


def _turns_beside(far: Sheet, derived: Derived, places: Pixels, visible: FlowArray, at: Indices) -> BoolArray:
    """Whether the visibility a thousandth of a pixel beside the flow's end is the recorded one.

    There the surface itself is higher or lower by its slope; parts of it closer than _NEAR_MM are taken to touch.
    """
    agreed = np.zeros(len(at), dtype=np.bool_)
    for shift in _AROUND:
        end = places[at] + derived.flow[at] + shift
        query = np.flatnonzero(_is_inside(end, far))
        seen = np.zeros(len(at), dtype=np.bool_)
        path = derived.path[at][query]
        found = far.seen(end[query])
        seen[query] = (found.height <= derived.height[at][query] + _NEAR_MM) & (found.path == path)
        agreed |= seen == visible[at]
    return agreed


def _is_ambiguous(near: Sheet, far: Sheet, ends: Pixels, closure: FloatArray) -> BoolArray:
    """Whether a thousandth of a pixel at the flow's end moves the place it comes from by more than the closure."""
    origin = _back(near, far, ends)[1]
    moved = np.zeros(len(ends))
    for shift in _AROUND:
        step = np.linalg.norm(_back(near, far, ends + shift)[1] - origin, axis=1)
        moved = np.maximum(moved, np.where(np.isnan(step), np.inf, step))
    return moved > closure


def _worst(name: str, values: FloatArray, tolerance: float, width: int, note: str) -> Check:
    if np.isnan(values).all():
        return Check(name, None, tolerance, "px", "no pixel to compare" + note)
    at = int(np.nanargmax(values))
    place = f"worst at row {at // width}, column {at % width}; mean {np.nanmean(values):.2g} px"
    return Check(name, float(values[at]), tolerance, "px", place + note)


def _number(name: str, wrong: BoolArray, width: int, note: str) -> Check:
    places = np.flatnonzero(wrong)
    detail = f"first at row {places[0] // width}, column {places[0] % width}" if len(places) else "all agree"
    return Check(name, float(len(places)), 0, "pixels wrong", detail + note)
