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

from synth.arrays import Points
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.mesh.tetrahedralise import shape_quality
from synth.press.press import MeshRule
from synth.scene import Scene
from synth.scene.template import load_scene
from synth.simulate import Trajectory, simulate
from synth.simulate.options import SolverOptions
from synth.stress.cases import Case, Run, SurfaceVariant

NEAR = 1e-5
"""Distance of a sliver triangle's third corner from its opposite edge, relative to that edge."""
RADIUS_MM = 3.0


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


def write_surface(variant: SurfaceVariant, path: Path) -> None:
    """A ball as a file of triangles (PLY), as it should be or with one thing wrong; or a pane that stands upright."""
    import pyvista as pv

    ball = pv.Icosphere(radius=RADIUS_MM, nsub=3)
    points, faces = np.asarray(ball.points, dtype=np.float64), ball.regular_faces.copy()
    match variant:
        case "inside out":
            faces = faces[:, ::-1]
        case "mixed":
            faces[::3] = faces[::3, ::-1]
        case "slivers":
            points, faces = _slivers(points, faces)
        case "open":
            faces = faces[7:]
        case "metres":
            points = points / 1000
        case "pane":
            box = pv.Box((-3.0, 3.0, -0.03, 0.03, -2.0, 2.0)).triangulate()
            points, faces = np.asarray(box.points, dtype=np.float64), box.regular_faces
    pv.PolyData.from_regular_faces(points, faces).save(path, recompute_normals=False)  # which would turn them back


def _slivers(points: Points, faces: np.ndarray) -> tuple[Points, np.ndarray]:
    """Split every tenth triangle from a point within it, NEAR its first edge."""
    split = np.arange(0, len(faces), 10)
    a, b, c = faces[split].T
    added = len(points) + np.arange(len(split))
    inside = (1 - NEAR) * (points[a] + points[b]) / 2 + NEAR * points[c]
    parts = [np.column_stack(part) for part in ((a, b, added), (b, c, added), (c, a, added))]
    return np.concatenate([points, inside]), np.concatenate([np.delete(faces, split, axis=0), *parts])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
