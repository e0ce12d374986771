"""Who may import whom in gelflow: one direction, and prediction nothing of training."""

import ast
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = (
    "errors", "arrays", "hardware", "terminal", "config", "files", "ops", "models", "losses", "data", "baselines",
    "predict", "compare", "train", "cli", "__main__",
)  # fmt: skip
"""A module imports from its own room and from those before it in this list, wherever in it the import stands."""


def _rooms_imported(path: Path) -> set[str]:
    """First part, after `gelflow.`, of everything that a module imports."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: imports are absolute"
            names |= {node.module or "", *(f"{node.module}.{alias.name}" for alias in node.names)}
    return {name.split(".")[1] for name in names if name.startswith("gelflow.")} - {"__version__"}


def test_imports_go_one_way() -> None:
    wrong, seen = [], set()
    for path in sorted((ROOT / "gelflow").rglob("*.py")):
        room = path.relative_to(ROOT / "gelflow").parts[0].removesuffix(".py")
        if room == "__init__":
            continue
        imported = _rooms_imported(path)
        seen |= imported
        wrong += [f"{path.relative_to(ROOT)} imports {other}, which comes later" for other in imported
                  if ROOMS.index(other) > ROOMS.index(room)]  # fmt: skip
    assert wrong == []
    assert seen == set(ROOMS[:-1]), "a finder that sees nothing would pass always"


def test_prediction_loads_nothing_of_training() -> None:
    code = (
        "import gelflow.predict.prediction, gelflow.baselines.learned, gelflow.compare.run, sys\n"
        "from gelflow.models.weights import load_weights, weights_file\n"
        "load_weights(weights_file(None))\n"
        "print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    loaded = set(done.stdout.split())
    assert "gelflow.models.gelflow" in loaded
    assert not [name for name in loaded if name.startswith(("gelflow.train", "lightning"))]
