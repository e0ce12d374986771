"""Do objects as files have them press the gel, and how deep do they sink in?

    python -m benchmarks objects parts/*.stl --draws 5 --workers 8

Each file is pressed, sheared and twisted as the default scene draws it, in a random orientation, its longest edge
8 mm. A ball on the same mesh, moved in the same way, gives the time to compare with.
"""

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.rows import Row, arguments, measure, show
from synth.cli_options import DEFAULT_SCENE
from synth.errors import InputError
from synth.mesh import PadMesh
from synth.scene import Scene
from synth.scene.sampling import draw
from synth.scene.template import load_scene
from synth.simulate import Trajectory, simulate
from synth.simulate.mesh_rule import MeshRule

SIZE_MM = 8.0
BALL = '{ shape = "sphere", radius_mm = 4.0 }'
DEEP = 0.02
"""Share of the depth by which edges are to sink in at most."""


def scene_of(indenter: str, seed: int) -> Scene:
    """A draw of the default scene with another indenter."""
    return draw(load_scene(DEFAULT_SCENE, [f"contact.indenter={indenter}", "motion.steps=2"]), seed, 0)


def timed(scene: Scene, mesh: PadMesh) -> tuple[Trajectory, float]:
    """A simulation and its seconds of processor time, which other programs on the machine do not lengthen."""
    started = time.process_time()
    return simulate(scene, mesh), time.process_time() - started


def press(case: Row) -> Row:
    """One row of the table."""
    seed = case["seed"]
    try:
        file = f'shape = "mesh", file = "{case["file"]}", size_mm = {SIZE_MM}, rotation_deg = "any"'
        scene = scene_of(f"{{ {file} }}", seed)
        mesh = MeshRule.of(scene).resolution(scene).mesh
        result, seconds = timed(scene, mesh)
    except InputError as error:
        return {"status": "refused", "reason": str(error)}
    pressed = result.states[1:]
    return {
        "status": result.status,
        "reason": result.reason,
        "seconds": round(seconds, 2),
        "times_a_ball": round(seconds / timed(scene_of(BALL, seed), mesh)[1], 2),
        "force_n": round(result.states[-1].force_n[2], 4),
        "penetration": round(max((s.max_penetration_mm / s.depth_mm for s in pressed), default=0.0), 4),
    }


def summary(rows: Sequence[Row]) -> Row:
    """What the rows say."""
    tried = [row for row in rows if row["status"] != "refused"]
    done = [row for row in tried if row["status"] == "complete"]
    found: Row = {"refused": len(rows) - len(tried), "pressed": len(tried), "complete": len(done)}
    if done:
        deep, slow = (np.array([row[name] for row in done]) for name in ("penetration", "times_a_ball"))
        found |= {"times a ball's time, median": float(np.median(slow)), "sunk in, median": f"{np.median(deep):.1%}"}
        found |= {"largest": f"{deep.max():.1%}", f"at most {DEEP:.0%}": f"{np.mean(deep <= DEEP):.0%}"}
    return found


def main(argv: list[str]) -> int:
    """Run the command line."""
    parser = arguments("objects", __doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=5, help="orientations of each file; default: 5")
    parser.add_argument("--workers", type=int, default=1, help="presses at once")
    given = parser.parse_args(argv)
    cases = [{"file": str(path.resolve()), "seed": seed} for path in given.files for seed in range(given.draws)]
    rows = measure(given.out / "objects.csv", cases, press, given.workers)
    unlucky = [row for row in rows if row["status"] != "complete"]
    show(unlucky, ["file", "seed", "status", "reason"], "Presses that did not complete")
    found = summary(rows)
    show([found], list(found))
    return 0
