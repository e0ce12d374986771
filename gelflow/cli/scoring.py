"""The commands `evaluate` and `compare`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from gelflow.cli.options import (
    AsJson,
    OnDevice,
    Paths,
    Registered,
    Registration,
    ShippedOrFile,
    Size,
    parse_size,
    whole,
)
from gelflow.errors import InputError

if TYPE_CHECKING:
    from gelflow.data import PairDataset
    from gelflow.methods.fast import Fast
    from gelflow.methods.learned import Learned, PublishedRaft
    from gelflow.methods.method import Method


def evaluate(
    data: Paths,
    /,
    *,
    weights: ShippedOrFile = None,
    registration: Registration = None,
    size: Size = None,
    device: OnDevice = "auto",
    as_json: AsJson = False,
) -> int:
    """Scores one file of weights on image pairs."""
    from gelflow.data import open_all
    from gelflow.methods.learned import open_network
    from gelflow.models.weights import weights_file

    network = open_network(weights_file(weights), None, parse_size(size), device, registration)
    _score(open_all(data), [network], None, as_json, 1)
    return 0


def compare(
    data: Paths,
    /,
    *,
    out: Annotated[Path | None, Parameter(help="Folder for tables, plots and all numbers.")] = None,
    methods: Annotated[
        str,
        Parameter(
            help="Methods, separated by commas; an empty text for none. Besides the default ones (the paper's) there "
            "are dis-motion, dis-both, dis-brightness (DIS medium, then registration), exact (the exact flow "
            "of synthetic pairs), al-dic (pyALDIC)."
        ),
    ] = "none,lucas-kanade,farneback,dis-ultrafast,dis-fast,dis-medium,tvl1",
    weights: Annotated[
        list[str] | None,
        Parameter(
            help="FILE or LABEL=FILE of a network: GelFlow (.safetensors; best: the shipped one) or RAFT (.pth); "
            "repeatable. Labels that differ only after # (best#0, best#1) are seeds: they share a row with mean and "
            "standard deviation."
        ),
    ] = None,
    registration: Annotated[
        list[Registered] | None,
        Parameter(
            help="Registration of GelFlow networks (see predict); repeatable. Each gives a row, whose name ends with "
            "+motion, +both or +brightness. Default: as the weights state."
        ),
    ] = None,
    ft: Annotated[
        int,
        Parameter(
            converter=whole(0),
            help="Steps of test-time optimisation of each GelFlow network on these pairs, reported apart.",
        ),
    ] = 0,
    batch: Annotated[
        int, Parameter(converter=whole(0), help="Pairs at once to measure networks' speed and memory; 0: do not.")
    ] = 1,
    every: Annotated[int, Parameter(converter=whole(1), help="Take only every n-th pair, for slow methods.")] = 1,
    size: Size = None,
    device: OnDevice = "auto",
    as_json: AsJson = False,
) -> int:
    """Scores several methods on the same image pairs."""
    from gelflow.baselines import named_methods
    from gelflow.data import PairDataset, open_all
    from gelflow.methods.learned import Learned

    chosen = named_methods([name.strip() for name in methods.split(",") if name.strip()], device)
    networks = [network for given in weights or () for network in _networks(given, registration, size, device)]
    own = [network for network in networks if isinstance(network, Learned)]
    if registration and not own:
        raise InputError(
            "--registration: needs --weights of GelFlow; of DIS there are dis-motion, dis-both, dis-brightness"
        )
    dataset = open_all(data)
    dataset = PairDataset(dataset.source, dataset.records[::every])
    if ft > 0:
        from gelflow.training.test_time import fine_tuned

        if out is None or not own:
            raise InputError(f"--ft {ft}: needs --weights of GelFlow, and --out beside which their copies are kept")
        folder = out.with_name(f"{out.name}_ft")
        for one in own:
            label = str(replace(one.name, registration="")).replace("/", "_")
            networks.append(fine_tuned(one, dataset, folder / label, ft))
    _score(dataset, [*chosen, *networks], out, as_json, batch)
    return 0


def _networks(
    given: str, registrations: Sequence[Registered] | None, size: str | None, device: str
) -> list[Learned | PublishedRaft | Fast]:
    """The rows of one --weights: of GelFlow one for each --registration, of RAFT, which it does not concern, one."""
    from gelflow.methods.learned import open_network
    from gelflow.methods.name import MethodName
    from gelflow.models.raft import looks_like_raft
    from gelflow.models.weights import weights_file

    label, equals, file = given.partition("=")
    path = weights_file(Path(file if equals else given))
    name = MethodName.parse(label) if equals else None
    choices = (None,) if not registrations or looks_like_raft(path) else tuple(registrations)
    return [open_network(path, name, parse_size(size), device, choice) for choice in choices]


def _score(dataset: PairDataset, methods: Sequence[Method], out: Path | None, as_json: bool, batch: int) -> None:
    from gelflow.compare.run import FILES, compare
    from gelflow.compare.tables import tables
    from gelflow.terminal import progress, show_table

    done, total = count(1), len(dataset) * len(methods)
    with progress("pairs", not as_json) as advance:
        result = compare(
            methods, dataset, out, lambda one: advance(next(done), total, f"{one.method}, {one.pair}"), batch
        )
    if as_json:
        print(result.to_json())
        return
    print(f"{', '.join(result.data)}; times on {result.devices}")
    for title, table in tables(result):
        show_table(title, *table)
    if out is not None:
        print(f"written: {', '.join(str(out / name) for name in FILES if (out / name).is_file())}")
