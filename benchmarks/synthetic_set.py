"""Generates the test set of docs/reports/gelflow.md: pairs of every shipped scene, as `generate` makes them.

There are 20 of the default scene and 10 of each other. Every trajectory has a sensor of its own; all but the main
camera are left out and the contact channel is written. Seed 77 is used nowhere else. Further options go to `synth
generate`. Run again, it goes on.
"""

from pathlib import Path

from benchmarks.rows import arguments
from synth.cli import main as synth
from synth.cli_options import DEFAULT_SCENE
from synth.scene.template import shipped_scenes

CHANGES = ("sampling.trajectories_per_sensor=1", "outputs.contact=true", "sensor.further_cameras=[]")


def main(argv: list[str]) -> int:
    """Generate, or go on; the largest exit status of the scenes."""
    parser = arguments("synthetic_set", __doc__)
    parser.set_defaults(out=Path("data/test"))
    given, further = parser.parse_known_args(argv)
    status = 0
    for scene in shipped_scenes():
        count = "20" if scene == DEFAULT_SCENE else "10"
        command = ["generate", "--scene", scene, "--n", count, "--seed", "77", "--out", str(given.out / scene)]
        changes = [part for change in CHANGES for part in ("--set", change)]
        status = max(status, synth([*command, *changes, *further]))
    return status
