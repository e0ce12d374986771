"""How many pairs does `generate` make in a second, by image size and worker processes, and where does the time go?

A run first makes one trajectory per worker, in which every process imports, compiles and reads ("startup_s", counted in
nothing else), then 2 n pairs. Instances of a scene come in a fixed order, so that the moment at which n of these are
there is the time of a run of n: "growth" is time(2 n) / time(n), and "work_growth" the same of the work that the
stages' own clocks counted, which differs from 2 as the random instances of the two halves do. Workers have one core
each. "other_s" is sampling the scene, meshing and scheduling.
"""

import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.rows import Row, arguments, machine, measure, plot, show
from synth.cli_options import DEFAULT_SCENE
from synth.dataset.manifest import MANIFEST_FILE
from synth.errors import InputError
from synth.pipeline.generate import Scheduling, generate
from synth.pipeline.worker_pool import cores
from synth.planning import job_variant
from synth.render.variant import Device
from synth.scene.template import Template, load_scene

JOBS = (5_000, 500_000, 50_000_000)
"""Numbers of pairs whose time and storage are extrapolated."""
STAGES = ("simulate", "render", "flow", "write")


def at_size(scene: str, assignments: Sequence[str], width: int, height: int) -> Template:
    """A scene with changes ("key=value") and its main camera's image in another size, the field of view kept.

    Raises:
        InputError: the scene or a change of it is wrong.
    """
    template = load_scene(scene, assignments)
    camera = template.corners[0].sensor.camera
    if (width, height) == (camera.width, camera.height):
        return template
    x, y = width / camera.width, height / camera.height
    changed = {"fx": camera.fx * x, "cx": camera.cx * x, "fy": camera.fy * y, "cy": camera.cy * y}
    changes = [*assignments, f"sensor.camera.width={width}", f"sensor.camera.height={height}"]
    return load_scene(scene, [*changes, *(f"sensor.camera.{name}={value:.6f}" for name, value in changed.items())])


def run(template: Template, n: int, workers: int, device: Device, seed: int, folder: Path) -> Row:
    """Make 2 n pairs in an empty folder, and say how long they took."""
    warm = workers * template.corners[0].sampling.pairs_per_trajectory
    times: dict[int, float] = {}
    started = time.perf_counter()

    def note(done: int, _: int) -> None:
        times[done] = time.perf_counter() - started

    variant = job_variant(template, device)
    generate(template, warm + 2 * n, folder, seed, variant, Scheduling(workers), note)
    files = [file for file in folder.rglob("*") if file.is_file() and file.parent.name != "meshes"]
    entries = [json.loads(line) for line in (folder / MANIFEST_FILE).read_bytes().splitlines()]
    size = sum(file.stat().st_size for file in files) / len(entries)
    return {"variant": variant.name, "bytes_per_pair": round(size), **rates(times, entries, warm, n)}


def rates(times: dict[int, float], entries: Sequence[dict[str, Any]], warm: int, n: int) -> Row:
    """Pairs per second and seconds per pair of each stage.

    Args:
        times: seconds from the start until so many pairs were finished.
        entries: of the manifest.
        warm: pairs that do not count.
        n: half of the pairs that do.
    """
    begin, end = min(done for done in times if done >= warm), max(times)
    half = min(done for done in times if done >= warm + n)
    seconds, first = times[end] - times[begin], times[half] - times[begin]

    def per_pair(last: int) -> dict[str, float]:
        counted = [entry["seconds"] for entry in entries if warm <= entry["index"] < last]
        return {stage: sum(one[stage] for one in counted) / len(counted) for stage in STAGES}

    stages = per_pair(end)
    return {
        "startup_s": times[begin],
        "pairs": end - begin,
        "seconds": seconds,
        "pairs_per_second": (end - begin) / seconds,
        "growth": 2 * (seconds / (end - begin)) / (first / (half - begin)),
        "work_growth": 2 * sum(stages.values()) / sum(per_pair(half).values()),
        **{f"{stage}_s": value for stage, value in stages.items()},
        "other_s": max(0.0, seconds / (end - begin) - sum(stages.values())),  # of one worker; several overlap
    }


def main(argv: list[str]) -> int:
    """Measure, or go on measuring."""
    parser = arguments("scale", __doc__)
    parser.add_argument("--scene", default=DEFAULT_SCENE, help="name or TOML file")
    parser.add_argument("--n", type=int, default=8, help="half of the pairs of each run")
    parser.add_argument(
        "--size", action="append", default=[], help="WIDTHxHEIGHT; default: the scene's own, and half of it"
    )
    parser.add_argument("--workers", type=int, action="append", default=[], help="default: 1, 2, 4 ... all cores")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto")
    parser.add_argument("--seed", type=int, default=0, help="of the pairs")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes of the scene")
    given = parser.parse_args(argv)
    camera = load_scene(given.scene, given.set).corners[0].sensor.camera
    sizes = [_size(text) for text in given.size] or [(camera.width // k, camera.height // k) for k in (2, 1)]
    counts = given.workers or [2**k for k in range(cores().bit_length())]
    if given.n < 1 or min(counts) < 1:
        raise InputError("--n and --workers: give whole numbers from 1 on")
    common = {"scene": given.scene, "changes": " ".join(given.set), "seed": given.seed, "n": given.n}
    cases = [{**common, "width": w, "height": h, "workers": count} for w, h in sizes for count in counts]

    def one(case: Row) -> Row:
        template = at_size(given.scene, given.set, case["width"], case["height"])
        with tempfile.TemporaryDirectory(prefix="scale-", dir=given.out) as folder:
            return run(template, given.n, case["workers"], given.device, given.seed, Path(folder) / "pairs")

    given.out.mkdir(parents=True, exist_ok=True)
    rows = measure(given.out / "scale.csv", cases, one)
    print(machine())
    times = [f"{stage}_s" for stage in (*STAGES, "other")]
    shown = ["width", "height", "workers", "pairs", "startup_s", "pairs_per_second", "growth", "work_growth"]
    show(rows, [*shown, *times], "Pairs per second, and seconds per pair of the stages, all workers together")
    best = max(rows, key=lambda row: (row["width"] * row["height"], row["pairs_per_second"]))
    larger = [
        {
            "pairs": pairs,
            "days": (best["startup_s"] + pairs / best["pairs_per_second"]) / 86400,
            "gigabytes": pairs * best["bytes_per_pair"] / 1e9,
        }
        for pairs in JOBS
    ]
    size = f"{best['width']} x {best['height']} px"
    show(larger, list(larger[0]), f"Extrapolated from {size} with {best['workers']} workers")
    plot(given.out / "scale.png", rows, x="workers", y="pairs_per_second", group="width")
    return 0


def _size(text: str) -> tuple[int, int]:
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdecimal() and int(part) >= 8 for part in parts):
        raise InputError(f"--size {text}: give WIDTHxHEIGHT in px, each from 8 on, such as 640x480")
    return int(parts[0]), int(parts[1])
