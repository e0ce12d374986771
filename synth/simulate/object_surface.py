"""Triangle surfaces of objects from files, brought to size.

Holes are left: inside is where the generalised winding number is above one half (`synth.simulate.object_grid`), which
closes them.
"""

from pathlib import Path

import numpy as np

from synth.errors import InputError
from synth.scene import MeshIndenter
from synth.scene.surface_file import Triangles, read_surface

SHORTEST_MM, LONGEST_MM = 0.5, 1000.0
"""Longest edges beyond which a file is taken to be in another unit."""


def object_triangles(indenter: MeshIndenter, folder: Path) -> Triangles:
    """An object's surface in mm, not turned, its bounding box centred on the origin; its file is relative to `folder`.

    Files have right-handed axes; the scene's are left-handed, because y points down in the image. So y changes its
    sign: a letter can be read in the picture, a screw keeps its hand.

    Raises:
        InputError: a file that is missing or no surface, or of a size that speaks for another unit.
    """
    try:
        surface = read_surface(folder / indenter.file)
    except ValueError as error:
        raise InputError(f"contact.indenter.file = {indenter.file!r}: {error}") from None
    longest = float(np.ptp(surface.points, axis=0).max())
    scale = indenter.size_mm / longest if indenter.size_mm is not None else indenter.scale
    if not SHORTEST_MM <= scale * longest <= LONGEST_MM:
        raise InputError(
            f"contact.indenter.scale = {scale:g}: {indenter.file} is then {scale * longest:.3g} mm long. Is it in "
            "metres (scale = 1000) or inches (scale = 25.4)? size_mm gives its longest edge instead"
        )
    centre = (surface.points.min(axis=0) + surface.points.max(axis=0)) / 2
    return Triangles(scale * (surface.points - centre) * [1, -1, 1], surface.faces[:, ::-1], surface.closed)
