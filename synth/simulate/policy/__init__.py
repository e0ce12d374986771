"""The step policy: how one press is led from its first touch to its last state, in plain Python over a few scalars.

    load_steps   how far each step goes, and what becomes of one that fails
    multipliers  the augmented-Lagrangian passes at a recorded state
    newton       one equilibrium by Newton's method, and relaxation where that finds none
    requests     what the policy asks of whoever holds displacements, contact and factors, and what it is answered

Each is a generator that yields requests. It never sees an array, so that it runs against any back end:
`synth.simulate.direct` answers it for one press on a CPU.
"""
