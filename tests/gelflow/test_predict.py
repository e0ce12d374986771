"""`predict` and the pictures of flow."""

import colorsys
import csv
from pathlib import Path

import cv2
import numpy as np
import pytest
from textures import as_bytes, moved, save, write_folder, write_video

from gelflow.baselines import named_methods
from gelflow.errors import InputError
from gelflow.files.exr import read_flow
from gelflow.predict.pictures import UNKNOWN_COLOUR, arrow_factor, draw_overlay, flow_to_colour, robust_scale
from gelflow.predict.prediction import predict_pair, predict_video

FARNEBACK = named_methods(["farneback"])[0]


def test_pair_gives_one_flow_in_three_files(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "in", {"press": (1.5, -0.5)})
    result = predict_pair(FARNEBACK, folder / "press_1.png", folder / "press_2.png", tmp_path / "out")
    assert [path.name for path in result.files] == ["press.exr", "press.flo", "press.png"]
    flow = read_flow(result.files[0]).flow
    np.testing.assert_array_equal(flow, cv2.readOpticalFlow(str(result.files[1])))
    # The limit of test_baselines for Farnebäck, 1/16 px, plus the rounding of images to 8 bit.
    assert np.abs(np.median(flow, axis=(0, 1)) - (1.5, -0.5)).max() < 0.1
    picture = cv2.imread(str(result.files[2]))
    assert picture.std() > 20


def test_names_without_a_number_are_joined(tmp_path: Path) -> None:
    for name in ("before", "after"):
        save(tmp_path / f"{name}.png", moved(32, 32, 0, 0))
    result = predict_pair(FARNEBACK, tmp_path / "before.png", tmp_path / "after.png", tmp_path)
    assert result.files[0].name == "before_to_after.exr"


@pytest.mark.parametrize(("reference", "expected"), [("first", [2.0, 4.0, 6.0]), ("previous", [2.0, 2.0, 2.0])])
def test_video_against_its_first_or_previous_frame(tmp_path: Path, reference: str, expected: list[float]) -> None:
    write_video(tmp_path / "a.avi", [as_bytes(moved(64, 96, shift, 0)) for shift in (0, 1, 2, 3, 4, 5, 6)])
    result = predict_video(FARNEBACK, tmp_path / "a.avi", tmp_path / "out", reference, every=2)  # type: ignore[arg-type]
    assert [motion.frame for motion in result.motions] == [2, 4, 6]
    for motion, true in zip(result.motions, expected, strict=True):
        flow = read_flow(tmp_path / "out" / "flow" / f"{motion.frame:06d}.exr").flow
        # 1/16 px as above; Motion JPEG adds noise of a few grey levels: twice that.
        assert np.median(flow[..., 0]) == pytest.approx(true, abs=1 / 8)
    with (tmp_path / "out" / "motion.csv").open(newline="") as file:
        assert [int(row["frame"]) for row in csv.DictReader(file)] == [2, 4, 6]
    capture = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 3
    assert not list((tmp_path / "out").glob(".*"))


def test_folder_of_frames_is_a_video(tmp_path: Path) -> None:
    for number in range(3):
        save(tmp_path / "in" / f"{number}.png", moved(48, 48, number, 0))
    assert len(predict_video(FARNEBACK, tmp_path / "in", tmp_path / "out").motions) == 2


def test_flow_files_of_an_earlier_run_go_and_others_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2.VideoWriter, "isOpened", lambda _: False)  # pictures in place of a video
    for number in range(5):
        save(tmp_path / "in" / f"{number}.png", moved(48, 48, number, 0))
    out = tmp_path / "out"
    assert len(predict_video(FARNEBACK, tmp_path / "in", out).motions) == 4
    others = [out / "flow" / "12.exr", out / "flow" / "000001.txt", out / "overlay" / "notes.png"]
    for other in others:
        other.touch()
    second = predict_video(FARNEBACK, tmp_path / "in", out, every=3)
    assert {path for path in out.rglob("*") if path.is_file()} == {*second.files, *others}


def test_rows_name_the_frames_files(tmp_path: Path) -> None:
    for name in ("b10", "b9", "a"):
        save(tmp_path / "in" / f"{name}.png", moved(48, 48, len(name), 0))
    predict_video(FARNEBACK, tmp_path / "in", tmp_path / "out")
    with (tmp_path / "out" / "motion.csv").open(newline="") as file:
        assert [row["file"] for row in csv.DictReader(file)] == ["b9.png", "b10.png"]


@pytest.mark.parametrize("name", ["a.exr", "a.flo", "a.png"])
def test_a_pairs_results_replace_those_of_an_earlier_run_and_nothing_else(tmp_path: Path, name: str) -> None:
    folder = write_folder(tmp_path / "in", {"a": (1.5, -0.5)})
    images = (folder / "a_1.png", folder / "a_2.png")
    (folder / name).write_text("another's")
    with pytest.raises(InputError, match=rf"{name}: exists and does not come from"):
        predict_pair(FARNEBACK, *images, folder)
    assert (folder / name).read_text() == "another's"
    for _ in range(2):
        predict_pair(FARNEBACK, *images, tmp_path / "out")


@pytest.mark.parametrize("name", ["flow/000007.exr", "motion.csv", "overlay.mp4", "overlay/000000.png"])
def test_a_videos_results_do_not_replace_anothers_files(tmp_path: Path, name: str) -> None:
    write_video(tmp_path / "a.avi", [as_bytes(moved(48, 64, shift, 0)) for shift in range(2)])
    other = tmp_path / name
    other.parent.mkdir(exist_ok=True)
    other.write_text("another's")
    with pytest.raises(InputError, match=rf"{name}: exists and does not come from"):
        predict_video(FARNEBACK, tmp_path / "a.avi", tmp_path)
    assert other.read_text() == "another's"


def test_progress_reaches_its_total(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", [as_bytes(moved(48, 64, shift, 0)) for shift in range(5)])
    calls: list[tuple[int, int]] = []
    predict_video(FARNEBACK, tmp_path / "a.avi", tmp_path / "out", progress=lambda n, total: calls.append((n, total)))
    assert calls == [(n, 8) for n in range(1, 9)]


def test_inputs_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    write_video(tmp_path / "one.avi", [as_bytes(moved(48, 64, 0, 0))])
    save(tmp_path / "in" / "0.png", moved(48, 48, 0, 0))
    (tmp_path / "in" / "1.png").write_bytes(b"broken")
    for name, word in (("one.avi", "fewer than two"), ("none.avi", "none.avi"), ("in", r"1\.png: cannot be read")):
        with pytest.raises(InputError, match=word):
            predict_video(FARNEBACK, tmp_path / name, tmp_path / "out")
    with pytest.raises(InputError, match="every"):
        predict_video(FARNEBACK, tmp_path / "one.avi", tmp_path / "out", every=0)


def test_colour_depends_on_direction_and_grows_with_length() -> None:
    angles = np.arange(0, 2 * np.pi, 0.1)
    flow = np.stack([np.cos(angles), np.sin(angles)], axis=-1)[None].astype(np.float32)
    full, half = flow_to_colour(flow, 1.0)[0], flow_to_colour(0.5 * flow, 1.0)[0]
    assert len({tuple(colour) for colour in full}) == len(angles)
    saturation = np.array([[colorsys.rgb_to_hsv(*(colour / 255))[1] for colour in row] for row in (full, half)])
    # Full colour at the scale, half of it at half the scale; 8 bits and float32 round by 1/255 each.
    np.testing.assert_allclose(saturation[0], 1.0, atol=2 / 255)
    np.testing.assert_allclose(saturation[1], 0.5, atol=2 / 255)
    assert tuple(flow_to_colour(np.zeros((1, 1, 2), np.float32), 1.0)[0, 0]) == (255, 255, 255)
    assert tuple(flow_to_colour(np.full((1, 1, 2), np.nan, np.float32), 1.0)[0, 0]) == UNKNOWN_COLOUR


@pytest.mark.parametrize("length", [0.013, 0.7, 42.0])
def test_scale_makes_small_and_large_flow_look_alike(length: float) -> None:
    flow = np.random.default_rng(0).uniform(-1, 1, (40, 50, 2)).astype(np.float32)
    flow *= length / np.hypot(flow[..., 0], flow[..., 1]).max()
    scale = robust_scale(flow)
    assert 0.7 * length < scale < 1.1 * length  # the 99th percentile, rounded up by a tenth at most
    assert scale * arrow_factor(scale) >= 3
    assert flow_to_colour(flow, scale).std() > 40


def test_scale_of_no_flow_is_one() -> None:
    assert robust_scale(np.zeros((4, 4, 2), np.float32)) == 1.0
    assert robust_scale(np.full((4, 4, 2), np.nan, np.float32)) == 1.0


def test_overlay_has_even_sides_and_arrows_of_the_true_length() -> None:
    frame = np.zeros((241, 321, 3), np.uint8)
    flow = np.zeros((241, 321, 2), np.float32)
    flow[..., 0] = 12.0
    picture = draw_overlay(frame, flow, 12.0)
    assert picture.shape[0] % 2 == 0
    assert picture.shape[1] % 2 == 0
    assert picture.shape[0] >= 480
    left = picture[:, : picture.shape[1] // 2].max(axis=2) > 128
    rows = np.flatnonzero(left.sum(axis=1) > left.shape[1] * 0.5)
    assert len(rows)  # arrows of 12 px at a distance of 13 px fill most of their rows
