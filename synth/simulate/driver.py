"""How Newton's method is led along a path: what `python -m benchmarks fem` varies and no scene needs to."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Driver:
    """Settings of `synth.simulate.stepping.Stepper`.

    Attributes:
        loose: tolerance on the way, also in recorded states that are not wanted. Its error does not reach those that
            are without friction; with friction about a twentieth of it does. The scene's own tolerance holds where it
            is larger, so that 0 asks for that everywhere.
        extrapolate: start each step from a linear extrapolation of the last two states, else from the last one, with
            friction carried along as after a turn. (From the last state as it is, a ball's shear and twist took 2800
            iterations instead of 96.)
        correction_iterations: of Newton's method in one augmented-Lagrangian pass; a correction that needs more is
            dropped, unless its balance is near (`newton.NEAR`).
        single_precision: factorise the tangent in float32; its rounding is iterated away (`synth.simulate.linear`).
        keep_factors: use the factors of earlier tangents (`synth.simulate.linear.Directions`).
        forcing: of the batched solver: relative residual that ends a linear solve, at most (Eisenstat and Walker 1996;
            `synth.simulate.batched.krylov`). With 0.1 a ring of wire far too thin for its mesh went through the
            surface, where Newton's method ended the trajectory in time before.
        closer: of the batched solver: tolerance of an augmented-Lagrangian pass over the scene's. Passes find what is
            recorded, and where most of a contact slips a residual of 1e-6 can be 1e-4 in displacement, by which two
            devices that end one iteration apart then differ.
    """

    loose: float = 1e-3
    extrapolate: bool = True
    correction_iterations: int = 10
    single_precision: bool = True
    keep_factors: bool = True
    forcing: float = 0.03
    closer: float = 0.1


STANDARD = Driver()
