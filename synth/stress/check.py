"""What is demanded of every run, and the comparison with what was written down for it.

Demanded of every run whatever its entry says: it ends by itself and without a traceback; an end other than "complete"
has a reason; "complete" has all states that were asked for; every number of every recorded state is finite; its
residual is within the tolerance; det F > 0 where it is integrated, as the solver reports it and as it comes out here
from the stored displacements. A recorded deviation excuses none of these. It can excuse det F <= 0 at the corners of a
quadratic element, which is otherwise held against every run.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from synth.arrays import FloatArray
from synth.mesh.element import quadratic_derivative
from synth.mesh.pad import barycentric_gradients
from synth.stress.cases import Comparison, Expectation, Run

GAUSS = np.full((4, 4), (5 - np.sqrt(5)) / 20) + np.eye(4) / np.sqrt(5)
"""Barycentric coordinates at which a quadratic element is integrated; a linear one's det F is the same everywhere."""
NOT_INVERTED = {"corner_jacobian": (0.0, np.inf)}
"""Bounds of every run: a quadratic element can be inverted at its corners although det F > 0 where it is integrated."""


@dataclass(frozen=True)
class Result:
    """How a run ended."""

    run: Run  # what was run
    outcome: str  # "complete", "partial", "failed", "refused", "crashed" or "hung"
    message: str  # reason, refusal, or the last line of the traceback
    wall_s: float  # seconds of the whole process
    record: Mapping[str, Any]  # result.json; empty where there is none
    arrays: Mapping[str, np.ndarray]  # states.npz; empty where there is none

    @property
    def states(self) -> list[dict[str, Any]]:
        """Summaries of the recorded states, the undeformed one first."""
        return list(self.record.get("states", []))


@dataclass(frozen=True)
class Verdict:
    """A run's result beside its expectation; what was measured is empty without states.

    `broken` is what is not as it has to be; empty where the run is as expected, or deviates in the way that is noted
    (`deviates`).
    """

    result: Result
    measured: Mapping[str, float]
    broken: tuple[str, ...]
    deviates: bool = False

    @property
    def ok(self) -> bool:
        return not self.broken

    @property
    def word(self) -> str:
        return "OTHERWISE" if self.broken else "explained" if self.deviates else "as expected"


def evaluate(result: Result, others: Mapping[str, Result]) -> Verdict:
    """Check a result; `others` are those with the same element by their case's name, for comparisons."""
    quantities = measured(result)
    always = faults(result)
    if always:
        return Verdict(result, quantities, tuple(always))
    broken = differences(result, quantities, result.run.case, others)
    deviation = result.run.case.deviation
    if broken and deviation and not (otherwise := differences(result, quantities, deviation, others)):
        return Verdict(result, quantities, tuple(otherwise), deviates=True)
    return Verdict(result, quantities, tuple(broken))


def faults(result: Result) -> list[str]:
    if result.outcome == "hung":
        return [f"hung: killed after its budget of {result.run.budget_s:g} s"]
    if result.outcome == "crashed":
        return [f"crashed: {result.message}"]
    found = []
    if result.outcome != "complete" and not result.message.strip():
        found.append(f"{result.outcome} without a reason")
    if result.outcome == "refused":
        return found
    asked, states = int(result.record["states_asked"]), result.states
    if result.outcome == "complete" and len(states) != asked:
        found.append(f"complete with {len(states)} of {asked} states")
    if result.outcome == "partial" and not 1 < len(states) < asked:
        found.append(f"partial with {len(states)} of {asked} states")
    for number, state in enumerate(states):
        found += [f"state {number}: {problem}" for problem in _state_faults(result, number, state)]
    return found


def _state_faults(result: Result, number: int, state: Mapping[str, Any]) -> list[str]:
    found = [f"{name} is not finite" for name, value in state.items() if not np.all(np.isfinite(value))]
    fields = [result.arrays[name][number] for name in ("displacement", "traction")]
    if not all(np.isfinite(field).all() for field in fields):
        return [*found, "a field is not finite"]
    if not state["residual"] <= result.record["tolerance"]:
        found.append(f"residual {state['residual']:.2g} is above the tolerance {result.record['tolerance']:.2g}")
    if not state["min_jacobian"] > 0:
        found.append(f"smallest det F is {state['min_jacobian']:.3g}")
    own = smallest_jacobian(result.arrays["points"], result.arrays["nodes"], fields[0], GAUSS)
    if not own > 0:
        found.append(f"smallest det F of the stored displacements is {own:.3g}")
    return found


def smallest_jacobian(points: FloatArray, nodes: np.ndarray, displacement: FloatArray, at: FloatArray) -> float:
    """Smallest det F of straight-edged tetrahedra at barycentric coordinates (k, 4).

    Points are (n, 3) mm, vertices first, for quadratic elements then the midpoints of their edges; nodes are (m, 4) or
    (m, 10), a tetrahedron's vertices, then the midpoints of EDGES; the displacement is (n, 3) mm.
    """
    gradient, moved, found = barycentric_gradients(points, nodes[:, :4]), displacement[nodes], []
    for by_place in np.eye(4)[None] if nodes.shape[1] == 4 else quadratic_derivative(at):
        slope = np.einsum("mai,ab,mbj->mij", moved, by_place, gradient)
        with np.errstate(invalid="ignore"):
            found.append(np.linalg.det(np.eye(3) + slope).min())
    return float(np.min(found))  # NaN where any is


def measured(result: Result) -> dict[str, float]:
    """Quantities for `bounds`: of the last recorded state, but for largest or smallest of all states where said so."""
    states = result.states
    if not states:
        return {}
    last = states[-1]
    force, side = last["force_n"], float(np.hypot(*last["force_n"][:2]))
    found = {
        "states": len(states) - 1,
        "depth_mm": last["depth_mm"],
        "shear_x_mm": last["shear_mm"][0],
        "shear_y_mm": last["shear_mm"][1],
        "twist_deg": last["twist_deg"],
        "force_x_n": force[0],
        "force_y_n": force[1],
        "force_z_n": force[2],
        "side_ratio": side / abs(force[2]) if force[2] else 0.0,  # sideways over normal force
        "torque_z_nmm": last["torque_nmm"][2],
        "displacement_mm": np.linalg.norm(result.arrays["displacement"][-1], axis=1).max(),
        "penetration_mm": max(state["max_penetration_mm"] for state in states),
        "min_jacobian": min(state["min_jacobian"] for state in states),
        "corner_jacobian": min(
            smallest_jacobian(result.arrays["points"], result.arrays["nodes"], moved, np.eye(4))
            for moved in result.arrays["displacement"]
        ),
        "residual": max(state["residual"] for state in states),
        "iterations": sum(state["newton_iterations"] for state in states),
    }
    if "slip_ratio" in last:
        found["slip_ratio"] = last["slip_ratio"]
    return {name: float(value) for name, value in found.items()}


def differences(
    result: Result, quantities: Mapping[str, float], expected: Expectation, others: Mapping[str, Result]
) -> list[str]:
    found = []
    if result.outcome not in expected.outcome:
        found.append(f"{result.outcome}, expected {' or '.join(expected.outcome)}: {result.message or 'no reason'}")
    if result.outcome != "complete" and expected.says not in result.message:
        found.append(f"does not say {expected.says!r}: {result.message}")
    if result.outcome not in ("complete", "partial"):
        return found
    for name, (low, high) in {**NOT_INVERTED, **expected.bounds}.items():
        if name not in quantities:
            found.append(f"{name} is not measured; measured are {', '.join(quantities)}")
        elif not low <= quantities[name] <= high:
            found.append(f"{name} = {quantities[name]:.6g} is not within [{low:g}, {high:g}]")
    if expected.compare is not None:
        found += _compared(result, expected.compare, others.get(expected.compare.with_case))
    return found


def _compared(result: Result, comparison: Comparison, other: Result | None) -> list[str]:
    name = comparison.with_case
    if other is None or other.outcome not in ("complete", "partial"):
        return [f"cannot be compared with {name}, which {'was not run' if other is None else other.outcome}"]
    found = []
    if comparison.force_ratio is not None:
        low, high = comparison.force_ratio
        force, base = result.states[-1]["force_n"][2], other.states[-1]["force_n"][2]
        if not low * base <= force <= high * base:
            found.append(f"force {force:.8g} N is {force / base:.8g} of {name}'s, not within [{low:g}, {high:g}]")
    if comparison.displacement is not None:
        if result.record["mesh"] != other.record["mesh"]:
            return [*found, f"has another mesh than {name}: displacements cannot be compared"]
        mine, its = result.arrays["displacement"][-1], other.arrays["displacement"][-1]
        difference = float(np.abs(mine - its).max() / np.abs(its).max())
        if not difference <= comparison.displacement:
            found.append(
                f"displacement differs from {name}'s by {difference:.3g}, not within {comparison.displacement:g}"
            )
    return found
