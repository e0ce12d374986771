"""Contact states put aside and back, while a state is corrected that the path does not go on from."""

import numpy as np

from synth.arrays import BoolArray

FIELDS = ("normal", "tangent", "anchor", "anchored", "place", "gap")


def kept_contact(contact: object) -> dict[str, np.ndarray]:
    """A copy of a `ContactState`'s arrays by name."""
    return {name: getattr(contact, name).numpy().copy() for name in FIELDS}


def restore_contact(contact: object, kept: dict[str, np.ndarray], mask: BoolArray) -> None:
    """Put the kept arrays back for the samples of mask (B,)."""
    for name, before in kept.items():
        array = getattr(contact, name)
        now = array.numpy().copy()
        now[mask] = before[mask]
        array.assign(now)
