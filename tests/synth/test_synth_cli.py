"""Every command of `python -m synth`: what it prints, writes and returns."""

import json
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import commands
import numpy as np
import pytest
import pyvista as pv
from samples import tree
from tiny_scene import fingerprint, reference

import synth.doctor
from synth.cli import main

pytestmark = pytest.mark.usefixtures("one_cache")

Run = Callable[..., str]
STEP = {
    "depth_mm", "shear_mm", "twist_deg", "force_n", "torque_nmm", "converged", "newton_iterations", "residual",
    "min_jacobian", "max_penetration_mm", "slip_ratio", "contact_area_mm2",
}  # fmt: skip


@pytest.fixture
def said(capsys: pytest.CaptureFixture[str]) -> Run:
    return partial(commands.said, capsys, main)


@pytest.fixture
def complaint(capsys: pytest.CaptureFixture[str]) -> Run:
    return partial(commands.complaint, capsys, main)


@pytest.mark.parametrize(("command", "words"), [
    ("", ["generate", "plan", "preview", "simulate", "inspect", "verify", "export", "doctor", "--debug"]),
    ("generate", ["--scene", "--n", "--out", "--seed", "--set", "--device", "--workers", "--dry-run", "--json"]),
    ("plan", ["--scene", "--set", "--n", "--device", "--json"]),
    ("preview", ["--scene", "--out", "--places", "--seed", "--set", "--device", "--json"]),
    ("simulate", ["--scene", "--out", "--seed", "--set", "--json"]),
    ("inspect", ["PATH", "--png", "--html", "--json"]),
    ("verify", ["PATH", "--json"]),
    ("export", ["PATH", "--format", "--out"]),
    ("doctor", ["--json"]),
])  # fmt: skip
def test_help_lists_commands_and_options(said: Run, command: str, words: list[str]) -> None:
    out = said(*command.split(), "--help")
    assert [word for word in words if word not in out] == []


@pytest.mark.parametrize(("arguments", "message"), [
    (["frobnicate"], 'Unknown command "frobnicate"'),
    (["generate", "--frobnicate"], "frobnicate"),
    (["generate", "--n", "0"], "--n: it is '0', allowed are whole numbers from 1 on"),
    (["generate", "--n", "many"], "--n: it is 'many'"),
    (["generate", "--seed", "-1"], "--seed: it is '-1', allowed are whole numbers from 0 on"),
    (["generate", "--workers", "0"], "--workers: it is '0'"),
    (["generate", "--device", "tpu"], "tpu"),
    (["plan", "--set", "motion.steps=3", "--set", "motion={}"], "motion undoes the earlier motion.steps"),
    (["plan", "--set", "contact.indenter={shape='torus',radius_mm=1,tube_mm=2}"], "contact.indenter.tube_mm = 2"),
    (["simulate", "--scene", "deltact"], "--out"),
    (["simulate", "--out", "x"], "--scene"),
    (["simulate", "--scene", "deltact", "--out", "x", "--index", "-1"], "--index: it is '-1'"),
    (["inspect", "nowhere"], "nowhere: there is no such file or directory"),
    (["inspect", ".", "--limit", "0"], "--limit: it is '0'"),
    (["verify", "nowhere"], "nowhere: there is no such directory"),
    (["verify", "."], "not a dataset"),
    (["export", ".", "--format", "gif", "--out", "x"], "gif"),
    (["export", ".", "--format", "flo", "--out", "x"], "not a dataset"),
])  # fmt: skip
def test_wrong_input_is_one_message_and_status_2(complaint: Run, tmp_path, monkeypatch, arguments, message) -> None:
    monkeypatch.chdir(tmp_path)
    assert message in complaint(*arguments)
    assert list(tmp_path.iterdir()) == []


def test_debug_adds_the_traceback_which_a_mistake_of_the_program_keeps(said: Run, monkeypatch) -> None:
    err = said("plan", "--scene", "nowhere", "--debug", status=2)
    assert "Traceback" in err
    assert err.rstrip().splitlines()[-1].startswith("synth: there is no scene 'nowhere'")

    def broken(*_: object, **__: object) -> int:
        raise RuntimeError("a bug")

    monkeypatch.setattr("synth.verify.verify_dataset", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        main(["verify", "x"])


def test_plan_explains_and_predicts_and_a_dry_run_writes_nothing(said: Run, tiny: Path, tmp_path: Path) -> None:
    out = said("plan", "--scene", tiny, "--set", "contact.friction=0", "--n", "100")
    wanted = ("friction state", "left out", "contact.friction = 0", "predicted per pair", "for 100 pairs", "factor of")
    assert [words for words in wanted if words not in out] == []
    answer = json.loads(said("plan", "--scene", tiny, "--json", "--n", "100"))
    assert answer["n"] == 100
    assert {"feature", "runs", "reason"} == set(answer["decisions"][0])
    assert json.loads(said("plan", "--json"))["scene"] == "gelsight_mini"  # by default
    assert "for 3 pairs" in said("generate", "--scene", tiny, "--out", tmp_path / "d", "--dry-run", "--n", "3")
    assert list(tmp_path.iterdir()) == [tiny]


@pytest.mark.parametrize(("width", "warning"), [
    (25.0, "motion.shear_mm = [10.0, 0.0] is more than twice the gel's thickness (2.5 mm)"),
    (16.0, "motion.shear_mm = [10.0, 0.0] takes the indenter's centre off the pad"),
])  # fmt: skip
def test_a_long_slide_is_warned_of_and_done(capsys, tiny: Path, width: float, warning: str) -> None:
    """It is unusual, not impossible; what JSON is asked for stays JSON."""
    slide = ["--set", f"sensor.gel.size_mm=[{width}, 6.0, 2.5]", "--set", "motion.shear_mm=[10.0, 0.0]"]
    assert main(["plan", "--scene", str(tiny), "--json", *slide]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["scene"] == "tiny"
    assert err.splitlines()[-1] == (f"synth: warning: {tiny} with --set sensor.gel.size_mm, motion.shear_mm: {warning}")


def test_generate_says_what_it_did_and_a_job_that_partly_fails_has_status_1(said, tiny, tmp_path, capsys) -> None:
    """In a folder whose name would be markup in a careless print."""
    out = tmp_path / "[bold] data [/x]"
    command = ["generate", "--scene", tiny, "--out", out, "--n"]
    assert f": {out}" in said(*command, 1)
    assert "1 pairs made (1 were there)" in said(*command, 2)
    answer = json.loads(said(*command, 2, "--json"))
    assert (answer["made"], answer["found"], answer["given_up"]) == (0, 2, [])
    found, expected = (fingerprint(d) for d in (out, reference()))
    files = [file for file in expected if file.startswith(("samples/000000/", "samples/000001/"))]
    assert len(files) == 2 * 5
    assert [found[file] for file in files] == [expected[file] for file in files]
    out = tmp_path / "d"
    impossible = ["--set", "motion.depth_mm={normal=[0, 1e9]}"]
    assert main(["generate", "--scene", str(tiny), "--out", str(out), "--n", "1", *impossible]) == 1
    printed, err = capsys.readouterr()
    assert f"synth: 1 samples could not be made, see {out}/failures.jsonl" in err
    assert "10 attempts failed" in printed


@pytest.mark.parametrize(("kind", "says"), [
    ("file", "is a file"),
    ("foreign", "not a dataset: holds thesis.tex"),
    ("another job", "seed: 0 there, 5 now"),
    ("below a file", "cannot be written: Not a directory"),
    ("not writable", "cannot be written"),
])  # fmt: skip
def test_places_that_cannot_take_the_dataset(complaint: Run, tiny, tmp_path, kind: str, says: str) -> None:
    out = tmp_path / "d"
    match kind:
        case "file":
            out.write_text("mine")
        case "foreign":
            out.mkdir()
            (out / "thesis.tex").write_text("mine")
        case "another job":
            shutil.copytree(reference(), out)
        case "not writable":
            out = Path("/proc/synth")  # not even by root
        case _:
            (tmp_path / "file").write_text("mine")
            out = tmp_path / "file" / "d"
    before = tree(tmp_path)
    message = complaint("generate", "--scene", tiny, "--out", out, "--seed", "5", "--n", "1")
    assert str(out) in message
    assert says in message
    assert before == tree(tmp_path)


def test_simulate_writes_the_trajectory_of_the_contract(said: Run, tiny: Path, tmp_path: Path) -> None:
    out = tmp_path / "s"
    out.mkdir()
    (out / "state_009.vtu").write_text('Name="mesh"')  # of an earlier run
    printed = said("simulate", "--scene", tiny, "--out", out, "--index", "1", "--json")
    record = json.loads((out / "trajectory.json").read_text())
    assert record == json.loads(printed)
    assert set(record) == {"scene", "steps", "status", "reason", "seconds"}
    assert record["status"] == "complete"
    assert record["seconds"] > 0
    assert all(set(step) == STEP for step in record["steps"])
    assert all(step["converged"] for step in record["steps"])
    motion = record["scene"]["motion"]
    assert record["steps"][0]["force_n"] == [0, 0, 0]
    last = record["steps"][-1]
    assert last["depth_mm"] == pytest.approx(motion["depth_mm"])
    assert last["shear_mm"] == pytest.approx(motion["shear_mm"])
    assert all(step["force_n"][2] > 0 for step in record["steps"][1:])
    assert 0 < last["min_jacobian"] < 1
    names = sorted(path.name for path in out.glob("*.vtu"))
    assert names == [f"state_{number:03d}.vtu" for number in range(3)]
    rest, pressed = (pv.read(out / names[i]) for i in (0, 2))
    assert np.abs(rest.point_data["displacement"]).max() == 0
    np.testing.assert_allclose(pressed.points, rest.points + pressed.point_data["displacement"], atol=1e-12)
    # Traction is per undeformed area: its integral over the flat face is the force. 1e-6 is the solver's tolerance.
    areas = rest.compute_cell_sizes().cell_data["Area"]
    mean = pressed.point_data_to_cell_data().cell_data["traction"]
    np.testing.assert_allclose((areas[:, None] * mean).sum(0), last["force_n"], atol=2e-3 * last["force_n"][2])


def test_simulate_prints_a_table_and_how_far_it_is_and_replaces_its_own_files(
    capsys, tiny, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("synth.progress.LINE_S", 0.0)
    motion = ["--set", "motion.depth_mm=0.2", "--set", "motion.steps=5"]
    assert main(["simulate", "--scene", str(tiny), "--out", str(tmp_path / "s"), *motion]) == 0
    out, err = capsys.readouterr()
    for words in ("force", "0.200", "complete"):
        assert words in out
    lines = [line for line in err.splitlines() if "percent" in line]
    assert " left" in lines[-1]  # from the second line on it knows how fast it is
    assert all(line.startswith("synth: simulate: percent of the ") for line in lines)
    for _ in range(2):
        assert main(["simulate", "--scene", str(tiny), "--out", str(tmp_path / "own")]) == 0


def test_simulate_names_the_scene_file_and_the_file_it_cannot_write_into(complaint: Run, tiny: Path, tmp_path) -> None:
    damaged = tmp_path / "damaged.stl"
    damaged.write_bytes(b"")
    indenter = f"contact.indenter={{ shape = 'mesh', file = '{damaged}' }}"
    words = complaint("simulate", "--scene", tiny, "--out", tmp_path / "s", "--set", indenter)
    begin = f"{tiny} with --set contact.indenter: contact.indenter.file = '{damaged}': it cannot be read"
    assert words.startswith(begin)
    assert "cannot be written" in complaint("simulate", "--scene", tiny, "--out", tiny)


def test_a_simulation_that_ends_early_is_written_and_has_status_1(said: Run, tiny: Path, tmp_path: Path) -> None:
    # A ring of wire thinner than the contact points are apart passes between them.
    wire = "contact.indenter={shape='torus',radius_mm=1.5,tube_mm=0.1}"
    sets = ["--set", wire, "--set", "motion.depth_mm=2.0", "--set", "motion.shear_mm=[0, 0]"]
    err = said("simulate", "--scene", tiny, "--out", tmp_path / "s", *sets, status=1)
    assert "synth: simulation partial: pressed 2 mm deep, the indenter touches no contact point" in err
    record = json.loads((tmp_path / "s" / "trajectory.json").read_text())
    assert record["status"] == "partial"
    assert "touches no contact point" in record["reason"]
    assert len(record["steps"]) == len(list((tmp_path / "s").glob("*.vtu"))) < 3


@pytest.mark.parametrize("name", ["dataset.json", "samples/000000/image1.png", "mine.html"])
@pytest.mark.parametrize("option", ["--png", "--html"])
def test_inspect_replaces_its_own_files_and_no_other(complaint: Run, tmp_path: Path, name: str, option: str) -> None:
    data = tmp_path / "d"
    shutil.copytree(reference(), data)
    (data / "mine.html").write_text("<!DOCTYPE html><title>mine</title>")
    before = fingerprint(data)
    message = complaint("inspect", data, option, data / name)
    assert message.startswith(f"{data / name}: exists and does not come from this command")
    assert fingerprint(data) == before
    for _ in range(2):
        assert main(["inspect", str(data / "samples" / "000000"), option, str(tmp_path / "own")]) == 0


@pytest.mark.parametrize("name", ["trajectory.json", "state_000.vtu", "stress.json"])
def test_simulate_and_stress_replace_no_others_files(complaint: Run, tiny: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("another's")
    before = tree(tmp_path)
    command = ["stress"] if name == "stress.json" else ["simulate", "--scene", tiny]
    message = complaint(*command, "--out", tmp_path)
    assert message.startswith(f"{tmp_path / name}: exists and does not come from this command")
    assert tree(tmp_path) == before


def test_inspect_verify_and_export_take_a_dataset_and_changed_files_have_status_1(said, tmp_path, capsys) -> None:
    data = reference()
    assert "tiny, 0" in said("inspect", data, "--png", tmp_path / "new" / "a.png", "--html", tmp_path / "a.html")
    assert (tmp_path / "new" / "a.png").stat().st_size > 10_000
    assert (tmp_path / "a.html").read_text().lstrip().lower().startswith("<!doctype html>")
    assert len(json.loads(said("inspect", data, "--json"))["samples"]) == 5
    assert json.loads(said("verify", data, "--json"))["ok"]
    assert "5 samples written to" in said("export", data, "--format", "npz", "--out", tmp_path / "npz")
    assert len(list((tmp_path / "npz").iterdir())) == 5
    copy = tmp_path / "d"
    shutil.copytree(reference(), copy)
    with (copy / "samples" / "000001" / "flow.exr").open("r+b") as file:
        file.truncate(3000)
    assert main(["verify", str(copy)]) == 1
    assert "FAILED" in capsys.readouterr().out


def test_doctor_tells_what_there_is_and_how_to_get_what_is_missing(said: Run, capsys, monkeypatch) -> None:
    findings = {finding["what"]: finding for finding in json.loads(said("doctor", "--json"))}
    assert findings["machine"]["state"] == "ok"
    assert "Mitsuba" in findings["rendering on the CPU"]["detail"]
    assert findings["meshing"]["state"] == "ok"
    assert "Mitsuba" in said("doctor")

    def nothing(name: str) -> str:
        raise synth.doctor.PackageNotFoundError(name)

    monkeypatch.setattr(synth.doctor, "version", nothing)
    monkeypatch.setattr("synth.simulate.linear.has_pardiso", lambda: False)
    assert main(["doctor", "--json"]) == 1
    findings = {finding["what"]: finding for finding in json.loads(capsys.readouterr().out)}
    assert findings["meshing"] == {"what": "meshing", "state": "missing", "detail": "pip install pytetwild"}
    assert "pip install pypardiso" in findings["linear solver"]["detail"]
