"""Where on the contact face an indenter will touch, from its shape and path alone.

The overlap is the part of the undeformed gel that lies inside the indenter at a pose; its footprint is the smallest
axis-parallel rectangle of the contact face over it. The true contact differs: gel bulges at the contact's rim
and lifts with it, friction drags it along. `margin` is for that. A drag carries the gel it sticks to, so the gel that
is touched is that under the press, and beyond it what the indenter reaches along its load path.

The search halves cells of space (branch and bound) and leaves those that hold nothing of the body or could not make
the rectangle larger, so that no part is missed however thin. With d and n the signed distance and its gradient at a
cell's centre and h the cell's half edges, the distance in the cell is at least d - |n| . h (by components) for a convex
body, whose distance is a convex function, and d - |h| for any. So it is for the height of a domed face over a point,
which is convex, too: the cells hold no gel where it is above zero throughout.
"""

from collections.abc import Sequence
from itertools import product

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points
from synth.mesh import Focus, face_height
from synth.press.distance import KINDS
from synth.press.load_path import LoadPath, Pose
from synth.press.measure import Distance

RESOLUTION = 2e-3
"""The rectangle falls short of the true one, on each side, by at most this fraction of its smaller width."""
FINEST_MM = 1e-3
"""Cells are not halved below this. Those that may hold a part of the body then count as overlap."""
POSES = 33
"""Poses looked at from the end of the press to the end of the path, besides the corners between them."""
UNTOUCHED = 0.25
"""Half width of the zone under an indenter that does not touch, over the pad's thickness."""
_CELLS = (16, 16, 1)
"""Cells along x, y and z that the search begins with."""
_CONVEX = tuple(KINDS[shape] for shape in ("sphere", "cylinder", "box", "cone"))


def footprint(path: LoadPath, size_mm: tuple[float, float, float], margin: float) -> Focus:
    """The part of the contact face that a path's indenter overlaps, from its end of press on: a rectangle on the pad.

    The footprint of the press grows by `margin`, above -1, of its half widths on every side. Where nothing overlaps, it
    is a small rectangle around the pad's point nearest to the indenter's position.
    """
    press = _rectangle(path, [path.pose(path.press_mm)], size_mm)
    even = np.linspace(path.press_mm, path.length_mm, POSES)
    after = np.unique(np.concatenate([even, path.ends[path.ends > path.press_mm]]))
    drag = _rectangle(path, [path.pose(float(s)) for s in after], size_mm) if path.length_mm > path.press_mm else None
    found = [] if drag is None else [drag]
    if press is not None:
        found.append(press + margin / 2 * (press[1] - press[0]) * np.array([[-1.0], [1.0]]))
    if not found:
        small = UNTOUCHED * size_mm[2]
        x, y = (float(np.clip(p, -s / 2, s / 2)) for p, s in zip(path.motion.position_mm, size_mm, strict=False))
        return Focus((x, y), (small, small)).clipped(size_mm)
    low, high = np.min([r[0] for r in found], axis=0), np.max([r[1] for r in found], axis=0)
    centre, half = (low + high) / 2, (high - low) / 2
    return Focus((float(centre[0]), float(centre[1])), (float(half[0]), float(half[1]))).clipped(size_mm)


def _rectangle(path: LoadPath, poses: Sequence[Pose], size_mm: tuple[float, float, float]) -> FloatArray | None:
    """(2, 2) lower and upper x, y of the pad's overlap with a body at any of the poses; None where there is none."""
    body = path.body
    poses = [pose for pose in poses if pose.depth_mm + path.face_mm > 0]
    if not poses:
        return None
    distance = Distance(body, np.array([p.centre for p in poses]), np.array([p.rotation for p in poses]))
    deepest = min(max(pose.depth_mm for pose in poses) + path.face_mm, size_mm[2])
    lower = np.array([-size_mm[0] / 2, -size_mm[1] / 2, 0.0])
    upper = np.array([size_mm[0] / 2, size_mm[1] / 2, deepest])
    half = (upper - lower) / (2 * np.array(_CELLS))
    grid = np.array(list(product(*(range(n) for n in _CELLS))))
    centres = np.tile(lower + half * (2 * grid + 1), (len(poses), 1))
    pose = np.repeat(np.arange(len(poses)), len(grid))
    found: FloatArray | None = None
    while True:
        normal, away = distance(centres, pose)
        lack, slope = _lack(centres, path.dome_radius_mm)
        found = _joined(found, centres[(away <= 0) & (lack <= 0), :2])
        reach = np.abs(normal) @ half if body.kind in _CONVEX else np.linalg.norm(half)
        keep = (away <= reach) & (lack <= slope @ half) & _beyond(found, centres, half)
        if not keep.any():
            return found
        centres, pose = centres[keep], pose[keep]
        if half.max() < FINEST_MM:
            return _joined(_joined(found, centres[:, :2] - half[:2]), centres[:, :2] + half[:2])
        split = half >= half.max() / 2  # cells stay about as wide as long
        signs = np.array(list(product(*((-0.5, 0.5) if cut else (0.0,) for cut in split))))
        centres = (centres[:, None, :] + signs * half).reshape(-1, 3)
        pose, half = np.repeat(pose, len(signs)), np.where(split, half / 2, half)


def _lack(points: Points, dome_radius_mm: float | None) -> tuple[FloatArray, FloatArray]:
    """How far (n,) mm points (n, 3) on a pad's side of z = 0 are from being gel along z, and the slopes (n, 3) of that.

    Slopes are without signs.
    """
    if dome_radius_mm is None:
        return -points[:, 2], np.tile([0.0, 0.0, 1.0], (len(points), 1))
    face = face_height(points[:, :2], dome_radius_mm)
    tilt = np.abs(points[:, :2]) / (dome_radius_mm - face)[:, None]
    return face - points[:, 2], np.column_stack([tilt, np.ones(len(points))])


def _joined(rectangle: FloatArray | None, points: FloatArray) -> FloatArray | None:
    """The smallest rectangle around another and points (n, 2)."""
    corners = points if rectangle is None else np.concatenate([rectangle, points])
    return np.array([corners.min(axis=0), corners.max(axis=0)]) if len(corners) else None


def _beyond(found: FloatArray | None, centres: Points, half: FloatArray) -> BoolArray:
    """(n,) whether a cell reaches beyond the rectangle by more than the resolution."""
    if found is None:
        return np.ones(len(centres), dtype=bool)
    allowed = RESOLUTION * (found[1] - found[0]).min()
    low, high = centres[:, :2] - half[:2] < found[0] - allowed, centres[:, :2] + half[:2] > found[1] + allowed
    return np.asarray((low | high).any(axis=1))
