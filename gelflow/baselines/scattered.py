"""A dense flow from motions at scattered points."""

import numpy as np
from numpy.typing import NDArray

from gelflow.arrays import FlowArray


def dense_flow(points: NDArray[np.float64], motion: NDArray[np.float64], height: int, width: int) -> FlowArray:
    """A dense flow (height, width, 2) float32 px, finite everywhere, from motions at scattered points.

    Points are (N, 2) columns and rows as pixel indices, N >= 1, their motions (N, 2) px. Inside the points' convex
    hull: Clough and Tocher's piecewise cubic on the Delaunay triangulation, continuous with its first derivatives,
    gradients chosen for least curvature (SciPy). Outside: the motion of the nearest point. With fewer than four points,
    or all of them on a line, there are no triangles: the nearest point everywhere.
    """
    from scipy.interpolate import CloughTocher2DInterpolator, NearestNDInterpolator
    from scipy.spatial import QhullError

    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    flow = np.asarray(NearestNDInterpolator(points, motion)(columns, rows))
    if len(points) >= 4:
        try:
            smooth = np.asarray(CloughTocher2DInterpolator(points, motion)(columns, rows))
        except QhullError:  # all points on a line
            return flow.astype(np.float32)
        flow = np.where(np.isfinite(smooth), smooth, flow)
    return flow.astype(np.float32)
