"""Trainings that differ in their seed as one row of every table; tables in LaTeX."""

from dataclasses import replace
from pathlib import Path

import pytest
from test_compare import Constant
from textures import write_folder, write_synthetic

from gelflow.compare.report import latex
from gelflow.compare.run import compare
from gelflow.compare.scores import evaluate, summarise
from gelflow.compare.seeds import group_name, grouped
from gelflow.compare.tables import pair_table, strata_table, summary_table, tables
from gelflow.data import open_pairs


def test_the_seed_is_a_number_at_the_end() -> None:
    names = ["best#0", "best#12+ft", "best", "C# code", "a#1b", "x#2#3"]
    assert [group_name(name) for name in names] == ["best", "best+ft", "best", "C# code", "a#1b", "x#2"]


def test_seeds_become_mean_and_standard_deviation(tmp_path: Path) -> None:
    """Fails with the population's standard deviation (n in place of n - 1)."""
    dataset = open_pairs(write_synthetic(tmp_path, [(1.0, 0.0), (2.0, 0.0)]))
    methods = [Constant("net#0", 0, 0), Constant("other", 5, 0), Constant("net#1", 0.5, 0), Constant("net#2", 1, 0)]
    scores = [score for method in methods for score in evaluate(method, dataset)]
    groups = grouped(summarise(scores))
    assert [group.label for group in groups] == ["net (3 seeds)", "other"]
    # errors of the seeds: (1 + 2) / 2, (0.5 + 1.5) / 2, (0 + 1) / 2
    assert groups[0].mean("endpoint_error_px") == pytest.approx(1.0)
    assert groups[0].spread("endpoint_error_px") == pytest.approx(0.5)
    assert groups[1].spread("endpoint_error_px") is None
    header, rows = summary_table(groups)
    column = header.index("EPE px")
    assert [row[column] for row in rows] == ["1.000 ± 0.500", "3.500"]
    table = pair_table(scores, lambda s: (s.endpoint_error_px or 0.0,), "{:.2f}")
    assert table == (["method", "000000", "000001"],
                     [["net (3 seeds)", "0.50", "1.50"], ["other", "4.00", "3.00"]])  # fmt: skip


def test_bins_of_seeds_are_pooled(tmp_path: Path) -> None:
    dataset = open_pairs(write_synthetic(tmp_path, [(1.0, 0.0)]))
    result = compare([Constant("net#0", 0, 0), Constant("net#1", 0.5, 0)], dataset)
    header, rows = strata_table(result.strata)
    assert header == ["where", "pixels", "net"]
    assert rows == [["motion: 1 to 2 px", "4096", "0.750"]]


def test_fine_tuned_methods_come_apart_and_devices_are_named_where_they_differ(tmp_path: Path) -> None:
    dataset = open_pairs(write_folder(tmp_path, {"a": (1, 0)}))
    result = compare([Constant("net#0+ft", 1, 0), Constant("net", 0, 0)], dataset)
    named = [[row[0] for row in rows] for _, (_, rows) in tables(result)]
    assert named == [["net"], ["net+ft"], ["net", "net+ft"]]
    elsewhere = replace(result.scores[1], method="net, GPU", device="NVIDIA H200", on_gpu=True)
    header, rows = summary_table(grouped(summarise([result.scores[1], elsewhere])))
    assert header[-1] == "on"
    assert rows[1][-1] == "NVIDIA H200"


def test_a_gpu_is_charged_time_as_it_passes_and_a_processor_that_of_a_core(tmp_path: Path) -> None:
    (score,) = evaluate(Constant("net", 0, 0), open_pairs(write_folder(tmp_path, {"a": (1, 0)})))
    here = replace(score, seconds=2.0, processor_seconds=0.5)
    there = replace(here, method="there", on_gpu=True)
    assert [one.cost_seconds for one in summarise([here, there])] == [0.5, 2.0]


def test_latex_escapes_what_it_must() -> None:
    text = latex("Errors of 50 % & more", (["method", "> 1 px %"], [["a_b (3 seeds)", "1.0 ± 0.5"]]))
    assert r"\caption{Errors of 50 \% \& more}" in text
    assert r"method & $>$ 1 px \% \\" in text
    assert r"a\_b (3 seeds) & 1.0 $\pm$ 0.5 \\" in text
    assert text.count(r"\begin") == text.count(r"\end") == 2
