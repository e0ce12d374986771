"""One lane's press: its step policy, translated into orders for the device, cycle by cycle."""

from collections.abc import Generator
from typing import Any

from synth.arrays import FloatArray
from synth.simulate.batched.lane_orders import PATH_DERIVATIVE_STEP, Number, Order, Seen
from synth.simulate.linear import GMRES_TOLERANCE
from synth.simulate.policy import requests as ask
from synth.simulate.policy.load_steps import LoadSteps

REDUCTION_FACTOR, SAFETY_FACTOR = 0.9, 0.3
UNANSWERED = {
    ask.Do.TAKE: int(Order.TAKE),
    ask.Do.KEEP_STEP: int(Order.KEEP_STEP),
    ask.Do.RESTORE_STEP: int(Order.RESTORE_STEP),
    ask.Do.KEEP_PASS: int(Order.KEEP_PASS),
    ask.Do.ANCHOR: int(Order.ANCHOR),
    ask.Do.ACCEPT: int(Order.ACCEPT),
}
AT, RATIO, SHARE, VISCOSITY, STIFFENING, NORM, GOAL, RECORD = map(int, Number)
FREE, FORCE, DONE, FINITE = int(Seen.FREE), int(Seen.FORCE), int(Seen.DONE), int(Seen.FINITE)
EVALUATE, TRY, SOLVE, BEGIN, PREDICT, STICKING = (
    int(order) for order in (Order.EVALUATE, Order.TRY, Order.SOLVE, Order.BEGIN, Order.PREDICT, Order.STICKING)
)
RESTORE_PASS, REPEAT, AUGMENT, FORCE_ORDER, RECORD_ORDER = (
    int(order) for order in (Order.RESTORE_PASS, Order.REPEAT, Order.AUGMENT, Order.FORCE, Order.RECORD)
)
Row = list[float]
"""What a lane has seen in a cycle, by the columns of `Seen`."""


def _evaluation(seen: Row) -> ask.Evaluation:
    return ask.Evaluation(*seen[:FORCE])


class Lane:
    """A press in a lane.

    Attributes:
        press: its number.
        records: what it has recorded; the fields are on the device.
        ended: whether the present orders are the last; reason: why the press ended early, or nothing.
    """

    def __init__(self, press: int, steps: LoadSteps, numbers: FloatArray, forcing: float) -> None:
        """numbers: (k,) the lane's, by the columns of `Number`; written to in place."""
        self.press, self.records = press, list[ask.Record]()
        self.ended, self.reason = False, ""
        self._steps, self._numbers, self._forcing = steps, numbers, forcing
        self._orders = self._translated()
        self.first = next(self._orders)
        self.advance = self._orders.send
        """The orders of the next cycle, for what was seen in the last."""

    def _translated(self) -> Generator[int, Row, None]:
        policy, numbers = self._steps.run(), self._numbers
        answer: Any = None
        order, at, target, stiffening, size = 0, 0.0, 0.0, 1.0, 1.0
        numbers[STIFFENING] = 1.0
        iterate = trial = _evaluation([0.0] * len(Seen))
        is_stale = False  # whether the last evaluation was of a trial that was not taken
        while True:
            try:
                request: Any = policy.send(answer)
            except StopIteration as end:
                self.ended, self.reason = True, end.value
                yield order
                return
            answer = None
            kind = type(request)
            if kind is ask.Do:
                if request in UNANSWERED:
                    order |= UNANSWERED[request]
                    if request is ask.Do.TAKE:
                        iterate, is_stale = trial, False
                    elif request is ask.Do.ACCEPT:
                        at = target
                    elif request is ask.Do.KEEP_PASS:
                        stiffening = numbers[STIFFENING]
                    elif request is ask.Do.RESTORE_STEP:
                        numbers[STIFFENING] = 1.0
                elif request is ask.Do.FORCE:
                    answer, order = (yield order | FORCE_ORDER)[FORCE], 0
                else:
                    if request is ask.Do.RESTORE_PASS:
                        numbers[STIFFENING] = stiffening
                        order |= RESTORE_PASS
                    else:
                        order |= REPEAT
                    answer = iterate = _evaluation((yield order | EVALUATE))
                    order, is_stale = 0, False
            elif kind is ask.Try:
                if request.share < 1:
                    numbers[SHARE] = request.share
                    trial = _evaluation((yield order | TRY))
                answer, order, is_stale = trial, 0, True
            elif kind is ask.Solve:
                if is_stale:
                    iterate = _evaluation((yield order | EVALUATE))
                    order, is_stale = 0, False
                numbers[NORM], numbers[VISCOSITY] = iterate.free, request.viscosity or 0.0
                numbers[GOAL] = self._goal(request, iterate.free / size)
                size = iterate.free
                seen = yield order | SOLVE
                while not seen[DONE]:
                    seen = yield 0
                answer, order, trial, is_stale = seen[FINITE] == 1, 0, _evaluation(seen), True
            elif kind is ask.Begin:
                target = request.at_mm
                numbers[RATIO] = request.ratio
                start = BEGIN
                if request.rigid:
                    numbers[AT] = at + PATH_DERIVATIVE_STEP * (target - at)
                    seen = yield order | BEGIN | STICKING | EVALUATE
                    numbers[AT], numbers[VISCOSITY], numbers[NORM] = at, 0.0, seen[FREE]
                    numbers[GOAL] = min(GMRES_TOLERANCE, self._forcing)
                    seen = yield SOLVE | STICKING
                    while not seen[DONE]:
                        seen = yield STICKING
                    order, start = 0, PREDICT if seen[FINITE] else BEGIN
                numbers[AT] = target
                answer = iterate = _evaluation((yield order | start | EVALUATE))
                order, is_stale = 0, False
            elif kind is ask.Augment:
                numbers[SHARE], numbers[STIFFENING] = request.share, request.stiffening
                answer = iterate = _evaluation((yield order | AUGMENT | EVALUATE))
                order, is_stale = 0, False
            else:
                numbers[RECORD] = len(self.records)
                self.records.append(request)
                order |= RECORD_ORDER

    def _goal(self, wanted: ask.Solve, fallen: float) -> float:
        """The second choice of Eisenstat & Walker (SIAM J. Sci. Comput. 17, 1996), no more than Newton's method needs.

        With these bounds their safeguard has nothing to do.
        """
        goal = self._forcing if wanted.iteration == 0 else REDUCTION_FACTOR * fallen * fallen
        goal = max(goal, SAFETY_FACTOR * wanted.tolerance / wanted.relative)
        return max(min(goal, self._forcing), min(GMRES_TOLERANCE, self._forcing))
