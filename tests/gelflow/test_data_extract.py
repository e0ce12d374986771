"""`pairs`: what is chosen from recordings, that it can be repeated, and what happens to broken ones."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from textures import REAL, as_bytes, moved, save, write_video

from gelflow.data import open_pairs
from gelflow.data.choose import ChoiceConfig, choose_pairs, usable_frames
from gelflow.data.extract import extract_pairs, find_recordings
from gelflow.data.pairset import read_pair_set
from gelflow.errors import InputError

Frame = NDArray[np.uint8]


def recording(shifts: list[float], seed: int = 0) -> list[Frame]:
    return [as_bytes(moved(96, 128, shift, 0, seed)) for shift in shifts]


@pytest.fixture
def videos(tmp_path: Path) -> Path:
    folder = tmp_path / "videos"
    folder.mkdir()
    write_video(folder / "a.avi", recording([0, 0.2, 3, 6, 9, 9.1], seed=1))
    write_video(folder / "b.avi", recording([0, 5, 0, 4, 8, 2], seed=2))
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_chosen_motion_is_the_true_one_and_within_the_limits(tmp_path: Path, videos: Path) -> None:
    shifts = {"a": [0, 0.2, 3, 6, 9, 9.1], "b": [0, 5, 0, 4, 8, 2]}
    result = extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig(per_source=4, maximum_motion_px=7))
    assert {pair.source for pair in result.pairs} == {"a", "b"}
    for pair in result.pairs:
        i, j = pair.frames
        true = abs(shifts[pair.source][j] - shifts[pair.source][i])
        # A rigid shift; the cheap flow errs by up to 0.25 px on the reduced image (see test_baselines), here unreduced,
        # and by more at the border, which the 95th percentile sees: 0.5 px.
        assert pair.motion_px == pytest.approx(true, abs=0.5)
        assert 2 <= pair.motion_px <= 7


def test_pair_set_can_be_opened_and_holds_the_frames(tmp_path: Path, videos: Path) -> None:
    result = extract_pairs([str(videos / "a.avi")], tmp_path / "out", ChoiceConfig(per_source=2))
    dataset = open_pairs(tmp_path / "out")
    assert dataset.names == [pair.name for pair in result.pairs]
    image1, _ = dataset.images(0)
    expected = moved(96, 128, [0, 0.2, 3, 6, 9, 9.1][result.pairs[0].frames[0]], 0, 1)
    # Motion JPEG at OpenCV's quality of 95: a few grey levels of 255 on average.
    assert np.abs(image1 - expected).mean() < 5 / 255


def test_same_seed_gives_the_same_bytes_and_another_seed_another_choice(tmp_path: Path, videos: Path) -> None:
    for out in ("one", "two"):
        extract_pairs([str(videos)], tmp_path / out, ChoiceConfig(per_source=2))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    seeds = set()
    for seed in range(1, 5):
        result = extract_pairs([str(videos)], tmp_path / f"seed{seed}", ChoiceConfig(per_source=2, seed=seed))
        seeds.add(tuple(pair.name for pair in result.pairs))
    assert len(seeds) > 1


def test_a_recording_gives_the_same_pairs_alone_and_among_others(tmp_path: Path, videos: Path) -> None:
    both = extract_pairs([str(videos)], tmp_path / "both", ChoiceConfig(per_source=3))
    alone = extract_pairs([str(videos / "b.avi")], tmp_path / "alone", ChoiceConfig(per_source=3))
    assert [pair for pair in both.pairs if pair.source == "b"] == list(alone.pairs)


def test_interrupted_job_goes_on_and_ends_with_the_same_bytes(tmp_path: Path, videos: Path) -> None:
    extract_pairs([str(videos)], tmp_path / "whole", ChoiceConfig())

    def interrupt(done: int, total: int, name: str, outcome: object) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        extract_pairs([str(videos)], tmp_path / "cut", ChoiceConfig(), interrupt)
    assert list(read_pair_set(tmp_path / "cut").sources) == ["a"]
    with pytest.raises(InputError, match="interrupted"):
        open_pairs(tmp_path / "cut")
    extract_pairs([str(videos)], tmp_path / "cut", ChoiceConfig())
    assert contents(tmp_path / "cut") == contents(tmp_path / "whole")


def test_running_a_finished_job_again_changes_nothing(tmp_path: Path, videos: Path) -> None:
    extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig())
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("*")}
    extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig())
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "out").rglob("*")} == before


def test_folder_of_another_job_is_refused_with_the_difference(tmp_path: Path, videos: Path) -> None:
    extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig())
    with pytest.raises(InputError, match=r"seed is 0 there and 7 here"):
        extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig(seed=7))
    with pytest.raises(InputError, match=r"only there: a"):
        extract_pairs([str(videos / "b.avi")], tmp_path / "out", ChoiceConfig())
    with pytest.raises(InputError, match="holds other things"):
        extract_pairs([str(videos)], videos, ChoiceConfig())


def test_undecodable_video_is_counted_the_others_are_used(
    tmp_path: Path, videos: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (videos / "broken.avi").write_bytes(b"RIFF" + b"junk" * 500)
    (videos / "empty.mp4").touch()
    result = extract_pairs([str(videos)], tmp_path / "out", ChoiceConfig())
    assert sorted(result.failures) == ["broken", "empty"]
    assert "broken.avi" in result.failures["broken"]
    assert sorted(result.sources) == ["a", "b"]
    assert capfd.readouterr() == ("", "")


def test_truncated_video_is_used_as_far_as_it_decodes_and_says_so(tmp_path: Path) -> None:
    write_video(tmp_path / "a.avi", recording([0, 3, 6, 9, 12, 15, 18, 21]))
    data = (tmp_path / "a.avi").read_bytes()
    (tmp_path / "a.avi").write_bytes(data[: int(0.6 * len(data))])
    report = extract_pairs([str(tmp_path / "a.avi")], tmp_path / "out", ChoiceConfig()).sources["a"]
    assert 2 <= report.frames < 8
    assert report.frames_rejected["undecodable"] == 8 - report.frames


def test_image_folder_is_a_recording_in_natural_order_and_a_broken_image_is_counted(tmp_path: Path) -> None:
    for number, shift in enumerate([0, 3, 6, 9, 12]):
        save(tmp_path / "run" / f"frame{8 + number}.png", moved(96, 128, shift, 0))
    (tmp_path / "run" / "frame13.png").write_bytes(b"no image")
    result = extract_pairs([str(tmp_path)], tmp_path / "out", ChoiceConfig(per_source=20))
    assert list(result.sources) == ["run"]
    assert result.sources["run"].frames == 5
    assert result.sources["run"].frames_rejected == {"undecodable": 1}
    for pair in result.pairs:
        assert pair.motion_px == pytest.approx(3 * abs(pair.frames[0] - pair.frames[1]), abs=0.5)


def test_blank_frames_and_exposure_ramps_are_put_aside() -> None:
    frames = recording([0, 3, 6, 9, 12])
    frames[1] = np.full_like(frames[1], 90)
    ramp = frames[3].astype(float) * [1.0, 0.6, 0.6]  # a red picture: green and blue have not come up yet
    frames[3] = ramp.astype(np.uint8)
    usable, rejected = usable_frames(frames)
    assert usable == [0, 2, 4]
    assert rejected == {"blank": 1, "exposure": 1}


def test_still_recording_gives_no_pair_and_repeated_motion_only_one() -> None:
    still = choose_pairs(recording([0, 0, 0.1, 0]), ChoiceConfig(), np.random.default_rng(0))
    assert not still.pairs
    assert set(still.rejected) == {"little motion"}
    there_and_back = choose_pairs(recording([0, 4, 0, 4, 0, 4]), ChoiceConfig(), np.random.default_rng(0))
    assert len(there_and_back.pairs) == 2  # one each way
    assert there_and_back.rejected["near duplicate"] >= 1


def test_unrelated_frames_are_seldom_a_pair() -> None:
    """The flow there and back closes by chance now and then: four out of five must be noticed."""
    frames = [as_bytes(moved(96, 128, 0, 0, seed)) for seed in range(6)]
    choices = choose_pairs(frames, ChoiceConfig(), np.random.default_rng(0))
    assert choices.tried == 15
    assert choices.rejected["unreliable"] >= 12


def test_inputs_are_found_by_file_folder_and_pattern(tmp_path: Path, videos: Path) -> None:
    expected = [("a", videos / "a.avi"), ("b", videos / "b.avi")]
    for inputs in ([str(videos)], [f"{videos}/*.avi"], [str(videos / "b.avi"), str(videos / "a.avi")]):
        assert [(r.name, r.path) for r in find_recordings(inputs)] == expected


def test_inputs_that_hold_nothing_are_named(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").touch()
    for given, word in (("nothing", "no file"), ("*.avi", "pattern"), ("notes.txt", "not a video"), ("", "neither")):
        with pytest.raises(InputError, match=word):
            find_recordings([str(tmp_path / given)])


@pytest.mark.parametrize(
    "config",
    [ChoiceConfig(per_source=0), ChoiceConfig(frames=1), ChoiceConfig(tries=0), ChoiceConfig(minimum_motion_px=99)],
)
def test_settings_out_of_range_are_refused(tmp_path: Path, videos: Path, config: ChoiceConfig) -> None:
    with pytest.raises(InputError):
        extract_pairs([str(videos)], tmp_path / "out", config)
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif(
    not (REAL / "clips_large_dots").is_dir(), reason="the real recordings are not beside the repository"
)
def test_real_exposure_ramp_is_put_aside(tmp_path: Path) -> None:
    """The first frame of this recording is dark and red; no pair may contain it."""
    clip = REAL / "clips_large_dots" / "tin_box__exp_num_2__camera_0.avi"
    extract_pairs([str(clip)], tmp_path / "out", ChoiceConfig(frames=15))
    content = json.loads((tmp_path / "out" / "pairs.json").read_text())
    assert content["sources"][clip.stem]["frames_rejected"] == {"exposure": 1}
    assert all(0 not in pair["frames"] for pair in content["pairs"])
