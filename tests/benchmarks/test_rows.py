"""The benchmarks' table, which killed and repeated runs keep whole, and the scripts around data and objects."""

import math
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import pyvista as pv
from commands import said

from benchmarks import synthetic_set
from benchmarks.__main__ import QUESTIONS, main
from benchmarks.objects import summary
from benchmarks.rows import Row, machine, measure, plot, read, show, write

CASES = [{"mesh": name, "cells": cells, "step_mm": None} for name in ("fine", "1e-3") for cells in (1, 2)]
"""One name reads like a number, and a key without a value is a key too."""


def square(case: Row) -> Row:
    return {"square": case["cells"] ** 2, "root": math.sqrt(case["cells"])}


def no_measurement(case: Row) -> Row:
    raise AssertionError(case)


@pytest.mark.parametrize("workers", [1, 2])
def test_only_missing_cases_are_measured(tmp_path: Path, workers: int) -> None:
    path = tmp_path / "out" / "rows.csv"
    first = measure(path, CASES[:2], square)
    rows = measure(path, CASES, square, workers)
    assert rows[:2] == first
    assert [(row["cells"], row["square"]) for row in rows] == [(1, 1), (2, 4), (1, 1), (2, 4)]
    again = measure(path, CASES[::-1], no_measurement)
    assert [row["root"] for row in again] == [row["root"] for row in rows[::-1]], "floats come back bit for bit"
    assert measure(path, CASES[:1], no_measurement)[0]["square"] == 1
    assert len(read(path)) == 4, "rows that are not asked for stay"
    assert measure(path, [], square) == []
    twice = measure(path, [{**CASES[0], "cells": 3}] * 2, square)
    assert [row["square"] for row in twice] == [9, 9]
    assert len(read(path)) == 5, "a case that is asked for twice is measured once"


def test_a_case_may_have_several_rows_whose_values_come_back(tmp_path: Path) -> None:
    several = [{"state": state, "root": state**0.5} for state in (1, 2)]
    rows = measure(tmp_path / "rows.csv", CASES[:1], lambda case: several)
    assert rows == [{**CASES[0], **row} for row in several]
    assert measure(tmp_path / "rows.csv", CASES[:1], no_measurement) == rows
    rows = [{"a": 1, "b": 0.1, "c": True, "d": "x, y"}, {"a": -2, "e": False, "f": 'say "no"'}]
    write(tmp_path / "rows.csv", rows)
    assert read(tmp_path / "rows.csv") == rows
    assert read(tmp_path / "none.csv") == []
    write(tmp_path / "rows.csv", [{"a": math.nan, "b": None}])
    assert math.isnan(read(tmp_path / "rows.csv")[0]["a"])


def test_a_killed_run_leaves_whole_rows(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    program = f"""
import os, signal
from pathlib import Path
from benchmarks import rows
real = rows.csv.DictWriter.writerows
def killed(self, some):
    real(self, some)
    if len(some) == 3:
        self.writer.writerow(["fi"])
        os.kill(os.getpid(), signal.SIGKILL)
rows.csv.DictWriter.writerows = killed
cases = {CASES!r}
rows.measure(Path({str(path)!r}), cases, lambda case: {{"square": case["cells"] ** 2, "root": case["cells"] ** 0.5}})
"""
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    assert subprocess.run([sys.executable, "-c", program], env=paths, capture_output=True).returncode == -signal.SIGKILL
    assert len(read(path)) == 2
    measured: list[Row] = []
    rows = measure(path, CASES, lambda case: measured.append(case) or square(case))  # type: ignore[func-returns-value]
    assert measured == CASES[2:]
    assert [row["square"] for row in read(path)] == [row["square"] for row in rows] == [1, 4, 1, 4]


def test_table_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"case": "held", "s": 1.23456, "error": 0.5, "mesh": "fine"}, {"case": "held", "s": math.nan, "mesh": None}]
    show(rows, ["mesh", "s"], "Held")
    shown = capsys.readouterr().out
    assert "Held" in shown
    cells = [line.split("|")[1:-1] for line in shown.strip().splitlines()[-2:]]
    assert [[cell.strip() for cell in line] for line in cells] == [["fine", "1.235"], ["-", "-"]]
    for panel in ("", "case"):
        plot(tmp_path / "plots" / f"{panel}.png", rows, "s", "error", "mesh", panel)
    plot(tmp_path / "plots" / "nothing.png", [], "s", "error", "mesh")
    assert all(path.stat().st_size > 1000 for path in (tmp_path / "plots").iterdir())
    assert "cores" in machine()


def test_help_names_the_questions_and_other_names_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for word, status in (("--help", 0), ("nothing", 2)):
        with pytest.raises(SystemExit) as left:
            main([word])
        assert left.value.code == status
    told = capsys.readouterr().out
    assert all(name in told for name in QUESTIONS)


def test_the_summary_of_made_up_presses() -> None:
    rows = [{"status": "complete", "penetration": depth, "times_a_ball": 1 + depth} for depth in (0.01, 0.02, 0.06)]
    found = summary([*rows, {"status": "partial"}, {"status": "refused"}])
    assert (found["refused"], found["pressed"], found["complete"]) == (1, 4, 3)
    assert found["times a ball's time, median"] == 1.02
    assert (found["sunk in, median"], found["largest"], found["at most 2%"]) == ("2.0%", "6.0%", "66.7%")
    assert summary([{"status": "refused"}]) == {"refused": 1, "pressed": 0, "complete": 0}


def test_the_synthetic_set_has_every_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def synth(command: list[str]) -> int:
        commands.append(command)
        return int("digit" in command)

    monkeypatch.setattr(synthetic_set, "synth", synth)
    assert synthetic_set.main(["--out", str(tmp_path), "--workers", "2"]) == 1  # the worst of all
    assert {"digit", "gelsight_mini", "tac3d"} <= {command[command.index("--scene") + 1] for command in commands}
    assert all(command[-2:] == ["--workers", "2"] for command in commands)


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(tmp_path / name) for name in ("cube.stl", "none.stl")]
    pv.Cube().triangulate().save(files[0])
    Path(files[1]).write_text("solid")
    assert "none.stl" in said(capsys, main, "objects", *files, "--draws", 1, "--out", tmp_path)
    rows = cube, none = read(tmp_path / "objects.csv")
    assert [(row["file"], row["status"]) for row in rows] == list(zip(files, ("complete", "refused"), strict=True))
    assert cube["force_n"] > 0
    assert 0 <= cube["penetration"] < 0.2
    assert cube["times_a_ball"] > 0.2
    assert "none.stl" in none["reason"]
