"""Do objects as files have them press the gel, and how deep do they sink in?

    python -m benchmarks.objects parts/*.stl --draws 5 --out objects.csv

Each file is pressed, sheared and twisted as the default scene draws it, in a random orientation, its longest edge
8 mm. A ball on the same mesh and the same way gives the time to compare with.
"""

import argparse
import csv
import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

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
    """A simulation and its seconds."""
    started = time.perf_counter()
    return simulate(scene, mesh), time.perf_counter() - started


def press(job: tuple[Path, int]) -> dict[str, Any]:
    """One row of the table."""
    path, seed = job
    row: dict[str, Any] = {"file": path.name, "seed": seed}
    try:
        scene = scene_of(f'{{ shape = "mesh", file = "{path}", size_mm = {SIZE_MM}, rotation_deg = "any" }}', seed)
        mesh = MeshRule.of(scene.numerics).resolution(scene).mesh
        result, seconds = timed(scene, mesh)
    except InputError as error:
        return {**row, "status": "refused", "reason": str(error)}
    pressed = result.states[1:]
    return {
        **row,
        "status": result.status,
        "reason": result.reason,
        "seconds": round(seconds, 2),
        "times_a_ball": round(seconds / timed(scene_of(BALL, seed), mesh)[1], 2),
        "force_n": round(result.states[-1].force_n[2], 4),
        "penetration": round(max((s.max_penetration_mm / s.depth_mm for s in pressed), default=0.0), 4),
    }


def summary(rows: list[dict[str, Any]]) -> str:
    """What the rows say."""
    tried = [row for row in rows if row["status"] != "refused"]
    done = [row for row in tried if row["status"] == "complete"]
    text = f"{len(rows) - len(tried)} refused; of {len(tried)} others {len(done)} complete"
    if done:
        deep, slow = (np.array([row[name] for row in done]) for name in ("penetration", "times_a_ball"))
        text += f"; median {np.median(slow):.1f} times a ball's time; sunk in by at most {DEEP:.0%}: "
        text += f"{np.mean(deep <= DEEP):.0%}, median {np.median(deep):.1%}, at most {deep.max():.1%}"
    return text


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.objects", description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--out", type=Path, default=Path("objects.csv"))
    given = parser.parse_args()
    jobs = list(product([path.resolve() for path in given.files], range(given.draws)))
    with ProcessPoolExecutor(given.workers) as pool:
        rows = list(pool.map(press, jobs))
    with given.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, sorted({name for row in rows for name in row}))
        writer.writeheader()
        writer.writerows(rows)
    print(summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
