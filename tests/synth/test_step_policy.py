"""The step policy against a scripted back end, which has no finite elements: what it asks for, and in what order."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import inf, nan
from typing import Any

import pytest
from pads import SPHERE, scene

from synth.press.indenter import rigid_body
from synth.press.load_path import LoadPath
from synth.simulate.direct import led
from synth.simulate.options import SolverOptions
from synth.simulate.policy import load_steps, multipliers, newton
from synth.simulate.policy import requests as ask
from synth.simulate.policy.load_steps import LoadSteps
from synth.simulate.policy.newton import Solution

GOOD = ask.Evaluation(free=1.0, forces=1.0, reaction=1.0, smallest_jacobian=0.5, deepest_mm=0.0)
TOLERANCE = 1e-6
FORCE = 1.0


@dataclass
class Scripted:
    """A back end whose residual falls by a factor with each Newton step, unless a trial is scripted.

    Attributes:
        falls: factor on the residual of a full step.
        trial: what becomes of a trial's evaluation; it is told the path length.
        deepest_mm: penetration of what comes to rest; halved by whole updates of the multipliers.
        asked: all requests.
    """

    falls: float = 0.009
    trial: Callable[[float, ask.Evaluation], ask.Evaluation] = lambda at, seen: seen
    finite: bool = True
    force: float = FORCE
    deepest_mm: float = 0.0
    asked: list[ask.Request] = field(default_factory=list)
    at_mm: float = 0.0
    seen: ask.Evaluation = GOOD
    kept: dict[str, tuple[ask.Evaluation, float]] = field(default_factory=dict)

    def answer(self, request: ask.Request) -> Any:
        self.asked.append(request)
        match request:
            case ask.Begin(at_mm):
                self.at_mm = at_mm
                self.seen = replace(GOOD, deepest_mm=self.deepest_mm)
                return self.seen
            case ask.Solve():
                return self.finite
            case ask.Try(share):
                free = self.seen.free * (1 - share * (1 - self.falls))
                self.tried = self.trial(self.at_mm, replace(self.seen, free=free))
                return self.tried
            case ask.Do.TAKE:
                self.seen = self.tried
            case ask.Do.KEEP_STEP | ask.Do.KEEP_PASS:
                self.kept[request.name[5:]] = (self.seen, self.deepest_mm)
            case ask.Do.RESTORE_STEP | ask.Do.RESTORE_PASS:
                self.seen, self.deepest_mm = self.kept[request.name[8:]]
            case ask.Do.REPEAT | ask.Augment():
                if isinstance(request, ask.Augment):
                    self.deepest_mm *= 1 - request.share / 2
                self.seen = replace(GOOD, deepest_mm=self.deepest_mm)
                return self.seen
            case ask.Do.FORCE:
                return self.force
        return None

    def kinds(self) -> str:
        """The requests' names in turn."""
        return " ".join(r.name if isinstance(r, ask.Do) else type(r).__name__ for r in self.asked)

    def all_of(self, kind: Any) -> list[Any]:
        return [r for r in self.asked if r is kind or (isinstance(kind, type) and isinstance(r, kind))]


def steps(
    depth_mm: float = 0.3,
    count: int = 1,
    frames: frozenset[int] | None = None,
    percent: float | None = None,
    **motion: Any,
) -> LoadSteps:
    """The policy of a ball, with load steps of at most 0.1 mm."""
    own = {} if percent is None else {"element": "p2p1", "edge_length_mm": None, "target_error_percent": percent}
    posed = scene(
        friction=0.5,
        motion={"depth_mm": depth_mm, "steps": count, **motion},
        numerics={"max_step_mm": 0.1, "tolerance": TOLERANCE, **own},
    )
    path = LoadPath(posed.motion, rigid_body(SPHERE_BODY))
    return LoadSteps(path, (8.0, 6.0, 4.0), True, posed.numerics, SolverOptions(), frames)


SPHERE_BODY = scene(indenter=SPHERE).contact.indenter


def solved(back_end: Scripted, at: ask.Evaluation = GOOD, tolerance: float = TOLERANCE, **limits: Any) -> Solution:
    back_end.seen = at
    return led(newton.solve(at, tolerance, **limits), back_end.answer)


def test_newton_takes_full_steps_until_the_tolerance() -> None:
    back_end = Scripted()
    found = solved(back_end)
    assert (found.converged, found.iterations) == (True, 3)  # 0.009 ** 3 is 7e-7
    assert back_end.kinds() == " ".join(["Solve Try TAKE"] * 3)
    assert [request.iteration for request in back_end.all_of(ask.Solve)] == [0, 1, 2]


def test_newton_gives_up_what_stalls_turns_to_nan_has_no_direction_or_inverts() -> None:
    stalling = solved(Scripted(falls=0.95))
    assert (stalling.converged, stalling.iterations) == (False, newton.STALL_ITERATIONS)
    slow = solved(Scripted(falls=0.8), limit=10)
    assert (slow.converged, slow.iterations) == (False, 10)
    assert solved(Scripted(falls=0.3), limit=10).iterations == 12  # near the equilibrium it may go on
    none = Scripted(finite=False)
    assert (solved(none).converged, none.kinds()) == (False, "Solve")
    broken = Scripted(trial=lambda at, seen: replace(seen, free=nan))
    assert not solved(broken).converged
    # Below INDIFFERENT the residual does not count, so that the fifth trial is taken and its NaN seen.
    assert broken.kinds() == "Solve Try Try Try TAKE"
    inverted = Scripted(trial=lambda at, seen: replace(seen, smallest_jacobian=-1.0))
    assert not solved(inverted).converged
    assert [request.share for request in inverted.all_of(ask.Try)] == [2.0**-k for k in range(11)]
    assert Scripted().asked == []
    assert not solved(untouched := Scripted(), replace(GOOD, smallest_jacobian=0.0)).converged
    assert untouched.asked == []


def test_newton_stops_where_a_node_has_gone_too_far() -> None:
    back_end = Scripted(trial=lambda at, seen: replace(seen, moved_mm=0.2))
    assert solved(back_end, reach_mm=0.1).iterations == 1
    assert solved(back_end, reach_mm=0.3).converged


def test_relaxation_ends_at_rest_or_where_the_body_has_slipped_off() -> None:
    def relaxed(trial: Callable[[ask.Evaluation], ask.Evaluation]) -> tuple[Solution, Scripted]:
        back_end = Scripted(falls=0.1, trial=lambda at, seen: trial(seen))
        return led(newton.relax(GOOD, TOLERANCE), back_end.answer), back_end

    rests, back_end = relaxed(lambda seen: replace(seen, error=0.01))
    viscosity = [request.viscosity for request in back_end.all_of(ask.Solve)]
    assert rests.converged
    assert viscosity[0] == newton.FIRST_VISCOSITY
    assert viscosity[-1] == 0.0
    assert not relaxed(lambda seen: replace(seen, reaction=0.1))[0].converged
    refused, back_end = relaxed(lambda seen: replace(seen, error=inf))
    assert not refused.converged
    assert not back_end.all_of(ask.Do.TAKE)
    assert back_end.all_of(ask.Try)[-1].share == newton.LEAST_SHARE


def test_a_path_that_never_touches_asks_for_nothing() -> None:
    back_end = Scripted()
    assert led(steps(-0.2).run(), back_end.answer) == ""
    assert back_end.asked == []


def test_a_press_goes_in_equal_steps_extrapolates_and_records_its_states() -> None:
    back_end = Scripted(falls=1e-7)
    policy = steps(0.3, 2)
    assert led(policy.run(), back_end.answer) == ""
    begun = back_end.all_of(ask.Begin)
    assert [request.at_mm for request in begun] == pytest.approx([0.0, 0.075, 0.15, 0.225, 0.3])
    assert [request.ratio for request in begun] == pytest.approx([0, 0, 1, 1, 1])
    assert [(record.at_mm, record.iterations) for record in back_end.all_of(ask.Record)] == [(0.15, 2), (0.3, 2)]
    assert len(back_end.all_of(ask.Do.ACCEPT)) == 5
    record = "KEEP_STEP ANCHOR Record RESTORE_STEP ACCEPT"
    assert back_end.kinds().endswith(f"Begin Solve Try TAKE FORCE {record}")
    # Where the last state alone is wanted the other is recorded without anchors, as the path goes through it.
    back_end = Scripted(falls=1e-7)
    led(steps(0.3, 2, frozenset({2})).run(), back_end.answer)
    assert len(back_end.all_of(ask.Do.ANCHOR)) == 1
    assert len(back_end.all_of(ask.Record)) == 2


def test_after_a_turn_the_rigid_motion_predicts_and_what_inverts_is_not_gone_on_from() -> None:
    back_end = Scripted(falls=1e-7)
    led(steps(0.1, 2, shear_mm=[0.1, 0.0]).run(), back_end.answer)
    assert [request.rigid for request in back_end.all_of(ask.Begin)] == [False, False, True]

    class Inverting(Scripted):
        def answer(self, request: ask.Request) -> Any:
            found = super().answer(request)
            is_predicted = isinstance(request, ask.Begin) and (request.rigid or request.ratio)
            return replace(found, smallest_jacobian=-1.0) if is_predicted else found

    back_end = Inverting(falls=1e-7)
    assert led(steps(0.2).run(), back_end.answer) == ""
    assert [request.ratio for request in back_end.all_of(ask.Begin)] == [0, 0, 1, 0]


def test_a_step_that_fails_is_halved_and_a_short_one_relaxed() -> None:
    """Nothing converges beyond 0.1 mm: steps are halved, relaxed from a quarter on, and the press ends."""

    def lost(at: float, seen: ask.Evaluation) -> ask.Evaluation:
        return replace(seen, free=1.0, error=inf) if at > 0.11 else seen

    back_end = Scripted(falls=1e-7, trial=lost)
    policy = steps(0.2)
    reason = led(policy.run(), back_end.answer)
    assert "did not converge" in reason
    assert policy.at == pytest.approx(0.1, abs=0.02)
    assert policy.step < load_steps.SHORTEST_STEP * 0.1
    assert not back_end.all_of(ask.Record)
    failed = [request.at_mm - 0.1 for request in back_end.all_of(ask.Begin) if request.at_mm > 0.11]
    assert failed[:2] == pytest.approx([0.1, 0.05])
    thick = [request.viscosity for request in back_end.all_of(ask.Solve) if request.viscosity is not None]
    assert max(thick) == newton.MOST_VISCOSITY
    # A step that is tried again with success goes on from there to the end.
    attempts = iter([False] * 40 + [True] * 1000)
    flaky = Scripted(falls=1e-7, trial=lambda at, seen: seen if next(attempts) else replace(seen, free=nan))
    assert led(steps(0.2).run(), flaky.answer) == ""
    assert len(flaky.all_of(ask.Record)) == 1


def test_a_body_that_meets_no_force_at_the_end_of_its_press_ends_the_path() -> None:
    back_end = Scripted(falls=1e-7, force=0.0)
    assert "touches no contact point" in led(steps(0.1).run(), back_end.answer)
    assert not back_end.all_of(ask.Record)


def test_passes_take_penetration_away_by_two_whole_updates() -> None:
    back_end = Scripted(falls=1e-7, deepest_mm=0.01)
    assert led(steps(0.1).run(), back_end.answer) == ""
    assert [(pass_.share, pass_.stiffening) for pass_ in back_end.all_of(ask.Augment)] == [(1.0, 1.0), (1.0, 1.0)]
    (record,) = back_end.all_of(ask.Record)
    assert record.evaluation.deepest_mm == 0.0025
    assert record.iterations == 3  # of the step and of both passes
    assert [request.tolerance for request in back_end.all_of(ask.Solve)] == [1e-3, 20 * TOLERANCE, TOLERANCE]


def test_passes_that_fail_are_halved_undone_and_at_last_given_up() -> None:
    """Each trial after the first multiplier update is lost; the state without any update is recorded."""
    back_end = Scripted(falls=1e-7, deepest_mm=0.004)
    back_end.trial = lambda at, seen: replace(seen, free=nan) if back_end.all_of(ask.Augment) else seen
    assert led(steps(0.1).run(), back_end.answer) == ""
    assert [pass_.share for pass_ in back_end.all_of(ask.Augment)] == [1.0, 0.5, 0.25]
    assert len(back_end.all_of(ask.Augment)) == multipliers.FAILURES
    (record,) = back_end.all_of(ask.Record)
    assert record.evaluation.deepest_mm == 0.004
    assert len(back_end.all_of(ask.Do.RESTORE_PASS)) == 3
    assert len(back_end.all_of(ask.Do.RESTORE_STEP)) == 1
    # A budget for force is worth more attempts.
    patient = Scripted(falls=1e-7, deepest_mm=0.004)
    patient.trial = lambda at, seen: replace(seen, free=nan) if patient.all_of(ask.Augment) else seen
    assert led(steps(0.1, percent=1.0).run(), patient.answer) == ""
    assert len(patient.all_of(ask.Augment)) == multipliers.MAX_FAILURES
    # What stays deeper than a fifth of the depth is not recorded.
    back_end = Scripted(falls=1e-7, deepest_mm=0.2)
    back_end.trial = lambda at, seen: replace(seen, free=nan) if back_end.all_of(ask.Augment) else seen
    assert "stays inside the indenter" in led(steps(0.1).run(), back_end.answer)
    assert len(back_end.all_of(ask.Augment)) == multipliers.MAX_FAILURES
    assert not back_end.all_of(ask.Record)


def test_a_record_that_misses_the_full_tolerance_is_polished_or_its_step_halved() -> None:
    """A step at the relaxed tolerance that needs no pass is solved further; where that fails the step is halved."""
    back_end = Scripted(falls=1e-4)
    assert led(steps(0.1).run(), back_end.answer) == ""
    (record,) = back_end.all_of(ask.Record)
    assert record.evaluation.relative <= TOLERANCE
    assert record.iterations == 2
    losing = Scripted(falls=1e-4)
    losing.trial = lambda at, seen: replace(seen, free=nan) if losing.all_of(ask.Do.KEEP_STEP) and at == 0.1 else seen
    policy = steps(0.1)
    assert "did not converge" in led(policy.run(), losing.answer)
    assert not losing.all_of(ask.Record)
    assert len(losing.all_of(ask.Do.KEEP_STEP)) == len(losing.all_of(ask.Do.RESTORE_STEP))
