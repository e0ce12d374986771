"""Videos and images as they are: irregular times, other names, 16 bits, and values that fill a part of their range."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import refused
from numpy.typing import NDArray
from textures import as_bytes, moved, save, table

from gelflow.baselines import named_methods
from gelflow.data.choose import ChoiceConfig
from gelflow.data.extract import extract_pairs
from gelflow.files.image import full_range, read_image, read_pair
from gelflow.files.video import describe, frames, newest_frames
from gelflow.predict.prediction import predict_video

FARNEBACK = named_methods(["farneback"])[0]
TICKS = (0, 1, 2, 9, 10, 14, 15)
"""Frames' times in 25ths of a second."""


def irregular(path: Path) -> Path:
    """A video of JPEG images with time stamps, in whose header no number of frames stands."""
    options = [cv2.VIDEOWRITER_PROP_RAW_VIDEO, 1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48), options)
    for number, tick in enumerate(TICKS):
        writer.set(cv2.VIDEOWRITER_PROP_PTS, tick)
        writer.write(cv2.imencode(".jpg", as_bytes(moved(48, 64, 3 * number, 0))[..., ::-1])[1].reshape(1, -1))
    writer.release()
    return path


@pytest.mark.parametrize(("every", "rate", "places"), [(1, 25.0, (0, 1, 2, 9, 10, 14, 15)), (2, 12.5, (0, 1, 5, 8))])
def test_irregular_times_are_kept_in_the_table_and_in_the_overlay(tmp_path: Path, every, rate, places) -> None:
    result = predict_video(FARNEBACK, irregular(tmp_path / "a.mkv"), tmp_path, every=every)
    assert (len(result.motions), result.lost) == (len(TICKS[::every]) - 1, 0)
    seconds = [float(row["time_s"]) for row in table(tmp_path / "motion.csv")]
    assert seconds == [tick / 25 for tick in TICKS[every::every]]
    info, shown = describe(result.files[-1]), [frame for _, _, frame in frames(result.files[-1])]
    # 80 ms are a frame of 12.5 frames/s, and half a frame is rounded to the even one.
    assert (info.frames, info.frames_per_second) == (places[-1] + 1, rate)
    changes = [np.abs(one.astype(float) - other).mean() for one, other in pairwise(shown)]
    # A picture that stays is coded as no change; one that moves by 3 px or more changes by several grey levels.
    assert [0, *(place for place, change in enumerate(changes, 1) if change > 2)] == list(places)


def test_frames_closer_than_the_nominal_rate_all_appear_and_a_camera_plays_as_stamped(tmp_path: Path) -> None:
    path = irregular(tmp_path / "a.mkv")
    assert [time_s for _, time_s, *_ in newest_frames(str(path))] == [tick / 25 for tick in TICKS]
    result = predict_video(FARNEBACK, path, tmp_path, every=3)  # frames 0, 9 and 15, at 25 / 3 frames/s
    assert describe(result.files[-1]).frames == 6


def test_pairs_takes_a_video_of_any_name_and_refuses_what_is_none(tmp_path: Path) -> None:
    path = irregular(tmp_path / "a.mkv").rename(tmp_path / "a.recording")
    result = extract_pairs([str(path)], tmp_path / "out", ChoiceConfig(minimum_motion_px=1))
    assert result.sources["a"].frames == len(TICKS)
    (tmp_path / "b.recording").write_text("notes")
    refused("not a video", extract_pairs, [str(tmp_path / "b.recording")], tmp_path / "b", ChoiceConfig())


def deep(path: Path, image: NDArray[np.float32], bits: int) -> Path:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), np.rint(image[..., ::-1] * (2**bits - 1)).astype(np.uint16))
    return path


class Seen:
    """A method that keeps the images that it is given."""

    name = "seen"

    def flow(self, image1: NDArray[np.float32], image2: NDArray[np.float32]) -> NDArray[np.float32]:
        self.images = image1, image2
        return np.zeros((*image1.shape[:2], 2), np.float32)


@pytest.mark.parametrize("bits", [16, 12, 10])
def test_a_folder_of_deep_images_keeps_its_depth_and_is_scaled_with_a_word(tmp_path: Path, bits: int, recwarn) -> None:
    images = [moved(96, 128, shift, 0) for shift in (0, 3, 6)]
    for number, image in enumerate(images):
        deep(tmp_path / "in" / f"{number}.png", image, bits)
    method = Seen()
    predict_video(method, tmp_path / "in", tmp_path / "out")
    assert [row["time_s"] for row in table(tmp_path / "out" / "motion.csv")] == ["", ""]
    # Half a level of the file, and 1/64 of the value by which the largest value lies below the next power of two.
    for expected, seen in zip((images[0], images[2]), method.images, strict=True):
        np.testing.assert_allclose(seen, expected, atol=0.5 / (2**bits - 1) + 0.002, rtol=0)
    words = [str(warning.message) for warning in recwarn if "multiplied" in str(warning.message)]
    assert any(f"{bits} bits" in word for word in words) == (bits < 16)
    extract_pairs([str(tmp_path / "in")], tmp_path / "pairs", ChoiceConfig(minimum_motion_px=1))
    written = next((tmp_path / "pairs" / "images").iterdir())
    assert np.ptp(cv2.imread(str(written), cv2.IMREAD_UNCHANGED)) > 0.5 * 2**bits
    assert cv2.imread(str(written), cv2.IMREAD_UNCHANGED).dtype == np.uint16


def test_a_pair_is_scaled_by_one_factor_and_bright_images_are_left_as_they_are(tmp_path: Path) -> None:
    first, second = deep(tmp_path / "a.png", moved(64, 80, 0, 0), 12), deep(tmp_path / "b.png", moved(64, 80, 1, 0), 12)
    with pytest.warns(UserWarning, match="at most 1/16 .* 12 bits .* multiplied by 16"):
        scaled = read_pair(first, second)
    for image, path in zip(scaled, (first, second), strict=True):
        np.testing.assert_array_equal(image, 16 * read_image(path))
    dark = 0.1 * moved(64, 80, 0, 0)
    with pytest.warns(UserWarning, match="multiplied by 8"):
        full_range(dark, np.zeros_like(dark))
    full, black = full_range(dark + 0.5, dark), full_range(0 * dark, 0 * dark)
    assert full[1] is dark
    assert black[0].max() == 0


def test_every_on_a_short_folder_explains_itself(tmp_path: Path) -> None:
    for number in range(3):
        save(tmp_path / "in" / f"{number}.png", moved(48, 48, number, 0))
    words = r"every = 5 takes one of the 3 frames, .* allowed are 1 to 2"
    refused(words, predict_video, FARNEBACK, tmp_path / "in", tmp_path, every=5)
