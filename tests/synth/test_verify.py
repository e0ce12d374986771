"""Verification passes exact samples and finds every kind of damage."""

import io
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from commands import refused
from kinematic_double import LENS, OBLIQUE, sensor, sheet
from rich.console import Console
from samples import write
from verified_sample import HEIGHT, WIDTH, as_sample, make_sample, motion_checks, pressed, scene, sheets

from synth.dataset.exr import read_channels, write_flow
from synth.dataset.job import Job
from synth.dataset.sample_reader import SampleData
from synth.dataset.writer import DatasetWriter
from synth.flow.field import FlowField
from synth.scene import Outputs
from synth.verify.dataset import flow_file_problems, verify_dataset, verify_sample
from synth.verify.motion import check_motion
from synth.verify.photometry import NAME as PHOTOMETRY
from synth.verify.photometry import check_photometry
from synth.verify.report import Check, Report, SampleReport

SCENE = scene()


@pytest.fixture(scope="module")
def sample() -> SampleData:
    """Between two presses, not from rest: up to some 6 px of motion."""
    return make_sample(SCENE, pressed(0.8, (0.1, 0.0)), pressed(1.1, (0.8, -0.5), 0.05))


def _failed(flow: FlowField, sample: SampleData) -> set[str]:
    report = verify_sample(0, SCENE, replace(sample, flow=flow))
    assert report.ok == all(check.passed for check in report.checks)
    return {check.name for check in report.checks if not check.passed}


def _failed_motion(name: str, sample: SampleData, **changes: np.ndarray) -> set[str]:
    """The same for one direction alone."""
    flow, surface = sample.flow, sample.surface
    moved = (surface.positions(u) for u in (sample.displacement1, sample.displacement2))
    states = sheets(SCENE.sensor, surface, *moved)
    fields = {"flow": getattr(flow, name), "visible": getattr(flow, f"{name}_visible"), **changes}
    checks = check_motion(name, *(states if name == "forward" else states[::-1]), fields["flow"], fields["visible"])
    return {check.name for check in checks if not check.passed}


def test_shares_no_code_with_the_generator():
    """Neither the camera, nor the tracer, nor Mitsuba are even loaded."""
    program = "import sys, synth.verify; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.split()
    assert "synth.verify.sheet" in loaded
    assert not {"synth.optics", "synth.flow.trace", "synth.flow.exact", "mitsuba", "warp"} & set(loaded)


def test_exact_sample_passes(sample):
    report = verify_sample(3, SCENE, sample)
    assert report.ok, [check for check in report.checks if not check.passed]
    figures = {check.name: check.figure for check in report.checks}
    assert len(figures) == 10
    assert None not in figures.values()  # every check applied
    motion = np.linalg.norm(sample.flow.forward, axis=2)
    assert np.nanmax(motion) > 3
    for direction in ("forward", "backward"):
        # float32 flow below 8 px rounds to 5e-7 px; the closure multiplies it by the strain.
        assert figures[f"{direction} flow"] < 1e-6
        assert figures[f"{direction} closure"] < 2e-6


def test_wrong_pixels_directions_masks_and_sizes_are_found(sample) -> None:
    for name, axis in (("forward", 0), ("backward", 1)):
        field = getattr(sample.flow, name).copy()
        field[70, 90, axis] += np.float32(0.05)
        assert _failed_motion(name, sample, flow=field) == {f"{name} flow", f"{name} closure"}
    flow = sample.flow
    exchanged = FlowField(flow.backward, flow.backward_visible, flow.forward, flow.forward_visible)
    turned = replace(flow, forward=flow.forward[..., ::-1].copy(), backward=flow.backward[..., ::-1].copy())
    wrong = {"forward flow", "forward closure", "backward flow", "backward closure", PHOTOMETRY}
    assert wrong <= _failed(exchanged, sample)
    assert wrong <= _failed(turned, sample)
    for components in (slice(None), 1):
        gone = sample.flow.forward.copy()
        gone[70, 90, components] = np.nan
        assert "forward pixels without gel" in _failed_motion("forward", sample, flow=gone)
    filled = sample.flow.backward.copy()
    nothing = np.argwhere(np.isnan(filled[..., 0]))
    assert 0 < len(nothing) < 0.5 * WIDTH * HEIGHT
    filled[tuple(nothing[0])] = 0
    assert _failed_motion("backward", sample, flow=filled) == {"backward pixels without gel"}
    assert _failed(replace(sample.flow, backward=None, backward_visible=None), sample) == {"backward flow"}
    small = FlowField(sample.flow.forward[1:], sample.flow.forward_visible[1:])
    assert "forward flow" in _failed(small, sample)


@pytest.mark.parametrize(("name", "value"), [("forward", 0), ("backward", 0.5)])
def test_wrong_visibility_is_found(sample, name, value):
    visible = getattr(sample.flow, f"{name}_visible").copy()
    visible[70, 90] = value  # a half is neither visible nor hidden
    assert _failed_motion(name, sample, visible=visible) == {f"{name} visibility"}


@pytest.mark.parametrize("seed", range(3))
def test_crumpled_surfaces_pass(seed):
    """Far beyond what a gel does: dozens of folds that pass through each other, seen from aslant."""
    rng = np.random.default_rng(seed)
    surface = sheet(30, 22, 20.0, 15.0, 2)

    def crumpled():
        waves = [rng.normal(size=(2, 3)) for _ in range(6)]
        phase = [np.sin(2 * surface.material[:, :2] @ k[0, :2] + 6 * k[0, 2])[:, None] * k[1] for k in waves]
        return surface.material + (0, 0, 2) + 0.2 * sum(phase)

    flow, checks = motion_checks(sensor(index=1.45, distortion=LENS, **OBLIQUE), surface, crumpled(), crumpled())
    assert 0.1 < flow.forward_visible.mean() < 0.9
    assert all(check.passed for check in checks.values()), checks


@pytest.mark.parametrize("pattern", [{"kind": "dots", "spacing_mm": (1, 1), "radius_mm": 0.2}, {"kind": "none"}])
def test_photometry_needs_a_pattern(pattern, sample):
    sensor, flow = scene(pattern).sensor, sample.flow
    check = check_photometry(sensor, sample.image1, sample.image2, flow.forward, flow.forward_visible)
    assert (check.figure is None) == (pattern["kind"] == "none")
    assert check.passed


def test_photometry_tells_the_right_flow_from_wrong_ones_or_that_it_does_not_apply(sample) -> None:
    forward, visible = sample.flow.forward, sample.flow.forward_visible
    pair = SCENE.sensor, sample.image1, sample.image2
    right = check_photometry(*pair, forward, visible)
    assert right.passed
    assert right.figure < 0.8 * right.tolerance
    for wrong in (0 * forward, -forward, forward[..., ::-1], forward + np.float32(0.4)):
        check = check_photometry(*pair, np.ascontiguousarray(wrong), visible)
        assert not check.passed, check
    small = scene(width=64, height=48, fx=70.0, fy=70.4, cx=31.7, cy=24.2)
    drawn = make_sample(small, pressed(0, (0, 0)), pressed(1.8, (1.6, -1.0), 0.6))
    y, x = np.mgrid[:48, :64]
    shade = 0.85 + 0.1 * np.sin(2 * np.pi * (x + y) / 12)
    image2 = np.rint(drawn.image2 * shade ** (1 / small.sensor.camera.gamma)).astype(np.uint8)
    check = check_photometry(small.sensor, drawn.image1, image2, drawn.flow.forward, drawn.flow.forward_visible)
    assert check.figure is None
    assert "textured blocks the motion bends too fast" in check.detail


def test_dataset_on_disk(tmp_path, sample, monkeypatch):
    path, seen = tmp_path / "data", []
    with DatasetWriter(path, Job(SCENE.model_dump(mode="json"), "double", "0", seed=0, n=2)) as writer:
        write(writer, as_sample(0, SCENE, sample), as_sample(1, SCENE, sample))
    report = verify_dataset(path, progress=lambda *numbers: seen.append(numbers))
    assert report.ok
    assert [s.index for s in report.samples] == [0, 1]
    assert seen == [(1, 2), (2, 2)]
    json.dumps(report.record())

    forward = sample.flow.forward.copy()
    forward[70, 90, 1] -= np.float32(0.05)
    write_flow(path / "samples" / "000000" / "flow.exr", replace(sample.flow, forward=forward), {})
    flow = path / "samples" / "000001" / "flow.exr"
    flow.write_bytes(flow.read_bytes()[:2000])
    damaged = verify_dataset(path)
    assert not damaged.ok
    failed = {check.name: check.detail for check in damaged.samples[0].checks if not check.passed}
    assert set(failed) == {"files", "forward flow", "forward closure"}
    assert "flow.exr: sha256" in failed["files"]
    assert "flow.exr: its header has seed = None, meta.json 0" in failed["files"]
    assert "row 70, column 90" in failed["forward flow"]
    assert not damaged.samples[1].ok
    monkeypatch.setattr("synth.verify.dataset._WORTHWHILE", 1)
    seen.clear()
    assert verify_dataset(path, lambda *numbers: seen.append(numbers), workers=2).record() == damaged.record()
    assert seen == [(1, 2), (2, 2)]
    assert "truncated" in damaged.samples[1].checks[0].detail
    refused("not a dataset", verify_dataset, tmp_path)


def _file_problems(folder, scene, **changes):
    """Of a flow.exr with header, channels or meta.json changed."""
    rng = np.random.default_rng(0)
    forward, visible = rng.random((3, 4, 2), np.float32), rng.random((3, 4), np.float32)
    forward[0, 0] = np.nan
    flow = FlowField(forward, visible, extras=changes.get("extras", {}))
    meta = {"scene_hash": "abc", "seed": 2**40, "index": 3}
    write_flow(folder / "flow.exr", flow, {"scene.hash": "abc", "seed": str(2**40), "index": 3})
    if "planes" in changes:
        planes, header = read_channels(folder / "flow.exr")
        OpenEXR.File(header, planes | changes["planes"]).write(str(folder / "flow.exr"))
    return flow_file_problems(folder, scene, meta | changes.get("meta", {}))


def test_channels_and_headers_of_the_flow_file_and_the_report(tmp_path) -> None:
    plain = SCENE.model_copy(update={"outputs": Outputs(backward=False)})
    rich = SCENE.model_copy(update={"outputs": Outputs(backward=False, depth=True, contact=True)})
    whole = {name: np.zeros((3, 4), np.float32) for name in ("depth1.Z", "depth2.Z", "contact.Y")}
    assert (_file_problems(tmp_path, plain), _file_problems(tmp_path, rich, extras=whole)) == ([], [])
    assert _file_problems(tmp_path, rich) == [f"flow.exr: lacks the channel {name}" for name in whole]
    half = {"depth2.Z": whole["depth2.Z"].astype(np.float16)}
    assert _file_problems(tmp_path, rich, extras=whole, planes=half) == ["flow.exr: depth2.Z is float16, not float32"]
    assert _file_problems(tmp_path, plain, planes={"G": whole["depth1.Z"]}) == ["flow.exr: G is not forward.V"]
    for key, header in (("seed", "seed"), ("index", "index"), ("scene_hash", "scene.hash")):
        assert _file_problems(tmp_path, plain, meta={key: 9})[0].startswith(f"flow.exr: its header has {header} = ")
    good = Check("a", 1.0, 2.0, "px")
    bad, unknown, skipped = replace(good, figure=3.0), replace(good, figure=float("nan")), replace(good, figure=None)
    assert [c.passed for c in (good, bad, unknown, skipped)] == [True, False, False, True]
    assert not Report("x", ()).ok
    bad = replace(bad, detail="p[/b]")
    report = Report(Path("q[/b][x]"), (SampleReport(0, (good, replace(skipped, name="b"))), SampleReport(4, (bad,))))
    assert not report.ok
    text = io.StringIO()
    Console(width=120, file=text).print(report.table())
    for shown in ("FAILED", "samples 4", "q[/b][x]: 2 samples", "p[/b]"):
        assert shown in text.getvalue()
    report = Report(Path("x"), (SampleReport(0, (replace(good, figure=float("inf")), unknown)),))
    checks = json.loads(json.dumps(report.record(), allow_nan=False))["samples"][0]["checks"]
    assert [check["figure"] for check in checks] == [None, None]
