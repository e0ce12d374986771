"""`benchmarks fem`: errors of known fields, errors that fall with the elements, and options that do what they say."""

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from commands import said

from benchmarks import fem
from benchmarks.fem import CASES, PLAIN, PX_PER_MM, Setting, errors, mark_best, mesh_of, press, press_of, settings_of
from benchmarks.press import PAD_MM, ball_scene, face_displacement, face_grid, timed
from benchmarks.rows import Row, read
from synth.simulate import Trajectory

SHALLOW = ball_scene(4.0, 0.0, {"depth_mm": 0.6, "steps": 1})
COARSE = {"max_step_mm": 0.5}


@pytest.fixture(scope="module")
def shallow() -> Trajectory:
    setting = Setting("", ("graded", 2), "P1/P1", numerics=COARSE)
    return press_of(SHALLOW, mesh_of(setting.mesh, SHALLOW), setting).run()


@pytest.fixture
def one_case(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(fem.CASES, "shallow", SHALLOW)
    monkeypatch.setitem(fem.COUNTED, "shallow", [1])


def posed(trajectory: Trajectory, displacement: np.ndarray, force: tuple[float, float, float]) -> Trajectory:
    state = replace(trajectory.states[1], displacement=displacement, force_n=np.array(force))
    return replace(trajectory, states=(trajectory.states[0], state))


def test_errors_of_known_fields(shallow: Trajectory) -> None:
    still = np.zeros_like(shallow.states[1].displacement)
    truth = posed(shallow, still + np.array([0, 0, 2.0]), (0.3, 0.4, 1.0))
    off = errors(posed(shallow, still + np.array([0.03, 0.04, 2.12]), (0.4, 0.3, 1.1)), truth, [1])
    # |(0.03, 0.04, 0.12)| = 0.13 of 2 mm, |(0.03, 0.04)| = 0.05; the force turns, |(0.1, -0.1)| of 0.5.
    assert off["displacement_percent"] == pytest.approx(6.5)
    assert off["displacement_px"] == pytest.approx(0.05 * PX_PER_MM)
    assert off["force_percent"] == pytest.approx(100 * np.hypot(0.1, 0.1) / 0.5)
    # Next to no tangential force: only the normal one counts.
    truth, found = (posed(shallow, still + 1, (x, 0.0, z)) for x, z in ((1e-3, 1.0), (2e-3, 1.1)))
    assert errors(found, truth, [1])["force_percent"] == pytest.approx(10)


def test_face_displacement_is_the_surface(shallow: Trajectory) -> None:
    """A field linear in x and y is interpolated exactly, whichever the mesh."""
    x, y, _ = shallow.space.points.T
    linear = posed(shallow, np.stack([x, y, 3 * x - y], axis=1), (0, 0, 1))
    points = face_grid(PAD_MM, (61, 46))
    (found,) = face_displacement(linear, points, [1])
    np.testing.assert_allclose(found[:, 2], 3 * found[:, 0] - found[:, 1], atol=1e-12)
    np.testing.assert_allclose(found[:, :2], points, atol=1e-12)
    np.testing.assert_allclose(found[:, 0].reshape(61, 46)[:, 0], np.linspace(-10, 10, 61), atol=1e-12)


def test_the_command(one_case: None, tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors fall with the elements as P2/P1's do, and the plain solver finds the same state on the same mesh."""
    meshes = [Setting("graded P2/P1", ("graded", n, 2), numerics=COARSE) for n in (2, 4)]
    ways = [Setting("plain solver", ("graded", 2, 2), numerics=COARSE, options=PLAIN), *meshes]
    wide = Setting("", ("wide", 8, 2))
    reference = press_of(SHALLOW, mesh_of(wide.mesh, SHALLOW), wide).run()
    monkeypatch.setattr(fem, "settings_of", lambda every, across: {"shallow": ways})
    monkeypatch.setattr(fem, "reference", lambda case, across: reference)
    assert "graded 4 2" in said(capsys, fem.main, "--out", tmp_path)
    rows = plain, coarse, fine = read(tmp_path / "fem.csv")
    assert {row["status"] for row in rows} == {"complete"}
    assert min(row["seconds"] for row in rows) > 0
    # The spacing halves, and the rate is about 1.6 (a factor of 3): half of the error must be gone.
    assert all(fine[name] < coarse[name] / 2 for name in ("displacement_percent", "displacement_px"))
    # Both are within 1e-6 of equilibrium.
    for name in ("displacement_percent", "force_percent"):
        assert plain[name] == pytest.approx(coarse[name], rel=1e-3)
    assert (tmp_path / "fem.png").read_bytes().startswith(b"\x89PNG")
    monkeypatch.setattr(fem, "press", lambda case, settings: pytest.fail(str(case)))  # all rows are there
    assert fem.main(["--out", str(tmp_path)]) == 0


def test_references_that_are_none_are_refused(monkeypatch: pytest.MonkeyPatch, shallow: Trajectory) -> None:
    lost = replace(shallow, reason="lost")
    monkeypatch.setattr(fem, "press_of", lambda *_: type("Ended", (), {"run": lambda self: lost})())
    with pytest.raises(RuntimeError, match="is partial"):
        fem.reference.__wrapped__("centred", 8)


def test_elements_and_contact_points(one_case: None, monkeypatch: pytest.MonkeyPatch, shallow: Trajectory) -> None:
    """Linear displacements alone lock: at a Poisson ratio of 0.4999 the ball is pushed back much harder."""
    monkeypatch.setattr(fem, "reference", lambda case, across: shallow)
    plain = Setting("same", ("graded", 2), "P1/P1", numerics=COARSE)
    ways = [plain, replace(plain, family="P1", element="P1"), replace(plain, family="3 points", contact_split=1)]
    cases = [way.case("shallow", 8) for way in ways]
    settings = {(case["family"], case["mesh"]): way for case, way in zip(cases, ways, strict=True)}
    same, locked, few = map(partial(press, settings=settings), cases)
    assert (same["displacement_percent"], same["force_percent"]) == (0, 0)
    assert locked["force_percent"] > 50
    assert locked["unknowns"] < same["unknowns"]  # no pressures
    assert 0 < few["force_percent"] < 20


def test_settings_are_well_formed() -> None:
    """Settings of a case differ in their keys; the plain solver comes first; the fine zone follows the ball."""
    for every in (False, True):
        for name, ways in settings_of(every, 12).items():
            assert ways[0].options == PLAIN
            keys = [(way.family, way.case(name, 12)["mesh"]) for way in ways]
            assert len(set(keys)) == len(keys)
    uniform = mesh_of(("uniform", 6, 4, 2), CASES["centred"])
    for axis, count in enumerate((6, 4, 2)):
        np.testing.assert_allclose(np.diff(np.unique(uniform.points[:, axis])), PAD_MM[axis] / count)
    beside = np.unique(mesh_of(("graded", 6), CASES["off-centre"]).points[:, 0])
    assert beside[np.argmin(np.diff(beside))] == pytest.approx(3.7, abs=3)


def test_best_rows_speed_up_and_short_presses_timed_three_times(monkeypatch, shallow: Trajectory) -> None:
    figures = [(10, 1), (1, 4), (2, 5), (4, 2), (0.5, None)]
    rows: list[Row] = [{"seconds": s, **({} if e is None else {"displacement_percent": e})} for s, e in figures]
    mark_best(rows)
    assert [row["best"] for row in rows] == ["*", "*", "", "*", ""]
    assert [row["speed_up"] for row in rows] == [1, 10, 5, 2.5, 20]
    for ends, median in (([0, 1.0, 1, 1.5, 2, 9], 1.0), ([0, 3.0], 3.0)):
        clock = iter(ends)
        monkeypatch.setattr("time.process_time", lambda clock=clock: next(clock))
        assert timed(lambda: shallow) == (shallow, median)
        assert next(clock, None) is None
