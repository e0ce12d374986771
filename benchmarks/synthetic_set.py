"""Generates the test set of docs/reports/gelflow.md: 20 pairs of every shipped scene, from 5 trajectories each.

Every trajectory has a sensor of its own; all but the main camera are left out and the contact channel is written.
Meshes are those of a target error of 1 px, coarser than most scenes ask for: the flow is exact for the surface that was
rendered, however coarse. Seed 77 is used nowhere else. Further options go to `synth generate`. Run again, it goes on.
"""

from pathlib import Path

from benchmarks.rows import arguments
from synth.cli import main as synth
from synth.scene.template import shipped_scenes

CHANGES = (
    "sampling.pairs_per_trajectory=4", "sampling.trajectories_per_sensor=1", "numerics.target_error_px=1.0",
    "outputs.contact=true", "sensor.further_cameras=[]",
)  # fmt: skip


def main(argv: list[str]) -> int:
    """Generate, or go on; the largest exit status of the scenes."""
    parser = arguments("synthetic_set", __doc__)
    parser.set_defaults(out=Path("data/test"))
    given, further = parser.parse_known_args(argv)
    status = 0
    for scene in shipped_scenes():
        command = ["generate", "--scene", scene, "--n", "20", "--seed", "77", "--out", str(given.out / scene)]
        changes = [part for change in CHANGES for part in ("--set", change)]
        status = max(status, synth([*command, *changes, *further]))
    return status
