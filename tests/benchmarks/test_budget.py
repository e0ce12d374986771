"""`benchmarks budget`: picture errors of fields made by hand, the reference, a tiny study, and what is read off it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import said

from benchmarks import budget
from benchmarks.__main__ import main
from benchmarks.budget import LEAST_SEEN, drawn, judge, picture_errors, places, press_draw, reference_mesh, summary
from benchmarks.press import face_displacement
from benchmarks.rows import Row, read
from synth.errors import InputError
from synth.press.footprint import footprint
from synth.press.press import MeshRule
from synth.press.resolution import MARGIN, graded_mesh, scale_px_per_mm
from synth.press.scene_path import path_of
from synth.sampling import draw, samples_of
from synth.scene.template import load_scene
from synth.simulate import simulate

TINY = """
name = "tiny"
sensor.gel = { size_mm = [8.0, 6.0, 2.5], youngs_modulus_kpa = 200.0 }
sensor.pattern.kind = "none"
sensor.lights = [{ position_mm = [0.0, 3.5, 2.0], size_mm = [0.3, 0.3], color = [1, 1, 1], power = 100.0 }]
sensor.camera = { width = 32, height = 24, fx = 82.0, fy = 82.0, cx = 16.0, cy = 12.0, position_mm = [0.0, 0.0, 20.0] }
contact.friction = 0.5
contact.indenter = { shape = "sphere", radius_mm = { uniform = [1.5, 2.5] } }
motion = { depth_mm = { uniform = [0.1, 0.3] }, shear_mm = [0.1, 0.0], steps = 3 }
numerics = { element = "p1p1", target_error_px = 0.0065 }
"""


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scene") / "tiny.toml"
    path.write_text(TINY)
    return path


def test_errors_of_known_fields(tiny: Path) -> None:
    """A shift along the face is one of the picture."""
    scene = draw(load_scene(tiny), 2, 0)
    points, scale = places(scene), scale_px_per_mm(scene)
    camera, size = scene.sensor.camera, scene.sensor.gel.size_mm
    # Of the pad's points those in the picture: the picture's share of the pad's area, within a row and a column.
    share = camera.width * camera.height / scale**2 / (size[0] * size[1])
    assert len(points) == pytest.approx(share * 81 * 67, rel=0.05)
    zero = np.zeros((3, len(points), 3))
    moved = zero.copy()
    moved[0] += (0.03, 0.04, 0.0)
    half = np.arange(len(points)) % 2 == 0
    moved[1, half] += (0.0, 0.1, 0.0)
    found, shares = picture_errors(moved, zero, scene)
    assert shares.min() > 0.95  # at most one of some 30 rows of points slides out of the picture
    assert shares[2] == 1
    # The magnification is the same all over the face, to the 1e-3 by which slanted rays refract otherwise.
    np.testing.assert_allclose(found, [0.05 * scale, 0.1 * scale * np.sqrt(half.mean()), 0], rtol=5e-3)


@pytest.mark.parametrize("name", ["gelslim", "tac3d"])
def test_what_slides_out_of_the_picture_does_not_count(name: str) -> None:
    """A shift of the whole face is one of the picture, whichever points it takes beyond a mirror's end."""
    scene = draw(load_scene(name), 3, 1)
    scale, zero = scale_px_per_mm(scene), np.zeros((3, len(places(scene)), 3))
    moved = zero + np.array([(0.3, 0.0, 0.0), (0.0, -0.3, 0.0), (0.0, 6.0, 0.0)])[:, None]
    found, shares = picture_errors(moved, zero, scene)
    # Mirrors at 45 degrees fold the view without magnifying it; drawn tilts of some 0.01 rad do, by their square.
    np.testing.assert_allclose(found[:2], 0.3 * scale, rtol=5e-3)
    # 0.3 mm are 3 % of the half of a picture that is 10 mm wide; 6 mm are most of its height, so that too few are left.
    assert (shares[:2] > 0.9).all()
    assert (shares[:2] < 1).all()
    assert shares[2] < LEAST_SEEN
    assert np.isnan(found[2])


@pytest.mark.parametrize("index", [3, 12])  # the smallest and the largest contact of the first twenty
def test_reference_is_finer_every_way_also_through_the_thickness(index: int) -> None:
    template = load_scene("gelsight")
    scene, folder = drawn(template, 2, index), template.source.parent
    gel = scene.sensor.gel
    zone = footprint(path_of(scene, folder), gel.size_mm, MARGIN)
    chosen_mm = MeshRule.of(scene).resolution(scene, folder).spacing_mm
    mesh, across, fine = reference_mesh(gel, zone, chosen_mm, 18)
    assert 2.4 * fine <= chosen_mm < 2.4 * fine * across / (across - 2)
    assert reference_mesh(gel, zone, chosen_mm, 8)[1] == 8
    planes, theirs = (np.unique(each.points[:, 2]) for each in (mesh, graded_mesh(gel, zone, across)[0]))
    assert len(planes) > len(theirs)
    assert planes[1] < 1.01 * fine
    heights = np.diff(planes)
    # One element more than growth 2.2 asks for: 1 + ... + q^n = 1 + ... + 2.2^(n - 1), q < 1.8 from three on.
    assert (heights[1:] / heights[:-1]).max() < 1.8


def test_draws(tiny: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    template = load_scene(tiny)
    assert drawn(template, 2, 1) == draw(template, 2, 1), "the draw of generate"
    fixed = tiny.with_name("fixed.toml")
    fixed.write_text(TINY.replace("target_error_px = 0.0065", "edge_length_mm = 1.0"))
    assert "edge_length_mm leaves no budget" in said(capsys, main, "budget", "--scene", fixed, status=2)
    case = {"scene": str(tiny), "hash": "", "seed": 2, "draw": 0}

    def refuse(*_: object, **__: object) -> None:
        raise InputError("no body")

    for name, status in (("simulate", "refused"), ("draw", "not drawn")):
        monkeypatch.setattr(budget, name, refuse)
        (row,) = press_draw(case, [], 8)
        assert row["status"] == status
        assert "no body" in row["reason"]
        assert judge([row]) is None


def test_the_command(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors are those between the fields of two presses, and fall with the elements; the rest is read off the rows."""
    options = ["budget", "--scene", str(tiny), "--draws", "2", "--reference", "8", "--out", str(tmp_path)]
    status = main(options)
    rows, shown = read(tmp_path / "budget.csv"), capsys.readouterr().out
    template, within = load_scene(tiny), 0
    for index in range(2):
        truth, *others = [row for row in rows if row["draw"] == index]
        assert truth["mesh"] == "reference"
        errors = [row["error_px"] for row in others]
        assert 0 < errors[-1] < errors[0]
        (chosen,) = [row for row in others if row["chosen"]]
        scene = draw(template, 2, index)
        best = MeshRule.of(scene).resolution(scene, tiny.parent)
        assert chosen["mesh"] == f"{best.across}x{best.through}"
        assert chosen["predicted_px"] == pytest.approx(best.error_px)
        within += chosen["error_px"] <= 0.0065
    assert status == (0 if within == 2 else 1)
    assert f"{within} ({within / 2:.0%})" in shown
    # The last draw again, by hand.
    gel, zone = scene.sensor.gel, footprint(path_of(scene, tiny.parent), scene.sensor.gel.size_mm, MARGIN)
    fine = scene.model_copy(update={"numerics": scene.numerics.model_copy(update={"max_step_mm": 0.125})})
    frames = sorted({k for pair in samples_of(template, 2, 1, scene.motion.steps) for k in pair.frames} - {0})
    presses = (scene, best.mesh), (fine, reference_mesh(gel, zone, best.spacing_mm, 8)[0])
    found, should = (face_displacement(simulate(*press), places(scene), frames) for press in presses)
    # Corrections of the reference may take more iterations, which changes it by much less than its distance.
    assert picture_errors(found, should, scene)[0].max() == pytest.approx(chosen["error_px"], rel=1e-3)
    assert (tmp_path / "budget.png").stat().st_size > 1000
    assert main(options) == status
    assert read(tmp_path / "budget.csv") == rows


def row(mesh: str, error: float | None, seconds: float, unknowns: int, **other: Any) -> Row:
    found = {"mesh": mesh, "error_px": error, "seconds": seconds, "unknowns": unknowns, "chosen": False}
    return {**found, "target_px": 1.0, "predicted_px": 0.5, "spacing_mm": 1.0, **other}


def test_judging_and_counting() -> None:
    """By hand: the chosen mesh against the cheapest within the target, and the reference by Richardson's rule."""
    truth = row("reference", None, np.nan, 0, spacing_mm=0.25)
    coarse, good, fine = row("4x2", 1.5, 1, 100), row("6x2", 0.8, 2, 400), row("8x2", 0.2, 5, 1600, spacing_mm=0.5)
    chosen = {"chosen": True}
    met = judge([truth, coarse, good, fine | chosen])
    cheap = judge([truth, coarse | chosen, good, fine])
    none = judge([truth, coarse | chosen])
    assert [one["within"] for one in (met, cheap, none)] == [True, False, False]
    assert [one["times_cheapest"] for one in (met, cheap, none)] == [2.5, 0.5, None]
    assert met["times_cheapest_by_unknowns"] == pytest.approx(4**1.25)
    assert met["own_px"] == pytest.approx(0.2 / (2**1.6 - 1))
    assert judge([truth, row("4x2", None, 1, 100, chosen=True)]) is None, "a reference that stopped"
    counted, ratios = summary("tiny", 5, [met, cheap, none]), np.log([0.4, 3, 3])
    expected = {"judged": 3, "within": "1 (33%)", "cost <= 2x": "1 of 2", "by unknowns": "1 of 2", "error/target": 1.5,
                "measured/predicted": f"{np.exp(ratios.mean()):.2f} (± {ratios.std():.2f})"}  # fmt: skip
    assert counted | expected == counted
    assert summary("tiny", 5, []) == {"scene": "tiny", "draws": 5, "judged": 0}
