"""Many presses through the lanes of one solver: the entry point, and what the host does."""

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from synth.arrays import FloatArray
from synth.simulate.batched import lanes as phases
from synth.simulate.batched.pad import Pad
from synth.simulate.batched.presses import press_tables, trajectory
from synth.simulate.batched.solver import INNER_ITERATIONS, BatchedSolver
from synth.simulate.options import STANDARD, SolverOptions
from synth.simulate.policy.newton import MAX_ITERATIONS
from synth.simulate.press import Press
from synth.simulate.solve import check_shared
from synth.simulate.trajectory import Trajectory, at_rest

MAX_BATCH = 512
OPTIONS = replace(STANDARD, relaxed_tolerance=0.0, forcing=1e-4, closer=1e-3)
"""The scene's tolerance along the whole load path, because friction remembers the path; linear solves and corrections
so tight that rounding hardly ever decides which equilibrium is found."""
CYCLES_PER_POLL = 2
"""Cycles between looks at which lanes have ended: a lane waits for half of them on average."""


def simulate_presses(
    presses: Sequence[Press],
    pad: Pad,
    frames: Sequence[frozenset[int]] | None = None,
    batch: int = MAX_BATCH,
    options: SolverOptions = OPTIONS,
) -> Iterator[tuple[int, Trajectory]]:
    """Simulate presses into pads of one mesh, each as if it were alone; their numbers and trajectories, as they end.

    The presses share the pad's materials and, but for the penalty, its numerics, else InputError; the pad is of
    `synth.simulate.batched.pad.prepare`. `frames` are the numbers of the states that are wanted, of each press (else
    ValueError), see `synth.simulate.simulate_press`; at most `batch` trajectories run at a time; `options` hold along
    the load paths.
    """
    if frames is not None and len(frames) != len(presses):
        raise ValueError(f"{len(frames)} sets of frames for {len(presses)} presses")
    check_shared([pad.scene, *(press.scene for press in presses)], pad.space.mesh)
    touching = []
    for number, press in enumerate(presses):
        if press.path.may_touch:
            touching.append(number)
        else:
            yield number, Trajectory(tuple(at_rest(press.path, pad.space)), "", 0.0, pad.space)
    if touching:
        theirs = None if frames is None else [frames[n] for n in touching]
        run = Run([presses[n] for n in touching], pad, theirs, min(batch, len(touching)), options)
        for number, result in run:
            yield touching[number], result


class Run:
    """An iterator over (number of the press, trajectory) in the order in which they end.

    Arguments as of `simulate_presses`, of presses whose indenters touch; `order` are the numbers of the presses in
    which they begin, by default each once, and `inner` the Krylov iterations of a cycle.
    """

    def __init__(
        self,
        presses: Sequence[Press],
        pad: Pad,
        frames: Sequence[frozenset[int]] | None,
        batch: int,
        options: SolverOptions,
        order: Iterable[int] | None = None,
        inner: int = INNER_ITERATIONS,
    ) -> None:
        self._presses, self._pad, numerics = presses, pad, presses[0].scene.numerics
        table, grid = press_tables(presses, frames, pad.device)
        settings = phases.Settings()
        settings.tolerance, settings.relaxed_tolerance = numerics.tolerance, options.relaxed_tolerance
        settings.longest, settings.extrapolate = numerics.max_step_mm, int(options.extrapolate)
        settings.forcing, settings.closer = options.forcing, options.closer
        settings.limit, settings.correction_limit = MAX_ITERATIONS, options.correction_iterations
        records = max(len(press.path.records()) for press in presses)
        self.solver = BatchedSolver(pad, table, batch, records, grid, settings, inner)
        self._order = range(len(presses)) if order is None else order
        self._graph: Any = None
        self.cycles = 0
        self._spent = 0.0

    def __iter__(self) -> Iterator[tuple[int, Trajectory]]:
        """Run all presses. Results are made and handed over while the device works on the next cycles."""
        batch = self.solver.batch
        working = np.full(batch, -1)
        begun = np.zeros(batch)
        waiting = iter(self._order)
        empty = np.arange(batch)
        fetched: list[tuple[int, FloatArray, tuple[int, float, float], float]] = []
        while True:
            assignment = np.full(batch, -1)
            for lane in empty:
                working[lane] = assignment[lane] = next(waiting, -2)
            began = time.perf_counter()
            begun[empty] = self._spent
            if len(empty):
                self.solver.fill(assignment)
            ongoing = bool((working >= 0).any())
            if ongoing:
                for _ in range(CYCLES_PER_POLL):
                    self.advance()
            self._spent += time.perf_counter() - began  # without what whoever takes the results does meanwhile
            for number, records, end, seconds in fetched:
                yield number, trajectory(self._presses[number], records, end, seconds, self._pad.space)
            if not ongoing:
                return
            began = time.perf_counter()
            empty = np.flatnonzero(self.solver.lanes.phase.numpy() == phases.ENDED)
            self._spent += time.perf_counter() - began
            fetched = [
                (int(working[s]), records, end, float(self._spent - begun[s]) / batch)
                for s, records, end in self.solver.ended(empty)
            ]

    def advance(self) -> None:
        """One cycle; on CUDA a graph that is captured the second time, when all kernels are loaded."""
        self.cycles += 1
        device = wp.get_device(self._pad.device)
        if not device.is_cuda or self.cycles == 1:
            self.solver.cycle()
            return
        if self._graph is None:
            # Relaxed: the garbage collector may free a renderer's memory in this thread meanwhile.
            mode = wp.CaptureMode.RELAXED
            with wp.ScopedCapture(device=device, force_module_load=False, capture_mode=mode) as capture:
                self.solver.cycle()
            self._graph = capture.graph
        wp.capture_launch(self._graph)
