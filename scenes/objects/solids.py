"""Building blocks of the objects: plane outlines, and the solids that arise when outlines move.

Lengths are in mm and angles in degrees unless a name says otherwise. An outline lies in the xy plane; `extrude` of
manifold3d raises it to z > 0. In `Manifold` and `CrossSection`, `+` is union, `-` difference and `^` intersection.
"""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TypeAlias

import matplotlib
import numpy as np
from manifold3d import CrossSection, FillRule, Manifold, Mesh64, OpType
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import TextPath
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
Point: TypeAlias = tuple[float, float]

SEGMENTS = 32
"""Sides of the polygon that stands for a circle."""
FONT = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans-Bold.ttf"
"""The copy that matplotlib carries, so that all machines write the same letters."""
CAP_HEIGHT = 0.729
"""Of the font, relative to its size."""


def circle(diameter: float, at: Point = (0, 0), segments: int = SEGMENTS) -> CrossSection:
    """Circle about a point."""
    return CrossSection.circle(diameter / 2, segments).translate(at)


def circle_points(diameter: float, segments: int, at: Point = (0, 0)) -> FloatArray:
    """Corners (segments, 2) of the polygon that stands for a circle."""
    return np.asarray(circle(diameter, at, segments).to_polygons()[0])


def rectangle(width: float, height: float, at: Point = (0, 0)) -> CrossSection:
    """Rectangle about a point."""
    return CrossSection.square((width, height), center=True).translate(at)


def hexagon(across_flats: float) -> CrossSection:
    """Regular hexagon with two corners on the x axis."""
    return circle(across_flats / np.cos(np.pi / 6), segments=6)


def polygon(points: Sequence[Point] | FloatArray) -> CrossSection:
    """Polygon through points, (n, 2), in either sense of rotation."""
    return CrossSection([np.asarray(points, dtype=np.float64)], FillRule.EvenOdd)


def polar(radii: Sequence[float] | FloatArray) -> CrossSection:
    """Polygon whose corners have these radii, (n,), at equal angles counter-clockwise from the x axis."""
    angles = 2 * np.pi * np.arange(len(radii)) / len(radii)
    return polygon(np.column_stack([np.cos(angles), np.sin(angles)]) * np.asarray(radii)[:, None])


def text(characters: str, height: float) -> CrossSection:
    """Characters of DejaVu Sans Bold, so high that a capital H has the height, their box centred on the origin."""
    path = TextPath((0, 0), characters, size=height / CAP_HEIGHT, prop=FontProperties(fname=str(FONT)))
    outline = CrossSection(path.to_polygons(), FillRule.EvenOdd).simplify(0.01)
    left, bottom, right, top = outline.bounds()
    return outline.translate((-(left + right) / 2, -(bottom + top) / 2))


def union(solids: Iterable[Manifold]) -> Manifold:
    """Union of any number of solids."""
    return Manifold.batch_boolean(list(solids), OpType.Add)


def copies(solid: Manifold, places: Iterable[Point]) -> Manifold:
    """Union of copies of a solid, moved by (x, y)."""
    return union(solid.translate((x, y, 0.0)) for x, y in places)


def around(solid: Manifold, count: int) -> Manifold:
    """Union of copies of a solid at equal angles about the z axis."""
    return union(solid.rotate((0.0, 0.0, 360 * i / count)) for i in range(count))


def turned(profile: Sequence[Point]) -> Manifold:
    """Solid of revolution about the z axis of a profile of points (radius, z)."""
    return polygon(profile).revolve(SEGMENTS)


def rod(diameter: float, length: float, chamfer: float = 0.0) -> Manifold:
    """Cylinder on z = 0 along the z axis, both rims chamfered at 45 degrees."""
    r, c = diameter / 2, chamfer
    return turned([(0, 0), (r - c, 0), (r, c), (r, length - c), (r - c, length), (0, length)])


def lying(solid: Manifold) -> Manifold:
    """The solid with its z axis laid along x."""
    return solid.rotate((0.0, 90.0, 0.0))


def skin(rings: FloatArray, closed: bool = False) -> Manifold:
    """Solid inside a tube through rings of points; its quadrilaterals are split by diagonals of alternate direction.

    Args:
        rings: (n, k, 3) corners, counter-clockwise as seen from the ring before.
        closed: whether the last ring joins the first; otherwise both are capped, and must be convex.
    """
    n, k, _ = rings.shape
    corner = np.arange(n * k).reshape(n, k)
    here, there = (corner, np.roll(corner, -1, axis=0)) if closed else (corner[:-1], corner[1:])
    a, b, c, d = here, np.roll(here, -1, axis=1), np.roll(there, -1, axis=1), there
    even = (np.indices(here.shape).sum(axis=0) % 2 == 0)[..., None]
    one = np.where(even, np.stack([a, c, b], axis=-1), np.stack([a, d, b], axis=-1))
    other = np.where(even, np.stack([a, d, c], axis=-1), np.stack([b, d, c], axis=-1))
    faces = [one.reshape(-1, 3), other.reshape(-1, 3)]
    if not closed:
        fan = np.column_stack([np.zeros(k - 2, dtype=int), np.arange(1, k - 1), np.arange(2, k)])
        faces += [corner[0][fan], corner[-1][fan[:, ::-1]]]
    return Manifold(Mesh64(rings.reshape(-1, 3), np.concatenate(faces).astype(np.uint64)))


def sweep(section: FloatArray, centres: FloatArray, outward: FloatArray, closed: bool = False) -> Manifold:
    """Solid that an upright convex section leaves behind as it moves counter-clockwise about the z axis.

    Args:
        section: (k, 2) corners, counter-clockwise, in coordinates outward and along z.
        centres: (n, 3) where the section's origin passes.
        outward: (n, 3) unit vectors, horizontal and at right angles to the movement.
        closed: whether the last place joins the first; otherwise both ends are capped.
    """
    return skin(centres[:, None] + section[:, :1] * outward[:, None] + section[:, 1:] * np.eye(3)[2], closed)


def helix(section: FloatArray, pitch: float, turns: float, segments: int) -> Manifold:
    """Right-handed helix about the z axis, from z = 0 up, of a convex section (k, 2) of points (radius, z)."""
    angles = 2 * np.pi * np.arange(round(turns * segments) + 1) / segments
    outward = np.column_stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)])
    return sweep(section, angles[:, None] * (0, 0, pitch / (2 * np.pi)), outward)


def thread(diameter: float, pitch: float, length: float, segments: int) -> Manifold:
    """Rod on z = 0 with a right-handed metric thread (ISO 68-1: 60 degrees between flanks, crest pitch / 8 wide)."""
    major, depth = diameter / 2, 0.6134 * pitch
    minor, sunk = major - depth, 0.1 * pitch
    crest, foot = pitch / 16, pitch / 16 + (depth + sunk) * np.tan(np.pi / 6)
    ridge = np.array([(minor - sunk, -foot), (major, -crest), (major, crest), (minor - sunk, foot)])
    turns = np.ceil(length / pitch) + 2
    winding = helix(ridge, pitch, turns, segments).translate((0.0, 0.0, -pitch))
    core = circle(2 * minor, segments=segments).extrude(length)
    return core + winding.trim_by_plane((0, 0, 1), 0).trim_by_plane((0, 0, -1), -length)
