"""Methods that make the flow between two states of a gel: the one of `generate`, and simpler ones to compare it with.

All get the same deformed surface and answer with the motion in both directions and where they say that the moving point
is seen in the other image. What a camera keeps between pairs (rays of its pixels, a fitted map) is made beforehand;
nothing is kept between states.
"""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from benchmarks.pressed_gel import View, main_camera, without_window
from synth.arrays import BoolArray, FloatArray, Points
from synth.flow.exact import exact_flow
from synth.flow.field import FlowArray
from synth.flow.view import View as Tracer
from synth.optics import Optics
from synth.scene import Sensor

Motion = tuple[FloatArray | FlowArray, BoolArray]
"""(H, W, 2) px, NaN where there is no value; (H, W) whether the point is seen in the other image."""
Generator = Callable[[Points, Points], tuple[Motion, Motion]]
"""Forward and backward motion between two states (v, 3) mm."""


class _TestedTracer(Tracer):
    """Looks at every pixel for what hides its point."""

    def overlap(self, positions: Points) -> None:
        return None


class _UntestedTracer(Tracer):
    """Takes all that lies inside the image for visible."""

    def overlap(self, positions: Points) -> BoolArray:
        return np.zeros(self.optics.size[::-1], dtype=bool)


def traced(view: View, kind: type[Tracer] = Tracer, sensor: Sensor | None = None) -> Generator:
    """Exact flow by rays of the pixel centres, through the scene's own sensor or another one."""
    tracer = _tracer(view, kind, sensor)

    def pair(first: Points, second: Points) -> tuple[Motion, Motion]:
        found = exact_flow(tracer, first, second)
        if found.backward is None or found.backward_visible is None:
            raise RuntimeError("the flow has no backward part")
        return (found.forward, found.forward_visible > 0), (found.backward, found.backward_visible > 0)

    return pair


def sparse(view: View, step: int) -> Generator:
    """Exact flow of an image `step` times smaller, enlarged bilinearly; what hides a point is the nearest pixel's."""
    import cv2

    camera = view.sensor.camera
    size = camera.width, camera.height
    small = main_camera(view.sensor, 1 / step)
    scale = np.array(size) / (small.camera.width, small.camera.height)
    coarse = traced(view, sensor=small)

    def enlarged(motion: Motion) -> Motion:
        flow, visible = motion
        hidden = (is_inside(flow) & ~visible).astype(np.uint8)
        wide = cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR) * scale
        return wide, is_inside(wide) & (cv2.resize(hidden, size, interpolation=cv2.INTER_NEAREST) == 0)

    def pair(first: Points, second: Points) -> tuple[Motion, Motion]:
        forward, backward = coarse(first, second)
        return enlarged(forward), enlarged(backward)

    return pair


def vertices(view: View, corners: bool) -> Generator:
    """Motion of projected vertices, interpolated linearly in their Delaunay triangulation in the image.

    Args:
        view: sensor and surface.
        corners: of the FEM mesh only, instead of all of the rendered surface.
    """
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import KDTree

    tracer = _tracer(view)
    chosen = np.arange(len(tracer.surface.material))
    if corners:
        coarse = tracer.surface.coarse
        chosen = KDTree(tracer.surface.material).query(coarse.nodes[np.unique(coarse.faces[:, :3])])[1]

    def one(near: Points, far: Points) -> Motion:
        flow = np.full(tracer.optics.centres.shape, np.nan)
        for path, at in _paths(tracer):
            here, there = (tracer.optics.project(state[chosen], path) for state in (near, far))
            known = np.isfinite(here + there).all(axis=1)
            flow[at] = LinearNDInterpolator(here[known], (there - here)[known])(tracer.optics.centres[at])
        return _all_visible(tracer, flow)

    return lambda first, second: (one(first, second), one(second, first))


def affine(view: View) -> Generator:
    """Motion in x and y times the matrix that fits the undeformed gel best: no perspective, no depth."""
    tracer = _tracer(view)
    points, maps = _rest_points(tracer), {}
    for path, at in _paths(tracer):
        known = at & np.isfinite(points[:, 0])
        across = np.column_stack([points[known, :2], np.ones(np.count_nonzero(known))])
        maps[path] = np.linalg.lstsq(across, tracer.optics.centres[known], rcond=None)[0][:2]

    def one(near: Points, far: Points) -> Motion:
        moved = tracer.state(near).hits.interpolate(tracer.surface.triangles, far - near)
        flow = np.full(tracer.optics.centres.shape, np.nan)
        for path, at in _paths(tracer):
            flow[at] = moved[at, :2] @ maps[path]
        return _all_visible(tracer, flow)

    return lambda first, second: (one(first, second), one(second, first))


def fitted_pinhole(view: View) -> Sensor:
    """A sensor without refraction whose focal lengths fit the undeformed gel best, as a calibration would find them."""
    tracer, sensor = _tracer(view), without_window(view.sensor)
    camera = sensor.camera
    seen = Optics.of(sensor).project(_rest_points(tracer), tracer.optics.own.path) - (camera.cx, camera.cy)
    true = tracer.optics.centres - (camera.cx, camera.cy)
    known = np.isfinite(seen).all(axis=1)
    ratio = float((seen[known] * true[known]).sum() / (seen[known] ** 2).sum())
    fitted = camera.model_copy(update={"fx": camera.fx * ratio, "fy": camera.fy * ratio})
    return sensor.model_copy(update={"camera": fitted})


SHIPPED = "traced, as `generate` does"
METHODS: dict[str, Callable[[View], Generator]] = {
    SHIPPED: traced,
    "every pixel tested for occlusion": partial(traced, kind=_TestedTracer),
    "no test for occlusion": partial(traced, kind=_UntestedTracer),
    "every 2 x 2 pixels, interpolated": partial(sparse, step=2),
    "every 4 x 4 pixels, interpolated": partial(sparse, step=4),
    "vertices of the rendered surface, interpolated": partial(vertices, corners=False),
    "corners of the FEM mesh, interpolated": partial(vertices, corners=True),
    "no refraction": lambda view: traced(view, sensor=without_window(view.sensor)),
    "no refraction, focal length fitted": lambda view: traced(view, sensor=fitted_pinhole(view)),
    "affine camera, fitted": affine,
}


def is_inside(flow: FloatArray | FlowArray) -> BoolArray:
    """(H, W) whether the pixel centres stay inside the image; False for NaN."""
    height, width = flow.shape[:2]
    row, column = np.mgrid[:height, :width] + 0.5
    x, y = column + flow[..., 0], row + flow[..., 1]
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0) & (x < width) & (y >= 0) & (y < height))


def _tracer(view: View, kind: type[Tracer] = Tracer, sensor: Sensor | None = None) -> Tracer:
    sensor = sensor or view.sensor
    tracer = kind(view.surface, Optics.of(sensor))
    _ = tracer.optics.own  # belongs to the camera
    return tracer


def _rest_points(tracer: Tracer) -> Points:
    """(n, 3) mm, where the pixels' rays meet the undeformed gel; NaN where they do not."""
    rest = tracer.surface.material
    return tracer.state(rest).hits.interpolate(tracer.surface.triangles, rest)


def _paths(tracer: Tracer) -> Iterator[tuple[int, BoolArray]]:
    """Light paths, directly or by mirrors, by which pixels look, and which pixels."""
    for path in np.unique(tracer.optics.own.path):
        if path >= 0:
            yield int(path), tracer.optics.own.path == path


def _all_visible(tracer: Tracer, flow: FloatArray) -> Motion:
    """Motion (n, 2) as an image in which all that stays inside it counts as visible."""
    image = flow.reshape(*tracer.optics.size[::-1], 2)
    return image, is_inside(image)
