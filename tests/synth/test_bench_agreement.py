"""`bench.agreement`: the CPU against itself and against itself with a GPU's rounding, and how outcomes are counted.

Each comment "Fails with" names a change of `synth` that was tried.
"""

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from synth.bench.agreement import WANTED, compare, main
from synth.bench.agreement_draws import drawn_of, together
from synth.bench.agreement_rounding import to_tf32
from synth.simulate import Trajectory
from synth.simulate.batched.many import DRIVER
from synth.template import load_scene

TINY = ["numerics.element=p1p1", "sensor.camera.width=32", "sensor.camera.height=24", "motion.steps=2"]
SMALL = ["--device", "cpu", "--cells", "6", "4", "2", "--trajectories", "4"]


def run(capsys: pytest.CaptureFixture[str], *options: str) -> dict[str, Any]:
    """What the command prints."""
    assert main([*SMALL, *[part for change in TINY for part in ("--set", change)], *options]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


def test_rounding_keeps_ten_bits() -> None:
    # Fails with bits that are cut off.
    given = np.array([1 + 2**-10, 1 + 2**-11, -1 - 2**-11, 1 + 2**-12, 0.0], dtype=np.float32)
    assert to_tf32(given).tolist() == [1 + 2**-10, 1 + 2**-10, -1 - 2**-10, 1.0, 0.0]
    many = np.random.default_rng(0).standard_normal(1000).astype(np.float32)
    # Half a unit of the tenth bit; and some are as far off as that.
    off = np.abs(to_tf32(many) / many.astype(np.float64) - 1)
    assert 2**-12 < off.max() <= 2**-11


def test_the_cpu_agrees_with_itself(capsys: pytest.CaptureFixture[str]) -> None:
    """A trajectory's bits depend neither on its neighbours nor on its slot."""
    # Fails with a device that is rounded.
    found = run(capsys)
    assert (found["draws"], found["same_outcome"], found["other_outcomes"]) == (4, 4, [])
    assert found["complete"] == found["within_1e-6"] == 4
    assert found["displacement_largest"] == found["traction_largest"] == found["flow_px_largest"] == 0


def test_a_gpus_rounding_stays_within_what_is_wanted(capsys: pytest.CaptureFixture[str]) -> None:
    """With the default way; a loose one lets friction remember what was rounded."""
    # Fails with a way to 1e-3 as the default.
    found, loose = run(capsys, "--rounded"), run(capsys, "--rounded", "--loose", "1e-3")
    assert found["same_outcome"] == loose["same_outcome"] == 4
    assert 0 < found["displacement_largest"] <= WANTED < loose["displacement_largest"]
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
    [(["--device", "cuda", "--rounded"], "use cpu"), (["--device", "cpu", "--trajectories", "0"], "at least 1")],
)
def test_what_cannot_be_compared(capsys: pytest.CaptureFixture[str], options: list[str], told: str) -> None:
    assert main(options) == 2
    assert told in capsys.readouterr().err
