"""Functions of a frame, recorded by Dr.Jit once and replayed from then on."""

from collections.abc import Callable
from typing import Any

_MOST = 16
"""Recordings that are kept: every size of mesh and of picture has its own."""


class Recordings:
    """Functions that Dr.Jit records at their first call and replays at later ones.

    What changes from call to call are Dr.Jit's numbers. Python's own, `static`, are part of the key: Dr.Jit 1.5 does
    not always notice that a bool has changed, and replays the other branch.
    """

    def __init__(self) -> None:
        self._known: dict[tuple[Any, ...], Callable[..., Any]] = {}

    def of(self, function: Callable[..., Any], *static: Any) -> Callable[..., Any]:
        """The function with its last arguments given."""
        import drjit as dr

        key = (function, *static)
        found = self._known.pop(key, None)
        if found is None:

            def called(*values: Any) -> Any:
                return function(*values, *static)

            found = dr.freeze(called, warn_after=10**9)
        self._known[key] = found  # the last used comes last
        if len(self._known) > _MOST:
            del self._known[next(iter(self._known))]
        return found
