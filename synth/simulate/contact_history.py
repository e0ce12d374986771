"""Saving and restoring contact's history, around a corrected state that the load path does not go on from."""

import numpy as np

FIELDS = ("normal", "tangent", "anchor", "anchored", "place", "gap")


def saved_contact(contact: object) -> dict[str, np.ndarray]:
    """A copy of a `ContactState`'s arrays by name."""
    return {name: getattr(contact, name).numpy().copy() for name in FIELDS}


def restore_contact(contact: object, saved: dict[str, np.ndarray]) -> None:
    """Put the saved arrays back."""
    for name, before in saved.items():
        getattr(contact, name).assign(before)
