"""Sets of lights as words of 32 bits, for vectorised variants: light n is bit n % BITS of word n // BITS."""

from typing import Any

BITS = 32


def bits(low: Any, high: Any, mi: Any) -> Any:
    """A word (mi.UInt32) of which the bits from `low` to before `high` (mi.Int32) are set, those that it has."""
    import drjit as dr

    def below(count: Any) -> Any:
        return dr.select(count >= BITS, mi.UInt32(2**BITS - 1), (mi.UInt32(1) << dr.clip(count, 0, BITS - 1)) - 1)

    return below(high) & ~below(low)
