"""Hashes and times of what the programs make, to be compared before and after a change that must not show.

    python .ci/fingerprint.py > before.json;  python .ci/fingerprint.py before.json

The second form prints what differs and ends with 1. Only the command line is used. Bits are comparable on one machine.
"""

import hashlib
import json
import subprocess
import sys
import tempfile
import time
import tomllib
from pathlib import Path
from typing import Any

from safetensors.numpy import load_file

ROOT = Path(__file__).parents[1]
WIDTH = 96


def inline(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {inline(entry)}" for key, entry in value.items()) + " }"
    return "[" + ", ".join(map(inline, value)) + "]" if isinstance(value, list) else json.dumps(value)


def scaled(value: Any, factor: float) -> Any:
    """A number, or a distribution of one."""
    if isinstance(value, dict):
        return {key: [factor * number for number in numbers] for key, numbers in value.items()}
    return factor * value


def smaller(camera: dict[str, Any]) -> dict[str, Any]:
    """A camera whose image is WIDTH px wide."""
    factor = WIDTH / camera["width"]
    sizes = {key: round(factor * camera[key]) for key in ("width", "height")}
    return {**camera, **{key: scaled(camera[key], factor) for key in ("fx", "fy", "cx", "cy")}, **sizes}


def settings(scene: Path) -> list[str]:
    """`--set` options that make a scene's pictures small."""
    content = tomllib.loads(scene.read_text())
    camera = smaller(content["sensor"]["camera"])
    given = [f"sensor.camera.{key}={inline(camera[key])}" for key in ("width", "height", "fx", "fy", "cx", "cy")]
    if further := content["sensor"].get("further_cameras"):
        given.append(f"sensor.further_cameras={inline([smaller(entry) for entry in further])}")
    if content["render"].get("samples_per_pixel") != "auto":
        given.append("render.samples_per_pixel=4")
    return [word for setting in given for word in ("--set", setting)]


def run(*words: object) -> float:
    """Run a command to its end; its seconds."""
    started = time.perf_counter()
    subprocess.run([sys.executable, *map(str, words)], check=True, cwd=ROOT, stdout=sys.stderr, stderr=sys.stderr)
    return time.perf_counter() - started


def hashes(folder: Path, pattern: str) -> dict[str, str]:
    """SHA-256 of the files of a folder."""
    files = sorted(folder.glob(pattern))
    return {str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()[:16] for file in files}


def tensors_hash(file: Path) -> str:
    """SHA-256 of a file's tensors by name; what else a file of weights records differs from run to run."""
    digest = hashlib.sha256()
    for name, tensor in sorted(load_file(file).items()):
        digest.update(name.encode() + tensor.tobytes())
    return digest.hexdigest()[:16]


def measured(folder: Path) -> dict[str, Any]:
    """Everything, by name."""
    found: dict[str, Any] = {"seconds": {}}
    for scene in sorted((ROOT / "scenes").glob("*.toml")):
        name, small = scene.stem, settings(scene)
        out = folder / name
        found["seconds"][f"generate {name}"] = run(
            "-m", "synth", "generate", "--scene", name, "--n", 2, "--out", out, *small
        )
        found[name] = hashes(out, "samples/*/*.[ep][xn]*")
    mini, small = "gelsight_mini", settings(ROOT / "scenes/gelsight_mini.toml")
    command = ["-m", "synth", "generate", "--scene", mini, *small, "--seed", 7, "--n"]
    for n in (2, 6):  # the second goes on with the first
        run(*command, n, "--out", folder / "resumed")
    for k in range(2):
        run(*command, 6, "--out", folder / "sharded", "--shard", f"{k}/2")
    run(*command, 6, "--out", folder / "workers", "--workers", 2)
    run(*command, 6, "--out", folder / "ray", "--ray", "local")
    for name in ("resumed", "sharded", "workers", "ray"):
        found[name] = hashes(folder / name, "samples/*/*.[ep][xn]*")
    if not found["resumed"] == found["sharded"] == found["workers"] == found["ray"]:
        print("resumed, sharded, workers and ray differ", file=sys.stderr)
    out = folder / "simulated"
    found["seconds"]["simulate"] = run("-m", "synth", "simulate", "--scene", mini, "--seed", 1, "--out", out)
    steps = json.loads((out / "trajectory.json").read_text())["steps"]
    found["trajectory"] = hashlib.sha256(json.dumps(steps).encode()).hexdigest()[:16]
    out = folder / "trained"
    found["seconds"]["train"] = run(
        "-m", "gelflow", "train", folder / "resumed", "--validation", folder / "resumed", "--out", out, "--steps", 4,
        "--config", ROOT / "docs/short_run.toml", "--set", "warmup_steps=1", "--set", "crop_size=[64, 64]",
    )  # fmt: skip
    found["weights"] = tensors_hash(out / "weights.safetensors")
    return found


def main() -> int:
    """Measure; compare with an earlier measurement where its file is given."""
    with tempfile.TemporaryDirectory() as folder:
        found = measured(Path(folder))
    if len(sys.argv) < 2:
        print(json.dumps(found, indent=1))
        return 0
    before = json.loads(Path(sys.argv[1]).read_text())
    for name, seconds in found.pop("seconds").items():
        print(f"{name}: {seconds:.1f} s, before {before['seconds'].get(name, float('nan')):.1f} s")
    differing = [name for name, value in found.items() if value != before.get(name)]
    print("differ: " + (", ".join(differing) or "none"))
    return int(bool(differing))


if __name__ == "__main__":
    sys.exit(main())
