"""The GelFlow paper's table: its eleven methods on eight real pairs, and on synthetic pairs with exact flow.

    python -m benchmarks paper REAL_PAIRS --raft raft.pth --train DATA...      # on a GPU: days at the full length

Makes the test set of 30 synthetic pairs (seed 58, five scenes), trains what is missing where --train gives the data,
scores what is not in the table yet, and prints the table, the paper's claims one by one, and what it did not run. Run
again, it goes on. Networks are trained with the presets' own settings but for `--steps` and what --set changes.

PSNR and SSIM are of the first image and the second one warped by the flow, as in the paper; they tell how well images
fit, not where the gel went. That tell the endpoint error in px and the distance from dots in px.
"""

import shlex
from pathlib import Path
from statistics import mean, stdev
from typing import Any

from benchmarks.rows import Row, arguments, measure, show
from gelflow.baselines import named_methods
from gelflow.compare.scores import evaluate
from gelflow.data import PairDataset, open_all
from gelflow.methods.learned import Learned, open_network
from gelflow.methods.name import MethodName
from synth.cli import main as synth

SCENES, PAIRS, SEED = ("gelsight_mini", "deltact", "gelslim", "soft_bubble", "tac3d"), 6, 58
"""Dots, random colours and speckle; pairs of each."""
CLASSICAL = {
    "Farneback": "farneback",
    "DIS ultrafast": "dis-ultrafast",
    "DIS fast": "dis-fast",
    "DIS medium": "dis-medium",
    "TV-L1": "tvl1",
}
NETWORKS: dict[str, tuple[str, ...]] = {
    "ARFlow": ("--config", "arflow"),
    "SelfFlow": ("--config", "selfflow"),
    "GelFlow": ("--config", "paper"),
    "GelFlow, no fusion": ("--config", "paper", "--set", "model.lffm=false"),
    "GelFlow, fusion as published": ("--config", "paper", "--set", "model.lffm_scale=none"),
    "GelFlow, no decomposition": ("--config", "paper", "--set", "loss.lambda_dc=0"),
    "GelFlow, no deformation": ("--config", "paper", "--set", "loss.lambda_df=0"),
    "GelFlow, no anti-edge weight": ("--config", "paper", "--set", "loss.least_weight=1.0"),
    "GelFlow, finest scale only": ("--config", "paper", "--set", "loss.lambda_s=[1.0,0,0,0,0,0,0]"),
}
"""Options of `gelflow train`: the paper's rows, and its ablation."""
FINE_TUNED = {"SelfFlow+ft": "SelfFlow", "GelFlow+ft": "GelFlow"}
TRADITIONAL = tuple(CLASSICAL)
CLAIMS: tuple[tuple[str, tuple[str, ...], tuple[str, ...]], ...] = (
    ("TV-L1 and DIS medium are the best traditional methods", ("TV-L1", "DIS medium"), TRADITIONAL[:3]),
    ("RAFT without training on gels is worse than DIS medium", ("DIS medium",), ("RAFT",)),
    ("ARFlow is worse than DIS medium", ("DIS medium",), ("ARFlow",)),
    ("SelfFlow+ft is better than every traditional method", ("SelfFlow+ft",), TRADITIONAL),
    ("GelFlow is better than every traditional method", ("GelFlow",), TRADITIONAL),
    ("GelFlow is better than SelfFlow", ("GelFlow",), ("SelfFlow",)),
    ("+ft improves SelfFlow", ("SelfFlow+ft",), ("SelfFlow",)),
    ("GelFlow+ft is the best of all", ("GelFlow+ft",), (*TRADITIONAL, "RAFT", "ARFlow", "SelfFlow+ft", "GelFlow")),
    ("fusion helps", ("GelFlow",), ("GelFlow, no fusion",)),
    ("the decomposition loss helps", ("GelFlow",), ("GelFlow, no decomposition",)),
    ("the deformation loss helps", ("GelFlow",), ("GelFlow, no deformation",)),
    ("the anti-edge weight helps", ("GelFlow",), ("GelFlow, no anti-edge weight",)),
)
"""What the paper says, what is better by it, and what each of those is better than; by the mean PSNR."""


def main(argv: list[str]) -> int:
    """Train, score and print; 1 if making the test set or a training failed."""
    parser = arguments("paper", __doc__)
    parser.add_argument("real", nargs="?", type=Path, help="the eight real pairs, as `gelflow compare` takes them")
    parser.add_argument("--raft", type=Path, help="RAFT's published weights")
    parser.add_argument("--runs", type=Path, default=Path("runs/paper"), help="where trainings are kept")
    parser.add_argument("--train", nargs="+", type=Path, default=[], help="pairs to train what is missing on")
    parser.add_argument("--steps", type=int, help="of each training; default: the presets' (66,400)")
    parser.add_argument("--ft-steps", type=int, default=1600, help="of +ft; default: the paper's 800 epochs, 1600")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a change of each training")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--device", default="auto")
    given = parser.parse_args(argv)
    test = given.out / "paper_test"
    if _make_test_set(test) != 0:
        return 1
    names: list[tuple[str, int | None]] = [(name, None) for name in (*CLASSICAL, *(["RAFT"] if given.raft else []))]
    left = [] if given.raft else ["RAFT: give its weights by --raft"]
    for name, options in NETWORKS.items():
        for seed in range(given.seeds):
            folder = _folder(given.runs, name, seed)
            if given.train and _train(folder, options, seed, given) != 0:
                return 1
            if (folder / "weights.safetensors").is_file():
                names += [(name, seed), *((tuned, seed) for tuned, of in FINE_TUNED.items() if of == name)]
            else:
                left.append(f"{name}, seed {seed}: {folder} holds no weights")
    data = {"synthetic": [test / scene for scene in SCENES]} | ({"real": [given.real]} if given.real else {})
    cases = [
        {"method": name, "seed": seed, "data": kind}
        for kind in data for name, seed in names if kind == "real" or name not in FINE_TUNED
    ]  # fmt: skip
    datasets = {kind: open_all(paths) for kind, paths in data.items()}
    rows = measure(given.out / "paper.csv", cases, lambda case: _scored(case, datasets[case["data"]], given))
    _show(rows)
    for text, better, worse in CLAIMS:
        print(f"- {text}: {_verdict(rows, better, worse)}")
    print("\nNot run:", *(left or ["nothing"]), sep="\n- ")
    return 0


def _make_test_set(folder: Path) -> int:
    status = 0
    for scene in SCENES:
        command = ["generate", "--scene", scene, "--n", str(PAIRS), "--seed", str(SEED), "--out", str(folder / scene)]
        status = max(status, synth([*command, "--set", "sampling.trajectories_per_sensor=1", "--device", "cpu"]))
    return status


def _folder(runs: Path, name: str, seed: int | None) -> Path:
    return runs / f"{name.replace(', ', '-').replace(' ', '_')}.{seed}"


def _train(folder: Path, options: tuple[str, ...], seed: int, given: Any) -> int:
    from gelflow.cli import main as gelflow

    if (folder / "weights.safetensors").is_file():
        return 0
    command = ["train", *map(str, given.train), *options, "--set", f"seed={seed}", "--out", str(folder)]
    command += [part for change in given.set for part in ("--set", change)]
    command += ["--device", given.device, *(["--steps", str(given.steps)] if given.steps else [])]
    print("gelflow", shlex.join(command), flush=True)
    return gelflow(command)


def _scored(case: Row, dataset: PairDataset, given: Any) -> list[Row]:
    """A row a pair."""
    scores = evaluate(_method(case["method"], case["seed"], dataset, given), dataset)
    found = ("pair", "psnr_db", "ssim", "endpoint_error_px", "marker_distance_px", "dot_distance_px", "own_dots")
    return [{name: getattr(score, name) for name in found} for score in scores]


def _method(name: str, seed: int | None, dataset: PairDataset, given: Any) -> Any:
    if name in CLASSICAL:
        return named_methods([CLASSICAL[name]], given.device)[0]
    if name == "RAFT":
        return open_network(given.raft, MethodName(name), device=given.device)
    from gelflow.training.test_time import fine_tuned

    folder = _folder(given.runs, FINE_TUNED.get(name, name), seed)
    network = open_network(folder / "weights.safetensors", MethodName(name), device=given.device, registration="none")
    if not isinstance(network, Learned):
        raise TypeError(f"{folder} holds other weights than GelFlow's")
    return fine_tuned(network, dataset, folder / "ft", given.ft_steps) if name in FINE_TUNED else network


def _show(rows: list[Row]) -> None:
    names = list(dict.fromkeys(row["method"] for row in rows))
    pairs = list(dict.fromkeys(row["pair"] for row in rows if row["data"] == "real"))
    for quantity, digits in (("psnr_db", 2), ("ssim", 3)):
        table = [
            {"method": name} | {f"#{k}": f"{_mean(rows, name, 'real', quantity, pair):.{digits}f}"
                                for k, pair in enumerate(pairs, 1)}
            for name in names if _values(rows, name, "real", quantity)
        ]  # fmt: skip
        if table:
            show(table, list(table[0]), quantity)
    print(*(f"#{k} {pair}" for k, pair in enumerate(pairs, 1)), sep=", ")
    columns = {
        "real PSNR, dB": ("real", "psnr_db"),
        "real SSIM": ("real", "ssim"),
        "from dots, px": ("real", "dot_distance_px"),
        "own dots": ("real", "own_dots"),
        "synthetic error, px": ("synthetic", "endpoint_error_px"),
        "synthetic PSNR, dB": ("synthetic", "psnr_db"),
    }
    means = [{"method": name} | {title: _spread(rows, name, *of) for title, of in columns.items()} for name in names]
    show(means, ["method", *columns], "Means over pairs; of seeds mean ± standard deviation")


def _values(rows: list[Row], name: str, data: str, quantity: str, pair: str | None = None) -> dict[Any, list[float]]:
    """Values of a quantity by seed."""
    found: dict[Any, list[float]] = {}
    for row in rows:
        if (
            (row["method"], row["data"]) == (name, data)
            and pair in (None, row["pair"])
            and row.get(quantity) is not None
        ):
            found.setdefault(row.get("seed"), []).append(row[quantity])
    return found


def _mean(rows: list[Row], name: str, data: str, quantity: str, pair: str | None = None) -> float:
    return mean(mean(values) for values in _values(rows, name, data, quantity, pair).values())


def _spread(rows: list[Row], name: str, data: str, quantity: str) -> str | None:
    seeds = list(_by_seed(rows, name, data, quantity).values())
    if not seeds:
        return None
    return f"{mean(seeds):.3f}" + (f" ± {stdev(seeds):.3f}" if len(seeds) > 1 else "")


def _verdict(rows: list[Row], better: tuple[str, ...], worse: tuple[str, ...]) -> str:
    """Whether the claim holds, by mean PSNR of real pairs and by mean error of synthetic ones, seed by seed."""
    told = []
    for data, quantity, sign in (("real", "psnr_db", 1), ("synthetic", "endpoint_error_px", -1)):
        known = {name: _by_seed(rows, name, data, quantity) for name in (*better, *worse)}
        missing = [name for name, values in known.items() if not values]
        if missing:
            told.append(f"{data} not run ({', '.join(missing)})")
            continue
        trained = [set(values) for values in known.values() if None not in values]
        seeds = sorted(set.intersection(*trained)) if trained else [None]
        at = {
            name: [values[seed] if seed in values else values[None] for seed in seeds] for name, values in known.items()
        }
        gaps = [
            min(sign * (at[a][k] - at[b][k]) for a in better for b in worse)
            for k in range(len(seeds))
        ]  # fmt: skip
        verdict = "holds" if min(gaps) > 0 else "does not hold" if max(gaps) <= 0 else "no difference"
        told.append(f"{data} {verdict} ({', '.join(f'{sign * gap:+.2f}' for gap in gaps)} {quantity.split('_')[-1]})")
    return "; ".join(told)


def _by_seed(rows: list[Row], name: str, data: str, quantity: str) -> dict[Any, float]:
    """Means over pairs."""
    return {seed: mean(values) for seed, values in _values(rows, name, data, quantity).items()}
