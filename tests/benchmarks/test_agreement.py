"""`benchmarks agreement`: the CPU against itself, plainly and with a GPU's rounding, and how outcomes are counted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from benchmarks.__main__ import main
from benchmarks.agreement import WANTED, Noisy, compare, drawn_of, one_by_one, summary, together
from benchmarks.rows import Row, read
from synth.scene import MeshIndenter
from synth.scene.template import load_scene
from synth.simulate.batched.pad import prepare
from synth.simulate.batched.run import OPTIONS

TINY = ["numerics.element=p1p1", "sensor.camera.width=32", "sensor.camera.height=24", "motion.steps=2"]


def run(out: Path, *options: str) -> Row:
    """What the command finds."""
    small = ["agreement", "--out", str(out), "--device", "cpu", "--trajectories", "4"]
    status = main([*small, *[part for change in TINY for part in ("--set", change)], *options])
    found = summary(read(out / "agreement.csv"))
    assert status == (0 if found["within 1e-6"] == 4 else 1)
    return found


def test_noise_has_the_size_that_was_asked_for() -> None:
    size, wanted = 400, wp.array([1, 0, 1], dtype=wp.int32, device="cpu")
    unit = wp.array(np.eye(size, dtype=np.float32), device="cpu")
    ones, noisy = wp.array(np.ones((3, size), dtype=np.float32), device="cpu"), Noisy(0.1)
    first, second = (wp.zeros((3, size), dtype=wp.float32, device="cpu") for _ in range(2))
    noisy.product(unit, ones, first, wanted)
    noisy.product(unit, ones, second, wanted)
    off = np.concatenate([first.numpy()[[0, 2]], second.numpy()[[0, 2]]]) - 1
    # A standard deviation from 400 draws is known to 1 / sqrt(800) = 3.5 %.
    np.testing.assert_allclose(off.std(axis=1), 0.1, rtol=0.15)
    assert np.abs(np.corrcoef(off) - np.eye(4)).max() < 0.2
    assert (first.numpy()[1] == 0).all()


def test_the_cpu_agrees_with_itself(tmp_path: Path) -> None:
    """A trajectory's bits depend neither on its neighbours nor on its lane."""
    found = run(tmp_path)
    assert (found["draws"], found["end alike"], found["complete"], found["within 1e-6"]) == (4, 4, 4, 4)
    assert found["displacement, largest"] == found["traction, largest"] == found["flow_px, largest"] == 0
    assert found["iterations"] == found["cpu_iterations"] > 4


def test_noise_in_the_directions_stays_within_what_is_wanted(tmp_path: Path) -> None:
    """With the default options; loose intermediate steps let friction remember the noise, rougher directions leave
    more of it.
    """
    ways: list[list[str]] = [[], ["--forcing", "0.03"], ["--loose", "1e-3"]]
    found, rough, loose = (run(tmp_path / str(n), "--noise", "3e-4", *way) for n, way in enumerate(ways))
    assert found["end alike"] == rough["end alike"] == loose["end alike"] == 4
    assert 0 < found["displacement, largest"] <= WANTED
    assert found["displacement, median"] < rough["displacement, median"]
    assert 2 * found["displacement, median"] < loose["displacement, median"]
    # At most some ten px of flow, within 1e-6 of them.
    assert 0 < found["mean_flow_px, largest"] <= found["flow_px, largest"] < 1e-4


def test_outcomes_are_counted() -> None:
    drawn = drawn_of(load_scene("gelsight_mini", ['numerics.solver="batched"', "numerics.cells=[4,4,1]", *TINY]), 3, 5)
    missing = MeshIndenter(shape="mesh", file="nothing.stl", scale=1.0)
    contact = drawn[2].scene.contact.model_copy(update={"indenter": missing})
    scene = drawn[2].scene.model_copy(update={"contact": contact})
    drawn[2] = replace(drawn[2], folder=Path("nowhere"), scene=scene)
    first = together(drawn, prepare(drawn[0].scene, drawn[0].mesh, "cpu"), OPTIONS)
    complete, other, unbuilt = first
    assert complete.status == other.status == "complete"
    assert "nothing.stl" in str(unbuilt)
    second = [replace(complete, status="partial", reason="lost"), *one_by_one(drawn[1:], OPTIONS, 2)]
    rows = list(map(compare, drawn, first, second))
    assert [row["same"] for row in rows] == [False, True, True]
    assert [row["status"] for row in rows] == ["complete", "complete", "unbuilt"]
    assert [row["cpu_status"] for row in rows] == ["partial", "complete", "unbuilt"]
    assert rows[0]["cpu_reason"] == "lost"
    found = summary(rows)
    assert (found["draws"], found["end alike"], found["complete"]) == (3, 2, 1)
    assert summary(rows[:1])["displacement, largest"] is None


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--device", "cuda", "--noise", "0.1"], "use cpu"),
        (["--device", "cpu", "--trajectories", "0"], "at least 1"),
        (["--device", "cpu", "--set", "motion.depth_mm={normal=[0.2, 1e9]}"], "none of 16 draws"),
    ],
)
def test_what_cannot_be_compared(options: list[str], told: str, tmp_path: Path, capsys) -> None:
    assert main(["agreement", "--out", str(tmp_path), *options]) == 2
    assert told in capsys.readouterr().err
