"""The camera's geometry: rays from pixels and pixels from points, through the lens, by a mirror and through the window.

A path says how a pixel sees: 0 straight through the window, k by mirror k - 1, -1 not at all. With mirrors one material
point may be seen in several places of one image, one for each path. Noise is made in `synth.render.camera_image`.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from synth.arrays import BoolArray, FloatArray, Pixels, Points
from synth.optics.lens import FisheyeLens, PinholeLens
from synth.optics.mirror import DIRECT, NOTHING, FlatMirror, first_met
from synth.optics.pose import Pose
from synth.optics.window import RoundWindow, Window
from synth.scene import CurvedWindow, Sensor

Paths = NDArray[np.intp]
"""(n,) path numbers."""


@dataclass(frozen=True, eq=False)
class Rays:
    """How n pixels look: by which path, -1 where there is no ray, and from where (n, 3) mm, in unit directions (n, 3).

    Origins lie on the window's outer face; at index 1 they are the camera's position, or its mirror image. Directions
    are those inside the gel. NaN for pixels that no ray reaches: outside the range of the lens model, looking away from
    the window, or at the back of a mirror or by two mirrors.
    """

    origins: Points
    directions: Points
    path: Paths

    @property
    def on_flat_face(self) -> Points:
        """(n, 3) mm where the rays meet the undeformed contact face of a flat gel, z = 0, or its continuation."""
        return np.asarray(self.origins - self.directions * (self.origins[:, 2:] / self.directions[:, 2:]))


@dataclass(frozen=True, eq=False)
class Optics:
    """A camera's pose and lens, the mirrors before it in the scene's order, and the window that it looks through.

    The lens maps one-to-one between directions in the camera's frame and pixels; both are NaN beyond its field. The
    size is the image's width and height, px.
    """

    pose: Pose
    lens: PinholeLens | FisheyeLens
    window: Window | RoundWindow
    mirrors: tuple[FlatMirror, ...]
    size: tuple[int, int]

    @staticmethod
    @lru_cache(maxsize=4)  # each holds the rays of its pixels, which trajectories of a sensor share
    def of(sensor: Sensor) -> "Optics":
        """The optics of a sensor's main camera (`Sensor.views` gives the others); InputError for a view along x."""
        camera = sensor.camera
        lens = FisheyeLens if camera.lens == "fisheye" else PinholeLens
        return Optics(
            pose=Pose.of(camera),
            lens=lens(np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy]), camera.distortion),
            window=_window(sensor),
            mirrors=tuple(FlatMirror.of(mirror) for mirror in sensor.mirrors),
            size=(camera.width, camera.height),
        )

    @cached_property
    def centres(self) -> Pixels:
        """(n, 2) centres of all pixels, row by row."""
        row, column = np.mgrid[: self.size[1], : self.size[0]]
        return np.column_stack([column.ravel() + 0.5, row.ravel() + 0.5])

    @cached_property
    def local(self) -> Points:
        """(n, 3) directions of the pixels' centres in the camera's frame, from the lens."""
        return self.lens.directions(self.centres)

    @cached_property
    def own(self) -> Rays:
        return self._follow(self.local)

    @cached_property
    def poses(self) -> tuple[Pose, ...]:
        """The camera's place and its mirror images, by path number."""
        return (self.pose, *(mirror.virtual(self.pose) for mirror in self.mirrors))

    def project(self, points: Points, path: Paths | int | None = None) -> Pixels:
        """Pixels (n, 2) px, float64, at which points (n, 3) mm inside the gel or window are seen.

        The path is one for all points or one for each; by default the first by which the point is seen inside the
        image, or else straight. Pixels may lie outside the image and, where a path is given, beyond the ends of a
        mirror. NaN for points that have no image: behind the camera, above the window's outer face (where there is
        one), or beyond the field of the lens model; for path -1; and by default where a mirror hides what would be in
        the image.
        """
        points = np.asarray(points, dtype=np.float64)
        if not self.mirrors:
            return self._project_by(self.pose, points)
        chosen = self._first_path(points) if path is None else np.broadcast_to(np.asarray(path), len(points))
        pixels = np.full((len(points), 2), np.nan)
        for number, pose in enumerate(self.poses):
            at = chosen == number
            pixels[at] = self._project_by(pose, points[at])
        if path is None:
            pixels[self.is_inside(pixels) & (self.look(pixels).path != chosen)] = np.nan
        return pixels

    def look(self, pixels: Pixels) -> Rays:
        """Rays along which pixels (n, 2) look, anywhere, also between pixel centres, and their paths."""
        return self._follow(self.lens.directions(np.asarray(pixels, dtype=np.float64)))

    def _follow(self, local: Points) -> Rays:
        """Rays of directions (n, 3) in the camera's frame."""
        air = self.pose.world(local)
        if not self.mirrors:
            origins, directions = self.window.enter(self.pose.position, air)
            return Rays(origins, directions, np.where(np.isnan(directions[:, 0]), NOTHING, DIRECT))
        path = first_met(self.mirrors, self.pose.position, air)
        origins, directions = np.full_like(air, np.nan), np.full_like(air, np.nan)
        for number, pose in enumerate(self.poses):
            at = path == number
            onward = air[at] if number == DIRECT else self.mirrors[number - 1].turned(air[at])
            origins[at], directions[at] = self.window.enter(pose.position, onward)
        return Rays(origins, directions, np.where(np.isnan(directions[:, 0]), NOTHING, path))

    def depth(self, points: Points, path: Paths | int = DIRECT) -> FloatArray:
        """Distance (n,) mm of points (n, 3) mm along the viewing axis, folded at the path's mirror.

        Straight through the window; NaN for path -1.
        """
        if not self.mirrors:
            return np.asarray((points - self.pose.position) @ self.pose.forward)
        chosen = np.broadcast_to(np.asarray(path), len(points))
        depth = np.full(len(points), np.nan)
        for number, pose in enumerate(self.poses):
            at = chosen == number
            depth[at] = (points[at] - pose.position) @ pose.forward
        return depth

    def is_inside(self, pixels: Pixels) -> BoolArray:
        """Whether pixels (n, 2) lie inside the image; False for NaN."""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.all((pixels >= 0) & (pixels < self.size), axis=1))

    def _project_by(self, pose: Pose, points: Points) -> Pixels:
        return self.lens.project(pose.local(self.window.aim(points, pose.position)))

    def _first_path(self, points: Points) -> Paths:
        """The lowest number of a path by which points (n, 3) are seen inside the image; 0 where there is none."""
        path = np.full(len(points), DIRECT)
        for number in reversed(range(len(self.poses))):
            pixels = self._project_by(self.poses[number], points)
            seen = np.flatnonzero(self.is_inside(pixels))
            path[seen[self.look(pixels[seen]).path == number]] = number
        return path


def _window(sensor: Sensor) -> Window | RoundWindow:
    given = sensor.window
    if isinstance(given, CurvedWindow):
        return RoundWindow(given.refractive_index, given.radius_mm, *given.axis_mm)
    return Window(given.refractive_index, sensor.gel.size_mm[2] + given.thickness_mm)
