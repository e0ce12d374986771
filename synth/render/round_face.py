"""The round inner face of a window in Dr.Jit: the rays of `synth.optics.round_window`, in the renderer's frame."""

from typing import Any

from synth.optics.round_window import RoundWindow


class RoundFace:
    """A sphere, cylinder or capsule about the z axis. Every number is opaque to Dr.Jit."""

    def __init__(self, window: RoundWindow, mi: Any) -> None:
        import drjit as dr

        self._mi = mi
        values = (window.index, window.radius, window.low, window.high)
        self._index, self._radius, self._low, self._high = (dr.opaque(mi.Float, value) for value in values)

    def enter(self, eye: Any, air: Any) -> tuple[Any, Any, Any, Any]:
        """Follow rays in air from within, with unit directions, through the face.

        Returns:
            Where they meet it, their unit directions beyond it, the cosine of their angle to the normal in air, and
            whether they meet it at all.
        """
        import drjit as dr

        level = self._mi.Vector2f(air.x, air.y)
        square, half = dr.squared_norm(level), air.x * eye.x + air.y * eye.y
        rest = eye.x * eye.x + eye.y * eye.y - dr.square(self._radius)
        side = dr.select(square > 1e-12, _far_root(square, half, rest), dr.inf)
        height = eye.z + side * air.z
        end = dr.clip(height, self._low, self._high)
        arm = self._mi.Vector3f(eye.x, eye.y, eye.z - end)
        cap = _far_root(1, dr.dot(arm, air), dr.squared_norm(arm) - dr.square(self._radius))
        distance = dr.select(height == end, side, cap)
        place = eye + air * distance
        foot = dr.clip(place.z, self._low, self._high)
        normal = self._mi.Vector3f(place.x, place.y, place.z - foot) / self._radius
        slant = dr.dot(air, normal)
        bent = dr.sqrt(dr.maximum(1 - (1 - dr.square(slant)) / dr.square(self._index), 0))
        inside = dr.normalize(air / self._index + normal * (bent - slant / self._index))
        return place, inside, slant, dr.isfinite(distance)


def _far_root(square: Any, half: Any, rest: Any) -> Any:
    """The larger root of square t² + 2 half t + rest = 0 with a rest below 0, without cancellation."""
    import drjit as dr

    root = dr.sqrt(dr.square(half) - square * rest)
    return dr.select(half > 0, -rest / (half + root), (root - half) / square)
