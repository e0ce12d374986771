"""The arithmetic of the error budget's study, on numbers made by hand: verdicts, tallies, and schedules."""

from dataclasses import replace

import numpy as np
import pytest

from synth.bench.budget_draws import misses
from synth.bench.budget_press import Measurement
from synth.bench.budget_schedule import OVERHEAD_S, Schedule
from synth.bench.budget_study import REFERENCE, Job
from synth.bench.budget_tally import tally
from synth.bench.budget_verdict import Rung, Verdict
from synth.planning.prediction import SOLVE_GROWTH


def measured(
    rung: int | str, seconds: float = 1.0, unknowns: int = 100, status: str = "complete", machine: str = "m"
) -> Measurement:
    name = rung if isinstance(rung, str) else f"{rung}x2"
    spacing = 0.1 if isinstance(rung, str) else 1.8 / rung
    return Measurement(
        scene="tiny", index=0, rung=name, status=status, reason="" if status == "complete" else "stuck",
        seconds=seconds, wall_s=seconds, setup_s=0.0, unknowns=unknowns, spacing_mm=spacing,
        penetration_mm=0.001, iterations=1, attempt=0, mesh="", machine=machine,
    )  # fmt: skip


def judged(errors: dict[int, float], chosen: int, target: float = 0.5, **changes: object) -> Verdict:
    """A draw whose rungs cost across seconds, and by unknowns (across / 4)^1.5."""
    rungs = tuple(Rung(measured(k, seconds=k, unknowns=25 * k), error, 0.4) for k, error in errors.items())
    verdict = Verdict("tiny", 0, "sphere", 0.5, target, f"{chosen}x2", 0.4, rungs, measured(REFERENCE))
    return replace(verdict, **changes)  # type: ignore[arg-type]


def test_chosen_is_the_cheapest() -> None:
    verdict = judged({4: 0.9, 6: 0.5, 8: 0.2}, chosen=6)  # on the target is within it
    assert verdict.within
    assert verdict.cheapest() is verdict.chosen_rung
    assert verdict.ratio() == 1
    assert verdict.affordable()


def test_chosen_is_dearer_than_needed() -> None:
    """Fails with the cheapest taken over all rungs, and with the dearest taken."""
    verdict = judged({4: 0.6, 6: 0.4, 8: 0.3, 14: 0.1}, chosen=14)
    assert verdict.cheapest() is verdict.rungs[1]
    assert verdict.ratio() == pytest.approx(14 / 6)
    assert verdict.ratio(nominal=True) == pytest.approx((14 / 6) ** SOLVE_GROWTH)
    assert not verdict.affordable()
    assert judged({4: 0.6, 6: 0.4, 12: 0.1}, chosen=12).affordable()  # twice is allowed
    assert not judged({4: 0.6, 6: 0.4, 12: 0.1}, chosen=12).affordable(nominal=True)


def test_chosen_is_cheaper_than_needed() -> None:
    verdict = judged({4: 0.6, 6: 0.55, 8: 0.4}, chosen=4)
    assert not verdict.within
    assert verdict.ratio() == 0.5
    assert verdict.affordable()
    (row,) = [line for line in misses([verdict], []) if line.startswith("| tiny")]
    assert "8x2 would have, 2 times the time" in row
    assert "predicted 1.5 times too little" in row


def test_no_rung_is_within_the_budget() -> None:
    """Fails with the draw counted among those that can be paid for."""
    verdict = judged({4: 0.9, 6: 0.8}, chosen=6)
    assert verdict.judged
    assert not verdict.within
    assert verdict.cheapest() is None
    assert np.isnan(verdict.ratio())
    assert not verdict.affordable()
    counted = tally("tiny", [verdict, judged({4: 0.4, 6: 0.3}, chosen=6)])
    assert (counted.judged, counted.within, counted.payable, counted.affordable) == (2, 1, 1, 1)
    assert not counted.met
    assert any("no mesh that was run met the target" in line for line in misses([verdict], []))


def test_a_coarse_rung_may_be_within_where_a_finer_one_is_not() -> None:
    """Errors need not fall from rung to rung; a press that did not end is none that would have done."""
    verdict = judged({4: 0.45, 6: 0.55, 8: 0.3}, chosen=8)
    assert verdict.ratio() == 2
    ended = (Rung(measured(4, status="partial"), float("nan"), 0.4), *verdict.rungs[1:])
    assert replace(verdict, rungs=ended).ratio() == 1


def test_times_of_different_machines_are_not_compared() -> None:
    """By unknowns where they would be. Fails with the machine not looked at: 0.5 s there are not less than 8 s here."""
    coarse, fitting, fine = (
        Rung(measured(k, seconds=k, unknowns=25 * k), error, 0.4) for k, error in ((4, 0.6), (6, 0.4), (8, 0.3))
    )
    there = [Rung(measured(k, seconds=0.5, unknowns=25 * k, machine="fast"), 0.4, 0.4) for k in (6, 10)]
    verdict = judged({}, chosen=8, rungs=(coarse, there[0], fine))
    assert not verdict.timed_together
    assert verdict.cheapest() is there[0]
    assert verdict.ratio() == verdict.ratio(nominal=True) == pytest.approx((8 / 6) ** SOLVE_GROWTH)
    finer_there = judged({}, chosen=8, rungs=(coarse, fitting, fine, there[1]))
    assert finer_there.timed_together
    assert finer_there.cheapest() is fitting
    assert finer_there.ratio() == pytest.approx(8 / 6)
    missed = judged({}, chosen=4, rungs=(coarse, there[0]))
    assert missed.ratio() == pytest.approx((4 / 6) ** SOLVE_GROWTH)
    assert tally("tiny", [verdict, finer_there, missed]).untimed == 2


def test_too_little_left_in_the_picture_is_told() -> None:
    blind = judged({4: float("nan")}, 4, seen=0.6)
    assert blind.trouble == "only 60 % of the picture's points stay in the picture, too few to judge by"


def test_draws_of_which_nothing_can_be_said_are_told() -> None:
    """Fails with any of the three left out of `trouble`."""
    errors = {4: 0.4, 6: 0.3}
    no_reference = judged(errors, 4, reference=measured(REFERENCE, status="partial"))
    ended = Rung(measured(4, status="failed"), float("nan"), 0.4)
    no_press = judged(errors, 4, rungs=(ended, Rung(measured(6), 0.3, 0.4)))
    unfinished = judged(errors, 4, missing=1)
    for verdict in (no_reference, no_press, unfinished):
        assert not verdict.judged
    assert "the reference is partial: stuck" in no_reference.trouble
    assert "`generate` replaces the draw" in no_press.trouble
    counted = tally("tiny", [no_reference, no_press, unfinished, judged(errors, 4)], undrawn=1)
    assert (counted.draws, counted.unfinished, counted.judged, counted.within, counted.replaced) == (5, 1, 1, 1, 1)
    told = "\n".join(misses([no_reference, no_press, unfinished], [("tiny", "no | attempt")]))
    assert told.count("| tiny |") == 3
    assert "the reference is partial" in told
    assert "not drawn: no / attempt" in told


def test_two_estimates_of_what_the_reference_leaves_open() -> None:
    """A reference of half the spacing has 0.5^1.6 of the error. Fails with the rate's sign changed."""
    verdict = judged({4: 0.3, 9: 0.2, 16: 0.04}, chosen=9)
    own = 0.04 / (1.125**1.6 - 1)  # of the reference: the finest rung has a spacing of 1.8 / 16 = 0.1125 mm
    assert verdict.added_px == pytest.approx(0.2 + own)
    assert verdict.extrapolated_px == pytest.approx(0.2 / (1 - 0.5**1.6))  # spacings of 0.2 and 0.1 mm
    assert judged({4: 0.0}, chosen=4).extrapolated_px == 0
    counted = tally("tiny", [replace(verdict, target_px=target) for target in (0.19, 0.22, 0.3, 0.41)])
    assert (counted.within, counted.added, counted.extrapolated) == (3, 1, 2)


def test_tally_of_known_numbers() -> None:
    """Error over target 0.1 to 2.0: the 95th percentile lies 0.05 of the way from the 19th to the 20th."""
    verdicts = [judged({4: 0.05 * k}, chosen=4) for k in range(1, 21)]
    counted = tally("tiny", verdicts)
    assert counted.median == pytest.approx(1.05)
    assert counted.high == pytest.approx(1.905)
    assert counted.within == 10
    assert counted.bias == pytest.approx(np.exp(np.mean(np.log(0.05 * np.arange(1, 21) / 0.4))))
    assert not counted.met
    # 19 of 20 are 95 %.
    assert tally("tiny", [*[judged({4: 0.1}, 4)] * 19, verdicts[-1]]).met
    assert not tally("tiny", [*[judged({4: 0.1}, 4)] * 18, *verdicts[-2:]]).met
    assert tally("tiny", [judged({4: 0.0}, 4, predicted_px=0.0)]).met  # untouched


def test_what_would_end_too_late_is_not_begun() -> None:
    """Fails with the deadline left out, with a begun job begun again, and with the last pace, not the largest."""
    now = [0.0]
    long, middle, short = (Job("tiny", 0, rung) for rung in ("16x4", "8x3", "4x2"))
    other = Job("tiny", 1, "16x4")
    schedule = Schedule({long: 8.0, other: 8.0, middle: 2.0, short: 1.0}, 100.0, lambda: now[0])
    assert schedule.begin() == long  # nothing is known yet
    now[0] = OVERHEAD_S + 20.0  # 2.5 s for each of its 8
    schedule.end(long)
    assert schedule.begin() == other
    now[0] += OVERHEAD_S + 16.0  # 2 s each
    schedule.end(other)
    assert schedule.begin() == short  # 76 + 20 + 2.5 s; the middle one would take until 76 + 20 + 2 * 2.5
    assert schedule.begin() is None
    now[0] = 0.0
    assert schedule.begin() == middle
    assert schedule.begin() is None
    assert Schedule({long: 1.0}, 100.0, lambda: 100.0).begin() is None
