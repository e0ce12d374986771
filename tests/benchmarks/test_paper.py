"""The paper's table: seeds are averaged before they are compared, and a claim needs every method that it names."""

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
        "real holds (+0.500 db); synthetic does not hold (+0.100 px)"
    )
    assert _verdict(ROWS, ("SelfFlow",), ("GelFlow", "RAFT")) == "real not run (RAFT); synthetic not run (RAFT)"
