"""Do the draws of the shipped scenes complete?

    python -m benchmarks draws --draws 300 --workers 16                   one by one on the CPU
    python -m benchmarks draws --draws 300 --workers 16 --device cuda     together on a GPU

Every draw is pressed as `generate` would: on the CPU on a mesh of its own, on a GPU on the batched solver's. An object
whose press does not complete is pressed again, with rounder edges or a stiffer contact. A draw that does not complete
then is a failure, which `generate` replaces. A repeated run goes on with the CSV file, on a GPU by whole scenes.
"""

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from functools import partial
from itertools import groupby
from multiprocessing import get_context
from pathlib import Path

from benchmarks.rows import Row, arguments, machine, measure, show
from synth.errors import InputError
from synth.mesh.cache import user_cache
from synth.pipeline.batched_simulation import BATCH
from synth.pipeline.pads import pad_key
from synth.press.press import BLUNTER, MeshRule, Press, blunter
from synth.sampling import draw, samples_of
from synth.scene import Scene
from synth.scene.template import SCENES, load_scene
from synth.simulate import Trajectory
from synth.simulate.batched import simulate_presses
from synth.simulate.batched.pad import prepare
from synth.simulate.policy.multipliers import DEEP
from synth.simulate.solve import simulate_press


def drawn(case: Row, settings: Sequence[str] = ()) -> tuple[Press, frozenset[int]] | str:
    """The press of a draw and the states that samples show of it, or why it cannot be built."""
    template = load_scene(case["scene"], settings)
    seed, number = case["seed"], case["trajectory"]
    try:
        scene = draw(template, seed, number)
        press = _pressed(case, scene, template.folder)
    except InputError as error:
        return str(error)
    pairs = samples_of(template, seed, number, scene.motion.steps)
    return press, frozenset(frame for pair in pairs for frame in pair.frames)


def tries(case: Row, press: Press) -> Iterator[Press]:
    """A press, and its retries; none for a body that cannot be built."""
    yield press
    for scene in blunter(press):
        with suppress(InputError):
            yield _pressed(case, scene, load_scene(case["scene"]).folder)


def _pressed(case: Row, scene: Scene, folder: Path) -> Press:
    """A scene's press; the meshes of fTetWild, which is random, are those of the user's cache."""
    return MeshRule.of(scene, case["device"] == "cuda").press(scene, folder, (user_cache(),))


def found(result: Trajectory, shown: frozenset[int], rounder: int) -> Row:
    """What a row says of a draw; `rounder` counts its retries."""
    deepest = max(state.depth_mm for state in result.states)
    sunk = max((state.max_penetration_mm for n, state in enumerate(result.states) if n in shown), default=0.0)
    return {
        "status": result.status,
        "reason": result.reason,
        "rounder": rounder,
        "iterations": sum(state.newton_iterations for state in result.states),
        "penetration": round(sunk / deepest, 5) if deepest > 0 else 0.0,
    }


def one(case: Row) -> Row:
    """A draw on the CPU."""
    made = drawn(case)
    if isinstance(made, str):
        return {"status": "unbuilt", "reason": made}
    press, shown = made
    for rounder, tried in enumerate(tries(case, press)):
        row = found(simulate_press(tried, shown), shown, rounder)
        if row["status"] == "complete":
            break
    return row


def together(case: Row, workers: int) -> list[Row]:
    """All draws of a scene by the batched solver; their bodies are made by processes."""
    cases = [{**case, "trajectory": number} for number in range(case["draws"])]
    drawn(cases[0], ['numerics.solver="batched"'])  # so that processes find a round gel's mesh
    with ProcessPoolExecutor(workers, get_context("spawn")) as pool:
        made = list(pool.map(partial(drawn, settings=['numerics.solver="batched"']), cases, chunksize=4))
    rows = {number: {"status": "unbuilt", "reason": each} for number, each in enumerate(made) if isinstance(each, str)}
    built = [(number, tries(case, each[0]), each[1]) for number, each in enumerate(made) if not isinstance(each, str)]
    for rounder in range(1 + len(BLUNTER)):
        pressed = [(number, press, shown) for number, those, shown in built if (press := next(those, None))]
        for _, group in groupby(pressed, lambda each: pad_key(each[1])):
            numbers, presses, frames = zip(*group, strict=True)
            pad = prepare(presses[0].scene, presses[0].mesh, case["device"])
            for k, result in simulate_presses(zip(presses, frames, strict=True), pad, BATCH["cuda"]):
                rows[numbers[k]] = found(result, frames[k], rounder)
        built = [each for each in built if rows[each[0]]["status"] != "complete"]
    return [{"trajectory": number, **rows[number]} for number in range(case["draws"])]


def summaries(rows: Sequence[Row]) -> Iterator[Row]:
    """A line for each scene, and one for all."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    for name in [*names, "all"]:
        own = [row for row in rows if name in (row["scene"], "all")]
        done = [row for row in own if row["status"] == "complete"]
        deep = [row["penetration"] for row in done]
        line: Row = {"scene": name, "draws": len(own), "complete": len(done), "share": f"{len(done) / len(own):.2%}"}
        line["after a retry"] = sum(row["rounder"] > 0 for row in done)
        yield line | {"deeper than 2 %": sum(x > DEEP for x in deep), "deepest": f"{max(deep, default=0.0):.1%}"}


def main(argv: list[str]) -> int:
    """Run the command line; 1 if a draw does not complete."""
    shipped = sorted(path.stem for path in SCENES.glob("*.toml"))
    parser = arguments("draws", __doc__)
    parser.add_argument("--scenes", nargs="+", default=shipped, help="default: all that are shipped")
    parser.add_argument("--draws", type=int, default=300, help="of each scene; default: 300")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    given = parser.parse_args(argv)
    print(machine())
    cases: list[Row] = [{"device": given.device, "scene": name, "seed": given.seed} for name in given.scenes]
    table = given.out / f"draws_{given.device}.csv"
    if given.device == "cpu":
        single = [{**case, "trajectory": number} for case in cases for number in range(given.draws)]
        rows = measure(table, single, one, given.workers)
    else:
        rows = measure(table, [{**c, "draws": given.draws} for c in cases], partial(together, workers=given.workers))
    failures = [row for row in rows if row["status"] != "complete"]
    show(failures, ["scene", "seed", "trajectory", "status", "reason"], "Draws that did not complete")
    lines = list(summaries(rows))
    show(lines, list(lines[0]), f"Draws on {given.device}")
    return 1 if failures else 0
