"""`bench.batched`: a short run, and the surface errors of its presses, on the CPU."""

import json

import numpy as np
import pytest
from pads import brick

from synth.bench.batched import main
from synth.bench.batched_errors import reference_mesh, surface_errors
from synth.bench.batched_presses import PLACES_MM, RADII_MM, SIZE_MM, ball_scene, shared_mesh

DEPTH = 0.3


def test_presses_are_what_they_are_said_to_be() -> None:
    # Fails with radii that are drawn from RADII_MM whatever is asked for.
    rng = np.random.default_rng(0)
    for limits in (RADII_MM, (3.0, 3.5)):
        for scene in (ball_scene(rng, DEPTH, 0.0, 1, limits) for _ in range(20)):
            assert limits[0] <= scene.contact.indenter.model_dump()["radius_mm"] <= limits[1]
            assert all(abs(x) <= half for x, half in zip(scene.motion.position_mm, PLACES_MM, strict=True))


def test_errors_fall_with_the_elements() -> None:
    """And are none on the mesh of the reference."""
    # Fails with a reference that is the mesh itself.
    scene = ball_scene(np.random.default_rng(0), DEPTH, 0.0, 1)
    same, coarse, finer = (
        next(surface_errors(mesh, 1, DEPTH, across=2))
        for mesh in (reference_mesh(scene, 2), brick(SIZE_MM, (5, 4, 1)), shared_mesh((8, 6), 2, 2.0))
    )
    assert same["elements"] == same["reference_elements"]
    assert (same["complete"], same["surface_error_percent"], same["force_error_percent"]) == (True, 0.0, 0.0)
    assert coarse["surface_error_percent"] > finer["surface_error_percent"] > 0


def test_the_command_measures_and_judges(capsys: pytest.CaptureFixture[str]) -> None:
    # Fails with --errors that is ignored.
    mesh = ["--device", "cpu", "--across", "4", "4", "--through", "1", "--depth", str(DEPTH)]
    assert main([*mesh, "--batch", "2", "--seconds", "0.1"]) == 0
    (line,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert line["presses"] == line["complete"] >= 1
    assert line["presses_per_s"] > 0
    # What a cycle takes is divided among its parts.
    assert sum(line["profile"]["parts"].values()) == pytest.approx(line["profile"]["ms_per_profiled_cycle"], rel=1e-3)
    assert main([*mesh, "--errors", "1", "--radii", "5", "6"]) == 0
    (line,) = map(json.loads, capsys.readouterr().out.splitlines())
    assert 5 <= line["radius_mm"] <= 6
    assert line["surface_error_percent"] > 0


def test_the_presses_that_are_judged_go_the_way_that_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    """Friction remembers it: 0.02 to 0.14 % of the displacement here."""
    # Fails with --step, or with --loose, that is not handed on.
    press = ["--across", "8", "6", "--through", "2", "--depth", "0.5", "--radii", "5", "6", "--errors", "1"]
    for way in ([], ["--step", "0.05"], ["--loose", "0.1"]):
        assert main([*press, *way]) == 0
    errors = [json.loads(line)["surface_error_percent"] for line in capsys.readouterr().out.splitlines()]
    assert len(set(errors)) == 3
