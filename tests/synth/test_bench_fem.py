"""The benchmark of the solver, on presses so small that only its workings can be judged; no test asserts a time."""

import csv
import json
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from synth.bench import run_bench
from synth.bench import suite as suites
from synth.bench.accuracy import GRID, Answer, Errors, answer, errors, worst
from synth.bench.cases import GEL, HELD, OFF_CENTRE, SHEARED, Case
from synth.bench.comparison import cheapest, pareto_front, rivalry, speed_up
from synth.bench.fem import Results, Row, measure
from synth.bench.picture import STYLES
from synth.bench.press import Press, pressed, ready_stepper
from synth.bench.report import record, summary, write_results
from synth.bench.setting import Fine, Graded, Setting, Uniform, of_family
from synth.bench.shares import ASSEMBLY, CONTACT, FACTORISATION, GMRES, OTHER, time_shares
from synth.bench.suite import PLAIN_DRIVER, Suite
from synth.errors import InputError
from synth.scene import Motion, Numerics
from synth.simulate.driver import STANDARD

SHALLOW = Case("shallow", Motion(depth_mm=0.6, steps=1), 0.0, (0,), ("0.6 mm",))
COARSE = Numerics(max_step_mm=0.5)
PLAIN = Setting("plain driver", Graded(2), numerics=COARSE, driver=PLAIN_DRIVER)
SMALL = Suite(
    ((SHALLOW, (PLAIN, *(replace(s, numerics=COARSE) for s in of_family("graded", "p2p1", Graded(2), Graded(4))))),),
    Fine(8, 2),
    Fine(6, 2),
    PLAIN,
)


@pytest.fixture(scope="module")
def results() -> Results:
    return measure(SMALL, 17.0, processes=1)


def test_errors_are_finite_and_fall_with_the_number_of_elements(results: Results) -> None:
    coarse, fine = results.rows[1:]
    for row in results.rows:
        assert row.complete
        assert row.seconds > 0
        assert np.isfinite([row.percent, row.px, row.force]).all()
        assert row.iterations > 0
    # The spacing halves, and the rate is about 1.6 (a factor of 3): half of the error must be gone.
    assert fine.percent < coarse.percent / 2
    assert fine.px < coarse.px / 2
    # Of all, the reference is the closest to the mesh that checks it.
    assert worst(results.trust["shallow"].difference.percent, SHALLOW) < fine.percent
    # On the same mesh the plain driver finds the same state: both are within 1e-6 of balance.
    # Fails with its tolerance between records applied to the recorded state, too.
    plain = results.rows[0]
    assert plain.percent == pytest.approx(coarse.percent, rel=1e-3)
    assert plain.force == pytest.approx(coarse.force, rel=1e-3)


def test_what_is_written(results: Results, tmp_path: Path) -> None:
    write_results(tmp_path, results, "the command")
    with (tmp_path / "fem.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["mesh"] for row in rows] == ["2 across", "2 across", "4 across"]
    assert [float(row["worst_error_percent"]) for row in rows] == pytest.approx(
        [row.percent for row in results.rows], rel=1e-4
    )  # five digits
    assert float(rows[0]["speed_up"]) == 1
    assert rows[0]["factor"] == "float64"
    assert rows[0]["tangential_force_percent_1"] == ""
    assert (tmp_path / "fem.png").read_bytes().startswith(b"\x89PNG")
    text = (tmp_path / "fem.md").read_text(encoding="utf-8")
    for heading in ("## Targets", "## Where the time goes", "## How far the references", "## What is not covered"):
        assert heading in text
    assert "the command" in text
    assert "nan" not in text
    assert json.loads(json.dumps(record(results), allow_nan=False)) == record(results)
    assert len(summary(results)) == 2


def _row(family: str, seconds: float, percent: float, force: float = 0.5, status: str = "complete") -> Row:
    """A row with given figures; its trajectory is never looked at but for how it ended."""
    ended = type("Ended", (), {"status": status})()
    press = Press(ended, seconds, seconds, 1, 0.0, 1)
    found = tuple(np.array([value]) for value in (percent, percent, force, np.nan))
    return Row(SHALLOW, Setting(family, Graded(2)), press, Errors(*found), 0.0)


def test_pareto_front_and_speed_up() -> None:
    """Fails with < replaced by > in `pareto_front`, and with incomplete rows kept."""
    rows = [
        _row("plain driver", 10, 1),
        _row("a", 1, 4),
        _row("a", 2, 5),
        _row("b", 4, 2),
        _row("c", 0.5, 1, 1, "partial"),
    ]
    front = pareto_front(rows)
    assert [(row.seconds, row.percent) for row in front] == [(1, 4), (4, 2), (10, 1)]
    assert speed_up(rows[3], rows) == 2.5
    assert np.isnan(speed_up(rows[1], [_row("plain driver", 1, 1, 1, "partial"), rows[1]]))
    assert cheapest(rows, "a", 4.5, 1.0) is rows[1]
    assert cheapest(rows, "a", 3.0, 1.0) is None
    assert cheapest(rows, "a", 4.5, 0.4) is None
    assert cheapest(rows, "c", 4.5, 2.0) is None


def test_families_are_compared_at_equal_time() -> None:
    """Errors of 4 / time for one, 12 / time: three times as much, wherever they overlap."""
    rows = [_row("a", t, 4 / t, 4 / t) for t in (1.0, 2.0, 8.0)] + [
        _row("b", t, 12 / t, 8 / t) for t in (0.5, 3.0, 8.0, 9.0)
    ]
    found = rivalry(rows, "a", "b")
    np.testing.assert_allclose(found.seconds, [3, 8])
    np.testing.assert_allclose(found.displacement, 3)
    np.testing.assert_allclose(found.force, 2)
    assert len(rivalry(rows, "a", "none").seconds) == 0
    assert len(rivalry(rows, "none", "b").seconds) == 0


def test_errors_of_known_fields() -> None:
    """Fails with the z component left in px, with the tangential error of lengths in place of vectors."""
    grid = np.zeros((1, 5, 3))
    reference = Answer(grid + np.array([0, 0, 2.0]), np.array([[0.3, 0.4, 1.0]]))
    found = Answer(grid + np.array([0.03, 0.04, 2.12]), np.array([[0.4, 0.3, 1.1]]))
    off = errors(found, reference, SHEARED, 20.0)
    # |(0.03, 0.04, 0.12)| = 0.13 of 2 mm, |(0.03, 0.04)| = 0.05 at 20 px/mm; the force turns, |(0.1, -0.1)| of 0.5.
    np.testing.assert_allclose([off.percent[0], off.px[0]], [6.5, 1.0])
    np.testing.assert_allclose([off.normal[0], off.tangential[0]], [10.0, 100 * np.hypot(0.1, 0.1) / 0.5])
    none = errors(Answer(grid[:0], np.zeros((0, 3))), reference, SHEARED, 20.0)
    assert np.isnan([none.percent[0], none.px[0], none.normal[0], none.tangential[0]]).all()
    assert np.isnan(errors(found, reference, HELD, 20.0).tangential).all()


def test_answer_is_the_surface() -> None:
    """A field linear in x and y is interpolated exactly, whichever the mesh. Fails with the grid's axes exchanged."""
    press = pressed(SHALLOW, replace(PLAIN, element="p1p1"), Graded(2).mesh(SHALLOW), 0.0)
    space, state = press.trajectory.space, press.trajectory.states[1]
    linear = np.stack([space.points[:, 0], space.points[:, 1], 3 * space.points[:, 0] - space.points[:, 1]], axis=1)
    posed = replace(press.trajectory, states=(state, replace(state, displacement=linear)))
    x, y, z = answer(posed).displacement[0].T
    np.testing.assert_allclose(z, 3 * x - y, atol=1e-12)
    np.testing.assert_allclose(x.reshape(GRID)[:, 0], np.linspace(-10, 10, GRID[0]), atol=1e-12)
    np.testing.assert_allclose(y.reshape(GRID)[0], np.linspace(-7.5, 7.5, GRID[1]), atol=1e-12)


def test_shares_tell_the_parts_apart() -> None:
    """They sum to 1 exactly, by construction of the rest, so each part is looked at."""
    shares = time_shares(ready_stepper(SHALLOW, PLAIN, Graded(2).mesh(SHALLOW)).run)
    assert sum(shares.values()) == pytest.approx(1)
    assert all(shares[part] > 0 for part in (FACTORISATION, ASSEMBLY, CONTACT, OTHER))


def test_shares_by_a_clock_of_our_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails with a part ended by the return of a call within it, and with all kernels taken for the gel's."""
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])

    def spend(seconds: float) -> None:
        now[0] += seconds

    def launch(kernel: SimpleNamespace, seconds: float) -> None:
        """As Warp's function of that name: what is looked at are the names, its own and its argument's."""
        spend(0.0)
        spend(seconds)

    def run() -> None:
        launch(SimpleNamespace(key="contact_tangent"), 3.0)
        spend(2.0)
        launch(SimpleNamespace(key="bulk_tangent"), 4.0)
        launch(SimpleNamespace(key="settle"), 1.0)

    shares = time_shares(run)
    assert shares == pytest.approx({FACTORISATION: 0, ASSEMBLY: 0.4, CONTACT: 0.4, GMRES: 0, OTHER: 0.2})


def test_the_plain_driver_needs_more_iterations() -> None:
    """Fails with the driver left out of `ready_stepper`, and with either of its settings without effect."""
    counts = []
    exact = replace(STANDARD, keep_factors=False)  # rough directions save time, not iterations
    for driver in (exact, replace(exact, loose=0.0), replace(exact, extrapolate=False), PLAIN_DRIVER):
        setting = replace(PLAIN, numerics=Numerics(max_step_mm=0.1), driver=driver)
        press = pressed(SHALLOW, setting, Graded(2).mesh(SHALLOW), 0.0)
        counts.append(sum(state.newton_iterations for state in press.trajectory.states))
    standard, tight, unpredicted, plain = counts
    assert standard < min(tight, unpredicted)
    assert max(tight, unpredicted) < plain


def test_double_factor_solves_to_double_precision() -> None:
    """Fails with single left out of `direct_factor`'s arguments: 1e-6."""
    stepper = ready_stepper(SHALLOW, PLAIN, Graded(2).mesh(SHALLOW))
    system, active = stepper.system, np.ones(1, dtype=bool)
    tangent = system.tangent(system.zero(), stepper.indenters, active)
    right = np.random.default_rng(0).standard_normal((1, len(system.free)))
    step = system.newton_step(tangent, right, active)
    solution = np.concatenate([step.u[0].ravel(), step.p[0]])[system.free]
    upper = system.matrix(tangent.values[0])
    left = upper @ solution + upper.T @ solution - upper.diagonal() * solution + right[0]
    # A backward stable solve leaves some 1e-16 of |K| |x|, which at a Poisson ratio of 0.4999 is 1e4 times |r|.
    assert np.linalg.norm(left) < 1e-10 * np.linalg.norm(right)


def test_suites_are_well_formed() -> None:
    """Every setting can be meshed and told from the others of its case; the plain driver comes first."""
    for suite in (suites.whole(), suites.quick()):
        for case, settings in suite.cases:
            assert settings[0] == suites.PLAIN
            names = [setting.name for setting in settings]
            assert len(set(names)) == len(names)
            assert suites.BASE in settings or suite.cases[0][0] is not case
            assert {setting.family for setting in settings} <= set(STYLES)  # else the plot would leave them out
    assert len(suites.whole().cases) == 3
    uniform = Uniform((6, 4, 2)).mesh(HELD)
    for axis, count in enumerate((6, 4, 2)):
        planes = np.unique(uniform.points[:, axis])
        np.testing.assert_allclose(np.diff(planes), GEL.size_mm[axis] / count)
    # The zone follows the ball.
    assert OFF_CENTRE.focus.centre_mm == pytest.approx((3.7, -2.3), abs=0.05)


def test_unknown_benchmark(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="fem"):
        run_bench("speed", tmp_path, True, False)
