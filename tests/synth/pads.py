"""Small pads and scenes for the tests of mesh and simulation.

`brick` is a structured box whose mesh is its own mirror image in x and in y, so that symmetry can be tested to
rounding, and free of the mesher's randomness.
"""

from itertools import permutations
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.mesh import PadMesh
from synth.mesh.pad import signed_volumes
from synth.scene import Scene
from synth.simulate.contact import Indenters
from synth.simulate.element import p1p1
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path
from synth.simulate.stepping import _indenters
from synth.simulate.system import System

SIZE = (8.0, 6.0, 4.0)
SPHERE = {"shape": "sphere", "radius_mm": 3.0}


def brick(size: tuple[float, float, float] = SIZE, counts: tuple[int, int, int] = (4, 4, 3)) -> PadMesh:
    """Box of counts cells, six tetrahedra each (Kuhn), every other cell mirrored; even counts give a symmetric mesh."""
    axes = [
        np.linspace(-size[0] / 2, size[0] / 2, counts[0] + 1),
        np.linspace(-size[1] / 2, size[1] / 2, counts[1] + 1),
    ]
    axes.append(np.linspace(0.0, size[2], counts[2] + 1))
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    cell = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for order in permutations(range(3)):
        corner, way = np.zeros(3, int), [np.zeros(3, int)]
        for axis in order:
            corner = corner + np.eye(3, dtype=int)[axis]
            way.append(corner)
        grid = [cell + np.where(cell % 2 == 1, 1 - step, step) for step in way]
        tets.append(np.stack([(g[:, 0] * (counts[1] + 1) + g[:, 1]) * (counts[2] + 1) + g[:, 2] for g in grid], axis=1))
    joined = np.concatenate(tets).astype(np.int32)
    flipped = signed_volumes(points, joined) < 0
    joined[flipped] = joined[flipped][:, [0, 2, 1, 3]]
    return PadMesh(points, joined, size)


def crooked(size: tuple[float, float, float] = (3.0, 2.0, 2.0), seed: int = 0) -> PadMesh:
    """A small brick whose nodes are moved within their faces at random, for tests that symmetry must not help."""
    straight = brick(size, (3, 2, 2))
    half = np.array([size[0] / 2, size[1] / 2])
    low, high = np.array([-half[0], -half[1], 0.0]), np.array([half[0], half[1], size[2]])
    move = 0.12 * np.random.default_rng(seed).standard_normal(straight.points.shape)
    move[(straight.points == low) | (straight.points == high)] = 0.0
    mesh = PadMesh(straight.points + move, straight.tets, size)
    assert mesh.volumes.min() > 0
    return mesh


def scene(size: tuple[float, float, float] = SIZE, **parts: Any) -> Scene:
    """A scene of a bare pad. parts: gel, indenter, friction, motion, numerics as in a scene file."""
    return Scene.model_validate(
        {
            "name": "pad",
            "sensor": {
                "gel": {"size_mm": size, "youngs_modulus_kpa": 200.0, "poisson_ratio": 0.4999, **parts.get("gel", {})},
                "pattern": {"kind": "none"},
                "lights": [{"position_mm": [0, 0, 0.1], "size_mm": [1, 1], "color": [1, 1, 1], "power": 1}],
                "camera": {
                    "width": 16, "height": 16, "fx": 9, "fy": 9, "cx": 8, "cy": 8, "position_mm": [0, 0, 90],
                },
            },
            "contact": {"indenter": parts.get("indenter", SPHERE), "friction": parts.get("friction", 0.0)},
            "motion": {"depth_mm": 0.5, "steps": 1, **parts.get("motion", {})},
            "numerics": {"edge_length_mm": min(size) / 4, **parts.get("numerics", {})},
        }
    )  # fmt: skip


def system(
    mesh: PadMesh, poisson_ratio: float, symmetric: bool = True, batch: int = 1, penalty: float = 50.0
) -> System:
    """The discrete system of a pad of E = 1."""
    return System(mesh, poisson_ratio, batch=batch, symmetric=symmetric, penalty=penalty, element=p1p1())


def indenters(posed: Scene, at: float, batch: int = 1) -> Indenters:
    """The kernels' view of a scene's indenter at a path length (mm), the same for every sample of a batch."""
    path = Path(posed.motion, rigid_body(posed.contact.indenter))
    packed = _indenters([path] * batch, [posed.contact.friction] * batch, "cpu")
    pose = path.pose(at)
    packed.centre.assign(np.tile(pose.centre, (batch, 1)))
    packed.rotation.assign(np.tile(pose.rotation, (batch, 1, 1)))
    return packed


def far_away() -> Indenters:
    """An indenter that touches nothing."""
    return indenters(scene(motion={"depth_mm": -40.0}), 0.0)


def everything(system: System) -> FloatArray:
    """(1,) all samples active."""
    return np.ones(system.batch, dtype=bool)
