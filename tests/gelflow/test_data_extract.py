"""`pairs`: what is chosen from recordings, that it can be repeated, and what happens to broken ones."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import refused
from numpy.typing import NDArray
from samples import tree
from textures import REAL, as_bytes, moved, save, write_folder, write_video

from gelflow.data import PairDataset
from gelflow.data.choose import ChoiceConfig, Choices, choose_pairs, usable_frames
from gelflow.data.extract import extract_pairs, find_recordings
from gelflow.data.pairset import read_pair_set

Frame = NDArray[np.uint8]
SHIFTS = {"a": [0, 0.2, 3, 6, 9, 9.1], "b": [0, 5, 0, 4, 8, 2]}


def recording(shifts: list[float], seed: int = 0) -> list[Frame]:
    return [as_bytes(moved(96, 128, shift, 0, seed)) for shift in shifts]


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    for seed, (name, shifts) in enumerate(SHIFTS.items(), start=1):
        write_video(folder / f"{name}.avi", recording(shifts, seed))
    return folder


def test_chosen_motion_is_the_true_one_and_the_same_whether_the_recording_is_alone_or_not(tmp_path, videos) -> None:
    result = extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig(per_source=4, maximum_motion_px=7))
    assert {pair.source for pair in result.pairs} == {"a", "b"}
    for pair in result.pairs:
        first, second = (SHIFTS[pair.source][k] for k in pair.frames)
        # A rigid shift; the cheap flow errs by up to 0.25 px (test_baselines), at the border by more: 0.5 px.
        assert pair.motion_px == pytest.approx(abs(second - first), abs=0.5)
        assert 2 <= pair.motion_px <= 7
    both = extract_pairs([str(videos)], tmp_path / "both", ChoiceConfig(per_source=3))
    alone = extract_pairs([str(videos / "b.avi")], tmp_path / "alone", ChoiceConfig(per_source=3))
    assert [pair for pair in both.pairs if pair.source == "b"] == list(alone.pairs)
    dataset = PairDataset(tmp_path / "alone")
    assert dataset.names == [pair.name for pair in alone.pairs]
    expected = moved(96, 128, SHIFTS["b"][alone.pairs[0].frames[0]], 0, 2)
    # Motion JPEG at OpenCV's quality of 95: a few grey levels of 255 on average.
    assert np.abs(dataset.images(0)[0] - expected).mean() < 5 / 255


def test_same_seed_gives_the_same_bytes_and_another_seed_another_choice(tmp_path: Path, videos: Path) -> None:
    for out in ("one", "two"):
        extract_pairs([str(videos)], tmp_path / out, ChoiceConfig(per_source=2))
    assert tree(tmp_path / "one") == tree(tmp_path / "two")
    results = [extract_pairs([str(videos)], tmp_path / f"seed{seed}", ChoiceConfig(per_source=2, seed=seed))
               for seed in range(1, 5)]  # fmt: skip
    assert len({tuple(pair.name for pair in result.pairs) for result in results}) > 1


def test_a_job_goes_on_where_it_was_interrupted_and_is_not_replaced_by_another(tmp_path: Path, videos: Path) -> None:
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    extract_pairs([str(videos)], whole, ChoiceConfig())

    def interrupt(done: int, total: int, name: str, outcome: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_pairs([str(videos)], cut, ChoiceConfig(), interrupt)
    assert list(read_pair_set(cut).sources) == ["a"]
    refused("interrupted", PairDataset, cut)
    extract_pairs([str(videos)], cut, ChoiceConfig())
    assert tree(cut) == tree(whole)
    before = {path: path.stat().st_mtime_ns for path in cut.rglob("*")}
    extract_pairs([str(videos)], cut, ChoiceConfig())  # it is finished: nothing is written
    for inputs, out, config, words in (
        (videos, cut, ChoiceConfig(seed=7), r"seed is 0 there and 7 here"),
        (videos / "b.avi", cut, ChoiceConfig(), r"a is \d+ there and missing here"),
        (videos, videos, ChoiceConfig(), "holds other things"),
    ):  # fmt: skip
        refused(words, extract_pairs, [str(inputs)], out, config)
    assert {path: path.stat().st_mtime_ns for path in cut.rglob("*")} == before


def test_undecodable_videos_are_counted_and_truncated_ones_used_as_far_as_they_decode(tmp_path, videos, capfd) -> None:
    (videos / "broken.avi").write_bytes(b"RIFF" + b"junk" * 500)
    (videos / "empty.mp4").touch()
    result = extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig())
    assert sorted(result.failures) == ["broken", "empty"]
    assert "broken.avi" in result.failures["broken"]
    assert sorted(result.sources) == ["a", "b"]
    assert capfd.readouterr() == ("", "")
    write_video(tmp_path / "a.avi", recording([0, 3, 6, 9, 12, 15, 18, 21]))
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(data[: int(0.6 * len(data))])
    report = extract_pairs([str(tmp_path / "a.avi")], tmp_path / "cut", ChoiceConfig()).sources["a"]
    assert 2 <= report.frames < 8
    assert report.frames_rejected["undecodable"] == 8 - report.frames


def test_image_folder_is_a_recording_in_natural_order_and_a_broken_image_is_counted(tmp_path: Path) -> None:
    for number, shift in enumerate([0, 3, 6, 9, 12]):
        save(tmp_path / "run" / f"frame{8 + number}.png", moved(96, 128, shift, 0))
    (tmp_path / "run" / "frame13.png").write_bytes(b"no image")
    result = extract_pairs([str(tmp_path)], tmp_path / "out", ChoiceConfig(per_source=20))
    (report,) = result.sources.values()
    assert (list(result.sources), report.frames, report.frames_rejected) == (["run"], 5, {"undecodable": 1})
    for pair in result.pairs:
        assert pair.motion_px == pytest.approx(3 * abs(pair.frames[0] - pair.frames[1]), abs=0.5)


def test_blank_frames_exposure_ramps_still_repeated_and_unrelated_frames_are_no_pairs() -> None:
    frames = recording([0, 3, 6, 9, 12])
    frames[1] = np.full_like(frames[1], 90)
    frames[3] = (frames[3] * np.array([1.0, 0.6, 0.6])).astype(np.uint8)  # green and blue have not come up yet
    assert usable_frames(frames) == ([0, 2, 4], {"blank": 1, "exposure": 1})

    def choose(frames: list[Frame]) -> Choices:
        return choose_pairs(frames, ChoiceConfig(), np.random.default_rng(0))

    still = choose(recording([0, 0, 0.1, 0]))
    assert (list(still.pairs), set(still.rejected)) == ([], {"little motion"})
    there_and_back = choose(recording([0, 4, 0, 4, 0, 4]))
    assert len(there_and_back.pairs) == 2  # one each way
    assert there_and_back.rejected["near duplicate"] >= 1
    unrelated = choose([as_bytes(moved(96, 128, 0, 0, seed)) for seed in range(6)])
    # The flow there and back closes by chance now and then: four out of five must be noticed.
    assert unrelated.tried == 15
    assert unrelated.rejected["unreliable"] >= 12


def test_inputs_are_found_by_file_folder_and_pattern_and_those_that_hold_nothing_are_named(tmp_path, videos) -> None:
    expected = [("a", videos / "a.avi"), ("b", videos / "b.avi")]
    for inputs in ([str(videos)], [f"{videos}/*.avi"], [str(videos / "b.avi"), str(videos / "a.avi")]):
        assert list(find_recordings(inputs).items()) == expected
    for folder in ("day1/press", "day2/press", ".trash"):
        (tmp_path / "nested" / folder).mkdir(parents=True)
        shutil.copy(videos / "a.avi", tmp_path / "nested" / folder)
    nested = {f"day{day}__press__a": tmp_path / "nested" / f"day{day}" / "press" / "a.avi" for day in (1, 2)}
    assert find_recordings([str(tmp_path / "nested")]) == nested
    shutil.copy(videos / "a.avi", videos / "a.mp4")
    refused(r"a\.avi and .*a\.mp4: two recordings", find_recordings, [str(videos)])
    ready = write_folder(tmp_path / "pairs", {"a": (1, 0)})
    refused("holds image pairs already", find_recordings, [str(ready)])
    empty = tmp_path / "empty"
    empty.mkdir()
    (empty / "notes.txt").touch()
    for given, word in (("nothing", "no file"), ("*.avi", "pattern"), ("notes.txt", "not a video"), ("", "neither")):
        refused(word, find_recordings, [str(empty / given)])


@pytest.mark.parametrize(
    "wrong",
    [{"per_source": 0}, {"frames": 1}, {"tries": 0}, {"minimum_motion_px": 99}, {"maximum_motion_px": np.inf}],
)
def test_settings_out_of_range_are_refused(tmp_path: Path, videos: Path, wrong: dict) -> None:
    refused(".", extract_pairs, [str(videos)], tmp_path / "out", ChoiceConfig(**wrong))
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(not (REAL / "clips_large_dots").is_dir(), reason="the real recordings are not here")
def test_real_exposure_ramp_is_put_aside(tmp_path: Path) -> None:
    """The first frame of this recording is dark and red; no pair may contain it."""
    clip = REAL / "clips_large_dots" / "tin_box__exp_num_2__camera_0.avi"
    extract_pairs([str(clip)], tmp_path / "out", ChoiceConfig(frames=15))
    content = json.loads((tmp_path / "out" / "pairs.json").read_text())
    assert content["sources"][clip.stem]["frames_rejected"] == {"exposure": 1}
    assert all(0 not in pair["frames"] for pair in content["pairs"])
