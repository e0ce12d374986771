"""The main job, as `python -m synth generate` does it on this machine: pairs a second, and what they are limited by.

Run it before and after any change of rendering, flow, solver or pipeline. A run makes N pairs of a scene without a
setting; the first hundred (or a tenth, if that is fewer) are start-up. Its row joins those of earlier runs in the
table, so that a loss is seen at once. "cores_limit" is the rate at which the cores would make pairs if they did nothing
but what the stages' own clocks count, and never waited; simulation in batches is not counted there. "states_per_second"
are recorded load steps.
"""

import json
import subprocess
import tempfile
import time
from datetime import date
from pathlib import Path
from threading import Event, Thread

import numpy as np

from benchmarks.rows import Row, arguments, machine, read, show, write
from benchmarks.scale import STAGES, at_size
from synth.cli_options import DEFAULT_SCENE
from synth.dataset.manifest import MANIFEST_FILE
from synth.pipeline.generate import Scheduling, generate
from synth.pipeline.worker_pool import cores
from synth.planning import job_variant, plan
from synth.scene.template import Template

TABLE = Path("docs/reports/throughput.csv")


def main(argv: list[str]) -> int:
    """Measure the scene once at each size, and show all rows of the table."""
    parser = arguments("throughput", __doc__)
    parser.add_argument("--scene", default=DEFAULT_SCENE, help="name or TOML file")
    parser.add_argument("--n", type=int, default=1000, help="pairs of a run")
    parser.add_argument("--devices", type=int, default=1, help="GPUs")
    parser.add_argument("--size", action="append", default=[], help="WIDTHxHEIGHT; default the scene's own")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="changes of the scene")
    parser.add_argument("--table", type=Path, default=TABLE, help="CSV file of all runs")
    parser.add_argument("--label", default="", help="what is measured, such as a commit")
    given = parser.parse_args(argv)
    rows = read(given.table)
    own = at_size(given.scene, given.set, 320, 240).corners[0].sensor.camera
    for text in given.size or [f"{own.width}x{own.height}"]:
        width, height = map(int, text.split("x"))
        device = _gpu("name") or f"{cores()} cores"
        case = {"date": date.today().isoformat(), "label": given.label, "device": device, "scene": given.scene}
        template = at_size(given.scene, given.set, width, height)
        rows.append({**case, "size": text, "changes": " ".join(given.set), **run(template, given.n, given.devices)})
        write(given.table, rows)
    print(machine())
    show(rows, [key for key in rows[-1] if key not in ("date", "changes")], "Runs, newest last")
    return 0


def run(template: Template, n: int, devices: int) -> Row:
    """Make n pairs by default settings; rates, and seconds a pair of each stage."""
    variant = job_variant(template, "auto")
    times: list[tuple[int, float]] = []
    busy: list[float] = []
    ended, started = Event(), time.perf_counter()
    watch = Thread(target=_watch, args=(busy, ended), daemon=True)
    watch.start()
    with tempfile.TemporaryDirectory(prefix="throughput-") as folder:
        generate(
            template, n, Path(folder) / "pairs", 0, variant,
            Scheduling(devices=devices), progress=lambda done, _: times.append((done, time.perf_counter() - started)),
        )  # fmt: skip
        entries = [json.loads(line) for line in (Path(folder) / "pairs" / MANIFEST_FILE).read_text().splitlines()]
    ended.set()
    done, seconds = np.array(times).T
    first = int(np.searchsorted(done, min(100, n // 10)))
    rate = (done[-1] - done[first]) / (seconds[-1] - seconds[first])
    counted = entries[int(done[first]) :]
    stages = {f"{stage}_s": float(np.mean([entry["seconds"][stage] for entry in counted])) for stage in STAGES}
    batched = plan(template, variant).is_batched
    core_s = sum(value for stage, value in stages.items() if not (batched and stage == "simulate_s"))
    limit = cores() / core_s
    sampling = template.sampling
    per_pair = template.corners[0].motion.steps / sampling.pairs_per_trajectory
    return {
        "variant": variant.name,
        "pairs": n,
        "first_s": float(seconds[0]),
        "total_s": float(seconds[-1]),
        "pairs_per_second": float(rate),
        "states_per_second": float(rate * per_pair),
        "devices": devices,
        "cores": cores(),
        "cores_limit": float(limit),
        "share_of_limit": float(rate / limit),
        "gpu_busy": float(np.mean(busy[len(busy) // 3 :])) if busy else None,
        **stages,
    }


def _watch(busy: list[float], ended: Event) -> None:
    """Shares of half seconds in which a GPU was busy, as long as there is one."""
    while not ended.wait(0.5):
        share = _gpu("utilization.gpu")
        if not share:
            return
        busy.append(float(share) / 100)


def _gpu(query: str) -> str:
    """What NVIDIA's tool says of the first GPU; empty where there is none."""
    command = ["nvidia-smi", f"--query-gpu={query}", "--format=csv,noheader,nounits"]
    try:
        return subprocess.run(command, capture_output=True, check=True, text=True).stdout.splitlines()[0].strip()
    except (OSError, subprocess.CalledProcessError, IndexError):
        return ""
