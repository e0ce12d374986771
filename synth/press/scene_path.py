"""The body and the load path of a scene."""

from pathlib import Path

import numpy as np

from synth.mesh.face import PadFace, face_of
from synth.press.indenter import Touchable, rigid_body
from synth.press.load_path import LoadPath, PressFrame
from synth.press.posed_path import PosedPath, touchable_at
from synth.scene import Scene

BULGE, SLACK_MM = 1.5, 1.0
"""Gel beside a contact rises toward the body: no higher than this share of the depth, and so much."""


def path_of(scene: Scene, folder: Path | None = None, resolution_mm: float = 0.0) -> LoadPath:
    """The load path of a fully drawn scene's indenter, whose mesh file is relative to `folder`.

    `resolution_mm` is the smallest radius that the gel's mesh resolves, see `rigid_body`. InputError where the indenter
    cannot be built.
    """
    motion, gel, indenter = scene.motion, scene.sensor.gel, scene.contact.indenter
    if motion.poses is not None:
        posed = rigid_body(indenter, folder, resolution_mm, touchable_at(motion, gel.size_mm))
        return PosedPath(motion, posed, gel.dome_radius_mm, gel=gel)
    poses = motion.stops.values()
    aside = max(float(np.hypot(*np.add(motion.position_mm, pose.shear_mm))) for pose in poses)
    face = face_of(gel, folder or Path())
    frame = None if isinstance(face, PadFace) else PressFrame.of(motion, face)
    lowest = -frame.start_mm if frame else gel.face_mm(*motion.position_mm)
    deepest = max(pose.depth_mm for pose in poses) + lowest
    height = BULGE * max(deepest, 0.0) + SLACK_MM
    at_tip = gel.shape == "capsule" or (motion.polar_deg, motion.height_mm) != (None, None)
    touchable = Touchable(float(np.hypot(*gel.size_mm[:2])) / 2 + aside, height, max(motion.depth_mm, 0.0), at_tip)
    return LoadPath(motion, rigid_body(indenter, folder, resolution_mm, touchable), gel.dome_radius_mm, frame)
