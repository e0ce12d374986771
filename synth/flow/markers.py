"""Tracks of a pattern's dots through the states of a surface, from the same geometry and camera as the flow."""

from collections.abc import Sequence

import numpy as np

from synth.arrays import FloatArray, Pixels, Points
from synth.flow.trace import trace
from synth.flow.view import View


def tracks(view: View, flattened: Pixels, dots: Pixels, states: Sequence[Points]) -> FloatArray:
    """Where a camera sees dots in each state, dot by dot: the columns of `synth.dataset.tracks.MARKERS`.

    A dot is a material point: that of the surface's triangles at its place in the texture. Places of vertices
    (v, 2) and of dots (n, 2) are mm, states vertices (v, 3) float64 mm. Returns (tracks * states, 7) rows of those that
    are seen in some state, each by one path of the camera (straight, or by a mirror); NaN beyond the lens's field.
    """
    if not len(dots):
        return np.zeros((0, 7))
    flat, ahead = np.column_stack([flattened, np.zeros(len(flattened))]), np.array([0.0, 0.0, 1.0])
    origins = np.column_stack([dots, -np.ones(len(dots))])
    hits = trace(flat, view.surface.triangles, origins, np.tile(ahead, (len(dots), 1)))
    found = hits.triangle >= 0
    paths = range(1 + len(view.optics.mirrors))
    rows = np.zeros((len(paths), found.sum(), len(states), 7))
    for number, positions in enumerate(states):
        points = hits.interpolate(view.surface.triangles, positions)[found]
        for path in paths:
            pixels, seen = view.state(positions).look_at(points, np.full(len(points), path))
            rows[path, :, number, 1] = number
            rows[path, :, number, 2:4], rows[path, :, number, 6] = pixels, seen
    rows[..., 4:6] = rows[..., 2:4] - rows[..., :1, 2:4]
    shown = rows[rows[..., 6].any(axis=2)]
    shown[..., 0] = np.arange(len(shown))[:, None]
    return shown.reshape(-1, 7)
