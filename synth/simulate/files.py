"""A trajectory on disk: trajectory.json and a surface mesh (VTU) per state."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from synth.mesh import PadMesh
from synth.scene import Scene
from synth.simulate.trajectory import Trajectory


def write_trajectory(directory: Path, scene: Scene, mesh: PadMesh, trajectory: Trajectory) -> dict[str, Any]:
    """Write DIR/trajectory.json and DIR/state_000.vtu and so on; returns the JSON's content.

    The VTU files hold the deformed contact surface with the fields displacement (mm) and traction (MPa).
    """
    import pyvista as pv

    directory.mkdir(parents=True, exist_ok=True)
    faces = mesh.contact_faces
    cells = np.column_stack([np.full(len(faces.faces), 3), faces.faces]).ravel()
    types = np.full(len(faces.faces), pv.CellType.TRIANGLE)
    for number, state in enumerate(trajectory.states):
        displacement = state.displacement[mesh.contact_nodes]
        grid = pv.UnstructuredGrid(cells, types, faces.nodes + displacement)
        grid.point_data["displacement"] = displacement
        grid.point_data["traction"] = state.traction
        grid.save(directory / f"state_{number:03d}.vtu")
    record = {
        "scene": scene.model_dump(mode="json"),
        "mesh": mesh.hash,
        "steps": [state.summary() for state in trajectory.states],
        "status": trajectory.status,
        "reason": trajectory.reason,
        "seconds": trajectory.seconds,
    }
    aside = directory / ".trajectory.json"
    aside.write_text(json.dumps(record, indent=1), encoding="utf-8")
    aside.replace(directory / "trajectory.json")
    return record
