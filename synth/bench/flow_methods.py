"""Ways to make the flow between two states of a gel: the one that `generate` has, and simpler ones beside it.

Each gives, for both directions, the motion of the image and where it says that the moving point is seen in the other
image. All get the same deformed surface; what a camera keeps between pairs (rays of its pixels, a fitted map) is made
before, and nothing is kept between states.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from synth.arrays import BoolArray, FloatArray, Pixels, Points
from synth.bench.flow_single import SingleView
from synth.bench.render_subject import View as Subject
from synth.bench.render_subject import resized, without_window
from synth.flow.exact import exact_flow
from synth.flow.field import FlowArray
from synth.flow.view import View
from synth.optics import Optics
from synth.scene import Sensor

Motion = tuple[FloatArray | FlowArray, BoolArray]
"""(H, W, 2) px, NaN where there is no value; (H, W) whether the point is seen in the other image."""
Generator = Callable[[Points, Points], tuple[Motion, Motion]]
"""Forward and backward motion of two states (v, 3) mm."""

STEPS = (2, 4)
"""Flow at every so many pixels, in both directions of the image."""
LEAST_SIDE = 16
"""Of an image, px: the scene's schema."""


@dataclass(frozen=True)
class Method:
    """One way.

    Attributes:
        family: what it leaves out, as legends have it.
        name: as tables have it.
        make: for one camera.
    """

    family: str
    name: str
    make: Callable[[Subject], Generator]


SHIPPED = "traced (as `generate` does)"


def methods(subject: Subject) -> list[Method]:
    """All ways that a camera allows, the shipped one first."""
    camera = subject.sensor.camera
    steps = [k for k in STEPS if min(camera.width, camera.height) // k >= LEAST_SIDE]
    return [
        Method("traced", SHIPPED, lambda s: _traced(s, View)),
        Method("occlusion", "every pixel tested for occlusion", lambda s: _traced(s, _TestedView)),
        Method("occlusion", "no test for occlusion", lambda s: _traced(s, _UntestedView)),
        Method("float32", "traced in float32", lambda s: _traced(s, SingleView)),
        *(Method("pixels", f"every {k} x {k} pixels, interpolated", partial(_sparse, step=k)) for k in steps),
        Method("vertices", "vertices of the rendered surface, interpolated", lambda s: _vertices(s, False)),
        Method("vertices", "corners of the FEM mesh, interpolated", lambda s: _vertices(s, True)),
        Method("camera", "no refraction", lambda s: _traced(s, View, without_window(s.sensor))),
        Method("camera", "no refraction, focal length fitted", lambda s: _traced(s, View, _fitted_pinhole(s))),
        Method("camera", "affine camera, fitted", _affine),
    ]


class _TestedView(View):
    """Looks for what hides a point at every pixel."""

    def _may_be_hidden(self, pixels: Pixels, inside: BoolArray, target: Points) -> np.ndarray:
        return np.flatnonzero(inside)


class _UntestedView(View):
    """Takes what lies inside the image for visible."""

    def _may_be_hidden(self, pixels: Pixels, inside: BoolArray, target: Points) -> np.ndarray:
        return np.flatnonzero(inside)[:0]


def _view(subject: Subject, kind: type[View] = View, sensor: Sensor | None = None) -> View:
    sensor = sensor or subject.sensor
    view = kind(subject.surface, Optics.of(sensor), sensor.camera.width, sensor.camera.height)
    _ = view.own, view.centres  # belong to the camera
    return view


def _traced(subject: Subject, kind: type[View], sensor: Sensor | None = None) -> Generator:
    view = _view(subject, kind, sensor)

    def pair(first: Points, second: Points) -> tuple[Motion, Motion]:
        found = exact_flow(view.surface, first, second, view.optics, view.width, view.height, view=view)
        if found.backward is None or found.backward_visible is None:
            raise RuntimeError("the flow has no backward part")
        return (found.forward, found.forward_visible > 0), (found.backward, found.backward_visible > 0)

    return pair


def _sparse(subject: Subject, step: int) -> Generator:
    """Flow of a smaller image of the same view, enlarged bilinearly; what hides a point is the nearest pixel's."""
    import cv2

    camera = subject.sensor.camera
    size = camera.width, camera.height
    small = resized(subject.sensor, (camera.width // step, camera.height // step))
    scale = np.array(size) / (small.camera.width, small.camera.height)
    coarse = _traced(subject, View, small)

    def enlarged(motion: Motion) -> Motion:
        flow, visible = motion
        hidden = (is_inside(flow) & ~visible).astype(np.uint8)
        wide = cv2.resize(flow, size, interpolation=cv2.INTER_LINEAR) * scale
        return wide, is_inside(wide) & (cv2.resize(hidden, size, interpolation=cv2.INTER_NEAREST) == 0)

    def pair(first: Points, second: Points) -> tuple[Motion, Motion]:
        forward, backward = coarse(first, second)
        return enlarged(forward), enlarged(backward)

    return pair


def _vertices(subject: Subject, corners: bool) -> Generator:
    """Motion of projected vertices, interpolated linearly in their Delaunay triangulation, path by path."""
    from scipy.interpolate import LinearNDInterpolator
    from scipy.spatial import KDTree

    view = _view(subject)
    chosen = np.arange(len(view.surface.material))
    if corners:
        coarse = view.surface.coarse
        chosen = KDTree(view.surface.material).query(coarse.nodes[np.unique(coarse.faces[:, :3])])[1]

    def one(near: Points, far: Points) -> Motion:
        flow = np.full(view.centres.shape, np.nan)
        for path, at in _paths(view):
            here, there = (view.optics.project(state[chosen], path) for state in (near, far))
            known = np.isfinite(here + there).all(axis=1)
            flow[at] = LinearNDInterpolator(here[known], (there - here)[known])(view.centres[at])
        return _bare(view, flow)

    return lambda first, second: (one(first, second), one(second, first))


def _affine(subject: Subject) -> Generator:
    """Points of the pixels by tracing, their motion in x and y times a fixed matrix: no perspective, no depth."""
    view = _view(subject)
    points = _rest_points(view)
    maps = {}
    for path, at in _paths(view):
        known = at & np.isfinite(points[:, 0])
        across = np.column_stack([points[known, :2], np.ones(np.count_nonzero(known))])
        maps[path] = np.linalg.lstsq(across, view.centres[known], rcond=None)[0][:2]

    def one(near: Points, far: Points) -> Motion:
        moved = view.first_hits(near).interpolate(view.triangles, far - near)
        flow = np.full(view.centres.shape, np.nan)
        for path, at in _paths(view):
            flow[at] = moved[at, :2] @ maps[path]
        return _bare(view, flow)

    return lambda first, second: (one(first, second), one(second, first))


def _fitted_pinhole(subject: Subject) -> Sensor:
    """A sensor without refraction whose focal lengths fit the undeformed gel best, as calibration would find them."""
    view, sensor = _view(subject), without_window(subject.sensor)
    camera = sensor.camera
    seen = Optics.of(sensor).project(_rest_points(view), view.own.path) - (camera.cx, camera.cy)
    true = view.centres - (camera.cx, camera.cy)
    known = np.isfinite(seen).all(axis=1)
    ratio = float((seen[known] * true[known]).sum() / (seen[known] ** 2).sum())
    fitted = camera.model_copy(update={"fx": camera.fx * ratio, "fy": camera.fy * ratio})
    return sensor.model_copy(update={"camera": fitted})


def _rest_points(view: View) -> Points:
    """(n, 3) mm, where the pixels' rays meet the undeformed gel; NaN where they do not."""
    rest = view.surface.material
    return view.first_hits(rest).interpolate(view.triangles, rest)


def _paths(view: View) -> Iterator[tuple[int, BoolArray]]:
    """Paths by which pixels look, and which pixels."""
    for path in np.unique(view.own.path):
        if path >= 0:
            yield int(path), view.own.path == path


def _bare(view: View, flow: FloatArray) -> Motion:
    """Motion (n, 2) as images; what lies inside the image counts as visible."""
    image = flow.reshape(view.height, view.width, 2)
    return image, is_inside(image)


def is_inside(flow: FloatArray | FlowArray) -> BoolArray:
    """(H, W) whether the pixel centres stay inside the image; False for NaN."""
    height, width = flow.shape[:2]
    row, column = np.mgrid[:height, :width] + 0.5
    x, y = column + flow[..., 0], row + flow[..., 1]
    with np.errstate(invalid="ignore"):
        return np.asarray((x >= 0) & (x < width) & (y >= 0) & (y < height))
