"""How a pixel and a point of the gel are related: lens, mirror, window.

A view is a chain: image pixel -> lens (`lens`) -> ray in air -> at most one flat mirror
(`mirror`) -> flat window (`window`) -> gel. `Optics` holds the chain and is its only way in: `project` and `look` are
exact inverses of each other.
"""

from synth.optics.camera import Optics, Rays

__all__ = ["Optics", "Rays"]
