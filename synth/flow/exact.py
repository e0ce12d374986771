"""Exact optical flow between two states of a gel: pixel -> material point -> pixel.

The ray of each pixel centre of one image is traced to the deformed surface (`synth.flow.trace`); the triangle and
barycentric coordinates that it hits name a material point; that point's position in the other state is projected into
the other image (`synth.optics`). Nothing is interpolated over the image, and neither state has to be undeformed.

A pixel that looks by a mirror gets the motion of its point's image in the same mirror, and one that looks straight that
of the image seen straight: `synth.optics` numbers these paths. A point is visible in the other image where its pixel
lies inside that image (0 <= x < width, 0 <= y < height), that pixel looks by the same path (it has not left the
mirror, and no mirror stands before it), and nothing of the surface lies in front of it along the ray of that pixel.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from synth.arrays import BoolArray, FloatArray, Pixels, Points, Triangles
from synth.errors import InputError
from synth.flow.field import FlowArray, FlowField
from synth.flow.normals import vertex_normals
from synth.flow.trace import Hits, trace
from synth.optics import Optics, Rays
from synth.surface import GelSurface

OCCLUSION_TOLERANCE_MM = 1e-6
"""A hit nearer than the point itself by more than this hides it.

Projection and its inverse agree to about 1e-12 px, so the ray of a point's own pixel passes it at less than 1e-12 mm
and meets its own surface within 1e-12 mm / sin(grazing angle): below the tolerance for every angle above 1e-6 rad.
Parts of the surface less than 1e-6 mm apart touch.
"""


def exact_flow(
    surface: GelSurface,
    positions1: Points,
    positions2: Points,
    optics: Optics,
    width: int,
    height: int,
    *,
    backward: bool = True,
    depth: bool = False,
    normal: bool = False,
    displacement: bool = False,
    traction: FloatArray | None = None,
    contact: FloatArray | None = None,
    device: str = "cpu",
) -> FlowField:
    """Exact flow between two states, and what else the surface knows at each pixel.

    Args:
        surface: the gel's surface; its `triangles` are used, the states are given apart.
        positions1: (v, 3) float64 mm, the surface's vertices in the state of image 1.
        positions2: the same in the state of image 2.
        optics: the camera.
        width: columns of both images.
        height: rows of both images.
        backward: also the flow from image 2 to image 1.
        depth: depth1.Z and depth2.Z, mm: distance of the surface point from the camera along the camera's viewing axis
            (folded where the pixel looks by a mirror), measured straight through the window: where the point is, not
            where refraction makes it appear.
        normal: normal1.X/Y/Z and normal2.X/Y/Z: unit, smooth across triangles, pointing from the surface into the gel,
            toward the camera.
        displacement: displacement.X/Y/Z, mm: state 2 minus state 1 at the pixels of image 1.
        traction: (v, 3) float64 MPa at the vertices, in the state the caller chooses; gives traction.X/Y/Z at the
            pixels of image 1.
        contact: (v,) 0 or 1 at the vertices; gives contact.Y, 1 where the linear interpolation is at least one half, at
            the pixels of image 1.
        device: Warp device of the tracing.

    Returns:
        The flow, float32. Beside pixels that see no gel, NaN marks the rare material point that has no image at all
        because it left the field of the lens model (see `synth.optics`); it is not visible.

    Raises:
        InputError: an array has the wrong length.
    """
    triangles, vertices = surface.triangles, len(surface.material)
    for name, array in (("positions1", positions1), ("positions2", positions2), ("traction", traction)):
        if array is not None and array.shape != (vertices, 3):
            raise InputError(f"{name} has shape {array.shape}; this surface needs ({vertices}, 3), one row per vertex")
    if contact is not None and contact.shape != (vertices,):
        raise InputError(f"contact has shape {contact.shape}; this surface needs ({vertices},), one value per vertex")
    view = _View(optics, triangles, width, height, device)
    hits1 = view.first_hits(positions1)
    forward, forward_visible = view.motion(hits1, positions2)
    extras: dict[str, FlowArray] = {}
    hits2 = view.first_hits(positions2) if backward or depth or normal else None
    if depth and hits2 is not None:
        for number, hits, positions in (("1", hits1, positions1), ("2", hits2, positions2)):
            depths = optics.depth(hits.interpolate(triangles, positions), view.own.path)
            extras[f"depth{number}.Z"] = view.image(depths)
    if normal and hits2 is not None:
        for number, hits, positions in (("1", hits1, positions1), ("2", hits2, positions2)):
            smooth = hits.interpolate(triangles, -vertex_normals(positions, triangles))
            extras |= view.vector(f"normal{number}", smooth / np.linalg.norm(smooth, axis=1, keepdims=True))
    if displacement:
        extras |= view.vector("displacement", hits1.interpolate(triangles, positions2 - positions1))
    if traction is not None:
        extras |= view.vector("traction", hits1.interpolate(triangles, traction))
    if contact is not None:
        share = hits1.interpolate(triangles, np.asarray(contact, dtype=np.float64)[:, None])[:, 0]
        extras["contact.Y"] = view.image(np.where(np.isnan(share), np.nan, share >= 0.5))
    if not backward or hits2 is None:
        return FlowField(forward, forward_visible, extras=extras)
    return FlowField(forward, forward_visible, *view.motion(hits2, positions1), extras=extras)


@dataclass(frozen=True, eq=False)
class _View:
    """One camera looking at states of one surface."""

    optics: Optics
    triangles: Triangles
    width: int
    height: int
    device: str

    @cached_property
    def centres(self) -> Pixels:
        row, column = np.mgrid[: self.height, : self.width]
        return np.column_stack([column.ravel() + 0.5, row.ravel() + 0.5])

    @cached_property
    def own(self) -> Rays:
        """The rays of the pixel centres."""
        return self.optics.look(self.centres)

    def first_hits(self, positions: Points) -> Hits:
        """What the pixel centres see of a state."""
        return trace(positions, self.triangles, self.own.origins, self.own.directions, device=self.device)

    def motion(self, hits: Hits, target: Points) -> tuple[FlowArray, FlowArray]:
        """Flow (H, W, 2) and visibility (H, W) of the hits' material points when the surface moves to `target`."""
        points = hits.interpolate(self.triangles, target)
        pixels = self.optics.project(points, self.own.path)
        with np.errstate(invalid="ignore"):
            inside: BoolArray = np.all((pixels >= 0) & (pixels < (self.width, self.height)), axis=1)
        visible = inside.copy()
        rays = self.optics.look(pixels[inside])
        same = rays.path == self.own.path[inside]
        visible[inside] = same & self._is_unobstructed(points[inside], rays, target)
        flow = (pixels - self.centres).astype(np.float32).reshape(self.height, self.width, 2)
        return flow, self.image(visible)

    def _is_unobstructed(self, points: Points, rays: Rays, positions: Points) -> BoolArray:
        distance = np.linalg.norm(points - rays.origins, axis=1)
        first = trace(positions, self.triangles, rays.origins, rays.directions, device=self.device).distance
        return first >= distance - OCCLUSION_TOLERANCE_MM

    def image(self, values: FloatArray | BoolArray) -> FlowArray:
        return values.astype(np.float32).reshape(self.height, self.width)

    def vector(self, name: str, values: FloatArray) -> dict[str, FlowArray]:
        return {f"{name}.{axis}": self.image(values[:, i]) for i, axis in enumerate("XYZ")}
