"""Tables and bins of a comparison, and dots found in both images: where they are and how near a flow leads."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from numpy.typing import NDArray
from test_compare import Constant
from textures import REAL, grid, moved, table, write_folder, write_synthetic

from gelflow.arrays import ImageArray, PointArray
from gelflow.compare.dots import Dots, dot_distance, find_dots
from gelflow.compare.metrics import closure
from gelflow.compare.run import compare, latex
from gelflow.compare.scores import evaluate, summarise
from gelflow.compare.seeds import grouped
from gelflow.compare.strata import EDGE, MOTION, PATTERN, SCENE, merged, pair_strata, signed_distance
from gelflow.compare.tables import EXPLAINED, pair_table, strata_table, summary_table, tables
from gelflow.data import PairDataset
from gelflow.data.record import PatternedScene
from gelflow.files.image import read_image
from gelflow.methods.name import MethodName

PITCH = 24.0


def test_seeds_become_mean_and_standard_deviation(tmp_path: Path) -> None:
    named = {"best#0": "best", "best#12+ft": "best+ft", "best": "best",
              "C# code": "C# code", "a#007": "a", "a#1b": "a#1b", "x#2#3": "x#2"}  # fmt: skip
    assert {text: str(MethodName.parse(text).group) for text in named} == named
    assert [str(MethodName.parse(text)) for text in named] == list(named)
    dataset = PairDataset(write_synthetic(tmp_path, [(1.0, 0.0), (2.0, 0.0)]))
    methods = [Constant("net#0", 0, 0), Constant("other", 5, 0), Constant("net#1", 0.5, 0), Constant("net#2", 1, 0)]
    scores = [score for method in methods for score in evaluate(method, dataset)]
    groups = grouped(summarise(scores))
    assert [group.label for group in groups] == ["net (3 seeds)", "other"]
    header, rows = summary_table(groups)  # errors of the seeds: (1 + 2) / 2, (0.5 + 1.5) / 2, (0 + 1) / 2
    assert [row[header.index("EPE px")] for row in rows] == ["1.000 ± 0.500", "3.500"]
    assert groups[1].spread("endpoint_error_px") is None
    assert pair_table(scores, ["endpoint_error_px"], "{:.2f}") == (
        ["method", "000000", "000001"], [["net (3 seeds)", "0.50", "1.50"], ["other", "4.00", "3.00"]])  # fmt: skip


def test_bins_of_seeds_are_pooled_and_fine_tuned_methods_and_other_devices_come_apart(tmp_path: Path) -> None:
    dataset = PairDataset(write_synthetic(tmp_path, [(1.0, 0.0)]))
    result = compare([Constant("net#0", 0, 0), Constant("net#1", 0.5, 0)], dataset)
    assert strata_table(result.strata) == (["where", "pixels", "net"], [["motion: 1 to 2 px", "4096", "0.750"]])
    dataset = PairDataset(write_folder(tmp_path / "plain", {"a": (1, 0)}))
    result = compare([Constant("net#0+ft", 1, 0), Constant("net", 0, 0)], dataset)
    named = [[row[0] for row in rows] for _, (_, rows) in tables(result)]
    assert named == [["net"], ["net+ft"], ["net", "net+ft"], ["net", "net+ft"]]  # PSNR and closure of each pair
    here = replace(result.scores[1], seconds=2.0, processor_seconds=0.5)
    elsewhere = replace(here, method=MethodName("net, GPU"), device="NVIDIA H200", on_gpu=True)
    means = summarise([here, elsewhere])
    header, rows = summary_table(grouped(means))
    assert (header[-1], rows[1][-1]) == ("on", "NVIDIA H200")
    # A GPU is charged time as it passes, a processor that of a core.
    assert [one.cost_seconds for one in means] == [0.5, 2.0]


def test_columns_that_need_words_have_them(tmp_path: Path) -> None:
    result = compare([Constant("net", 1, 0)], PairDataset(write_synthetic(tmp_path, [(1.0, 0.0)])))
    known = {"dot_distance_px": 0.1, "dot_p90_px": 0.3, "own_dots": 0.9, "closure_px": 0.1, "closure_p90_px": 0.2}
    known |= {"unknown": 0.1, "certain": 0.8, "calibration": 0.7}
    title, (header, _) = tables(replace(result, scores=(replace(result.scores[0], **known),)))[0]
    explained = {line.partition(":")[0].split(", ")[0]: line for line in title.splitlines()[1:]}
    assert list(explained) == list(EXPLAINED)
    assert set(explained) < set(header)
    assert "within a quarter of the pitch" in explained["own dot %"]
    assert "own dot %" not in tables(result)[0][0]


def test_latex_escapes_distance_is_signed_and_pairs_add_up_pixel_by_pixel() -> None:
    text = latex("Errors of 50 % & more", (["method", "> 1 px %"], [["a_b^2{ (3 seeds)", "1.0 ± 0.5"]]))
    assert r"\caption{Errors of 50 \% \& more}" in text
    assert r"method & $>$ 1 px \% \\" in text
    assert r"a\_b\textasciicircum{}2\{ (3 seeds) & 1.0 $\pm$ 0.5 \\" in text
    assert text.count(r"\begin") == text.count(r"\end") == 2
    region = np.zeros((5, 12), bool)
    region[:, :4] = True
    np.testing.assert_array_equal(signed_distance(region)[2], [-3.5, -2.5, -1.5, -0.5, *np.arange(0.5, 8)])
    one = pair_strata(np.full((2, 3), 0.5), np.full((2, 3, 2), 0.1, np.float32), np.ones((2, 3), bool))
    two = pair_strata(np.full((4, 3), 2.0), np.full((4, 3, 2), 9.0, np.float32), np.ones((4, 3), bool))
    both = merged([*two, *one, *one])
    found = [(s.bin, s.pixels, s.error_px, s.above_1px) for s in both]
    assert found == [("0 to 0.5 px", 12, 6.0, 0), ("8 to 16 px", 12, 24.0, 12)]


def test_bins_hold_every_compared_pixel_once() -> None:
    generator = np.random.default_rng(0)
    truth = generator.normal(0, 6, (20, 30, 2)).astype(np.float32)
    error, compared = generator.exponential(0.4, (20, 30)), generator.random((20, 30)) < 0.8
    contact = np.zeros((20, 30), bool)
    contact[5:15, 8:20] = True
    strata = pair_strata(error, truth, compared, contact, PatternedScene("gelsight", "speckle"))
    counted = error[compared]
    for kind in (MOTION, EDGE, PATTERN, SCENE):
        mine = [(s.pixels, s.error_px, s.above_1px, s.above_01px) for s in strata if s.kind == kind]
        expected = (counted.size, counted.sum(), (counted > 1).sum(), (counted > 0.1).sum())
        np.testing.assert_allclose(np.sum(mine, axis=0), expected, rtol=1e-12)
    length = np.hypot(*np.moveaxis(truth, -1, 0))
    (bin_,) = (s for s in strata if s.bin == "2 to 4 px")
    assert bin_.error_px == pytest.approx(error[compared & (length >= 2) & (length < 4)].sum(), rel=1e-12)
    for edgeless in (None, np.zeros((20, 30), bool), np.ones((20, 30), bool)):
        assert {s.kind for s in pair_strata(error, truth, compared, edgeless)} == {MOTION}


DRAWN_KIND = {"kind": {"choice": ["dots", "speckle"]}}
DRAWN_PATTERN = {"choice": [{"kind": "dots", "radius_mm": 0.2}, {"kind": "speckle"}]}


def with_contact(folder: Path, pattern: dict) -> Path:
    """A data set as synth writes it, with a contact in the left half and with patterns that differ by sample."""
    write_synthetic(folder, [(3.0, 0.0), (0.0, 0.25)])
    scene = {"name": "toy", "sensor": {"pattern": pattern}}
    (folder / "dataset.json").write_text(json.dumps({"schema_version": 1, "scene": scene}))
    for index, kind in enumerate(["dots", "speckle"]):
        sample = folder / "samples" / f"{index:06d}"
        meta = {"scene": {"name": "toy", "sensor": {"pattern": {"kind": kind}}}}
        (sample / "meta.json").write_text(json.dumps(meta))
        with OpenEXR.File(str(sample / "flow.exr"), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
        channels["contact.Y"] = np.zeros_like(channels["forward.U"])
        channels["contact.Y"][:, :40] = 1.0
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, channels).write(str(sample / "flow.exr"))
    return folder


@pytest.mark.parametrize("pattern", [DRAWN_KIND, DRAWN_PATTERN], ids=["kind", "pattern"])
def test_a_data_set_with_contact_and_patterns_is_sorted(pattern: dict, tmp_path: Path) -> None:
    dataset = PairDataset(with_contact(tmp_path / "data", pattern))
    result = compare([Constant("zero", 0, 0), Constant("right", 3, 0)], dataset, tmp_path / "out")
    header, rows = strata_table(result.strata)
    assert header == ["where", "pixels", "zero", "right"]
    cells = {row[0]: row[1:] for row in rows}
    # 64 rows; columns 8 to 71 are known and visible
    assert cells["motion: 2 to 4 px"] == ["4096", "3.000", "0.000"]
    assert cells["motion: 0 to 0.5 px"] == ["4096", "0.250", f"{np.hypot(3, 0.25):.3f}"]
    assert cells["scene and pattern: toy, dots"][1] == cells["pattern: dots"][1] == "3.000"
    assert cells["scene and pattern: toy, speckle"][1] == "0.250"
    # columns 36 to 39 are within 4 px of the edge at 40, on its inner side, in both samples
    assert cells["distance to contact edge: -4 to 0 px"] == [str(2 * 64 * 4), "1.625", f"{np.hypot(3, 0.25) / 2:.3f}"]
    still, moved = (row for row in table(tmp_path / "out" / "strata.csv") if row["bin"] in ("0 to 0.5 px", "2 to 4 px")
                    and row["method"] == "zero")  # fmt: skip
    assert float(moved["outliers_1px"]) == 1.0
    assert (float(still["outliers_1px"]), float(still["outliers_01px"])) == (0.0, 1.0)


def test_bare_gels_are_left_out_of_a_second_table_of_means(tmp_path: Path) -> None:
    """Nothing can be followed on a gel without a pattern, whose errors would hide all others."""
    dataset = PairDataset(with_contact(tmp_path, DRAWN_KIND))  # a pair moves by 3 px, the other by 0.25 px
    first = dataset.records[0]
    bare = PairDataset(dataset.source, [replace(first, scene=PatternedScene("toy", "none")), *dataset.records[1:]])
    result = compare([Constant("zero", 0, 0)], bare)
    found = {title: rows for title, (_, rows) in tables(result) if title.startswith("Means")}
    assert [rows[0][3] for rows in found.values()] == ["1.625", "0.250"]
    assert "the 1 pairs of gels with a pattern" in list(found)[1]
    cells = {row[0]: row[2] for row in strata_table(result.strata)[1]}
    assert cells["motion, bare gel: 2 to 4 px"] == "3.000"
    assert cells["distance to contact edge, bare gel: -4 to 0 px"] == "3.000"
    assert cells["distance to contact edge: -4 to 0 px"] == cells["motion: 0 to 0.5 px"] == "0.250"
    assert "motion: 2 to 4 px" not in cells
    compare([Constant("zero", 0, 0)], PairDataset(dataset.source, bare.records[:1]), tmp_path / "out")  # bare alone
    assert len([title for title, _ in tables(compare([Constant("zero", 0, 0)], dataset)) if "Means" in title]) == 1


def lattice(shift: tuple[float, float] = (0.0, 0.0)) -> PointArray:
    """8 x 6 places, slightly off a grid, that all remain in an image of 240 x 200 px when moved by some px."""
    columns, rows = np.meshgrid(30 + PITCH * np.arange(8), 35 + PITCH * np.arange(6))
    points = np.stack([columns.ravel(), rows.ravel()], axis=1)
    return points + np.random.default_rng(0).uniform(-0.5, 0.5, points.shape) + shift


def image(dots: PointArray, contrast: float) -> ImageArray:
    """Discs of 5 px with a soft edge on a slope of brightness; darker than the coating or, below 0, brighter."""
    x, y = grid(200, 240)
    value = 0.5 + 0.1 * x / 240 + np.zeros_like(y)
    for column, row in dots:
        value -= contrast / (1 + np.exp(2 * (np.hypot(x - 0.5 - column, y - 0.5 - row) - 5)))
    return np.repeat(value[..., None], 3, axis=2).astype(np.float32)


def constant(u: float, v: float) -> NDArray[np.float32]:
    return np.full((200, 240, 2), (u, v), np.float32)


@pytest.mark.parametrize("contrast", [0.4, 0.15, -0.3])
def test_centres_of_dots_are_found_and_the_true_flow_leads_to_them(contrast: float) -> None:
    true, shift = lattice(), (3.3, -2.6)
    dots1, dots2 = find_dots(image(true, contrast)), find_dots(image(lattice(shift), contrast))
    assert len(dots1.centres) == len(dots2.centres) == len(true)
    distance = np.linalg.norm(dots1.centres[:, None] - true, axis=2).min(axis=1)
    # Images of 8 bit: a centroid over 100 px of contrast 38 of 255 errs by about 0.3 * 5 / (38 * sqrt(100)) = 0.004 px.
    assert distance.max() < 0.02
    found = dot_distance(constant(*shift), dots1, dots2)
    assert (found.own, found.median_px, found.p90_px) == (1.0, pytest.approx(0, abs=0.02), pytest.approx(0, abs=0.03))
    still = dot_distance(constant(0, 0), dots1, dots2)
    assert still.median_px == pytest.approx(np.hypot(*shift), abs=0.01)


def test_share_of_dots_that_reach_one_of_their_own() -> None:
    """Of a flow of zero: two dots share one of image 2, one is too far from any, one leaves the image."""
    flow = constant(0, 0)
    dots2 = Dots(np.array([[20.0, 20.0], [44.0, 20.0], [68.0, 20.0], [92.0, 20.0]]), 10.0)
    dots1 = Dots(np.array([[21.0, 20.0], [18.0, 20.0], [44.0, 20.5], [75.0, 20.0], [220.0, 100.0]]), 10.0)
    flow[100, 220] = [11.0, 0.0]
    found = dot_distance(flow, dots1, dots2)
    assert (found.median_px, found.own) == (1.5, 2 / 5)
    assert dot_distance(constant(300, 0), dots1, dots2) is None


def test_textures_bare_gels_and_few_dots_are_no_pattern_of_dots() -> None:
    generator = np.random.default_rng(0)
    x, y = grid(200, 240)
    speckle = image(generator.uniform(5, 195, (300, 2)), 0.1)
    shade = np.repeat((0.5 + 0.3 * np.exp(-((x - 100) ** 2 + (y - 90) ** 2) / 800))[..., None], 3, axis=2)
    for other in (speckle, moved(200, 240, 0, 0), shade.astype(np.float32), image(lattice()[:11], 0.4)):
        assert find_dots(other) is None
    assert find_dots(image(lattice()[:12], 0.4)) is not None


@pytest.mark.parametrize(
    ("name", "dots"), [("tac3d", True), ("dmtac", False), ("gelsight_bare", False), ("9dtact", False), ("digit", False)]
)
def test_real_sensors_with_dots_and_without(name: str, dots: bool) -> None:
    folder = REAL.parent / "other_sensors" / name
    if not folder.is_dir():
        pytest.skip(f"photographs of {name} are not beside this repository")
    files: list[Path] = sorted(folder.glob("*.png"))
    assert [find_dots(read_image(file)) is not None for file in files] == [dots] * len(files)


def test_closure_of_a_rotation_and_its_inverse_and_of_a_jump_by_a_pitch() -> None:
    x, y = (place - 0.5 for place in grid(60, 80))
    centred = np.stack([x - 39.5, y - 29.5], axis=-1)
    turn = np.array([[np.cos(0.1), -np.sin(0.1)], [np.sin(0.1), np.cos(0.1)]])
    there, back = (centred @ (m - np.eye(2)).T for m in (turn, turn.T))
    gap = closure(there.astype(np.float32), back.astype(np.float32))
    assert np.nanmax(gap) < 1e-5  # A linear field is interpolated exactly, in float32; corners leave the image
    assert 0 < np.isnan(gap).sum() < 0.2 * gap.size
    back[..., 0] += PITCH
    gap = closure(there.astype(np.float32), back.astype(np.float32))
    np.testing.assert_allclose(np.nanmedian(gap), PITCH, rtol=1e-5)
