"""What a simulation returns."""

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from synth.arrays import FloatArray
from synth.simulate.load_path import Pose
from synth.simulate.space import Space


@dataclass(frozen=True)
class State:
    """One recorded, converged state of the gel.

    Attributes:
        depth_mm, shear_mm, twist_deg: the indenter's pose; on a round gel in the frame of the place, see
            `synth.scene.Motion`.
        displacement: (n, 3) float64 mm at all nodes of the trajectory's space.
        traction: (s, 3) float64 MPa on the gel at the space's surface nodes, per undeformed area.
        force_n, torque_nmm: of the indenter on the gel, in the sensor's frame; torque about its origin.
        residual: of the unknowns over the norm of the nodal forces.
        min_jacobian: smallest det F at any quadrature point.
        max_penetration_mm: deepest contact point inside the indenter.
        slip_ratio: of the touching area, the part that slipped in the last load step.
    """

    depth_mm: float
    shear_mm: tuple[float, float]
    twist_deg: float
    displacement: FloatArray
    traction: FloatArray
    force_n: tuple[float, float, float]
    torque_nmm: tuple[float, float, float]
    newton_iterations: int
    residual: float
    min_jacobian: float
    max_penetration_mm: float
    slip_ratio: float

    def summary(self) -> dict[str, Any]:
        """The state without its fields, as trajectory.json has it."""
        return {
            "depth_mm": self.depth_mm,
            "shear_mm": list(self.shear_mm),
            "twist_deg": self.twist_deg,
            "force_n": list(self.force_n),
            "torque_nmm": list(self.torque_nmm),
            "converged": True,
            "newton_iterations": self.newton_iterations,
            "residual": self.residual,
            "min_jacobian": self.min_jacobian,
            "max_penetration_mm": self.max_penetration_mm,
            "slip_ratio": self.slip_ratio,
        }


def undeformed(pose: Pose, space: Space) -> State:
    """The gel at rest, while the indenter is at a pose where it does not touch."""
    fields = np.zeros((len(space.points), 3)), np.zeros((len(space.surface_nodes), 3))
    zero = (0.0, 0.0, 0.0)
    return State(pose.depth_mm, pose.shear_mm, pose.twist_deg, *fields, zero, zero, 0, 0.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Trajectory:
    """Converged states only, the undeformed one first.

    status "complete": every state asked for; "partial": the first ones, up to the last good state; "failed": none after
    the undeformed one. `reason` says why when it is not complete. `space` tells where the displacements are.
    """

    states: tuple[State, ...]
    status: Literal["complete", "partial", "failed"]
    reason: str
    seconds: float
    space: Space


def trajectory_of(states: tuple[State, ...], reason: str, seconds: float, space: Space) -> Trajectory:
    """A trajectory that ended for a reason, or without one at its end."""
    status: Literal["complete", "partial", "failed"] = "partial" if len(states) > 1 else "failed"
    return Trajectory(states, status if reason else "complete", reason, seconds, space)


def no_contact(depth_mm: float) -> str:
    """Why a trajectory ends whose indenter, at the end of its press, bears on nothing."""
    return (
        f"pressed {depth_mm:.3g} mm deep, the indenter touches no contact point that bears it: it is too "
        "small for the mesh or for the steps; lower numerics.target_error_px or edge_length_mm, or max_step_mm"
    )


def not_converged(beyond_mm: float, pose: Pose) -> str:
    """Why a trajectory ends so far before a place that Newton's method does not reach."""
    return (
        f"Newton's method did not converge {beyond_mm:.2g} mm beyond depth {pose.depth_mm:.3g} mm, "
        f"shear {np.hypot(*pose.shear_mm):.3g} mm, twist {pose.twist_deg:.3g} deg"
    )


def too_deep(pose: Pose, share: float) -> str:
    """Why a trajectory ends whose indenter stays deeper inside the gel than this share of its depth."""
    return (
        f"at depth {pose.depth_mm:.3g} mm an edge stays inside the gel by more than {share:.0%} of the depth: lower "
        "numerics.target_error_px or edge_length_mm, or raise numerics.penalty"
    )
