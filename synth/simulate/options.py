"""How Newton's method is led along a load path: what `python -m benchmarks fem` varies and no scene needs to."""

from dataclasses import dataclass


@dataclass(frozen=True)
class SolverOptions:
    """Settings of `synth.simulate.policy` and of the batched solver.

    Attributes:
        relaxed_tolerance: tolerance of intermediate steps, also of recorded states that are not wanted. Without
            friction its error does not reach the wanted states. The scene's own tolerance holds where it is larger, so
            that 0 asks for that everywhere.
        extrapolate: start each step from a linear extrapolation of the last two states, else from the last one, with
            friction from the rigid-motion predictor as after a turn.
        correction_iterations: of Newton's method in one augmented-Lagrangian pass; a correction that needs more is
            dropped, unless its equilibrium is near (`newton.NEAR`).
        single_precision: factorise the tangent in float32; its rounding is iterated away (`synth.simulate.linear`).
        reuse_factors: use the factors of earlier tangents (`synth.simulate.linear.LinearSolver`).
        forcing: of the batched solver: relative residual that ends a linear solve, at most (Eisenstat and Walker 1996;
            `synth.simulate.batched.krylov`).
        closer: of the batched solver: tolerance of an augmented-Lagrangian pass over the scene's. What the passes find
            is recorded, so that an iteration more or less should not show.
    """

    relaxed_tolerance: float = 1e-3
    extrapolate: bool = True
    correction_iterations: int = 10
    single_precision: bool = True
    reuse_factors: bool = True
    forcing: float = 0.03
    closer: float = 0.1


STANDARD = SolverOptions()
