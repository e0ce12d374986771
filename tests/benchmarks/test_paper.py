"""The paper's table: claims are judged seed by seed, and need every method that they name."""

from benchmarks.paper import _spread, _verdict
from benchmarks.rows import Row

ROWS: list[Row] = [
    {"method": name, "seed": seed, "data": data, "pair": pair, "psnr_db": psnr + by, "endpoint_error_px": error}
    for name, seed, psnr, error in (("GelFlow", 0, 27.0, 0.3), ("GelFlow", 1, 29.0, 0.5), ("SelfFlow", None, 27.5, 0.3))
    for data in ("real", "synthetic")
    for pair, by in (("one", -1.0), ("two", 1.0))
]


def test_means_over_pairs_come_before_those_over_seeds() -> None:
    assert _spread(ROWS, "GelFlow", "real", "psnr_db") == "28.000 ± 1.414"
    assert _spread(ROWS, "SelfFlow", "real", "psnr_db") == "27.500"
    assert _spread(ROWS, "RAFT", "real", "psnr_db") is None


def test_a_claim_is_judged_where_all_its_methods_have_run() -> None:
    assert _verdict(ROWS, ("GelFlow",), ("SelfFlow",)) == (
        "real no difference (-0.50, +1.50 db); synthetic does not hold (+0.00, +0.20 px)"
    )
    only_second = [row for row in ROWS if row["seed"] != 0]
    assert _verdict(only_second, ("GelFlow",), ("SelfFlow",)).startswith("real holds (+1.50 db)")
    first_alone = [*ROWS, *({**row, "method": "GelFlow+ft"} for row in ROWS if row["seed"] == 0)]
    assert "(+0.00 db)" in _verdict(first_alone, ("GelFlow",), ("GelFlow+ft",)), "the seeds that both have"
    assert _verdict(ROWS, ("SelfFlow",), ("GelFlow", "RAFT")) == "real not run (RAFT); synthetic not run (RAFT)"
