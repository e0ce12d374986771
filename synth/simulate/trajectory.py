"""What a simulation returns, and how it is kept on disk: trajectory.json and a surface mesh (VTU) per state."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from synth.arrays import FloatArray
from synth.dataset.atomic_files import replace_file, storage_errors
from synth.press.load_path import LoadPath, Pose
from synth.scene import Scene
from synth.simulate.contact_patch import ContactPatch
from synth.simulate.policy.requests import Record
from synth.simulate.space import Space

Loads = tuple[FloatArray, FloatArray, FloatArray]
"""Force (3,) and moment about the frame's origin (3,) of the indenter on the gel, and tractions (s, 3)."""


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
        min_jacobian: smallest det F at any quadrature point or sample point (`synth.simulate.inversion_barrier`).
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

    @classmethod
    def of(
        cls, record: Record, pose: Pose, displacement: FloatArray, loads: Loads, modulus_mpa: float, slip_ratio: float
    ) -> "State":
        """A state that the policy has recorded, from its displacement and its loads in units of Young's modulus."""
        force, torque, traction = (modulus_mpa * load for load in loads)
        return cls(
            depth_mm=pose.depth_mm,
            shear_mm=pose.shear_mm,
            twist_deg=pose.twist_deg,
            displacement=displacement,
            traction=traction,
            force_n=_triple(force),
            torque_nmm=_triple(torque),
            newton_iterations=record.iterations,
            residual=record.evaluation.relative,
            min_jacobian=record.evaluation.smallest_jacobian,
            max_penetration_mm=record.evaluation.deepest_mm,
            slip_ratio=slip_ratio,
        )

    def summary(self) -> dict[str, Any]:
        """The state without its fields, as trajectory.json has it."""
        numbers = {name: value for name, value in vars(self).items() if name not in ("displacement", "traction")}
        return {**numbers, "converged": True}


def _triple(values: FloatArray) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def at_rest(path: LoadPath, space: Space) -> list[State]:
    """The undeformed state at the start of a load path, and of one that never touches at its recorded places."""
    zero, places = (0.0, 0.0, 0.0), [] if path.may_touch else path.records().tolist()
    fields = np.zeros((len(space.points), 3)), np.zeros((len(space.surface_nodes), 3))
    poses = [path.pose(place) for place in (0.0, *places)]
    return [
        State(pose.depth_mm, pose.shear_mm, pose.twist_deg, *fields, zero, zero, 0, 0.0, 1.0, 0.0, 0.0)
        for pose in poses
    ]


@dataclass(frozen=True)
class Trajectory:
    """Converged states only, the undeformed one first.

    `reason` says why it ended early; empty where it has every state asked for. `space` tells where the displacements
    are.
    """

    states: tuple[State, ...]
    reason: str
    seconds: float
    space: Space

    @property
    def status(self) -> Literal["complete", "partial", "failed"]:
        """Partial: the first states, up to the last good one; failed: none after the undeformed one."""
        return "complete" if not self.reason else "partial" if len(self.states) > 1 else "failed"


def no_contact(depth_mm: float) -> str:
    """Why a trajectory ends whose indenter, at the end of its press, bears on nothing."""
    return (
        f"pressed {depth_mm:.3g} mm deep, the indenter touches no contact point that supports it: it is too "
        "small for the mesh or for the steps; lower numerics.target_error_px or edge_length_mm, or max_step_mm"
    )


def not_converged(beyond_mm: float, pose: Pose) -> str:
    """Why a trajectory ends so far before a place that Newton's method does not reach."""
    return (
        f"Newton's method did not converge {beyond_mm:.2g} mm beyond depth {pose.depth_mm:.3g} mm, "
        f"shear {np.hypot(*pose.shear_mm):.3g} mm, twist {pose.twist_deg:.3g} deg"
    )


def too_deep(pose: Pose, share: float) -> str:
    """Why a trajectory ends whose gel stays further inside the indenter than this share of the press depth."""
    return (
        f"at depth {pose.depth_mm:.3g} mm the gel stays inside the indenter by more than {share:.0%} of the depth: "
        "keep it off held rims, lower numerics.target_error_px or edge_length_mm, or raise numerics.penalty"
    )


def write_trajectory(directory: Path, scene: Scene, path: LoadPath, trajectory: Trajectory) -> dict[str, Any]:
    """Write DIR/trajectory.json and DIR/state_000.vtu and so on, in the place of an earlier trajectory's.

    The VTU files hold the deformed contact surface with the fields displacement (mm) and traction (MPa), and the mesh's
    hash as the field datum "mesh". On round gels shear_mm lies in the tangent plane at the place of the press, and
    force_n and torque_nmm are in the sensor's frame. contact_area_mm2 is of the deformed contact face, see
    `synth.simulate.contact_patch`. Returns the JSON's content.
    """
    space, states = trajectory.space, trajectory.states
    touching = [
        ContactPatch.of(space.surface, state.displacement[space.surface_nodes], path, number, state.max_penetration_mm)
        for number, state in enumerate(states)
    ]
    record = {
        "scene": scene.model_dump(mode="json"),
        "steps": [
            {**state.summary(), "contact_area_mm2": patch.area_mm2}
            for state, patch in zip(states, touching, strict=True)
        ],
        "status": trajectory.status,
        "reason": trajectory.reason,
        "seconds": trajectory.seconds,
    }
    with storage_errors(directory):
        directory.mkdir(parents=True, exist_ok=True)
        (directory / "trajectory.json").unlink(missing_ok=True)  # while it is missing, the states are not complete
        for old in directory.glob("state_*.vtu"):
            old.unlink()
    for number, state in enumerate(trajectory.states):
        replace_file(directory / f"state_{number:03d}.vtu", _vtu(trajectory.space, state))
    replace_file(directory / "trajectory.json", json.dumps(record, indent=1).encode("utf-8"))
    return record


def _vtu(space: Space, state: State) -> bytes:
    import pyvista as pv
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    faces = space.surface
    count, corners = faces.faces.shape
    cells = np.column_stack([np.full(count, corners), faces.faces]).ravel()
    types = np.full(count, pv.CellType.QUADRATIC_TRIANGLE if faces.is_quadratic else pv.CellType.TRIANGLE)
    displacement = state.displacement[space.surface_nodes]
    grid = pv.UnstructuredGrid(cells, types, faces.nodes + displacement)
    grid.point_data["displacement"] = displacement
    grid.point_data["traction"] = state.traction
    grid.field_data["mesh"] = [space.mesh.hash]
    writer = vtkXMLUnstructuredGridWriter()  # to memory: VTK does not say when a disk is full
    writer.SetInputData(grid)
    writer.WriteToOutputStringOn()
    writer.Write()
    return str(writer.GetOutputString()).encode("ascii")
