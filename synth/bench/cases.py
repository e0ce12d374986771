"""The presses that the benchmark of the solver is about: one gel pad, one rigid ball, three ways of moving it."""

from dataclasses import dataclass
from functools import cached_property

from synth.mesh import Focus
from synth.scene import Gel, Motion, Pose, Sphere
from synth.simulate.footprint import footprint
from synth.simulate.indenter import rigid_body
from synth.simulate.path import Path
from synth.simulate.resolution import MARGIN

GEL = Gel(size_mm=(20.0, 15.0, 4.0), youngs_modulus_kpa=200.0, poisson_ratio=0.4999)
INDENTER = Sphere(shape="sphere", radius_mm=4.0)


@dataclass(frozen=True)
class Case:
    """One way of moving the ball.

    Attributes:
        name: of the case.
        motion: of the ball.
        friction: Coulomb's coefficient.
        judged: numbers of the recorded states, from 0, whose errors count.
        poses: what to call the recorded states.
    """

    name: str
    motion: Motion
    friction: float
    judged: tuple[int, ...]
    poses: tuple[str, ...]

    @cached_property
    def focus(self) -> Focus:
        """The zone of the contact face that local refinement resolves, as for any draw of a scene."""
        return footprint(Path(self.motion, rigid_body(INDENTER)), GEL.size_mm, MARGIN)


def _deeper(position: tuple[float, float]) -> Motion:
    return Motion(depth_mm=0.5, position_mm=position, steps=3, then=(Pose(depth_mm=1.2), Pose(depth_mm=2.0)))


DEPTHS = ("0.5 mm", "1.2 mm", "2.0 mm")
HELD = Case("held", _deeper((0.0, 0.0)), 0.0, (1, 2), DEPTHS)
OFF_CENTRE = Case("off-centre", _deeper((3.7, -2.3)), 0.0, (1, 2), DEPTHS)
SHEARED = Case(
    "sheared",
    Motion(
        depth_mm=1.2,
        position_mm=(1.3, -0.7),
        shear_mm=(1.0, 0.4),
        twist_deg=8.0,
        steps=3,
        then=(Pose(depth_mm=1.2, shear_mm=(-0.5, 0.4), twist_deg=-8.0),),
    ),
    0.5,
    (0, 1, 2),
    ("pressed", "sheared", "reversed"),
)
