"""A trajectory on disk: trajectory.json and a surface mesh (VTU) per state."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from synth.dataset.storage import replace_file, storage_errors
from synth.scene import Scene
from synth.simulate.space import Space
from synth.simulate.trajectory import State, Trajectory


def write_trajectory(directory: Path, scene: Scene, trajectory: Trajectory) -> dict[str, Any]:
    """Write DIR/trajectory.json and DIR/state_000.vtu and so on, in the place of an earlier trajectory's.

    The VTU files hold the deformed contact surface with the fields displacement (mm) and traction (MPa), and the mesh's
    hash as the field datum "mesh". On round gels shear_mm lies in the tangent plane at the place of the press, and
    force_n and torque_nmm are in the sensor's frame. Returns the JSON's content.
    """
    record = {
        "scene": scene.model_dump(mode="json"),
        "steps": [state.summary() for state in trajectory.states],
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
    """The contact surface of a state as a VTK XML file."""
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
