"""The wheel, installed outside the checkout: the scenes come with it, and the main job runs."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

pytest.importorskip("setuptools", minversion="77", reason="older ones do not build this project")
ROOT = Path(__file__).parents[1]
SOURCES = ("synth", "gelflow", "scenes", "pyproject.toml", "setup.py", "README.md", "LICENSE")
SMALL = ["--set", "render.samples_per_pixel=4", "--set", "numerics.target_error_px=2.0"]

pytestmark = pytest.mark.slow


def run(folder: Path, *words: object) -> str:
    """Run a command in a folder, without the checkout on its path; what it printed. Only the programs may speak."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    command = list(map(str, words))
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    noise = [line for line in done.stderr.splitlines() if not line.startswith(("synth: ", "gelflow: "))]  # progress
    assert (done.returncode, noise) == (0, []), done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a fresh environment that holds the wheel and, of this one, whatever the wheel depends on."""
    sources, folder = tmp_path_factory.mktemp("sources"), tmp_path_factory.mktemp("environment")
    for name in SOURCES:
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copyfile
        copy(ROOT / name, sources / name)
    pip = (sys.executable, "-m", "pip", "--disable-pip-version-check")
    subprocess.run([*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, sources], check=True)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    python = folder / "venv" / "bin" / "python"
    (wheel,) = folder.glob("*.whl")
    subprocess.run([*pip, "--python", python, "install", "-q", "--no-deps", "--no-index", wheel], check=True)
    packages = run(folder, python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    (Path(packages) / "dependencies.pth").write_text(sysconfig.get_path("purelib"))
    return python.parent


def test_everything_comes_from_the_wheel(installed: Path, tmp_path: Path) -> None:
    code = "import synth.scene.template as t; print(t.SCENES, *t.shipped_scenes(), sep='\\n')"
    scenes, *names = run(tmp_path, installed / "python", "-c", code).splitlines()
    assert Path(scenes).is_relative_to(installed.parent)
    assert names == sorted(path.stem for path in (ROOT / "scenes").glob("*.toml"))
    for program in ("synth", "gelflow"):
        version = run(tmp_path, installed / program, "--version").strip()
        assert f'version = "{version}"' in (ROOT / "pyproject.toml").read_text()
    assert run(tmp_path, installed / "synth", "plan", "--scene", "objects")  # whose meshes must be there


def test_the_installed_programs_do_the_main_job(installed: Path, tmp_path: Path) -> None:
    run(tmp_path, installed / "python", "-m", "synth", "generate", "--n", 2, "--out", "demo", *SMALL)
    assert "all samples agree" in run(tmp_path, installed / "synth", "verify", "demo")
    run(tmp_path, installed / "synth", "inspect", "demo", "--png", "demo.png")
    pair = [f"demo/samples/000000/image{number}.png" for number in (1, 2)]
    run(tmp_path, installed / "python", "-m", "gelflow", "predict", *pair, "--out", "flow")
    assert (tmp_path / "demo.png").is_file()
    assert list((tmp_path / "flow").glob("*.exr"))
