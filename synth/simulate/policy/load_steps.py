"""Load stepping: move the indenter along its load path, recording converged states, halving steps that fail.

Each step starts from a linear extrapolation of the last two states; a relaxed tolerance is enough for it. At a state
that is wanted augmented-Lagrangian passes take penetration and elastic slip away, and the full tolerance holds; the
start of the passes, and the result of each but the last, need less, because the next one changes it. All of this is
for what is recorded only: the path goes on from the intermediate state before, because multipliers that stay behind on
a moving contact upset Newton's method at sharp edges. An unconverged field is never recorded: a press whose step would
have to become shorter than SHORTEST_STEP ends at its last good state.
"""

from math import ceil

from synth.press.load_path import TOUCH_MM, LoadPath
from synth.press.posed_path import IN_GEL, PosedPath
from synth.scene import Numerics
from synth.simulate.options import SolverOptions
from synth.simulate.policy.multipliers import Passes, allowed_share, polish
from synth.simulate.policy.newton import Solution, relax, solve
from synth.simulate.policy.requests import FORCE_FLOOR, Asking, Begin, Do, Evaluation, Record
from synth.simulate.trajectory import no_contact, not_converged, too_deep

SHORTEST_STEP = 1 / 128
"""Shortest step, as a share of max_step_mm."""
MAX_PRESS_ITERATIONS = 2000
"""A step that fails after so many iterations of a press ends it; on a CPU no press that completed took as
many."""
MAX_ITERATIONS_TO_GROW = 7
"""Most iterations of a step that is followed by a longer one."""
GROWTH = 1.5
MAX_RELAXED_STEP = 1 / 4
"""A step that fails is relaxed (`synth.simulate.policy.newton`) when it is at most this share of max_step_mm."""


class LoadSteps:
    """The policy of one press.

    Attributes:
        at: path length (mm) of the last accepted step.
        step: length (mm) of the next step at most.
        next: number of the waypoint that comes next.
        iterations: of Newton's method and relaxation since the last recorded state; spent: of the whole press.
    """

    def __init__(
        self,
        path: LoadPath,
        size_mm: tuple[float, float, float],
        rubs: bool,
        numerics: Numerics,
        options: SolverOptions,
        frames: frozenset[int] | None = None,
        closer: float = 1.0,
    ) -> None:
        """For a gel of a size, with friction if it `rubs`; frames: numbers of the states that are wanted, default all.

        The others are recorded as the path goes through them.
        """
        self._path, self._size_mm, self._rubs, self.numerics, self._options = path, size_mm, rubs, numerics, options
        self._relaxed_tolerance = max(options.relaxed_tolerance, numerics.tolerance)
        limits = (numerics.tolerance, self._relaxed_tolerance, options.correction_iterations)
        self._passes = Passes(path, *limits, closer, patient=numerics.target_error_percent is not None)
        self._waypoints = path.waypoints().tolist()
        records = path.records().tolist()
        self._recorded = frozenset(records)
        self._wanted = frozenset(place for k, place in enumerate(records, 1) if frames is None or k in frames)
        self.at, self.step, self.next = 0.0, numerics.max_step_mm, 0
        self._previous: float | None = None
        self.iterations = self.spent = 0
        self._reason = ""

    def run(self) -> Asking[str]:
        """Follow the load path to its end or to its last good state; why it ended early, or nothing.

        A path that never touches asks for nothing.
        """
        if not self._path.may_touch:
            return ""
        start = yield Begin(0.0)
        yield Do.ACCEPT
        if isinstance(self._path, PosedPath) and start.deepest_mm > TOUCH_MM:
            self._reason = f"the object is {IN_GEL}"
        while self.next < len(self._waypoints) and not self._reason:
            yield from self._advance()
        return self._reason

    def target(self) -> float:
        """Path length of the next step's end: equal steps of at most `step` to the next waypoint."""
        goal = float(self._waypoints[self.next])
        count = max(1, ceil((goal - self.at) / self.step - 1e-9))
        return goal if count == 1 else self.at + (goal - self.at) / count

    def _advance(self) -> Asking[None]:
        """One step."""
        target = self.target()
        between = target in self._recorded or target not in self._waypoints
        tolerance = self._relaxed_tolerance if between else self.numerics.tolerance
        start = yield from self._predict(target)
        solution = yield from solve(start, tolerance)
        self._count(solution.iterations)
        relaxed = not solution.converged and target - self.at <= MAX_RELAXED_STEP * self.numerics.max_step_mm
        if relaxed:
            start = yield Begin(target)
            solution = yield from relax(start, tolerance)
            self._count(solution.iterations)
        good = solution.converged
        if good and target in self._recorded and not (yield from self._slipped_through(target)):
            good = yield from self._record(solution, target)
        if good:
            # After the record, whose passes must still see how far points slipped in this step.
            yield Do.ACCEPT
            self._lengthen(target, solution.iterations, relaxed)
        else:
            self._shorten(target, relaxed)

    def _count(self, iterations: int) -> None:
        self.iterations += iterations
        self.spent += iterations

    def _predict(self, target: float) -> Asking[Evaluation]:
        """First iterate: by extrapolation, after a turn by rigid motion; the last state if det F would not be > 0."""
        if self._previous is not None and not self._path.turns_between(self._previous, self.at):
            ahead: Evaluation = yield Begin(target, ratio=(target - self.at) / (self.at - self._previous))
        elif self._rubs and self.at > 0:
            ahead = yield Begin(target, rigid=True)
        else:
            return (yield Begin(target))
        return ahead if ahead.smallest_jacobian > 0 else (yield Begin(target))

    def _slipped_through(self, target: float) -> Asking[bool]:
        """Whether the indenter, at the end of its press, bears on nothing: it passed between the contact points.

        Ends the press, saying so.
        """
        if target != self._path.press_mm or (yield Do.FORCE) > FORCE_FLOOR or not self._path.is_over(self._size_mm):
            return False
        self._reason = no_contact(target)
        return True

    def _record(self, step: Solution, target: float) -> Asking[bool]:
        """Record the corrected state, if it reaches the full tolerance, and put contact back for the path to go on.

        Returns whether it does. A state that is too deep is not recorded either, and ends the press, saying so.
        """
        yield Do.KEEP_STEP
        solution = step
        if target in self._wanted:
            yield Do.ANCHOR
            solution = yield from self._passes.run(step)
            share = allowed_share(self._path.body)
            if solution.converged and solution.at.deepest_mm > share * self._path.depth_scale_mm:
                self._reason = too_deep(self._path.pose(target), share)
            else:
                solution = yield from polish(solution, self.numerics.tolerance)
        self._count(solution.iterations - step.iterations)
        if solution.converged and not self._reason:
            yield Record(target, self.iterations, solution.at)
            self.iterations = 0
        yield Do.RESTORE_STEP
        return solution.converged

    def _lengthen(self, target: float, iterations: int, relaxed: bool) -> None:
        """After a good step: go on from its end, by a longer one if it was easy.

        Nothing is extrapolated across a relaxed step, which may have jumped.
        """
        taken = target - self.at
        self._previous, self.at = self.at if self._options.extrapolate and not relaxed else None, target
        if target == self._waypoints[self.next]:
            self.next += 1
        if iterations <= MAX_ITERATIONS_TO_GROW:
            self.step = min(self.numerics.max_step_mm, GROWTH * max(taken, self.step / GROWTH))

    def _shorten(self, target: float, relaxed: bool) -> None:
        """After a failure: half the step, a quarter if it was relaxed; and the end if that is too short or late."""
        self.step = (target - self.at) / (4 if relaxed else 2)
        self._previous = None
        if self.step < SHORTEST_STEP * self.numerics.max_step_mm or self.spent > MAX_PRESS_ITERATIONS:
            self._reason = not_converged(target - self.at, self._path.pose(self.at))
