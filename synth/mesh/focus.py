"""The zone of the contact face that a locally refined mesh resolves."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Focus:
    """An axis-parallel rectangle of the undeformed contact face.

    Attributes:
        centre_mm: x and y of its centre.
        half_mm: half its width along x and along y, >= 0; a half width of 0 is a line or a point.
    """

    centre_mm: tuple[float, float]
    half_mm: tuple[float, float]

    def span(self, axis: int, length_mm: float) -> tuple[float, float]:
        """Lower and upper end along an axis (0: x, 1: y), clipped to a pad of that length around the origin.

        A focus beyond the pad becomes the nearest edge, of no width.
        """
        centre, half, edge = self.centre_mm[axis], self.half_mm[axis], length_mm / 2
        return min(max(centre - half, -edge), edge), min(max(centre + half, -edge), edge)

    def clipped(self, size_mm: tuple[float, float, float]) -> "Focus":
        """The part of it that lies on a pad of that size."""
        (left, right), (top, bottom) = (self.span(axis, size_mm[axis]) for axis in (0, 1))
        return Focus(((left + right) / 2, (top + bottom) / 2), ((right - left) / 2, (bottom - top) / 2))
