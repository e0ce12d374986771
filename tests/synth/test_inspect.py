"""Inspection of flows that are known, its pictures and pages."""

import dataclasses
import io
import json
import re
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from commands import refused
from rich.console import Console
from samples import HEIGHT, WIDTH, job, translation_sample, write_dataset

from synth.commands import inspect as inspect_command
from synth.dataset.exr import write_flow
from synth.dataset.manifest import Failure
from synth.dataset.writer import DatasetWriter
from synth.inspect import inspect, tables, write_html, write_sheet
from synth.inspect.inspection import evenly_spaced
from synth.inspect.panels import NO_GEL, arrows_of, flow_colours, robust_scale, wheel_legend
from synth.inspect.text import COLUMNS, facts
from synth.inspect.view import View, sample_at


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    directory = write_dataset(tmp_path_factory.mktemp("inspect") / "d", map(translation_sample, range(3)))
    with DatasetWriter(directory, job(3)) as writer:
        writer.fail(Failure(1, 0, "simulate", "Newton failed"))
    return directory


def test_translation_exchanged_directions_and_missing_visibility_in_numbers(dataset, tmp_path) -> None:
    """Every number has a closed form: |(1.25, -0.5)| everywhere, closure 0, the gel's last two columns missing."""
    found = inspect(dataset / "samples" / "000000").as_dict()["samples"][0]
    length = np.hypot(1.25, 0.5)
    for direction in ("forward", "backward"):
        assert found[direction]["min_px"] == found[direction]["max_px"] == found[direction]["median_px"] == length
        assert found[direction]["nan_share"] == pytest.approx(2 / WIDTH)
    # x + 0.5 + 1.25 < 32 keeps columns 0 ... 29 whole; y + 0.5 - 0.5 > 0 loses row 0: 23 of 24 rows.
    assert found["forward"]["visible_share"] == pytest.approx(23 / 24)
    assert found["closure"]["max_px"] == 0
    # Between 4 x 4 pixels with gel: column c + 1.25 takes c ... c + 3 of 30, row r - 0.5 takes r - 2 ... r + 1 of 24.
    assert found["closure"]["pixels"] == 27 * 21
    assert (found["width"], found["height"], found["bits"]) == (WIDTH, HEIGHT, 8)
    assert (found["force_n"][1], found["solver"][1]["depth_mm"]) == ([0.1, 0.0, 1.5], 0.2)
    # Rounding of both images to 1/255 has an RMS of 0.29/255 each; interpolation adds less than that again.
    assert found["difference"]["after_rmse"] < 2 * 0.29 / 255
    assert found["difference"]["before_rmse"] > 0.05
    # Forward + backward(...) of a field that is not its own inverse is twice the flow.
    flow = translation_sample().flow
    wrong = dataclasses.replace(flow, backward=flow.forward)
    write_flow(tmp_path / "wrong.exr", wrong, {})
    found = inspect(tmp_path / "wrong.exr").numbers[0]
    assert found["closure"]["median_px"] == pytest.approx(2 * np.hypot(1.25, 0.5))
    assert found["difference"] is found["force_n"] is None
    # An estimate does not know visibility; that is said, not made up. What gelflow says of its error is shown.
    planes = {f"forward.{name}": np.ascontiguousarray(flow.forward[..., k]) for k, name in enumerate("UV")}
    planes["forward.sigma"] = np.full((HEIGHT, WIDTH), 0.25, np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(str(tmp_path / "e.exr"))
    inspection = inspect(tmp_path / "e.exr")
    (found,) = inspection.numbers
    assert found["forward"]["visible_share"] is found["backward"] is None
    assert found["sigma"]["median_px"] == 0.25
    write_html(inspection, tmp_path / "e.html")
    for words in ("visible in image 2: not given", "sigma, log 0.01 to 10 px: median 0.25"):
        assert words in (tmp_path / "e.html").read_text()


def test_page_is_self_contained_and_tables_and_json_tell_the_numbers(dataset, tmp_path) -> None:
    inspection = inspect(dataset)
    write_html(inspection, tmp_path / "d.html")
    page = (tmp_path / "d.html").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:image/png;base64,|#)', page)
    assert "<script" not in page
    counts = {f'<h2 id="s00000{index}">': 1 for index in range(3)} | {"<figure>": 3 * 9, "<svg ": 3}
    assert {text: page.count(text) for text in counts} == counts
    record = json.loads(json.dumps(inspection.as_dict(), allow_nan=False))
    assert (record["kind"], record["finished"], record["failed_draws"], record["seed"]) == ("dataset", 3, 1, 7)
    text = _printed(inspection, 200)
    for said in ("000002", "1.35", "simulate 3.3 s"):  # |(1.25, -0.5)| = 1.346 px
        assert said in text


@pytest.mark.parametrize("part", ["", "samples/000001", "samples/000001/flow.exr"])
def test_sheet_is_a_picture(dataset, tmp_path, part):
    write_sheet(inspect(dataset / part), tmp_path / "s.png")
    sheet = cv2.imread(str(tmp_path / "s.png"))
    assert min(sheet.shape[:2]) > 300
    assert len(np.unique(sheet.reshape(-1, 3), axis=0)) > 100


def _printed(inspection, width):
    console = Console(width=width, file=io.StringIO())
    for table in tables(inspection, width):
        console.print(table)
    return console.file.getvalue()


@pytest.mark.parametrize("width", [40, 80, 400])
def test_no_figure_is_cut_on_a_narrow_terminal_and_brackets_are_no_markup(dataset, width):
    inspection = inspect(dataset)
    shown = _printed(inspection, width)
    assert "…" not in shown
    assert shown.count("000001 │") == len(tables(inspection, width)) - 1 == {40: 5, 80: 2, 400: 1}[width]
    for figure in ("1.35", "95.83 %", "32x24", "0.2"):
        assert f" {figure} " in shown
    for name in ("q[/b]", "[x]", "a:b:c"):  # no markup
        assert name in _printed(dataclasses.replace(inspection, path=Path(name)), 80)


@pytest.mark.parametrize("terminal", [False, True])
def test_tables_keep_their_width_where_stdout_is_no_terminal(dataset, capsys, monkeypatch, terminal):
    monkeypatch.setenv("COLUMNS", "80")
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
    assert inspect_command(dataset) == 0
    assert capsys.readouterr().out.count("000001") == (2 if terminal else 1)


@pytest.mark.parametrize(("name", "value", "most"), [("nowhere", np.nan, None), ("still", 0.0, 0.0)])
def test_gel_out_of_sight_or_at_rest(tmp_path, name, value, most):
    """No pixel sees the gel, or nothing moves: numbers say so and pictures are drawn."""
    flow = translation_sample().flow
    constant, visible = np.full_like(flow.forward, value), np.full_like(flow.forward_visible, most is not None)
    write_flow(tmp_path / f"{name}.exr", dataclasses.replace(flow, forward=constant, forward_visible=visible), {})
    inspection = inspect(tmp_path / f"{name}.exr")
    write_sheet(inspection, tmp_path / "s.png")
    write_html(inspection, tmp_path / "s.html")
    assert inspection.numbers[0]["forward"]["max_px"] == most


def test_what_cannot_be_inspected(tmp_path):
    image = write_dataset(tmp_path / "d", [translation_sample()]) / "samples/000000/image2.png"
    cv2.imwrite(str(image), cv2.imread(str(image))[:-1])
    refused(r"image1\.png is .*, image2\.png .*, flow\.exr .*; they must agree", inspect, tmp_path / "d")
    refused("no such file", inspect, tmp_path / "none")
    refused(r"holds neither dataset\.json nor flow\.exr", inspect, tmp_path)
    (tmp_path / "a.txt").write_text("x")
    refused(r"a\.txt: cannot be inspected", inspect, tmp_path / "a.txt")
    (tmp_path / "flow.exr").write_bytes(b"x")
    refused(r"meta\.json.*cannot be read", inspect, tmp_path)


def test_interpolation_is_exact_to_second_degree_and_stops_at_gaps() -> None:
    def quadratic(x, y):
        return 1 + 2 * x - y + 0.3 * x * x - 0.2 * x * y + 0.1 * y * y

    rows, columns = np.mgrid[:12, :15] + 0.5
    x, y = np.random.default_rng(1).uniform(2.5, (12, 9), (200, 2)).T
    found = sample_at(quadratic(columns, rows)[..., None], x, y)[:, 0]
    # Rounding only: values up to 50, a few eps each of 16 terms.
    np.testing.assert_allclose(found, quadratic(x, y), atol=1e-12)
    values = np.arange(36.0).reshape(6, 6, 1)
    values[5, 5] = np.nan
    x = np.array([0.5, 0.4, 1.0, 2.0, 5.5, 4.5, np.nan])
    y = np.array([0.5, 0.5, 0.5, 0.5, 5.5, 4.5, 1.0])
    found = sample_at(values, x, y)[:, 0]
    # A pixel centre needs its pixel alone; column 1.0 would need one at -1; (2.0, 0.5) interpolates 0 1 2 3 along x.
    np.testing.assert_allclose(found, [0, np.nan, np.nan, 1.5, np.nan, 28, np.nan], equal_nan=True)


def test_colour_wheel_and_pages_of_limited_and_empty_datasets(dataset, tmp_path) -> None:
    """Baker et al. 2011: right is red, down is yellow-ish, zero is white, beyond the rim is darker, NaN is grey."""
    flow = np.array([[[1, 0], [0, 0], [2, 0], [np.nan, 0], [0, 1], [-1, 0]]], np.float32)
    # A quarter turn is 13.75 of 55 steps of the wheel, of which yellow is at 15: green 13.75 / 15.
    # Half a turn is 27.5, between cyan (25) and blue (36).
    down, left = [255, round(255 * 13.75 / 15), 0], [0, round(255 * (1 - 2.5 / 11)), 255]
    expected = [[255, 0, 0], [255, 255, 255], [191, 0, 0], list(NO_GEL), down, left]
    assert flow_colours(flow, 1.0)[0].tolist() == expected
    legend = wheel_legend(64)
    assert (legend[0, 0, 3], legend[32, 63, 0]) == (0, 255)
    inspection = inspect(dataset, limit=2)
    assert [numbers["name"] for numbers in inspection.numbers] == ["000000", "000002"]
    assert (inspection.about["finished"], inspection.about["inspected"]) == (3, 2)
    assert (evenly_spaced(0, 5), evenly_spaced(100, 3)) == ([], [0, 50, 99])
    inspection = inspect(write_dataset(tmp_path / "d", []))
    assert inspection.as_dict()["samples"] == []
    write_sheet(inspection, tmp_path / "d.png")
    write_html(inspection, tmp_path / "d.html")
    assert len(tables(inspection)) == 2


@pytest.mark.parametrize("size", [1e-4, 0.013, 1.0, 37.0])
def test_scale_follows_small_flows_and_ignores_outliers(size):
    flow = np.zeros((100, 100, 2), np.float32)
    flow[:50, :, 0] = size
    flow[0, 0] = 1e4
    assert size <= robust_scale(flow) * (1 + 1e-6) <= 1.1 * size * (1 + 1e-6)
    assert robust_scale(np.full((4, 4, 2), np.nan, np.float32)) == 1e-6


@pytest.mark.parametrize("size", [1e-3, 0.2, 30.0])
def test_arrows_can_be_seen_at_any_flow(size):
    arrows = arrows_of(View("v", translation_sample(shift=(size, 0.0)).flow))
    drawn = np.linalg.norm(arrows.tip - arrows.start, axis=1)
    # Spacing 2 px: at most 1.6 of it; steps 1 2 3 5 7 10 at least half of that, less 5 % for the scale's rounding.
    assert (drawn <= 1.6 * 2 + 1e-9).all()
    assert (drawn >= 0.45 * 1.6 * 2).all()


def test_forces_on_round_gels_are_told_along_the_inward_normal_of_the_press(tmp_path) -> None:
    """A press at the equator pushes along -x: its force has no z, and would be called all shear."""
    sample = translation_sample()
    pressed = dataclasses.replace(
        sample,
        force_n=np.array([[0.0, 0.0, 0.0], [-1.5, 0.3, 0.4]]),
        diagnostics={**sample.diagnostics, "inward_normal": [-1.0, 0.0, 0.0]},
    )
    directory = write_dataset(tmp_path / "d", [pressed])
    found = inspect(directory)
    assert found.numbers[0]["normal_force_n"] == [0.0, 1.5]
    assert found.numbers[0]["side_force_n"] == [0.0, 0.5]
    cells = {name: text(found.numbers[0]) for name, text in COLUMNS}
    assert cells["Fn\nN"] == "1.5"
    rows = dict(facts(found.numbers[0]))
    assert (rows["normal force in frames 1, 2"], rows["side force in frames 1, 2"]) == ("0; 1.5 N", "0; 0.5 N")
