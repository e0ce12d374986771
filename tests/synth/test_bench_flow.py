"""`bench flow` on flat gels whose flow has a closed form, on a bump that hides a part, and a whole run; `bench all`.

No test asserts a time.
"""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from render_scenes import flat_surface, plain, small_sensor
from tiny_scene import own_cache, write_tiny

import synth.bench
from synth.bench import every, flow_measure
from synth.bench.every import Bench
from synth.bench.flow_measure import Row, failures, measure, truth
from synth.bench.flow_methods import SHIPPED, methods
from synth.bench.flow_picture import pareto_front
from synth.bench.render_subject import View
from synth.cli import main
from synth.cli_bench import bench
from synth.optics import Optics


@pytest.fixture(autouse=True)
def _cache(monkeypatch: pytest.MonkeyPatch) -> None:
    """One mesh for all runs: the mesher is random."""
    own_cache(monkeypatch)


FOCAL = 160.0
"""px, so that the gel's edges stay out of the picture."""


def _moved(index: float, motion: tuple[float, float, float], cells: int = 12) -> View:
    """A flat gel that moves as a whole, mm; no refraction at index 1."""
    sensor = small_sensor(index, fx=FOCAL, fy=FOCAL)
    surface = flat_surface(sensor, cells)
    return View(sensor, plain(), surface, surface.material + np.array(motion))


def _rows(view: View) -> dict[str, Row]:
    return {row.method: row for row in measure("flat", view, truth(view))}


def test_every_way_is_right_where_it_leaves_out_nothing() -> None:
    """Without refraction, for motion along a flat face, flow is f t / Z everywhere and each simplification is exact.

    Fails with the enlarged flow not scaled (error 2.3 px), with the affine map's last row, the offset, in place of its
    second (17 px), and with the single-precision rays traced in float64 (no worse than the shipped way's).
    """
    view = _moved(1.0, (0.47, -0.32, 0.0))  # its ends lie off the border
    pair, expected = truth(view), FOCAL * np.array([0.47, -0.32]) / 20.0
    # float64; the root search ends at 1e-6 of a triangle's weights at worst, here of 0.5 mm and 8 px/mm.
    np.testing.assert_allclose(pair.motions[0][0], np.broadcast_to(expected, (60, 80, 2)), atol=4e-6)
    np.testing.assert_allclose(pair.lengths, np.hypot(*expected), atol=4e-6)
    found = _rows(view)
    assert len(found) == len(methods(view)) == 10  # a quarter of 60 rows is less than the schema allows
    for name, row in found.items():
        # float32 flow of 4 px: 2.4e-7; rays in float32: 6e-8 of 20 mm and of the ray's slope over it, times 8 px/mm,
        # magnified by as much again where the point is named by weights.
        limit = 1e-4 if "float32" in name else 5e-6
        assert row.max_px < limit, name
        assert row.mask_px == 0, name
    assert found["traced in float32"].mean_px > 3 * found[SHIPPED].mean_px


def test_what_a_camera_without_perspective_misses() -> None:
    """A gel that rises by 0.5 mm: no motion in x and y, so that the affine camera misses all of it.

    Fails with the fitted matrix applied to z and y in place of x and y.
    """
    view = _moved(1.0, (0.0, 0.0, 0.5))
    pair = truth(view)
    row = _rows(view)["affine camera, fitted"]
    assert row.max_px == pytest.approx(pair.lengths.max(), rel=1e-6)
    # f r / (Z - 0.5) - f r / Z at the corner pixel farthest from the axis, (42, 28) px; backward it is smaller.
    assert row.max_px == pytest.approx(np.hypot(42, 31) * (20 / 19.5 - 1), rel=0.03)


def test_the_fitted_pinhole_is_the_paraxial_one() -> None:
    """Apparent depth: 14 mm of air and 6 mm of gel at n = 1.45 look like 14 + 6 / 1.45.

    Off the axis the last term, 23 % of the depth, differs by (1 - 1 / n²) tan² / 2: 0.7 % of the depth at the corners,
    less in the mean. Fails with the ratio's inverse (0.907).
    """
    from synth.bench.flow_methods import _fitted_pinhole

    camera = _fitted_pinhole(_moved(1.45, (0, 0, 0))).camera
    assert camera.fx / FOCAL == pytest.approx(20 / (14 + 6 / 1.45), rel=0.007)
    assert camera.fy / camera.fx == pytest.approx(1, rel=1e-12)


def test_refraction_left_out() -> None:
    """Seen straight from above a translation is scaled by the ratio of the apparent depths.

    Fails with `without_window` left out of the method (no error).
    """
    found = _rows(_moved(1.45, (0.5, 0.0, 0.0)))
    lost = 0.5 * FOCAL * (1 / (14 + 6 / 1.45) - 1 / 20)
    # The depth differs by 0.25 % in the mean (as above), its derivative by up to three times that: 0.033 of 4.4 px.
    assert found["no refraction"].mean_px == pytest.approx(lost, abs=0.033)
    assert found["no refraction, focal length fitted"].mean_px < 0.1 * lost
    assert found["vertices of the rendered surface, interpolated"].mean_px < 0.01 * lost


def _bump() -> View:
    """A gel with a bump near the side of the image, so steep that it hides what lies behind it."""
    flat = _moved(1.0, (0.0, 0.0, 0.0), 48)
    pressed = flat.pressed.copy()
    pressed[:, 2] += 2.5 * np.exp(-((pressed[:, 0] - 4.0) ** 2 + pressed[:, 1] ** 2) / 0.35**2)
    return replace(flat, pressed=pressed)


def test_occlusion() -> None:
    """Fails with an overlap test that returns nothing (the shipped way then errs as the untested one does)."""
    view = _bump()
    pair = truth(view)
    found = _rows(view)
    assert pair.hidden > 5
    assert found[SHIPPED].mask_px == found["every pixel tested for occlusion"].mask_px == 0
    assert found["no test for occlusion"].mask_px == pair.hidden
    # Single precision may decide otherwise at the silhouette alone, a line of some ten pixels.
    assert found["traced in float32"].mask_px <= 2
    assert failures(view, pair) == []


def test_failures_are_told() -> None:
    """The derivation of another press does not fit. Fails with `failures` that returns nothing."""
    view = _bump()
    told = failures(view, truth(_moved(1.0, (0.02, 0.0, 0.0), 48)))
    assert any(line.startswith("forward flow: ") for line in told)
    assert any(line.startswith("backward flow: ") for line in told)


def test_pareto_front() -> None:
    """Fast and rough; slow and exact; as slow and less exact; slower and no better. Fails with `<=` for `<`."""
    rough = Row("s", "f", "rough", 0.5, 1.0, 2.0, 0, 1.0)
    exact = replace(rough, method="exact", mean_px=0.001, ms=10.0)
    beaten = replace(exact, method="beaten", mean_px=0.01)
    slow = replace(exact, method="slow", ms=11.0)
    assert pareto_front([slow, beaten, exact, rough]) == [rough, exact]


def test_bench_flow(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    scene, out = write_tiny(tmp_path), tmp_path / "out"
    assert main(["bench", "flow", str(scene), "--out", str(out), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    # 24 rows have no half that the schema allows.
    assert [row["method"] for row in answer["rows"]][:2] == [SHIPPED, "every pixel tested for occlusion"]
    assert len(answer["rows"]) == 9
    assert answer["failures"] == []
    assert answer["rows"][0]["max_px"] < 1e-5  # float32 flow of a few px
    assert all(row["ms"] > 0 for row in answer["rows"])
    with (out / "flow.csv").open() as file:
        assert [line["method"] for line in csv.DictReader(file)] == [row["method"] for row in answer["rows"]]
    text = (out / "flow.md").read_text()
    assert f"python -m synth bench flow {scene.name} --out DIR" in text
    assert text.count("| **") == sum(row["pareto"] for row in answer["rows"]) > 0
    assert (out / "flow.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(flow_measure, "failures", lambda *_: ["forward flow: far off"])
    assert main(["bench", "flow", str(scene), "--out", str(out)]) == 1
    assert "verify would object: tiny: forward flow: far off" in capsys.readouterr().out


def test_a_scene_counts_once(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = str(write_tiny(tmp_path))
    assert main(["bench", "flow", scene, scene, "--out", str(tmp_path / "out")]) == 2
    assert "tiny, tiny; each may be given once" in capsys.readouterr().err


def test_bench_all_goes_on(tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The first cannot run. Fails with `check=True` in the call (nothing of the second)."""
    scene, out = write_tiny(tmp_path), tmp_path / "out"
    monkeypatch.setattr(every, "BENCHES", (Bench("light", 3, ("no_such",)), Bench("flow", 0.5, (str(scene),))))
    assert main(["bench", "all", "--out", str(out), "--json"]) == 1
    said = capfd.readouterr()
    answer = json.loads(said.out)
    assert {name: one["status"] for name, one in answer.items()} == {"light": 2, "flow": 0}
    assert (out / "flow" / "flow.md").exists()
    assert "light 3 min, flow 0.5 min: 3.5 min" in said.err
    assert "there is no scene 'no_such'" in said.err
    monkeypatch.setattr(every, "BENCHES", ())
    assert main(["bench", "all", "--out", str(out)]) == 0


def test_bench_all_knows_every_benchmark() -> None:
    names = {name for name in bench if not name.startswith("-")}
    assert {one.name for one in every.BENCHES} | {"all"} == names


def test_bench_light_has_a_scene_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[list[str]] = []

    def run(scenes: list[str], *_: object) -> int:
        seen.append(scenes)
        return 0

    monkeypatch.setattr(synth.bench, "run_light", run)
    assert main(["bench", "light"]) == 0
    assert main(["bench", "light", "digit", "gelsight"]) == 0
    assert seen == [["gelsight_mini"], ["digit", "gelsight"]]


def test_optics_of_the_bump_look_straight() -> None:
    """The closed forms above take the camera's axis for the z axis."""
    ray = Optics.of(_bump().sensor).look(np.array([[42.5, 28.5]]))
    np.testing.assert_allclose(ray.directions, [[0, 0, -1]], atol=1e-12)
