"""Many trajectories through the slots of one machine: what the host does."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.scene import Numerics
from synth.simulate.batched import slots as phases
from synth.simulate.batched.jobs import Ended, Job, body_tables, job_tables, trajectory
from synth.simulate.batched.machine import INNER, Machine
from synth.simulate.batched.pad import Pad
from synth.simulate.newton import MAX_ITERATIONS
from synth.simulate.options import SolverOptions
from synth.simulate.trajectory import Trajectory

LOOK = 2
"""Cycles between looks at which slots have ended: a slot waits for half of them on average, some 1 % of its time."""


@dataclass(frozen=True)
class Fetched:
    """A trajectory as it left its slot: number of its job, records, how it ended, and its share of the time."""

    number: int
    records: FloatArray
    ended: Ended
    seconds: float


class Run:
    """An iterator over (number of the job, trajectory) in the order in which they end.

    Args:
        jobs: trajectories whose indenters touch.
        pad: they run on.
        numerics: of all of them.
        driver: how Newton's method is led.
        frames: numbers of the states that are corrected, of each job; default all.
        batch: number of slots.
        order: numbers of the jobs in which they begin, default each once.
        inner: Krylov iterations of a cycle.
    """

    def __init__(
        self,
        jobs: Sequence[Job],
        pad: Pad,
        numerics: Numerics,
        driver: SolverOptions,
        frames: Sequence[frozenset[int]] | None,
        batch: int,
        order: Iterable[int] | None = None,
        inner: int = INNER,
    ) -> None:
        self._jobs, self._pad = jobs, pad
        self.table = job_tables(jobs, pad.mesh.size_mm, frames, pad.device)
        self._shapes, self._grids, grid = body_tables(jobs, pad.device)
        settings = phases.Settings()
        settings.tolerance, settings.loose = numerics.tolerance, driver.relaxed_tolerance
        settings.longest, settings.extrapolate = numerics.max_step_mm, int(driver.extrapolate)
        settings.forcing, settings.closer = driver.forcing, driver.closer
        settings.limit, settings.correction_limit = MAX_ITERATIONS, driver.correction_iterations
        records = max(len(job.path.records()) for job in jobs)
        self.machine = Machine(pad, batch, records, grid, settings, numerics.penalty, inner)
        self._order = range(len(jobs)) if order is None else order
        self._graph: Any = None
        self.cycles = 0
        self._spent = 0.0

    def __iter__(self) -> Iterator[tuple[int, Trajectory]]:
        """Run all jobs.

        Results are made and handed over while the device works on the next cycles. When it waited for that, a cycle of
        1,024 slots took 22.8 ms on an H200, of which its kernels took 19.4.
        """
        machine, batch = self.machine, self.machine.batch
        working = np.full(batch, -1)
        begun = np.zeros(batch)
        waiting = iter(self._order)
        empty = np.arange(batch)
        fetched: list[Fetched] = []
        while True:
            assignment = np.full(batch, -1)
            for slot in empty:
                working[slot] = assignment[slot] = next(waiting, -2)
            began = time.perf_counter()
            begun[empty] = self._spent
            if len(empty):
                machine.fill(assignment, self.table, self._shapes, self._grids)
            ongoing = bool((working >= 0).any())
            if ongoing:
                for _ in range(LOOK):
                    self.advance()
            self._spent += time.perf_counter() - began  # without what whoever takes the results does meanwhile
            for one in fetched:
                result = trajectory(self._jobs[one.number], one.records, one.ended, one.seconds, self._pad.space)
                yield one.number, result
            if not ongoing:
                return
            began = time.perf_counter()
            empty = np.flatnonzero(machine.slots.phase.numpy() == phases.ENDED)
            self._spent += time.perf_counter() - began
            fetched = self._fetch(empty, working, begun)

    def advance(self) -> None:
        """One cycle; on CUDA a graph that is captured the second time, when all kernels are loaded."""
        self.cycles += 1
        device = wp.get_device(self._pad.device)
        if not device.is_cuda or self.cycles == 1:
            self.machine.cycle(self.table)
            return
        if self._graph is None:
            # Relaxed: the garbage collector may free a renderer's memory in this thread meanwhile.
            mode = wp.CaptureMode.RELAXED
            with wp.ScopedCapture(device=device, force_module_load=False, capture_mode=mode) as capture:
                self.machine.cycle(self.table)
            self._graph = capture.graph
        wp.capture_launch(self._graph)

    def _fetch(self, slots: np.ndarray, working: np.ndarray, begun: np.ndarray) -> list[Fetched]:
        """What ended slots recorded, before they are filled again."""
        if not len(slots):
            return []
        state = self.machine.slots
        count, reason, at, target = (array.numpy() for array in (state.records, state.reason, state.at, state.target))
        found = []
        for s in map(int, slots):
            ended = Ended(int(reason[s]), float(at[s]), float(target[s]))
            seconds = float(self._spent - begun[s]) / self.machine.batch
            found.append(Fetched(int(working[s]), self.machine.record_of(s, int(count[s])), ended, seconds))
        return found
