"""Edges of objects: a stated radius is kept or refused by name, and detail that is lost is told."""

import json
from pathlib import Path

import pytest
import pyvista as pv
from commands import complaint, refused
from pads import scene

from synth.cli import main
from synth.dataset.reader import read_dataset
from synth.press.press import MeshRule
from synth.scene import Scene

SIZE = (12.0, 10.0, 4.0)


def block(fillet_mm: float | None, **numerics: object) -> Scene:
    indenter = {"shape": "box", "size_mm": (3.0, 3.0, 3.0), "fillet_mm": fillet_mm}
    return scene(SIZE, indenter=indenter, numerics={"element": "auto", "edge_length_mm": None, **numerics})


def test_a_stated_fillet_is_kept_by_a_finer_mesh_and_a_default_one_may_be_raised() -> None:
    presses = {fillet: MeshRule.of(block(fillet)).press(block(fillet)) for fillet in (None, 0.05)}
    assert presses[0.05].path.body.fillet_mm == 0.05
    # P2 nodes and quadrature: a quarter of an element's edge is what its contact points resolve.
    assert presses[0.05].mesh.spacing_mm / 4 <= 0.05 < presses[None].mesh.spacing_mm / 4
    default = presses[None].path.body.fillet_mm
    assert default == pytest.approx(max(0.2, presses[None].mesh.spacing_mm / 4))


@pytest.mark.parametrize(
    ("numerics", "setting"),
    [
        ({}, "40 elements across the contact"),
        ({"solver": "batched"}, "numerics.cells"),
        ({"edge_length_mm": 1.0}, r"numerics.edge_length_mm = 0\.0"),
    ],
)
def test_a_fillet_too_sharp_for_the_mesh_is_refused_by_name(numerics: dict[str, object], setting: str) -> None:
    sharp = block(0.01, **numerics)
    rule = MeshRule.of(sharp, is_batched="solver" in numerics)
    refused(rf"fillet_mm = 0.01 .*{setting}.*allowed are .* px\) and more", rule.press, sharp)


@pytest.fixture
def ribbed(tiny: Path, tmp_path: Path) -> list[str]:
    """What presses a plate with a rib of a quarter of a millimetre on the tiny pad."""
    plate, rib = pv.Box((-2, 2, -2, 2, -1, 0)), pv.Box((-0.12, 0.12, -1.5, 1.5, -0.5, 0.25))
    pv.merge([plate, rib]).extract_surface(algorithm="dataset_surface").triangulate().save(tmp_path / "plate.stl")
    indenter = f'contact.indenter={{ shape = "mesh", file = "{tmp_path / "plate.stl"}" }}'
    camera = ["--set", "sensor.camera.fx=330", "--set", "sensor.camera.fy=330"]
    return ["--scene", str(tiny), "--set", indenter, "--set", "motion.depth_mm=0.2", *camera]


def test_detail_that_is_lost_is_told_and_the_pressed_radius_recorded(capsys, ribbed: list[str], tmp_path: Path) -> None:
    def told(*arguments: str) -> str:
        assert main([*arguments, *ribbed]) == 0
        return capsys.readouterr().err

    out = tmp_path / "press"
    for command in (
        ["plan"],
        ["simulate", "--out", str(out)],
        ["generate", "--n", "1", "--out", str(tmp_path / "set"), "--set", "outputs.contact=true"],
    ):
        warning = told(*command)
        assert "radius of" in warning
        assert "parts and gaps less than" in warning
        assert "contact.indenter.fillet_mm = " in warning
        assert "times the simulation's time" in warning
    record = json.loads((out / "trajectory.json").read_text())
    assert record["scene"]["contact"]["indenter"]["fillet_mm"] > 0.25  # wider than the rib: it is lost
    assert record["steps"][-1]["contact_area_mm2"] > 0
    meta = read_dataset(tmp_path / "set").read(0).meta
    assert meta["scene"]["contact"]["indenter"]["fillet_mm"] == pytest.approx(
        meta["diagnostics"]["edge_radius_mm"], abs=1e-4
    )
    assert meta["diagnostics"]["solver"][1]["contact_area_mm2"] > 0
    assert "slid" in meta["conventions"]["solver.slip_ratio"]
    assert "fillet_mm = 0.05" in complaint(
        capsys, main, "simulate", *ribbed, "--set", "contact.indenter.fillet_mm=0.05", "--out", tmp_path / "other"
    )
