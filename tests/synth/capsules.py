"""A capsule's scene for the tests, and its meshes of fTetWild, which are kept for the session."""

import functools
from typing import Any

from pads import scene as pad_scene
from tiny_scene import home

from synth.mesh import PadMesh, pad_mesh
from synth.scene import Gel, Numerics, Scene

SHAPE = {"shape": "capsule", "radius_mm": 5.0, "thickness_mm": 2.0, "length_mm": 2.0, "youngs_modulus_kpa": 200.0}
SIZE = (10.0, 10.0, 7.0)
EDGE = 1.5


def capsule(gel: dict[str, Any] | None = None, **parts: Any) -> Scene:
    """A scene with a ball of 2 mm pressed on a capsule; parts: indenter, friction, motion, numerics as in a file."""
    motion = {"depth_mm": 0.5, "steps": 1, **parts.pop("motion", {})}
    content = {**pad_scene(SIZE, **parts).model_dump(), "motion": motion}
    numerics = {"edge_length_mm": EDGE, "element": "auto", **parts.get("numerics", {})}
    content["numerics"] = {**content["numerics"], **numerics}
    content["sensor"]["gel"] = {**SHAPE, **(gel or {})}
    if "indenter" not in parts:
        content["contact"]["indenter"] = {"shape": "sphere", "radius_mm": 2.0}
    return Scene.model_validate(content)


@functools.cache
def capsule_mesh(gel: Gel, edge_mm: float = EDGE) -> PadMesh:
    return pad_mesh(gel, Numerics(edge_length_mm=edge_mm), [home() / "capsules"])
