"""The albedo of a matt gel, looked up in its texture between texels: for light that is separated.

Dr.Jit cannot replay what looks up a texture in the GPU's own units, which moreover round weights to 8 bits.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from synth.arrays import Image
from synth.render.aligned import aligned


@dataclass(init=False, eq=False)
class AlbedoMap:
    """A texture (rows, columns, channels) float32 in [0, 1]."""

    channels: int
    _mi: Any
    _dr: Any
    _values: Any
    _size: Any

    def __init__(self, texture: Image, mi: Any) -> None:
        import drjit as dr

        self._mi, self._dr = mi, dr
        rows, columns, self.channels = texture.shape
        self._values = mi.Float(aligned(texture))
        self._size = mi.Vector2i(*(dr.opaque(mi.Int32, count) for count in (columns, rows)))

    def at(self, place: Any, active: Any, channels: Iterable[Any] | None = None) -> list[Any]:
        """Albedo (channels of mi.Float) at places (mi.Point2f, u and v): bilinear, with the edge's beyond the edge.

        Of all channels, or of those whose numbers are given.
        """
        mi, dr = self._mi, self._dr
        texel = mi.Vector2f(place) * mi.Vector2f(self._size) - 0.5
        first = mi.Vector2i(dr.floor(texel))
        x, y = texel - mi.Vector2f(first)
        numbers = range(self.channels) if channels is None else list(channels)
        total = [mi.Float(0) for _ in numbers]
        for right, down, weight in ((0, 0, (1 - x) * (1 - y)), (1, 0, x * (1 - y)), (0, 1, (1 - x) * y), (1, 1, x * y)):
            column, row = dr.clip(first + mi.Vector2i(right, down), 0, self._size - 1)
            index = mi.UInt32(row * self._size.x + column) * self.channels
            values = (dr.gather(mi.Float, self._values, index + channel, active) for channel in numbers)
            total = [dr.fma(value, weight, sum_) for value, sum_ in zip(values, total, strict=True)]
        return total
