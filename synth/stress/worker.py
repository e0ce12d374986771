"""One run in a process of its own: `python -m synth.stress.worker FOLDER MESHES`.

FOLDER holds run.json; result.json and states.npz are written there when the run ends by itself. Nothing is caught here
but what the stages promise (InputError), so anything else shows as a traceback and an exit status.
"""

import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from synth.errors import InputError
from synth.mesh import PadMesh
from synth.mesh.tetrahedralise import shape_quality
from synth.scene import Scene
from synth.scene.template import load_scene
from synth.simulate import Trajectory, simulate
from synth.simulate.mesh_rule import MeshRule
from synth.simulate.options import SolverOptions
from synth.stress.cases import Case, Run
from synth.stress.inputs import altered_mesh, write_surface


def main(arguments: Sequence[str]) -> int:
    folder, meshes = Path(arguments[0]), Path(arguments[1])
    asked = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    run = Run(Case.model_validate(asked["case"]), asked["element"], asked["budget_s"], Path(asked["base"]))
    try:
        scene, mesh, trajectory = simulated(run, folder, meshes)
        record = saved(scene, mesh, trajectory, folder)
    except InputError as error:
        record = {"outcome": "refused", "message": _without_folders(str(error), folder, run.base)}
    (folder / "result.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
    return 0


def simulated(run: Run, folder: Path, meshes: Path) -> tuple[Scene, PadMesh, Trajectory]:
    """Load, mesh and simulate a run's scene, as `synth simulate` does; InputError where one of the stages refuses."""
    assignments = run.assignments
    if run.case.surface is not None:
        file = folder.resolve() / "indenter.ply"
        write_surface(run.case.surface, file)
        assignments = [*assignments, f"contact.indenter={{ shape = 'mesh', file = '{file}' }}"]
    template = load_scene(run.base, assignments)
    scene = template.corners[0]  # no distributions: all corners are the same
    mesh = MeshRule.of(scene).resolution(scene, folder, [meshes]).mesh
    if run.case.mesh != "as made":
        mesh = altered_mesh(mesh, run.case.mesh)
    options = SolverOptions(single_precision=run.case.factor == "single")
    return scene, mesh, simulate(scene, mesh, folder, options=options)


def saved(scene: Scene, mesh: PadMesh, trajectory: Trajectory, folder: Path) -> dict[str, Any]:
    """Write the states' fields; return everything else, JSON-able."""
    space = trajectory.space
    np.savez_compressed(
        folder / "states.npz",
        displacement=np.array([state.displacement for state in trajectory.states]),
        traction=np.array([state.traction for state in trajectory.states]),
        points=space.points,
        nodes=space.nodes,
    )
    return {
        "outcome": trajectory.status,
        "message": trajectory.reason,
        "seconds": trajectory.seconds,
        "states": [state.summary() for state in trajectory.states],
        "states_asked": scene.motion.steps + 1,
        "tolerance": scene.numerics.tolerance,
        "mesh": mesh.hash,
        "nodes": len(mesh.points),
        "tetrahedra": len(mesh.tets),
        "worst_shape": float(shape_quality(mesh.points, mesh.tets).min()),
    }


def _without_folders(message: str, *places: Path) -> str:
    """File names alone: a report is read on other machines."""
    for place in places:
        folder = place.resolve() if place.is_dir() else place.resolve().parent
        message = message.replace(f"{folder}{os.sep}", "")
    return message


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
