r"""Is the undeformed face of a domed gel the sphere that the scene says? By rays that meet it in closed form.

From where the light of a pixel leaves the body (`ForwardCamera.entrances`) it is followed back along the line e + t w,
which meets the sphere of radius R about c = (0, 0, R) last, at the face, where

.. math::  t = -b + \sqrt{b^2 - |e - c|^2 + R^2}, \qquad b = w \cdot (e - c).

The recorded surface is made of triangles with corners on or near the sphere, and no point of a triangle whose longest
edge is l lies deeper under its corners' sphere than the l² / 6R of an equilateral one. The corners are those of the
simulation's faces and, between them, of quadratic interpolation, which errs along a line of length h by

.. math::  \frac{h^3}{72 \sqrt{3}} \max |D|, \qquad |D| \le \frac{3 r R^2}{(R^2 - r^2)^{5/2}}

with D the third derivative of its height, at distances up to r from the axis; twice that is allowed for a triangle.
What a pixel sees of the surface, found by the root search of `synth.verify.sheet`, may be off along the line by both
over the cosine of the angle between line and normal.
"""

import numpy as np

from synth.arrays import FloatArray, Pixels
from synth.scene import Camera
from synth.surface import GelSurface
from synth.verify.camera import ForwardCamera
from synth.verify.report import Check
from synth.verify.sheet import Sheet

NAME = "undeformed dome against the sphere"
STRIDE = 4
"""Every so many columns and rows a pixel is looked at."""
LEAST_MM = 1e-6


def check_dome(camera: ForwardCamera, surface: GelSurface, radius_mm: float, image: Camera) -> Check:
    """Compares what pixels of an image see of a sample's undeformed surface with the sphere."""
    sheet = Sheet(camera, surface.triangles, surface.material, image.width, image.height)
    places = _grid(image.width, image.height)
    seen = sheet.seen(places)
    on_gel = np.flatnonzero(seen.triangle >= 0)
    if not len(on_gel):
        return Check(NAME, None, LEAST_MM, "mm", "no pixel sees the gel")
    found, path = seen.positions(surface.triangles, surface.material)[on_gel], seen.path[on_gel]
    start = np.zeros_like(found)
    for number in camera.paths:
        at = path == number
        start[at] = camera.entrances(found[at], number)
    reach = np.linalg.norm(found - start, axis=1)
    direction = (found - start) / reach[:, None]
    arm = start - (0.0, 0.0, radius_mm)
    b = (direction * arm).sum(axis=1)
    with np.errstate(invalid="ignore"):
        t = -b + np.sqrt(b**2 - (arm**2).sum(axis=1) + radius_mm**2)
    cosine = ((arm + t[:, None] * direction) * direction).sum(axis=1) / radius_mm
    corners = surface.material[surface.triangles[seen.triangle[on_gel]]]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    bound = _deviation_bound(surface, longest, np.hypot(found[:, 0], found[:, 1]), radius_mm) / cosine + LEAST_MM
    off = np.where(np.isnan(t), np.inf, np.abs(t - reach))
    worst = int(np.argmax(off / bound))
    column, row = (int(v) for v in places[on_gel[worst]])
    detail = f"nearest its bound at row {row}, column {column}; {len(on_gel)} pixels, mean {off.mean():.2g} mm, "
    detail += f"largest {off.max():.2g} mm"
    return Check(NAME, float(off[worst]), float(bound[worst]), "mm", detail)


def _deviation_bound(surface: GelSurface, longest: FloatArray, away: FloatArray, radius_mm: float) -> FloatArray:
    """How far (n,) mm triangles with longest edges (n,) mm, (n,) mm away from the axis, may be off the sphere."""
    face = surface.subdivisions * longest
    if not surface.coarse.is_quadratic:
        return face**2 / (6 * radius_mm)  # linear elements keep their flat faces
    edge = np.hypot(*surface.coarse.nodes[:, :2].T).max()
    r = np.minimum(away + face, edge)
    bend = 3 * r * radius_mm**2 / (radius_mm**2 - r**2) ** 2.5
    return np.asarray(longest**2 / (6 * radius_mm) + 2 * bend * face**3 / (72 * np.sqrt(3)))


def _grid(width: int, height: int) -> Pixels:
    """(n, 2) centres of the pixels that are looked at."""
    row, column = np.mgrid[:height:STRIDE, :width:STRIDE]
    return np.column_stack([column.ravel() + 0.5, row.ravel() + 0.5])
