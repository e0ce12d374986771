"""What error does the simulation of a scene make in the picture, on which mesh, in which time; is it within its budget?

    python -m benchmarks budget --scene my_sensor.toml              three random draws, some minutes
    python -m benchmarks budget --all --draws 12 --workers 40       all shipped scenes, on many cores

Draws are those of `synth generate`, and pressed as there: load steps, solver options and the states that samples show.
Each is simulated on the mesh that `numerics.target_error_px` chooses, on coarser ones, on up to three finer ones, and
on a reference mesh whose elements are at least 2.4 times smaller than the chosen mesh's.

Material points lie on a regular grid over the undeformed contact face. With P(X) where the camera sees a point and u, r
a field and the reference's, the error is the largest over the states of

    error_px  sqrt(mean |P(X + u) - P(X + r)|²)

over the points that are in the picture in both, by the same mirror if there are mirrors. force_percent and
displacement_percent are the largest errors of the contact force and of the points' displacement (root mean square),
each over the largest of the reference's states. Time is processor time of the solver. Of each scene the table tells how
many of the draws that can be judged are within their target; of how many the chosen mesh costs at most twice the
cheapest mesh within the target, by time and by unknowns to the power 1.25; error over target, median and 95th
percentile; and measured over predicted error, geometric mean and standard deviation of the logarithm. *own* is the
reference's own error over the target, the median, by Richardson's extrapolation from the finest other mesh. Rows are
found again by scene, seed and draw: after a change of the solver begin with an empty directory.
"""

import math
from functools import partial
from typing import Any

import numpy as np

from benchmarks.press import face_displacement, face_grid, root_mean_square, timed
from benchmarks.rows import Row, arguments, machine, measure, plot, show
from synth.arrays import BoolArray, FloatArray
from synth.cli_options import DEFAULT_SCENE
from synth.errors import InputError
from synth.mesh import Counts, Focus, PadMesh, domed, face_height, graded_box
from synth.optics import Optics
from synth.optics.camera import Paths
from synth.planning.prediction import SOLVE_GROWTH
from synth.press.error_model import error_percent
from synth.press.footprint import footprint
from synth.press.press import MeshRule
from synth.press.resolution import (
    ELEMENTS_ACROSS,
    MARGIN,
    STEEPEST_DEPTH,
    Fineness,
    depth_growth,
    graded_mesh,
    lateral_spacing,
    mesh_levels,
    predicted_error_px,
)
from synth.press.scene_path import path_of
from synth.sampling import MAX_DRAWS, draw, draw_sensor, samples_of, sensor_of
from synth.scene import Gel, Scene
from synth.scene.template import Template, load_scene, shipped_scenes
from synth.simulate import Trajectory, simulate
from synth.simulate.options import SolverOptions
from synth.simulate.policy.newton import MAX_ITERATIONS

FINER, BESIDE, STEP_MM = 2.4, (4, 3), 0.125
"""Of the reference: how many times smaller its elements are, elements beside the contact, longest load step."""
BEYOND = 3
"""Meshes finer than the chosen one."""
GRID, LEAST_SEEN = (81, 67), 0.75
"""Points of the contact face; the share of those seen at rest that must stay in the picture to judge by."""
RATE = 1.6
"""Power of the elements' size with which errors fall."""
GOAL, LARGEST_RATIO = 0.95, 2.0


def places(scene: Scene) -> FloatArray:
    """(n, 2) x and y, mm, of the grid's points that the camera sees on the undeformed face."""
    points = face_grid(scene.sensor.gel.size_mm, GRID)
    camera, seen = scene.sensor.camera, Optics.of(scene.sensor).project(_at_rest(points, scene))
    return np.asarray(points[((seen > 0) & (seen < (camera.width, camera.height))).all(axis=1)])


def picture_errors(found: FloatArray, reference: FloatArray, scene: Scene) -> tuple[FloatArray, FloatArray]:
    """(k,) px, and (k,) the share of the points that count: see the module.

    Both fields are (k, n, 3) mm at the points of `places`. An error is NaN where less than LEAST_SEEN of them counts:
    points that leave the picture, or slide beyond a mirror's end, have no image there.
    """
    optics, rest = Optics.of(scene.sensor), _at_rest(places(scene), scene)
    errors, shares = [], []
    for u, r in zip(found, reference, strict=True):
        path = optics.look(optics.project(rest + r)).path
        here, there = optics.project(rest + u, path), optics.project(rest + r, path)
        counts = _is_seen(optics, here, path) & _is_seen(optics, there, path)
        shares.append(counts.mean())
        distance = np.linalg.norm(here[counts] - there[counts], axis=1)
        errors.append(np.sqrt((distance**2).mean()) if shares[-1] >= LEAST_SEEN else np.nan)
    return np.array(errors), np.array(shares)


def _is_seen(optics: Optics, pixels: FloatArray, path: Paths) -> BoolArray:
    """(n,) whether pixels (n, 2) are in the picture, and show what is seen by these paths."""
    return np.asarray(optics.is_inside(pixels) & (optics.look(pixels).path == path) & (path >= 0))


def _at_rest(points: FloatArray, scene: Scene) -> FloatArray:
    return np.column_stack([points, face_height(points, scene.sensor.gel.dome_radius_mm)])


def drawn(template: Template, seed: int, index: int) -> Scene:
    """The draw of a trajectory: as `generate`, the first that the schema and the mesher take.

    Raises:
        InputError: none of its attempts can be used.
    """
    sensor, refused = draw_sensor(template, seed, sensor_of(template, index)), ""
    for attempt in range(MAX_DRAWS):
        try:
            scene = draw(template, seed, index, attempt, sensor)
            MeshRule.of(scene).resolution(scene, template.source.parent)
        except InputError as error:
            refused = str(error)
        else:
            return scene
    raise InputError(f"{template.name}, draw {index}: none of {MAX_DRAWS} attempts can be used: {refused}")


def reference_mesh(gel: Gel, zone: Focus, chosen_mm: float, most: int) -> tuple[PadMesh, int, float]:
    """A mesh whose elements are FINER times smaller than `chosen_mm`, with more beside the contact and one more
    through the thickness than meshes of draws have.

    Args:
        gel: the pad.
        zone: the contact's.
        chosen_mm: size of the elements under the contact that it is to be finer than.
        most: elements across the contact, at most.

    Returns:
        The mesh, elements across the contact, and their size in mm.
    """
    for across in (*range(ELEMENTS_ACROSS[1], most, 2), most):
        fine = lateral_spacing(gel, zone, Counts((across, across), BESIDE))
        if FINER * fine <= chosen_mm:
            break
    height = gel.size_mm[2] / fine
    through = max(2, math.ceil(math.log1p(height * (STEEPEST_DEPTH - 1)) / math.log(STEEPEST_DEPTH))) + 1
    counts = Counts((across, across), BESIDE, through, growth=depth_growth(through, height))
    box = graded_box(gel.size_mm, zone, counts, tuple(layer.thickness_mm for layer in gel.layers))
    return domed(box, gel.dome_radius_mm), across, fine


def press_draw(case: Row, assignments: list[str], most: int) -> list[Row]:
    """A row for the reference, and one for each mesh of a draw, coarsest first.

    A case has scene, seed and draw; `assignments` are `--set` of the command; `most` limits the elements across the
    contact in the reference.
    """
    template = load_scene(case["scene"], assignments)
    try:
        scene = drawn(template, case["seed"], case["draw"])
    except InputError as error:
        return [{"mesh": "none", "chosen": True, "status": "not drawn", "reason": str(error)}]
    folder, gel = template.source.parent, scene.sensor.gel
    zone = footprint(path_of(scene, folder), gel.size_mm, MARGIN)
    pairs = samples_of(template, case["seed"], case["draw"], scene.motion.steps)
    frames = frozenset(frame for pair in pairs for frame in pair.frames)
    shown, points = sorted(frames - {0}), places(scene)
    rule = MeshRule.of(scene)
    chosen = rule.resolution(scene, folder)
    mesh, finest, fine = reference_mesh(gel, zone, chosen.spacing_mm, most)
    step = min(STEP_MM, scene.numerics.max_step_mm)
    closer = scene.model_copy(update={"numerics": scene.numerics.model_copy(update={"max_step_mm": step})})
    options = SolverOptions(correction_iterations=MAX_ITERATIONS)
    about: dict[str, Any] = {
        "indenter": scene.contact.indenter.shape,
        "depth_mm": round(scene.motion.depth_mm, 3),
        "target_px": rule.target_error_px,
    }
    own = Fineness(chosen.across, chosen.through)
    meshes = [each for each in mesh_levels(gel, zone) if each.across < finest]
    meshes = meshes[: meshes.index(own) + BEYOND + 1] if own in meshes else [*meshes, own]
    try:
        truth = simulate(closer, mesh, folder, frames=frames, options=options)
        field = face_displacement(truth, points, shown) if truth.status == "complete" else None
        rows = [{**about, "mesh": "reference", "chosen": False, **_outcome(truth, shown), "spacing_mm": fine}]
        for fineness in meshes:
            mesh, spacing_mm = graded_mesh(gel, zone, *fineness)
            found, seconds = timed(partial(simulate, scene, mesh, folder, frames=frames))
            row = {**about, "mesh": "x".join(map(str, fineness)), "chosen": fineness == own, **_outcome(found, shown)}
            row |= {"seconds": round(seconds, 3), "unknowns": 3 * len(found.space.points), "spacing_mm": spacing_mm}
            row["predicted_px"] = predicted_error_px(scene, zone, spacing_mm)
            percent = error_percent(scene, zone, spacing_mm)
            row["predicted_percent"] = None if np.isnan(percent) else percent
            if field is not None and found.status == "complete":
                px, seen = picture_errors(face_displacement(found, points, shown), field, scene)
                row |= {"error_px": None if np.isnan(px).any() else float(px.max()), "seen": float(seen.min())}
                row["force_percent"], row["displacement_percent"] = percents(found, truth, points, shown)
            rows.append(row)
    except InputError as error:  # an indenter that cannot be built
        return [{**about, "mesh": "none", "chosen": True, "status": "refused", "reason": str(error)}]
    return rows


def percents(found: Trajectory, truth: Trajectory, points: FloatArray, shown: list[int]) -> tuple[float, float]:
    """Errors of force and displacement, see the module."""
    forces = [np.array([[each.states[state].force_n] for state in shown]) for each in (found, truth)]
    fields = [face_displacement(each, points, shown) for each in (found, truth)]
    force, displacement = (
        float(100 * root_mean_square(own - reference).max() / root_mean_square(reference).max())
        for own, reference in (forces, fields)
    )
    return force, displacement


def _outcome(found: Trajectory, shown: list[int]) -> Row:
    """How a press ended, and how deep the states that samples show are in the indenter."""
    reached = [found.states[k].max_penetration_mm for k in shown if k < len(found.states)]
    return {"status": found.status, "reason": found.reason, "penetration_mm": max(reached, default=None)}


def judge(rows: list[Row]) -> Row | None:
    """The row of a draw's chosen mesh with what the draw says; None where nothing can be said of it.

    Args:
        rows: of one draw, the meshes by rising fineness.
    """
    chosen = next(row for row in rows if row["chosen"])
    if chosen.get("error_px") is None:
        return None
    truth = next(row for row in rows if row["mesh"] == "reference")
    good = [row for row in rows if row.get("error_px") is not None and row["error_px"] <= chosen["target_px"]]
    last = [row for row in rows if row.get("error_px") is not None][-1]
    ratio = last["spacing_mm"] / truth["spacing_mm"]

    def costs(name: str, power: float) -> float | None:
        return (chosen[name] / min(row[name] for row in good)) ** power if good else None

    return {
        **chosen,
        "within": chosen["error_px"] <= chosen["target_px"],
        "times_cheapest": costs("seconds", 1.0),
        "times_cheapest_by_unknowns": costs("unknowns", SOLVE_GROWTH),
        "own_px": last["error_px"] / (ratio**RATE - 1) if ratio > 1 else None,
    }


def summary(name: str, draws: int, judged: list[Row]) -> Row:
    """The row of a scene, see the module."""
    if not judged:
        return {"scene": name, "draws": draws, "judged": 0}
    share = np.array([row["error_px"] / row["target_px"] for row in judged])
    off = np.log([row["error_px"] / row["predicted_px"] for row in judged if row["error_px"] * row["predicted_px"] > 0])
    own = [row["own_px"] / row["target_px"] for row in judged if row["own_px"] is not None]

    def cheap(column: str) -> str:
        ratios = [row[column] for row in judged if row[column] is not None]
        return f"{sum(ratio <= LARGEST_RATIO for ratio in ratios)} of {len(ratios)}"

    return {
        "scene": name,
        "draws": draws,
        "judged": len(judged),
        "within": f"{sum(row['within'] for row in judged)} ({np.mean([row['within'] for row in judged]):.0%})",
        "with own": sum(row["error_px"] + (row["own_px"] or 0.0) <= row["target_px"] for row in judged),
        "cost <= 2x": cheap("times_cheapest"),
        "by unknowns": cheap("times_cheapest_by_unknowns"),
        "error/target": float(np.median(share)),
        "95th": float(np.quantile(share, 0.95)),
        "measured/predicted": f"{np.exp(off.mean()):.2f} (± {off.std():.2f})" if len(off) else None,
        "own": float(np.median(own)) if own else None,
    }


def main(argv: list[str]) -> int:
    """Run the command line; 1 if less than GOAL of the draws that can be judged are within their target."""
    parser = arguments("budget", __doc__)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--scene", action="append", help=f"name or file; repeatable; default: {DEFAULT_SCENE}")
    which.add_argument("--all", action="store_true", help="all shipped scenes")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="as of generate; repeatable")
    parser.add_argument("--draws", type=int, default=3, help="of each scene; default: 3")
    parser.add_argument("--seed", type=int, default=2, help="of the draws; the error model saw 0, 1 and 3")
    parser.add_argument("--reference", type=int, default=18, help="elements across a contact in it, at most")
    parser.add_argument("--workers", type=int, default=1, help="draws at once")
    given = parser.parse_args(argv)
    names = shipped_scenes() if given.all else list(dict.fromkeys(given.scene or [DEFAULT_SCENE]))
    cases = []
    for name in names:
        template = load_scene(name, given.set)
        if template.corners[0].numerics.edge_length_mm is not None:
            raise InputError(
                f"{template.label}: numerics.edge_length_mm leaves no budget; give target_error_px instead"
            )
        key = {"scene": name, "hash": template.hash, "seed": given.seed, "reference_across": given.reference}
        cases += [{**key, "draw": index} for index in range(given.draws)]
    one = partial(press_draw, assignments=given.set, most=given.reference)
    print(machine())
    rows = measure(given.out / "budget.csv", cases, one, given.workers)
    draws = [[row for row in rows if all(row[key] == case[key] for key in case)] for case in cases]
    verdicts = [(case["scene"], judge(of_draw)) for case, of_draw in zip(cases, draws, strict=True)]
    judged = [verdict for _, verdict in verdicts if verdict is not None]
    table = [summary(name, given.draws, [v for of, v in verdicts if v is not None and of == name]) for name in names]
    if len(names) > 1:
        table.append(summary("all", len(cases), judged))
    columns = ["draw", "mesh", "chosen", "indenter", "depth_mm", "seconds", "predicted_px", "error_px", "target_px"]
    columns += ["predicted_percent", "force_percent", "displacement_percent"]
    if len(names) == 1:
        show(rows, [*columns, "penetration_mm", "status"], f"Meshes of the draws of {names[0]}")
    missed = [verdict for verdict in judged if not verdict["within"] or verdict["times_cheapest"] > LARGEST_RATIO]
    unjudged = [row for of, (_, v) in zip(draws, verdicts, strict=True) if v is None for row in of if row["chosen"]]
    show(
        [*missed, *unjudged],
        ["scene", *columns, "times_cheapest", "status", "reason"],
        "Draws above their target, dearer than twice the cheapest mesh, or that cannot be judged",
    )
    show(table, list(table[0] if judged else {"scene": 0, "draws": 0, "judged": 0}), "Within the budget?")
    plot(given.out / "budget.png", rows, "seconds", "error_px", "draw", "scene")
    plot(given.out / "budget_model.png", rows, "predicted_px", "error_px", "chosen", style="o")
    return 0 if judged and np.mean([row["within"] for row in judged]) >= GOAL else 1
