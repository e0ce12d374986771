"""`bench.agreement`: the CPU against itself and against itself with a GPU's rounding, and how outcomes are counted.

Each comment "Fails with" names a change of `synth` that was tried.
"""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from synth.bench.agreement import WANTED, compare, main
from synth.bench.agreement_draws import drawn_of, together
from synth.bench.agreement_noise import Noisy
from synth.scene.template import load_scene
from synth.simulate import Trajectory
from synth.simulate.batched.many import DRIVER

TINY = ["numerics.element=p1p1", "sensor.camera.width=32", "sensor.camera.height=24", "motion.steps=2"]
SMALL = ["--device", "cpu", "--cells", "6", "4", "2", "--trajectories", "4"]


def run(capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    """What the command prints."""
    assert main([*SMALL, *[part for change in TINY for part in ("--set", change)], *options]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_noise_has_the_size_that_was_asked_for() -> None:
    # Fails with noise in rows that are not wanted, or with the same noise in every product.
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


def test_the_cpu_agrees_with_itself(capsys: pytest.CaptureFixture[str]) -> None:
    """A trajectory's bits depend neither on its neighbours nor on its slot."""
    # Fails with a device that has noise.
    found = run(capsys)
    assert (found["draws"], found["same_outcome"], found["other_outcomes"]) == (4, 4, [])
    assert found["complete"] == found["within_1e-6"] == 4
    assert found["displacement_largest"] == found["traction_largest"] == found["flow_px_largest"] == 0


def test_noise_in_the_directions_stays_within_what_is_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    """With the default way; a loose one lets friction remember the noise, rougher directions leave more of it."""
    # Fails with either as the default.
    ways: list[list[str]] = [[], ["--forcing", "0.03"], ["--loose", "1e-3"]]
    found, rough, loose = (run(capsys, "--noise", "3e-4", *way) for way in ways)
    assert found["same_outcome"] == rough["same_outcome"] == loose["same_outcome"] == 4
    assert 0 < found["displacement_largest"] <= WANTED
    assert found["displacement_median"] < rough["displacement_median"]
    assert 2 * found["displacement_median"] < loose["displacement_median"]
    # At most some ten px of flow, within 1e-6 of them.
    assert 0 < found["flow_px_largest_mean"] <= found["flow_px_largest"] < 1e-4


def test_outcomes_are_counted() -> None:
    # Fails with trajectories that are compared whatever their outcome.
    drawn = drawn_of(load_scene("gelsight_mini", ['numerics.solver="batched"', "numerics.cells=[4,4,1]", *TINY]), 3, 5)
    first = together(drawn, "cpu", DRIVER)
    assert all(isinstance(one, Trajectory) and one.status == "complete" for one in first)
    second = [replace(first[0], status="partial", reason="lost"), first[1], "no such file"]  # type: ignore[type-var]
    found = compare(drawn, first, second)
    assert (found["draws"], found["same_outcome"], found["complete"]) == (3, 1, 1)
    assert [other["trajectory"] for other in found["other_outcomes"]] == [0, 2]
    assert found["other_outcomes"][0]["cpu"] == ("partial", "lost")
    assert found["other_outcomes"][1]["cpu"] == ("unbuilt", "no such file")


@pytest.mark.parametrize(
    ("options", "told"),
    [(["--device", "cuda", "--noise", "0.1"], "use cpu"), (["--device", "cpu", "--trajectories", "0"], "at least 1")],
)
def test_what_cannot_be_compared(capsys: pytest.CaptureFixture[str], options: list[str], told: str) -> None:
    assert main(options) == 2
    assert told in capsys.readouterr().err
