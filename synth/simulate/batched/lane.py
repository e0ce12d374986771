"""One lane's press: its step policy, translated into orders for the device, cycle by cycle."""

from collections.abc import Generator
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.press.press import Press
from synth.simulate.batched.lane_orders import Number, Order, Seen
from synth.simulate.linear import GMRES_TOLERANCE
from synth.simulate.policy import requests as ask
from synth.simulate.policy.load_steps import LoadSteps

REDUCTION_FACTOR, SAFETY_FACTOR = 0.9, 0.3
ORDERS: dict[ask.Do, int] = {do: getattr(Order, do.name) for do in ask.Do}
Row = list[float]
"""What a lane has seen in a cycle, by the columns of `Seen`."""


def _evaluation(seen: Row) -> ask.Evaluation:
    return ask.Evaluation(*seen[: Seen.DONE])


class Lane:
    """A press in a lane.

    Attributes:
        number, press: the press and its number.
        records: what it has recorded; the fields are on the device.
        ended: whether the present orders are the last; reason: why the press ended early, or nothing.
    """

    def __init__(self, number: int, press: Press, steps: LoadSteps, numbers: FloatArray, forcing: float) -> None:
        """numbers: (k,) the lane's, by the columns of `Number`; written to in place."""
        self.number, self.press, self.records = number, press, list[ask.Record]()
        self.ended, self.reason = False, ""
        self._steps, self._numbers, self._forcing = steps, numbers, forcing
        self._orders = self._translated()
        self.first = next(self._orders)
        self.advance = self._orders.send
        """The orders of the next cycle, for what was seen in the last."""

    def _translated(self) -> Generator[int, Row, None]:
        policy, numbers = self._steps.run(), self._numbers
        answer: Any = None
        order, at, target, size = 0, 0.0, 0.0, 1.0
        own = before_pass = numbers[Number.STIFFNESS] = (
            self.press.scene.numerics.penalty * self.press.path.body.sharpness
        )
        iterate = trial = _evaluation([0.0] * Seen.DONE)
        is_stale = False  # whether the last evaluation was of a trial that was not taken
        while True:
            try:
                request: Any = policy.send(answer)
            except StopIteration as end:
                self.ended, self.reason = True, end.value
                yield order
                return
            answer, changes = None, False  # whether the iterate changes, so that it must be evaluated
            kind = type(request)
            if kind is ask.Do:
                order |= ORDERS[request]
                if request is ask.Do.TAKE:
                    iterate, is_stale = trial, False
                elif request is ask.Do.ACCEPT:
                    at = target
                elif request is ask.Do.KEEP_PASS:
                    before_pass = numbers[Number.STIFFNESS]
                elif request is ask.Do.RESTORE_STEP:
                    numbers[Number.STIFFNESS] = own
                elif request is ask.Do.FORCE:
                    answer = float(np.dot((yield order)[Seen.FORCE : Seen.FORCE + 3], self.press.path.direction))
                    order = 0
                elif request is ask.Do.REPEAT:
                    changes = True
                elif request is ask.Do.RESTORE_PASS:
                    numbers[Number.STIFFNESS], changes = before_pass, True
            elif kind is ask.Try:
                if request.share < 1:
                    numbers[Number.SHARE] = request.share
                    trial = _evaluation((yield order | Order.TRY))
                answer, order, is_stale = trial, 0, True
            elif kind is ask.Solve:
                if is_stale:
                    iterate = _evaluation((yield order | Order.EVALUATE))
                    order, is_stale = 0, False
                numbers[Number.NORM], numbers[Number.TURN] = iterate.free, request.max_turn
                numbers[Number.VISCOSITY] = request.viscosity or 0.0
                numbers[Number.GOAL] = self._goal(request, iterate.free / size)
                size = iterate.free
                seen = yield order | Order.SOLVE
                while not seen[Seen.DONE]:
                    seen = yield 0
                answer, order, trial, is_stale = seen[Seen.FINITE] == 1, 0, _evaluation(seen), True
            elif kind is ask.Begin:
                target, changes = request.at_mm, True
                numbers[Number.RATIO] = request.ratio
                start = Order.BEGIN
                if request.rigid:
                    numbers[Number.AT] = at + ask.PATH_DERIVATIVE_STEP * (target - at)
                    seen = yield order | Order.BEGIN | Order.STICKING | Order.EVALUATE
                    numbers[Number.AT], numbers[Number.NORM] = at, seen[Seen.FREE]
                    numbers[Number.VISCOSITY], numbers[Number.TURN] = 0.0, np.inf
                    numbers[Number.GOAL] = min(GMRES_TOLERANCE, self._forcing)
                    seen = yield Order.SOLVE | Order.STICKING
                    while not seen[Seen.DONE]:
                        seen = yield Order.STICKING
                    order, start = 0, Order.PREDICT if seen[Seen.FINITE] else Order.BEGIN
                numbers[Number.AT] = target
                order |= start
            elif kind is ask.Augment:
                numbers[Number.SHARE], numbers[Number.STIFFNESS] = request.share, request.stiffening * own
                order, changes = order | Order.AUGMENT, True
            else:
                numbers[Number.RECORD] = len(self.records)
                self.records.append(request)
                order |= Order.RECORD
            if changes:
                answer = iterate = _evaluation((yield order | Order.EVALUATE))
                order, is_stale = 0, False

    def _goal(self, wanted: ask.Solve, fallen: float) -> float:
        """The second choice of Eisenstat & Walker (SIAM J. Sci. Comput. 17, 1996), no more than Newton's method needs.

        With these bounds their safeguard has nothing to do.
        """
        goal = self._forcing if wanted.iteration == 0 else REDUCTION_FACTOR * fallen * fallen
        goal = max(goal, SAFETY_FACTOR * wanted.tolerance / wanted.relative)
        return max(min(goal, self._forcing), min(GMRES_TOLERANCE, self._forcing))
