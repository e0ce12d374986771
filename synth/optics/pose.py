"""Where a camera stands and how it is turned, and the virtual camera that stands behind a mirror.

Frame (docs/decisions.md): forward f = look_at - position, normalised; right r is +x made orthogonal to f; down
d = r x f by components. The scene's axes are a left-handed triple, so everything here works by components.
"""

from dataclasses import dataclass

import numpy as np

from synth.arrays import FloatArray, Points
from synth.errors import InputError
from synth.scene import Camera


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera's place: (3,) mm, the pinhole, and (3,) unit vectors of the image's axes and of the viewing axis.

    Behind a mirror these are the mirrored ones, so that the same pixel belongs to both cameras.
    """

    position: FloatArray
    right: FloatArray
    down: FloatArray
    forward: FloatArray

    @staticmethod
    def of(camera: Camera) -> "Pose":
        """The place of a camera; InputError for a view along x."""
        position = np.array(camera.position_mm, dtype=np.float64)
        forward = np.array(camera.look_at_mm, dtype=np.float64) - position
        length = float(np.linalg.norm(forward))
        forward = forward / length if length > 0 else np.array([1.0, 0.0, 0.0])
        right = np.array([1.0, 0.0, 0.0]) - forward[0] * forward
        length = float(np.linalg.norm(right))
        if length < 1e-6:
            raise InputError(
                f"sensor.camera looks along x (from {camera.position_mm} to {camera.look_at_mm}), so its image has no "
                "right: move look_at_mm or position_mm so that the camera looks down at the gel"
            )
        right /= length
        return Pose(position, right, np.cross(right, forward), forward)

    def local(self, arms: Points) -> Points:
        """Vectors (n, 3) of the scene by their components along right, down and forward."""
        return np.column_stack([arms @ self.right, arms @ self.down, arms @ self.forward])

    def world(self, local: Points) -> Points:
        """Unit vectors (n, 3) in the scene's frame of directions (n, 3) in the camera's."""
        x, y, z = (local[:, i : i + 1] for i in range(3))
        vectors = z * self.forward + x * self.right + y * self.down
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
