"""Do objects as files have them press the gel, and how deep do they sink in?

    python -m benchmarks objects parts/*.stl --draws 5 --workers 8

Each file is pressed, sheared and twisted as the default scene draws it, in a random orientation, its longest edge
8 mm. A ball on the same mesh, moved in the same way, gives the time to compare with.

    python -m benchmarks objects parts/*.stl --draws 1 --forces

compares the forces of the presses alone with those on meshes of half the spacing, where edges have half the radius;
with --target 0.2 on meshes of a smaller error than the scene asks for.
"""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, arguments, measure, show
from synth.cli_options import DEFAULT_SCENE
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.scene import Scene, Sphere
from synth.scene.sampling import draw
from synth.scene.template import checked_template, load_scene
from synth.simulate import Trajectory, simulate
from synth.simulate.footprint import footprint
from synth.simulate.policy.multipliers import DEEP
from synth.simulate.press import MeshRule
from synth.simulate.resolution import MARGIN, graded_mesh
from synth.simulate.scene_path import path_of

SIZE_MM = 8.0
BALL = Sphere(shape="sphere", radius_mm=4.0)
NEAR = 0.05
"""Share by which half the spacing is to change a force at most."""


def scene_of(case: Row) -> tuple[Scene, Path]:
    """A draw of the default scene with an object, and the folder of its file, on which the draw does not depend."""
    file = Path(case["file"])
    content = load_scene(DEFAULT_SCENE, ["motion.steps=2"]).content
    indenter = {"shape": "mesh", "file": file.name, "size_mm": SIZE_MM, "rotation_deg": "any"}
    template = checked_template({**content, "contact": {**content["contact"], "indenter": indenter}}, file)
    scene = draw(template, case["seed"], 0)
    numerics = scene.numerics.model_copy(update={"target_error_px": case["target_px"]})
    return scene.model_copy(update={"numerics": numerics}), file.parent


def timed(scene: Scene, mesh: PadMesh, folder: Path) -> tuple[Trajectory, float, int]:
    """A simulation, its seconds of processor time, which other programs do not lengthen, and its iterations."""
    started = time.process_time()
    result = simulate(scene, mesh, folder)
    return result, time.process_time() - started, sum(state.newton_iterations for state in result.states)


def press(case: Row) -> Row:
    """One row of the table."""
    try:
        scene, folder = scene_of(case)
        ball = scene.model_copy(update={"contact": scene.contact.model_copy(update={"indenter": BALL})})
        mesh = MeshRule.of(scene).resolution(scene, folder).mesh
        simulate(ball, mesh, folder)  # analyses the mesh's matrices, which whatever is pressed first would pay for
        result, seconds, iterations = timed(scene, mesh, folder)
    except InputError as error:
        return {"status": "refused", "reason": str(error)}
    _, ball_seconds, ball_iterations = timed(ball, mesh, folder)
    return {
        "status": result.status,
        "reason": result.reason,
        "seconds": round(seconds, 2),
        "times_a_ball": round(seconds / ball_seconds, 2),
        "force_n": round(result.states[-1].force_n[2], 4),
        "iterations": iterations,
        "times_its_iterations": round(iterations / ball_iterations, 2),
        "penetration": round(max(state.max_penetration_mm for state in result.states) / scene.motion.depth_mm, 4),
    }


def force(case: Row) -> Row:
    """A row that compares the force of a press with that on a mesh of twice as many elements across the contact."""
    drawn, folder = scene_of(case)
    alone = drawn.motion.model_copy(update={"shear_mm": (0.0, 0.0), "twist_deg": 0.0, "steps": 1})
    scene = drawn.model_copy(update={"motion": alone})
    coarse = MeshRule.of(scene).resolution(scene, folder)
    gel = scene.sensor.gel
    fine, spacing = graded_mesh(gel, footprint(path_of(scene, folder), gel.size_mm, MARGIN), 2 * coarse.across)
    results = [simulate(scene, mesh, folder) for mesh in (coarse.mesh, fine)]
    if any(result.status != "complete" for result in results):
        return {"status": "incomplete"}
    forces = [result.states[-1].force_n[2] for result in results]
    found: Row = {"status": "complete", "error_px": round(coarse.error_px, 3)}
    found |= {"spacing_mm": round(coarse.spacing_mm, 3), "half_mm": round(spacing, 3)}
    found |= {"force_n": round(forces[0], 4), "half_force_n": round(forces[1], 4)}
    return found | {"change": round(abs(forces[0] / forces[1] - 1), 4)}


def changes(rows: Sequence[Row]) -> Row:
    """What the rows of `force` say."""
    found = np.array([row["change"] for row in rows if row["status"] == "complete"])
    if len(found) == 0:
        return {"compared": 0}
    row: Row = {"compared": len(found), "force changes, median": f"{np.median(found):.1%}"}
    return row | {"largest": f"{found.max():.1%}", f"at most {NEAR:.0%}": f"{np.mean(found <= NEAR):.0%}"}


def summary(rows: Sequence[Row]) -> Row:
    """What the rows say."""
    tried = [row for row in rows if row["status"] != "refused"]
    done = [row for row in tried if row["status"] == "complete"]
    found: Row = {"refused": len(rows) - len(tried), "pressed": len(tried), "complete": len(done)}
    if done:
        deep, slow = (np.array([row[name] for row in done]) for name in ("penetration", "times_a_ball"))
        found |= {"times a ball's time, median": float(np.median(slow)), "sunk in, median": f"{np.median(deep):.1%}"}
        found |= {"largest": f"{deep.max():.1%}", f"at most {DEEP:.0%}": f"{np.mean(deep <= DEEP):.1%}"}
    return found


def main(argv: list[str]) -> int:
    """Run the command line."""
    parser = arguments("objects", __doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=5, help="orientations of each file; default: 5")
    parser.add_argument("--workers", type=int, default=1, help="presses at once")
    parser.add_argument("--forces", action="store_true", help="compare forces with those on finer meshes, instead")
    parser.add_argument("--target", type=float, default=0.7, help="px of error asked for; default: the scene's, 0.7")
    given = parser.parse_args(argv)
    files, seeds, target = [str(path.resolve()) for path in given.files], range(given.draws), given.target
    cases: list[Row] = [{"file": file, "seed": seed, "target_px": target} for file in files for seed in seeds]
    if given.forces:
        found = changes(measure(given.out / "object_forces.csv", cases, force, given.workers))
        show([found], list(found))
        return 0
    rows = measure(given.out / "objects.csv", cases, press, given.workers)
    unlucky = [row for row in rows if row["status"] != "complete"]
    show(unlucky, ["file", "seed", "status", "reason"], "Presses that did not complete")
    found = summary(rows)
    show([found], list(found))
    return 0
