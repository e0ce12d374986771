"""`benchmarks objects`: a cube and a file that cannot be read, and what is counted."""

from pathlib import Path

import pytest
import pyvista as pv

from benchmarks.__main__ import main
from benchmarks.objects import summary
from benchmarks.rows import read


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(tmp_path / name) for name in ("cube.stl", "none.stl")]
    pv.Cube().triangulate().save(files[0])
    Path(files[1]).write_text("solid")
    assert main(["objects", *files, "--draws", "1", "--out", str(tmp_path)]) == 0
    rows = cube, none = read(tmp_path / "objects.csv")
    assert [(row["file"], row["status"]) for row in rows] == list(zip(files, ("complete", "refused"), strict=True))
    assert cube["force_n"] > 0
    assert 0 <= cube["penetration"] < 0.2
    assert cube["times_a_ball"] > 0.2
    assert "none.stl" in none["reason"]
    assert "none.stl" in capsys.readouterr().out


def test_what_is_counted() -> None:
    rows = [{"status": "complete", "penetration": depth, "times_a_ball": 1 + depth} for depth in (0.01, 0.02, 0.06)]
    found = summary([*rows, {"status": "partial"}, {"status": "refused"}])
    assert (found["refused"], found["pressed"], found["complete"]) == (1, 4, 3)
    assert found["times a ball's time, median"] == 1.02
    assert (found["sunk in, median"], found["largest"], found["at most 2%"]) == ("2.0%", "6.0%", "67%")
    assert summary([{"status": "refused"}]) == {"refused": 1, "pressed": 0, "complete": 0}
