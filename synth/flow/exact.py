"""Exact optical flow between two states of a gel: pixel -> material point -> pixel.

The ray of each pixel centre of one image is traced to the deformed surface (`synth.flow.trace`); the triangle and
barycentric coordinates that it hits name a material point; that point's position in the other state is projected into
the other image (`synth.optics`). Nothing is interpolated over the image, and neither state has to be undeformed.

A pixel that looks by a mirror gets the motion of its point's image in the same mirror, and one that looks straight that
of the image seen straight: `synth.optics` numbers these paths. A point is visible in the other image where its pixel
lies inside that image (0 <= x < width, 0 <= y < height), that pixel looks by the same path (it has not left the
mirror, and no mirror stands before it), and nothing of the surface lies in front of it along the ray of that pixel.
"""

from collections.abc import Callable

import numpy as np

from synth.arrays import BoolArray, FloatArray, Points
from synth.errors import InputError
from synth.flow.field import FlowArray, FlowField
from synth.flow.view import View
from synth.surface import vertex_normals


def exact_flow(
    view: View,
    positions1: Points,
    positions2: Points,
    *,
    backward: bool = True,
    depth: bool = False,
    normal: bool = False,
    displacement: bool = False,
    traction: FloatArray | None = None,
    contact: Callable[[Points, Points], BoolArray] | None = None,
) -> FlowField:
    """Exact flow between two states, and what else the surface knows at each pixel.

    Args:
        view: the camera and the surface. One that has shown a state before saves what both pairs have in common.
        positions1: (v, 3) float64 mm, the surface's vertices in the state of image 1.
        positions2: the same in the state of image 2.
        backward: also the flow from image 2 to image 1.
        depth: depth1.Z and depth2.Z, mm: distance of the surface point from the camera along the camera's viewing axis
            (folded where the pixel looks by a mirror), measured straight through the window: where the point is, not
            where refraction makes it appear.
        normal: normal1.X/Y/Z and normal2.X/Y/Z: unit, smooth across triangles, pointing from the surface into the gel,
            toward the camera.
        displacement: displacement.X/Y/Z, mm: state 2 minus state 1 at the pixels of image 1.
        traction: (v, 3) float64 MPa at the vertices, in the state the caller chooses; gives traction.X/Y/Z at the
            pixels of image 1.
        contact: whether material points touch in state 2, by their places (n, 3) mm undeformed and in that state;
            gives contact.Y, 0 or 1 at the pixels of image 1.

    Returns:
        The flow, float32. Beside pixels that see no gel, NaN marks the rare material point that has no image at all
        because it left the field of the lens model (see `synth.optics`); it is not visible.

    Raises:
        InputError: an array has the wrong length.
    """
    triangles, vertices, optics = view.surface.triangles, len(view.surface.material), view.optics
    for name, array in (("positions1", positions1), ("positions2", positions2), ("traction", traction)):
        if array is not None and array.shape != (vertices, 3):
            raise InputError(f"{name} has shape {array.shape}; this surface needs ({vertices}, 3), one row per vertex")
    hits1 = view.state(positions1).hits
    forward, forward_visible = view.motion(hits1, positions2)
    extras: dict[str, FlowArray] = {}
    hits2 = view.state(positions2).hits if backward or depth or normal else None
    if hits2 is not None:
        for number, hits, positions in (("1", hits1, positions1), ("2", hits2, positions2)):
            if depth:
                depths = optics.depth(hits.interpolate(triangles, positions), optics.own.path)
                extras[f"depth{number}.Z"] = view.image(depths)
            if normal:
                smooth = hits.interpolate(triangles, -vertex_normals(positions, triangles))
                extras |= view.vector(f"normal{number}", smooth / np.linalg.norm(smooth, axis=1, keepdims=True))
    if displacement:
        extras |= view.vector("displacement", hits1.interpolate(triangles, positions2 - positions1))
    if traction is not None:
        extras |= view.vector("traction", hits1.interpolate(triangles, traction))
    if contact is not None:
        material, moved = (hits1.interpolate(triangles, at) for at in (view.surface.material, positions2))
        on_gel, touching = np.isfinite(moved[:, 0]), np.full(len(moved), np.nan)
        touching[on_gel] = contact(material[on_gel], moved[on_gel])
        extras["contact.Y"] = view.image(touching)
    if not backward or hits2 is None:
        return FlowField(forward, forward_visible, extras=extras)
    return FlowField(forward, forward_visible, *view.motion(hits2, positions1), extras=extras)


def since_before(
    view: View,
    first: Points,
    before: Points,
    now: Points,
    *,
    previous: bool = False,
    slip: Callable[[Points, Points, Points], FloatArray] | None = None,
) -> dict[str, FlowArray]:
    """Channels of a clip's frame that say what happened since the frame before.

    The states are the first, the one before and this one, vertices (v, 3) float64 mm. `previous` gives
    previous.U/V/visible, the forward flow from the state before at its own pixels. `slip` says which material points
    slipped, 1, 0 or NaN, by their places (n, 3) mm undeformed, before and now, and gives slip.Y at the first's pixels.
    """
    found: dict[str, FlowArray] = {}
    if previous:
        motion, visible = view.motion(view.state(before).hits, now)
        found |= {"previous.U": motion[..., 0], "previous.V": motion[..., 1], "previous.visible": visible}
    if slip is not None:
        hits = view.state(first).hits
        places = [hits.interpolate(view.surface.triangles, at) for at in (view.surface.material, before, now)]
        on_gel, slipped = np.isfinite(places[2][:, 0]), np.full(len(places[2]), np.nan)
        slipped[on_gel] = slip(*(place[on_gel] for place in places))
        found["slip.Y"] = view.image(slipped)
    return found
