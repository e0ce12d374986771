"""A scene that takes the whole chain about a second: a small pad, a coarse mesh, 32 x 24 pixels; all else is real."""

import atexit
import functools
import hashlib
import json
import os
import shutil
import tempfile
from pathlib import Path
from typing import Any

import pytest

from synth.pipeline.generate import generate, make_job
from synth.pipeline.records import JobContext
from synth.planning import job_variant, plan
from synth.scene.template import Template, load_scene

SENSOR = """
name = "tiny"
numerics = { element = "p1p1", edge_length_mm = 1.25 }
render = { samples_per_pixel = 4, max_depth = 2 }
[sensor]
gel = { size_mm = [8.0, 6.0, 2.5], youngs_modulus_kpa = { log_uniform = [100.0, 300.0] } }
window.thickness_mm = 3.0
pattern = { kind = "dots", spacing_mm = [1.0, 1.0], radius_mm = { uniform = [0.2, 0.3] } }
[sensor.camera]
width = 32
height = 24
fx = 82.0
fy = 82.0
cx = { normal = [16.0, 0.3] }
cy = 12.0
position_mm = [0.0, 0.0, 20.0]
read_noise = 0.002
"""
# Five lights: a scene whose lights came in another order every time would be the same by chance in 1 of 120 runs.
PLACES = {
    (3.8, 0.0): [1.0, 0.2, 0.2], (-3.8, 0.0): [0.2, 1.0, 0.2], (0.0, 2.9): [0.2, 0.2, 1.0],
    (0.0, -2.9): [1.0, 1.0, 0.2], (3.8, 2.9): [0.2, 1.0, 1.0],
}  # fmt: skip
LIGHTS = "".join(
    f"""
[[sensor.lights]]
position_mm = [{x}, {y}, 2.0]
size_mm = [0.3, 0.3]
color = {color}
power = {{ uniform = [90.0, 110.0] }}
"""
    for (x, y), color in PLACES.items()
)
CONTACT = """
[contact]
friction = { uniform = [0.3, 0.8] }
indenter = { shape = "sphere", radius_mm = { uniform = [1.5, 2.5] } }
[motion]
depth_mm = { uniform = [0.1, 0.3] }
position_mm = [{ uniform = [-1.0, 1.0] }, { uniform = [-1.0, 1.0] }]
shear_mm = [{ uniform = [-0.1, 0.1] }, 0.0]
steps = 2
[sampling]
pairs_per_trajectory = 2
trajectories_per_sensor = 2
"""
TEXT = SENSOR + LIGHTS + CONTACT


def write_tiny(folder: Path, text: str = TEXT) -> Path:
    path = folder / "tiny.toml"
    path.write_text(text)
    return path


def fingerprint(dataset: Path) -> dict[str, Any]:
    """SHA-256 of every file of a dataset by relative path; manifest lines less their seconds; no lock, no summary."""
    files = [f for f in sorted(dataset.rglob("*")) if f.is_file() and f.name not in (".lock", "summary.json")]
    found: dict[str, Any] = {str(f.relative_to(dataset)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files}
    lines = (dataset / "manifest.jsonl").read_text().splitlines()
    found["manifest.jsonl"] = [json.loads(line) | {"seconds": None} for line in lines]
    return found


@functools.cache
def home() -> Path:
    folder = Path(tempfile.mkdtemp(prefix="synth-tests-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


def own_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep meshes apart from the user's and share them within the session; Warp's kernels stay where they are."""
    kept = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    monkeypatch.setenv("WARP_CACHE_PATH", os.environ.get("WARP_CACHE_PATH") or str(kept / "warp"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(home() / "cache"))


@functools.cache
def reference() -> Path:
    """Five samples of the scene, seed 0, made in one go in this process; made once per session, after `own_cache`."""
    out = home() / "reference"
    generate(load_scene(write_tiny(home())), 5, out)
    return out


def job_context(template: Template, n: int, out: Path, seed: int = 0) -> JobContext:
    planned = plan(template, job_variant(template, "cpu"))
    return JobContext(planned, make_job(planned, n, seed), out, out / "cache")
