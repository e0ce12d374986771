"""Who may import whom, what stays unloaded, and how long a file may be."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_scene import own_cache, write_tiny

ROOT = Path(__file__).parents[2]
STAGES = (
    "synth",  # the package itself: its version, and where its public names are, which it loads when they are asked for
    "synth.errors", "synth.arrays", "synth.untrusted",
    "synth.warp_start",
    "synth.dataset.atomic_files",  # how a file gets to the disk as a whole; knows nothing of datasets
    "synth.scene", "synth.surface", "synth.optics", "synth.mesh", "synth.press", "synth.simulate", "synth.flow",
    "synth.render",
    "synth.sampling",  # draws again what could not be rendered
    "synth.dataset", "synth.verify", "synth.inspect", "synth.planning", "synth.pipeline",
    "synth.preview",
    "synth.progress", "synth.calibrate", "synth.stress", "synth.doctor", "synth.cli_options", "synth.commands",
    "synth.cli", "synth.__main__",
)  # fmt: skip
"""A module imports from its own stage and from those above it in this list, never from those below."""

HEAVY = {
    "numpy", "scipy", "pydantic", "mitsuba", "drjit", "warp", "pytetwild", "pyvista", "vtk", "vtkmodules", "cv2", "ray",
    "matplotlib", "torch", "lightning", "torchmetrics", "OpenEXR", "skimage", "pypardiso", "fsspec", "tensorboard",
}  # fmt: skip
MAIN = "import sys\nfrom {0}.cli import main\nassert main(sys.argv[1:]) == 0"


def _modules(package: str) -> dict[str, ast.Module]:
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        parts = path.relative_to(ROOT).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found[name] = ast.parse(path.read_text(encoding="utf-8"), str(path))
    return found


def _imports(tree: ast.Module) -> set[str]:
    """Dotted names of everything that a module imports, wherever in it; of `from a import b` both a and a.b."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            assert node.level == 0, f"{base}: imports are absolute"
            found |= {base, *(f"{base}.{alias.name}" for alias in node.names)}
    return found


def _stage(module: str) -> int:
    fitting = [stage for stage in STAGES[1:] if module == stage or module.startswith(f"{stage}.")]
    return STAGES.index(max(fitting, key=len)) if fitting else 0


SYNTH = _modules("synth")
GELFLOW = _modules("gelflow")


def _imports_of(modules: dict[str, ast.Module]) -> list[tuple[str, str]]:
    return [(name, imported) for name, tree in modules.items() for imported in sorted(_imports(tree))]


def test_the_public_names_are_those_of_the_interface() -> None:
    """In a fresh process, and after everything that they load has left its modules in the packages."""
    code = "import synth, gelflow; [getattr(package, name) for package in (synth, gelflow) for name in dir(package)]"
    command = [sys.executable, "-c", f"{code}; print(dir(synth), dir(gelflow)); print(gelflow.train)"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    names = ["generate", "load_scene", "plan", "read_dataset"], ["PairDataset", "Tracker", "load_model", "train"]
    assert done.stdout.startswith(f"{names[0]} {names[1]}\n<function train"), done.stderr


def test_every_module_has_a_stage_and_imports_only_from_earlier_ones() -> None:
    assert len(SYNTH) > 80
    assert ("synth.cli", "synth.errors") in _imports_of(SYNTH), "a finder that sees nothing would pass always"
    assert [name for name in SYNTH if name != "synth" and _stage(name) == 0] == []
    assert [stage for stage in STAGES if stage not in SYNTH] == []
    wrong = [
        f"{name} imports {imported}, which comes later"
        for name, imported in _imports_of(SYNTH)
        if name != "synth" and imported in SYNTH and _stage(imported) > _stage(name)
    ]
    assert wrong == []


ROOMS = (
    "errors", "arrays", "untrusted", "hardware", "terminal", "config", "files", "ops", "models", "losses", "data",
    "fast", "methods", "baselines", "track", "predict", "compare", "training", "cli", "__main__",
)  # fmt: skip
"""The same for the parts of gelflow."""


def test_gelflow_imports_only_from_earlier_parts() -> None:
    pairs = [(name.split("."), imported.split(".")) for name, imported in _imports_of(GELFLOW)]
    parts = [(name[1], other[1]) for name, other in pairs if len(name) > 1 and other[0] == "gelflow" and len(other) > 1]
    parts = [pair for pair in parts if pair[1] != "__version__"]
    assert [pair for pair in parts if ROOMS.index(pair[1]) > ROOMS.index(pair[0])] == []
    assert {imported for _, imported in parts} == set(ROOMS[:-1]), "a finder that sees nothing would pass always"


def test_networks_need_no_baseline_baselines_no_weights_and_the_writer_no_kind_of_store() -> None:
    gelflow, synth = _imports_of(GELFLOW), _imports_of(SYNTH)
    ours = ("gelflow.methods", "gelflow.predict", "gelflow.track")
    assert [pair for pair in gelflow if pair[0].startswith(ours) and pair[1].startswith("gelflow.baselines")] == []
    weights = ("gelflow.methods.learned", "gelflow.models.weights", "gelflow.models.raft")
    assert [pair for pair in gelflow if pair[0].startswith("gelflow.baselines") and pair[1].startswith(weights)] == []
    kinds = {f"synth.dataset.store.{name}Store" for name in ("Directory", "Remote")} | {"synth.dataset.objects"}
    askers = {name for name, imported in synth if imported in kinds}
    assert askers == {"synth.dataset.store", "synth.dataset.manifest_lines", "synth.dataset.lock"}


@pytest.mark.parametrize(("modules", "forbidden"), [
    (SYNTH, {"gelflow", "benchmarks", "torch", "lightning", "torchmetrics"}),
    (GELFLOW, {"synth", "benchmarks", "mitsuba", "drjit", "pytetwild", "pypardiso", "pyvista"}),
], ids=["synth", "gelflow"])  # fmt: skip
def test_the_two_programs_share_nothing(modules: dict[str, ast.Module], forbidden: set[str]) -> None:
    assert [pair for pair in _imports_of(modules) if pair[1].split(".")[0] in forbidden] == []


def _loaded_after(code: str, *arguments: str) -> set[str]:
    report = "\nimport sys\nsys.stderr.write('\\nLOADED ' + ' '.join({name.split('.')[0] for name in sys.modules}))"
    command = [sys.executable, "-c", code + report, *arguments]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    return set(done.stderr.rpartition("LOADED ")[2].split())


@pytest.mark.parametrize(("code", "arguments"), [
    ("import synth", ()),
    ("import gelflow", ()),
    (MAIN.format("synth"), ("--help",)),
    (MAIN.format("synth"), ("generate", "--help")),
    (MAIN.format("gelflow"), ("train", "--help")),
    (MAIN.format("gelflow"), ("compare", "--help")),
], ids=lambda value: "" if isinstance(value, str) else " ".join(value))  # fmt: skip
def test_help_loads_nothing_heavy(code: str, arguments: tuple[str, ...]) -> None:
    """The reason that it answers in a fraction of a second; seconds themselves depend on the machine."""
    assert _loaded_after(code, *arguments) & HEAVY == set()


def test_prediction_loads_nothing_of_training_simulate_no_renderer_and_preview_no_solver(
    tmp_path: Path, monkeypatch
) -> None:
    code = """
import gelflow.predict.prediction, gelflow.methods.learned, gelflow.compare.run, sys
from gelflow.models.weights import load_weights, weights_file
load_weights(weights_file(None))
print(*sys.modules)"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "gelflow.models.gelflow" in done.stdout.split()
    assert not [name for name in done.stdout.split() if name.startswith(("gelflow.training", "lightning", "warp"))]
    assert not _loaded_after("import gelflow.config") & {"torch", "numpy", "lightning"}
    own_cache(monkeypatch)
    scene = write_tiny(tmp_path)
    command = ["simulate", "--scene", str(scene), "--out", str(tmp_path / "out"), "--json"]
    loaded = _loaded_after(MAIN.format("synth"), *command)
    assert "warp" in loaded
    assert not loaded & {"mitsuba", "drjit", "torch", "matplotlib", "OpenEXR"}
    assert (tmp_path / "out" / "trajectory.json").exists()
    loaded = _loaded_after(MAIN.format("synth"), "preview", "--scene", str(scene), "--out", str(tmp_path / "p.png"))
    assert "mitsuba" in loaded
    assert not loaded & {"warp", "pytetwild", "torch", "matplotlib", "OpenEXR", "pyvista"}


def test_files_stay_short() -> None:
    paths = [path for package in ("synth", "gelflow", "benchmarks") for path in (ROOT / package).rglob("*.py")]
    assert [path for path in paths if len(path.read_text(encoding="utf-8").splitlines()) > 350] == []
