"""README, guide, docstrings and examples: links lead somewhere, commands are known, programs give what they say."""

import doctest
import importlib
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

import gelflow.cli
import synth
import synth.cli

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs" / "guide").glob("*.md"))]
APPS = {"synth": synth.cli.app, "gelflow": gelflow.cli.app}
EXAMPLES = ROOT / "examples"
NUMBER = r"(\d+\.\d+)"


def commands(page: Path) -> list[list[str]]:
    """The arguments of every `python -m synth` and `python -m gelflow` in a page's shell blocks."""
    found = []
    for block in re.findall(r"```sh\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            for part in re.split(r" && | & ", line):
                words = shlex.split(part, comments=True)
                if words[:2] == ["python", "-m"] and words[2] in APPS:
                    found.append(words[2:])
    return found


def test_the_readme_is_short() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(text.split()) <= 900
    assert [line for line in text.splitlines() if len(line) > 120] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_tables_are_scenes(page: Path, tmp_path: Path) -> None:
    """A table extends what its page says, or a flat sensor; tables that name files of the reader's own are left out."""
    text, scene = page.read_text(encoding="utf-8"), tmp_path / "mine.toml"
    assert [at for at in re.findall(r"\]\((?!https?:)([^)#]+)", text) if not (page.parent / at).exists()] == []
    base = f'extends = "{"allsight" if page.stem == "round_sensor" else "gelsight_mini"}"\n'
    for table in re.findall(r"```toml\n(.*?)```", text, re.DOTALL):
        if ".stl" not in table and ".csv" not in table:
            scene.write_text(table if "extends" in table else base + table)
            synth.plan(scene)


def test_commands_are_known() -> None:
    """Options are parsed as the programs parse them; nothing runs."""
    shown = [command for page in PAGES for command in commands(page)]
    assert len(shown) > 30
    for program, *arguments in shown:
        APPS[program].parse_args(arguments, exit_on_error=False, print_error=False)


MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for package in ("synth", "gelflow")
    for path in sorted((ROOT / package).rglob("*.py"))
    if ">>> " in path.read_text(encoding="utf-8")
]


def test_the_public_interface_has_examples() -> None:
    assert {"synth", "synth.scene.template", "synth.planning.plan", "gelflow.predict.model"} <= set(MODULES)


@pytest.mark.parametrize("module", MODULES)
def test_examples_in_docstrings(module: str) -> None:
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted > 0
    assert result.failed == 0


def run(name: str, *arguments: object) -> str:
    environment = os.environ | {"PYTHONPATH": str(EXAMPLES.parent)}
    command = [sys.executable, str(EXAMPLES / name), *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def found(pattern: str, text: str) -> list[float]:
    match = re.search(pattern, text)
    assert match, text
    return [float(group) for group in match.groups()]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("examples") / "ten"
    printed = run("make_pairs.py", "--n", 2, "--out", out)
    assert found(rf"largest motion {NUMBER} px", printed)[0] > 1
    assert (out / "flow.png").stat().st_size > 50_000
    return out


def test_examples_are_short() -> None:
    programs = sorted(EXAMPLES.glob("*.py"))
    assert len(programs) == 10
    lines = {program.name: len(program.read_text().splitlines()) for program in programs}
    assert lines.pop("ros2_node.py") <= 60
    assert max(lines.values()) <= 40


def test_make_clip(tmp_path: Path) -> None:
    quick = ['numerics={ element = "p1p1", edge_length_mm = 1.0 }', "render.samples_per_pixel=4", "motion.steps=7"]
    printed = run("make_clip.py", "--out", tmp_path / "clip", "--set", *quick)
    assert found(rf"8 frames, at most {NUMBER} N; slides as a whole in [1-7] of them", printed)[0] > 0.3
    assert Image.open(tmp_path / "clip" / "film.webp").n_frames == 8
    assert (tmp_path / "clip" / "states.png").stat().st_size > 10_000


def test_make_grasp(tmp_path: Path) -> None:
    quick = ['numerics={ element = "p1p1", edge_length_mm = 1.0 }', "render.samples_per_pixel=4"]
    printed = run("make_grasp.py", "--out", tmp_path / "grasp", "--set", *quick)
    most, last = found(rf"25 frames, at most {NUMBER} N; {NUMBER} N when it is let go", printed)
    assert most > 1
    assert last == 0


def test_read_exr(dataset: Path) -> None:
    printed = run("read_exr.py", dataset / "samples" / "000000" / "flow.exr")
    assert "flow.units: px" in printed
    assert found(rf"{NUMBER} % of image 1 is seen", printed)[0] > 50


def test_flow_of_two_images(dataset: Path) -> None:
    folder = dataset / "samples" / "000000"
    printed = run("flow_of_two_images.py", folder / "image1.png", folder / "image2.png")
    assert found(rf"closure: {NUMBER} px in the median", printed)[0] < 0.5


def test_camera_loop(tmp_path: Path) -> None:
    frames = [np.roll(np.random.default_rng(0).integers(0, 256, (64, 80, 3), np.uint8), shift, 1) for shift in range(4)]
    writer = cv2.VideoWriter(str(tmp_path / "a.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (80, 64))
    for frame in frames:
        writer.write(cv2.GaussianBlur(frame, (0, 0), 2))
    writer.release()
    printed = run("camera_loop.py", tmp_path / "a.avi")
    # JPEG's blocks stand still while the picture moves by 3 px.
    assert found(rf"frame 3: mean motion {NUMBER} px", printed)[0] == pytest.approx(3, abs=0.5)


def test_ros2_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """With modules in place of ROS: two images come in, one as BGR with padded rows; flow and sigma go out."""
    Image, topics, sent = SimpleNamespace, {}, []

    def create_publisher(kind: type, name: str, _: object) -> SimpleNamespace:
        return SimpleNamespace(publish=lambda message: sent.append((name, message)))

    def create_subscription(kind: type, name: str, callback: Any, _: object) -> None:
        topics[name] = callback

    node = SimpleNamespace(create_publisher=create_publisher, create_subscription=create_subscription)
    modules = {
        "rclpy": {"init": lambda: None, "create_node": lambda _: node, "spin": lambda _: None},
        "rclpy.qos": {"QoSProfile": SimpleNamespace, "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2)},
        "sensor_msgs.msg": {"Image": Image},
        "std_msgs.msg": {"Empty": SimpleNamespace},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(EXAMPLES / "ros2_node.py"))["main"]()
    noise = np.random.default_rng(0).integers(0, 256, (64, 80, 3), np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 2)
    moved = np.roll(image, 2, axis=1)[..., ::-1]
    padded = np.concatenate([moved.reshape(64, 240), np.zeros((64, 16), np.uint8)], axis=1)
    size = {"height": 64, "width": 80}
    topics["image_raw"](Image(header=1, encoding="rgb8", step=240, data=image.tobytes(), **size))
    assert not sent
    topics["image_raw"](Image(header=2, encoding="bgr8", step=256, data=padded.tobytes(), **size))
    assert [name for name, _ in sent] == ["flow", "sigma"]
    heads = [(message.header, message.encoding, message.step) for _, message in sent]
    assert heads == [(2, "32FC2", 640), (2, "32FC1", 320)]
    flow = np.frombuffer(sent[0][1].data, np.float32).reshape(64, 80, 2)
    assert np.median(flow, axis=(0, 1)) == pytest.approx((2, 0), abs=0.1)
    topics["reset"](None)
    grey = image[..., 0]
    for shift in (0, 1):
        data = np.roll(grey, shift, axis=0).tobytes()
        topics["image_raw"](Image(header=3, encoding="mono8", step=80, data=data, **size))
    flow = np.frombuffer(sent[2][1].data, np.float32).reshape(64, 80, 2)
    assert np.median(flow, axis=(0, 1)) == pytest.approx((0, 1), abs=0.1)


def test_dataloader(dataset: Path, tmp_path: Path) -> None:
    assert synth.cli.main(["export", str(dataset), "--format", "webdataset", "--out", str(tmp_path)]) == 0
    error, motion = found(rf"mean endpoint error {NUMBER} px of {NUMBER} px", run("dataloader.py", tmp_path))
    assert error < motion / 4


def test_own_pattern(tmp_path: Path) -> None:
    assert "1 pairs of the new pattern" in run("own_pattern.py", "--n", 1, "--out", tmp_path / "rings")
    assert (tmp_path / "rings" / "samples" / "000000" / "image2.png").is_file()


@pytest.mark.slow
def test_error_against_time(tmp_path: Path) -> None:
    printed = run("error_against_time.py", "--targets", 0.4, 0.2, 0.1, "--out", tmp_path)
    errors = [float(line.split()[1]) for line in printed.splitlines()[1:]]
    assert errors[0] > errors[1] > errors[2] == 0.0
