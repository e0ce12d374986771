"""The flow of a stream and its markers: nothing drifts, a cut is survived, a dead dot disturbs no other."""

import pickle
from pathlib import Path
from threading import Event

import numpy as np
import OpenEXR
import pytest
from commands import refused
from dots import PITCH, Turn, centres
from numpy.typing import NDArray
from textures import as_bytes, moved, table, write_video

import gelflow
from gelflow.arrays import Estimate
from gelflow.cli import main
from gelflow.track.markers import Markers

SIZE = (160, 208)
DOTS = centres(*SIZE)


def frame(turn: float = 0.0, shift: tuple[float, float] = (0.0, 0.0), dots: NDArray = DOTS) -> NDArray[np.uint8]:
    return Turn(turn, shift=shift).frame(*SIZE, dots)


def off(flow: NDArray, motion: Turn) -> float:
    """Median error, px, where the motion stays in the picture."""
    truth = motion.flow(*SIZE)
    rows, columns = np.indices(SIZE)
    x, y = columns + truth[..., 0], rows + truth[..., 1]
    seen = (x > 12) & (x < SIZE[1] - 12) & (y > 12) & (y < SIZE[0] - 12)
    return float(np.median(np.hypot(*np.moveaxis(flow - truth, -1, 0))[seen]))


def test_motion_grows_beyond_what_a_direct_flow_finds_and_nothing_drifts() -> None:
    tracker, errors = gelflow.Tracker(frame()), []
    for number in range(1, 25):
        motion = Turn(0.8 * number, shift=(2.2 * number, 0.5 * number))
        image = motion.frame(*SIZE, DOTS)
        errors.append(off(tracker.update(image).flow, motion))
    # Two and a half pitches and 19 degrees from the reference, dots are taken for others.
    assert off(gelflow.load_model("fast").flow(frame(), image), motion) > PITCH / 4
    # Errors are those of one registration, some hundredths of a px at a noise of 0.5 %, and no sum of 24.
    assert max(errors) < 0.1
    assert np.mean(errors[-4:]) < 3 * np.mean(errors[:4])


def test_after_a_cut_nothing_is_known_and_the_next_frame_is_found() -> None:
    tracker = gelflow.Tracker(frame())
    assert not tracker.update(frame(shift=(2.0, 1.0))).markers["sigma"].max() > 1
    dark = tracker.update(as_bytes(moved(*SIZE, 0, 0, seed=3)))
    assert dark.afresh
    assert (dark.sigma > 9).all()
    assert not dark.markers["visible"].any()
    motion = Turn(shift=(3.0, 1.0))
    found = tracker.update(motion.frame(*SIZE, DOTS))
    assert off(found.flow, motion) < 0.1
    assert not tracker.update(motion.frame(*SIZE, DOTS)).afresh


def test_a_ramp_of_exposure_is_unknown_asks_no_network_and_the_stream_goes_on(monkeypatch) -> None:
    monkeypatch.setattr("gelflow.track.tracker.shipped", None)
    tracker = gelflow.Tracker(frame())
    light = [1.0, 0.15, 0.03, 0.1, 0.9, 1.0, 1.0]
    found = []
    for number, factor in enumerate(light):
        motion = Turn(shift=(1.0 + number, 0.0))
        found.append(tracker.update((factor * motion.frame(*SIZE, DOTS)).astype(np.uint8)))
    assert [float((each.sigma < 1).mean()) > 0.5 for each in found] == [factor > 0.5 for factor in light]
    assert off(found[-1].flow, motion) < 0.1
    assert not found[-1].afresh


def test_a_fresh_start_that_jumps_by_a_pitch_and_tears_no_less_is_not_taken(monkeypatch) -> None:
    axes = (np.arange(-4, 14) * PITCH for _ in SIZE)
    dots = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    tracker, motion = gelflow.Tracker(frame(dots=dots)), Turn(shift=(4.0, 0.0))
    tracker.update(frame(shift=(2.0, 0.0), dots=dots))
    jumped = np.full((*SIZE, 2), (4.0 - PITCH, 0.0), np.float32)
    monkeypatch.setattr("gelflow.track.tracker.fresh_start", lambda *_: jumped)
    broken = motion.frame(*SIZE, dots)
    broken[40:90, 60:120] = as_bytes(moved(50, 60, 0, 0))
    found = tracker.update(broken)
    # A tenth of the picture is torn under both flows; 0.1 px is the limit of the tests above.
    assert off(found.flow, motion) < 0.1
    assert not found.afresh


def test_a_stream_that_begins_in_contact_counts_motion_from_there() -> None:
    tracker = gelflow.Tracker(frame(turn=3.0, shift=(4.0, 0.0)))
    found = tracker.update(frame(turn=3.0, shift=(6.0, 0.0)))
    inner = found.flow[20:-20, 20:-20]
    assert np.abs(np.median(inner, axis=(0, 1)) - (2, 0)).max() < 0.1


def test_frames_of_another_kind_are_taken_if_they_show_the_same() -> None:
    tracker, motion = gelflow.Tracker(frame()), Turn(shift=(2.0, 0.0))
    image = motion.frame(*SIZE, DOTS)
    for same in (image, image.astype(np.float32) / 255, image.astype(np.uint16) * 257, image[..., [0, 1, 2, 2]]):
        assert off(tracker.update(same).flow, motion) < 0.1


def test_of_two_markers_at_one_place_only_the_surer_one_is_seen() -> None:
    image = frame().astype(np.float32) / 255
    markers = Markers(image)
    still = Estimate(np.zeros((*SIZE, 2), np.float32), np.full(SIZE, 0.1, np.float32), np.ones(SIZE, np.float32))
    rest = markers.at(still, image)
    one, other = np.argsort(np.hypot(rest["x"] - SIZE[1] / 2, rest["y"] - SIZE[0] / 2))[:2]
    row, column = np.indices(SIZE) + 0.5
    near = np.hypot(column - rest["x"][one], row - rest["y"][one]) < 8
    still.flow[near] = [rest["x"][other] - rest["x"][one], rest["y"][other] - rest["y"][one]]
    still.sigma[near] = 0.2
    moved = markers.at(still, image)
    assert rest["visible"].all()
    assert list(np.flatnonzero(~moved["visible"])) == [one]


def test_wrong_frames_and_times_are_refused_and_leave_no_trace() -> None:
    trackers = [gelflow.Tracker(frame()) for _ in range(2)]
    for tracker in trackers:
        tracker.update(frame(shift=(1.0, 0.0)), time_s=0.1)
    refused("must be equal", trackers[0].update, frame()[:-8], time_s=0.2)
    refused("values from", trackers[0].update, 1.0 * frame(), time_s=0.2)
    refused("NaN", trackers[0].update, np.full((*SIZE, 3), np.nan), time_s=0.2)
    for time_s in (0.1, 0.0, np.nan):
        refused("times must rise", trackers[0].update, frame(), time_s=time_s)
    flows = [tracker.update(frame(shift=(2.0, 0.0)), time_s=0.2).flow for tracker in trackers]
    np.testing.assert_array_equal(*flows)
    refused("scene = ", gelflow.Tracker, frame(), scene="gelsight_mini")


def test_reset_forgets_the_stream_and_takes_another_reference() -> None:
    tracker = gelflow.Tracker(frame())
    first = tracker.update(frame(shift=(1.0, 0.0)), time_s=5.0)
    tracker.update(frame(shift=(4.0, 0.0)), time_s=6.0)
    tracker.reset()
    again = tracker.update(frame(shift=(1.0, 0.0)), time_s=0.0)
    np.testing.assert_array_equal(first.flow, again.flow)
    tracker.reset(frame(shift=(4.0, 0.0))[:128])
    image = frame(shift=(5.0, 0.0))[:128]
    assert np.median(tracker.update(image).flow[..., 0]) == pytest.approx(1, abs=0.1)


def test_memory_does_not_grow_with_frames() -> None:
    tracker, sizes = gelflow.Tracker(frame()), []
    for number in range(12):
        tracker.update(frame(shift=(number % 3, 0.0)))
        sizes.append(len(pickle.dumps(vars(tracker))))
    assert max(sizes[2:]) == sizes[2]


def test_markers_need_no_grid_and_a_dead_one_disturbs_no_other() -> None:
    """One dot is missing from the start; another goes out while the gel turns."""
    middle = np.argsort(np.hypot(*(DOTS - (SIZE[1] / 2, SIZE[0] / 2)).T))
    dots = np.delete(DOTS, middle[3], axis=0)
    without = np.delete(DOTS, middle[[3, 0]], axis=0)
    motion = Turn(3.0, shift=(2.0, -1.0))
    tracker = gelflow.Tracker(frame(dots=dots))
    whole, broken = (tracker.update(motion.frame(*SIZE, each)).markers for each in (dots, without))
    inner = dots[((dots > 8) & (dots < np.array(SIZE[::-1]) - 8)).all(axis=1)]
    places = np.stack([whole["x"], whole["y"]], axis=-1)
    distance, other = (np.hypot(*np.moveaxis(places[:, None] - each, -1, 0)) for each in (dots, inner))
    assert len(np.unique(whole["id"])) == len(whole)
    assert (distance.min(axis=1) < 0.2).all()
    assert (other.min(axis=0) < 0.2).all()
    dead = np.hypot(*(places - DOTS[middle[0]]).T).argmin()
    assert list(np.flatnonzero(whole["visible"] & ~broken["visible"])) == [dead]
    truth = motion.moved(places, *SIZE) - places
    for markers in (whole, broken):
        kept = markers["visible"]
        assert kept.mean() > 0.8
        error = np.hypot(markers["u"] - truth[:, 0], markers["v"] - truth[:, 1])[kept]
        assert error.max() < 0.3
        assert np.median(error) < 0.1


def test_the_network_takes_over_where_the_stream_is_lost(monkeypatch) -> None:
    """A turn by 14 degrees at once: at the border, dots move by more than half their distance."""
    tracker = gelflow.Tracker(frame(), weights="best")
    network, asked = tracker._network, []
    monkeypatch.setattr(tracker, "_network", lambda *images: asked.append(1) or network(*images))
    for number in range(1, 4):
        motion = Turn(shift=(2.0 * number, 0.0))
        assert off(tracker.update(motion.frame(*SIZE, DOTS)).flow, motion) < 0.1
    assert not asked
    motion = Turn(14.0, shift=(2.0, 0.0))
    found = tracker.update(motion.frame(*SIZE, DOTS))
    assert asked
    assert found.afresh
    truth = motion.flow(*SIZE)
    wrong = np.hypot(*np.moveaxis(found.flow - truth, -1, 0)) > PITCH / 2
    assert wrong[found.sigma < 1].mean() < 0.01


def test_frames_that_do_not_wait_go_on_and_the_networks_answer_is_moved_on(monkeypatch) -> None:
    """The same turn; the network answers two frames later."""
    tracker, lost, let = gelflow.Tracker(frame(), wait=False), Turn(14.0, shift=(2.0, 0.0)), Event()
    flow = lost.flow(*SIZE).astype(np.float32)
    monkeypatch.setattr(tracker, "_network", lambda *_: flow if let.wait(60) else None)
    assert off(tracker.update(frame(shift=(1.0, 0.0))).flow, Turn(shift=(1.0, 0.0))) < 0.1

    def wrong(motion: Turn) -> tuple[float, gelflow.track.tracker.Tracked]:
        found = tracker.update(motion.frame(*SIZE, DOTS))
        missed = np.hypot(*np.moveaxis(found.flow - motion.flow(*SIZE), -1, 0)) > PITCH / 2
        assert missed[found.sigma < 1].mean() < 0.01
        return float(missed.mean()), found

    for motion in (lost, Turn(14.5, shift=(3.0, 0.0))):
        assert wrong(motion)[0] > 0.02
    let.set()
    tracker._thread.shutdown()
    share, found = wrong(Turn(15.0, shift=(4.0, 0.0)))
    assert share < 0.001
    assert found.afresh
    assert wrong(Turn(15.5, shift=(5.0, 0.0)))[0] < 0.001


def test_a_network_that_does_not_help_is_asked_ever_more_seldom(monkeypatch) -> None:
    """Asked at first and 20, 60 and 140 frames after its answers; other starts compete in every tenth frame."""
    tracker, asked = gelflow.Tracker(frame(), wait=False), []
    useless = np.zeros((*SIZE, 2), np.float32)
    monkeypatch.setattr(tracker, "_network", lambda *_: asked.append(1) or useless)
    tracker.update(frame())
    for number in range(50):
        tracker.update(Turn(14.0, shift=(2.0 + 0.01 * number, 0.0)).frame(*SIZE, DOTS))
        tracker._thread.submit(int).result()  # so that the answer is there
    assert len(asked) == 2


@pytest.mark.parametrize("weights", [["--weights", "fast"], ["--method", "farneback"]])
def test_the_commands_write_markers_as_a_table(tmp_path: Path, weights: list[str], capsys) -> None:
    video = tmp_path / "a.avi"
    write_video(video, [frame(shift=(shift, 0.0)) for shift in range(4)], 10.0)
    assert main(["predict", str(video), "--out", str(tmp_path), "--markers", *weights]) == 0
    rows = table(tmp_path / "markers.csv")
    assert list(rows[0]) == ["id", "frame", "time_s", "x", "y", "u", "v", "sigma", "visible"]
    assert {int(row["frame"]) for row in rows} == {1, 2, 3}
    assert len(rows) == 3 * len({row["id"] for row in rows})
    seen = [float(row["u"]) for row in rows if row["frame"] == "3" and row["visible"] == "1"]
    assert np.median(seen) == pytest.approx(3, abs=0.3)  # compression of the video
    assert main(["live", str(video), "--markers", str(tmp_path / "live.csv"), *weights]) == 0
    live = [row for row in table(tmp_path / "live.csv") if row["frame"] == "3"]
    assert [row["id"] for row in live] == [row["id"] for row in rows if row["frame"] == "3"]
    assert main(["predict", str(video), "--out", str(tmp_path), *weights]) == 0
    assert not (tmp_path / "markers.csv").exists()
    capsys.readouterr()
    assert main(["predict", str(video), "--out", str(tmp_path), "--markers", "--reference", "previous", *weights]) == 2
    assert "leave out --reference previous" in capsys.readouterr().err


def write_places(path: Path, size: tuple[int, int]) -> Path:
    """A camera's places of 0.05 mm a px along x and 0.1 along y, 1 mm off."""
    row, column = (np.indices(size) + 0.5).astype(np.float32)
    planes = {"place.X": 0.05 * column - 1, "place.Y": 0.1 * row - 1}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, planes).write(str(path))
    return path


@pytest.mark.parametrize("command", ["predict", "live"])
def test_with_a_scene_markers_are_in_millimetres(tmp_path: Path, command: str, capsys) -> None:
    video, scene = tmp_path / "a.avi", write_places(tmp_path / "places.exr", SIZE)
    write_video(video, [frame(shift=(shift, shift / 2)) for shift in range(4)], 10.0)
    out = tmp_path / "markers.csv"
    options = ["--out", tmp_path, "--markers"] if command == "predict" else ["--markers", out]
    tables = []
    for further in ([], ["--scene", scene]):
        assert main([command, str(video), "--weights", "fast", *map(str, [*options, *further])]) == 0
        tables.append([row for row in table(out) if row["frame"] == "3" and row["visible"] == "1"])
    pixels, millimetres = tables
    assert len(pixels) == len(millimetres) > 10
    for px, mm in zip(pixels, millimetres, strict=True):
        x, y, u, v, sigma = (float(px[name]) for name in ("x", "y", "u", "v", "sigma"))
        given = [float(mm[name]) for name in ("x_mm", "y_mm", "u_mm", "v_mm", "sigma_mm")]
        # Numbers have four digits, and OpenCV reads places in steps of 1/32 px.
        np.testing.assert_allclose(
            given, [x / 20 - 1, y / 10 - 1, u / 20, v / 10, sigma / 200**0.5], atol=0.1 / 32 + 1e-4
        )
    capsys.readouterr()
    assert main([command, str(video), *map(str, options), "--scene", str(write_places(scene, (32, 32)))]) == 2
    assert "--scene: it has 32x32 px, the frame 208x160" in capsys.readouterr().err
    assert main([command, str(video), *map(str, options), "--scene", str(video)]) == 2
    assert main([command, str(video), "--out", str(tmp_path), "--scene", str(scene)]) == 2
    assert "--scene: is for --markers" in capsys.readouterr().err
