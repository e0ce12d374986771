"""`predict` and its pictures; `gelflow.load_model` and `gelflow.PairDataset` in Python."""

import colorsys
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from commands import refused
from samples import synth_sample, write_dataset
from textures import as_bytes, moved, save, table, write_folder, write_synthetic, write_video

import gelflow
from gelflow.baselines import named_methods
from gelflow.data.open import holds_pairs
from gelflow.data.pairs import PairDataset
from gelflow.files.exr import read_flow
from gelflow.files.video import VideoInfo, describe
from gelflow.methods.learned import Learned
from gelflow.models.uncertainty import UNKNOWN_PX
from gelflow.models.weights import weights_file
from gelflow.predict import pictures
from gelflow.predict.pictures import UNKNOWN_COLOUR, flow_to_colour, robust_scale
from gelflow.predict.prediction import predict_pair, predict_pairs, predict_video

FARNEBACK = named_methods(["farneback"])[0]


def video(path: Path, frames: int, rate: float = 25.0) -> Path:
    write_video(path, [as_bytes(moved(48, 64, shift, 0)) for shift in range(frames)], rate)
    return path


def frame_folder(folder: Path, names: Iterable[object]) -> Path:
    for shift, name in enumerate(names):
        save(folder / f"{name}.png", moved(48, 48, shift, 0))
    return folder


def test_pair_gives_one_flow_in_three_files_named_after_the_images(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "in", {"press": (1.5, -0.5)})
    exr, flo, png = predict_pair(FARNEBACK, folder / "press_1.png", folder / "press_2.png", tmp_path / "out").files
    assert [path.name for path in (exr, flo, png)] == ["press.exr", "press.flo", "press.png"]
    flow = read_flow(exr).flow
    np.testing.assert_array_equal(flow, cv2.readOpticalFlow(str(flo)))
    # The limit of test_baselines for Farnebäck, 1/16 px, plus the rounding of images to 8 bit.
    assert np.abs(np.median(flow, axis=(0, 1)) - (1.5, -0.5)).max() < 0.1
    assert cv2.imread(str(png)).std() > 20
    images = [frame_folder(tmp_path, ["before", "after"]) / f"{name}.png" for name in ("before", "after")]
    assert predict_pair(FARNEBACK, *images, tmp_path).files[0].name == "before_to_after.exr"


def test_a_set_of_pairs_gives_the_flow_of_each_and_a_folder_of_frames_is_none(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "in", {"a": (1.5, -0.5), "b": (0.0, 2.0)})
    data = write_synthetic(tmp_path / "data", [(1.0, 0.0)])
    assert [holds_pairs(path) for path in (folder, data, tmp_path, folder / "a_1.png")] == [True, True, False, False]
    result = predict_pairs(FARNEBACK, PairDataset(folder), tmp_path / "out")
    names = [f"{name}.{end}" for name in "ab" for end in ("exr", "flo", "png")]
    assert [file.name for file in result.files] == [*names, "motion.csv"]
    assert [row["file"] for row in table(result.files[-1])] == ["a", "b"]
    assert [(motion.frame, motion.file) for motion in result.motions] == [(1, "a"), (2, "b")]
    assert np.median(read_flow(result.files[3]).flow[..., 1]) == pytest.approx(2.0, abs=0.1)
    save(folder / "photograph.png", moved(48, 48, 0, 0))
    (folder / "._a_1.png").write_bytes(b"left by a Mac")
    assert len(PairDataset(folder)) == 2
    assert holds_pairs(folder)
    save(folder / "a_3.png", moved(48, 48, 0, 0))
    assert not holds_pairs(folder)


@pytest.mark.parametrize(("reference", "expected"), [("first", [2.0, 4.0, 6.0]), ("previous", [2.0, 2.0, 2.0])])
def test_video_against_its_first_or_previous_frame(tmp_path: Path, reference: str, expected: list[float]) -> None:
    path, out, calls = video(tmp_path / "a.avi", 7), tmp_path / "out", []
    result = predict_video(FARNEBACK, path, out, reference, 2, progress=lambda *done: calls.append(done))
    assert [motion.frame for motion in result.motions] == [2, 4, 6]
    flows = [read_flow(out / "flow" / f"{frame:06d}.exr").flow[..., 0] for frame in (2, 4, 6)]
    # 1/16 px as above; Motion JPEG adds noise of a few grey levels: twice that.
    np.testing.assert_allclose([np.median(flow) for flow in flows], expected, rtol=0, atol=1 / 8)
    assert [int(row["frame"]) for row in table(out / "motion.csv")] == [2, 4, 6]
    assert describe(out / "overlay.mp4") == VideoInfo(4, 12.5)  # as long as the recording, whose frame 0 has no flow
    assert not list(out.glob(".*"))
    assert calls == [(n, 6) for n in range(1, 7)]


def test_a_fast_camera_has_an_overlay_too(tmp_path: Path) -> None:
    path = video(tmp_path / "a.avi", 3, rate=239.682)
    assert predict_video(FARNEBACK, path, tmp_path / "out").files[-1].is_file()


def test_folder_of_frames_is_a_video_and_flow_files_of_an_earlier_run_go(tmp_path: Path) -> None:
    frames = frame_folder(tmp_path / "in", ["b10", "b9", "a"])
    assert len(predict_video(FARNEBACK, frames, tmp_path / "out").motions) == 2
    assert [row["file"] for row in table(tmp_path / "out" / "motion.csv")] == ["b9.png", "b10.png"]
    frames, out = frame_folder(tmp_path / "five", range(5)), tmp_path / "again"
    assert len(predict_video(FARNEBACK, frames, out).motions) == 4
    others = [out / "flow" / "12.exr", out / "flow" / "000001.txt"]
    for other in others:
        other.touch()
    second = predict_video(FARNEBACK, frames, out, every=3)
    assert {path for path in out.rglob("*") if path.is_file()} == {*second.files, *others}


@pytest.mark.parametrize("name", ["a.exr", "a.flo", "a.png"])
def test_a_pairs_results_replace_those_of_an_earlier_run_and_nothing_else(tmp_path: Path, name: str) -> None:
    folder = write_folder(tmp_path / "in", {"a": (1.5, -0.5)})
    images = (folder / "a_1.png", folder / "a_2.png")
    (folder / name).write_text("another's")
    refused(rf"{name}: exists and does not come from", predict_pair, FARNEBACK, *images, folder)
    assert (folder / name).read_text() == "another's"
    for _ in range(2):
        predict_pair(FARNEBACK, *images, tmp_path / "out")


@pytest.mark.parametrize("name", ["flow/000007.exr", "motion.csv", "overlay.mp4"])
def test_a_videos_results_do_not_replace_anothers_files(tmp_path: Path, name: str) -> None:
    other = tmp_path / name
    other.parent.mkdir(exist_ok=True)
    other.write_text("another's")
    refused(rf"{name}: exists and does not come from", predict_video, FARNEBACK, video(tmp_path / "a.avi", 2), tmp_path)
    assert other.read_text() == "another's"


def test_inputs_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    video(tmp_path / "one.avi", 1)
    (frame_folder(tmp_path / "in", [0]) / "1.png").write_bytes(b"broken")
    for name, every, word in (("one.avi", 1, "fewer than two"), ("none.avi", 1, "none.avi"),
                              ("in", 1, r"1\.png: cannot be read"), ("one.avi", 0, "every")):  # fmt: skip
        refused(word, predict_video, FARNEBACK, tmp_path / name, tmp_path / "out", every=every)


def test_colours_follow_direction_and_length_and_arrows_have_the_true_length() -> None:
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
    flow = np.full((241, 321, 2), (12.0, 0.0), np.float32)
    assert pictures.draw_overlay(np.zeros((480, 96, 3), np.uint8), np.zeros((480, 96, 2)), 1.0).shape == (480, 192, 3)
    picture = pictures.draw_overlay(np.zeros((241, 321, 3), np.uint8), flow, 12.0)
    height, width = picture.shape[:2]
    assert (height % 2, width % 2) == (0, 0)
    assert height >= 480
    left = picture[:, : width // 2].max(axis=2) > 128
    assert left.mean(axis=1).max() > 0.5  # arrows of 12 px at a distance of 13 px fill most of their rows


@pytest.mark.parametrize("length", [0.013, 0.7, 42.0])
def test_scale_makes_small_and_large_flow_look_alike_and_is_one_for_none(length: float) -> None:
    flow = np.random.default_rng(0).uniform(-1, 1, (40, 50, 2)).astype(np.float32)
    flow *= length / np.hypot(flow[..., 0], flow[..., 1]).max()
    scale = robust_scale(flow)
    assert 0.7 * length < scale < 1.1 * length  # the 99th percentile, rounded up by a tenth at most
    assert scale * pictures.arrow_factor(scale) >= 3
    assert flow_to_colour(flow, scale).std() > 40
    assert robust_scale(0 * flow) == robust_scale(np.nan * flow) == 1.0


def test_arrays_and_tensors_give_one_flow_that_follows_a_known_motion(tmp_path: Path) -> None:
    pairs = gelflow.PairDataset(write_dataset(tmp_path, [synth_sample(0), synth_sample(1)]))
    batch = next(iter(torch.utils.data.DataLoader(pairs, batch_size=2)))
    model = gelflow.load_model("best", device="cpu")
    flow = model.flow(batch["image1"], batch["image2"])
    assert flow.shape == batch["flow"].shape
    one = model.flow(batch["image1"][1], batch["image2"][1])
    arrays = model.flow(*pairs.images(1))
    # Batches and single pairs are summed in different orders: float32 rounding, some ten layers deep.
    np.testing.assert_allclose(one.numpy(), flow[1].numpy(), atol=1e-3)
    np.testing.assert_allclose(arrays, np.moveaxis(one.numpy(), 0, -1), atol=1e-3)
    image1, image2 = (as_bytes(moved(96, 128, shift, 0)) for shift in (0, 2))
    flow = gelflow.load_model(device="cpu").flow(image1, image2)
    assert flow.dtype == np.float32
    # 8-bit images of texture: a tenth of a px is twenty times what rounding leaves.
    assert np.median(flow, axis=(0, 1)) == pytest.approx((2.0, 0.0), abs=0.1)


@pytest.mark.parametrize(("image1", "image2", "message"), [
    (np.zeros((64, 64, 3)), torch.zeros(3, 64, 64), "ndarray and Tensor: two NumPy arrays or two torch tensors"),
    (np.full((64, 64, 3), 9.0), np.zeros((64, 64, 3)), r"image 1 is float64 with values from 9 to 9"),
    (torch.zeros(3, 64, 64), torch.full((3, 64, 64), -1.0), r"image 2 is torch.float32 with values from -1 to -1"),
    (np.zeros((64, 64, 2)), np.zeros((64, 64, 2)), r"\(rows, columns, 3\) is needed"),
    (torch.zeros(3, 64, 64), torch.zeros(3, 64, 80), "differ in shape"),
    (torch.zeros(0, 3, 64, 64), torch.zeros(0, 3, 64, 64), "the batch is empty"),
    (np.full((64, 64, 3), np.nan), np.zeros((64, 64, 3)), "NaN or infinite"),
])  # fmt: skip
def test_images_that_cannot_be_used(image1: object, image2: object, message: str) -> None:
    refused(message, gelflow.load_model(device="cpu").flow, image1, image2)  # type: ignore[call-overload]


def test_a_network_is_not_loaded_with_wrong_options() -> None:
    refused("registration = 'foo': allowed are none, motion", gelflow.load_model, device="cpu", registration="foo")
    refused(r"size = \(240,\): rows and columns", gelflow.load_model, device="cpu", size=(240,))
    refused("image 1 is complex128", gelflow.load_model(device="cpu").flow, *np.ones((2, 64, 64, 3), complex))


def test_estimate_refuses_tensors() -> None:
    tensor = torch.zeros(3, 64, 64)
    refused("estimate takes arrays", gelflow.load_model(device="cpu").estimate, tensor, tensor)


def test_grey_images_alpha_16_bits_batches_and_the_smallest_images_of_synth_have_a_flow() -> None:
    model = gelflow.load_model(device="cpu")
    pair = [as_bytes(moved(64, 80, shift, 0)) for shift in (0, 1)]
    flow = model.flow(*pair)
    grey = [image[..., :1] for image in pair]
    expected = model.flow(*(image.repeat(3, axis=2) for image in grey))
    alpha = [np.concatenate([image, image[..., :1]], axis=2) for image in pair]
    for images, result in (
        (grey, expected),
        ([image[..., 0] for image in grey], expected),
        (alpha, flow),
        ([image.astype(np.uint16) * 257 for image in pair], flow),
    ):
        np.testing.assert_allclose(model.flow(*images), result, atol=1e-5)  # float32
    for images in (grey, alpha):
        tensors = [torch.from_numpy(image / np.float32(255)).movedim(-1, 0) for image in images]
        result = expected if images is grey else flow
        np.testing.assert_allclose(model.flow(*tensors).movedim(0, -1), result, atol=1e-5)
        np.testing.assert_allclose(
            model.flow(*(tensor[None] for tensor in tensors))[0].movedim(0, -1), result, atol=1e-5
        )
    one = model.flow(*(torch.from_numpy(image[..., 0] / np.float32(255)) for image in grey))
    np.testing.assert_allclose(one.movedim(0, -1), expected, atol=1e-5)
    together = model.estimate(np.stack(pair), np.stack(pair[::-1]))
    assert [part.shape for part in together] == [(2, 64, 80, 2), (2, 64, 80), (2, 64, 80)]
    np.testing.assert_array_equal(together.flow[0], flow)
    np.testing.assert_array_equal(model.flow(np.stack(pair), np.stack(pair[::-1])), together.flow)
    refused("batches of 2 and 1 images", model.flow, np.stack(pair), np.stack(pair[:1]))
    with pytest.warns(UserWarning, match="multiplied by 64"):
        faint = model.flow(*(image.astype(np.uint16) * 4 for image in pair))
    np.testing.assert_allclose(faint, flow, atol=0.05)  # 1020 / 1023.98 of the contrast
    small = model.estimate(*(moved(24, 32, shift, 0) for shift in (0, 1)))
    # A wave of 8 px and more, enlarged to 64 px a side; its motion is seen to a few hundredths of a px.
    assert np.abs(np.median(small.flow, axis=(0, 1)) - (1, 0)).max() < 0.1
    assert small.sigma.shape == (24, 32)
    refused("each side needs 16 px", model.flow, *np.zeros((2, 15, 32, 3), np.uint8))


def test_what_is_uncertain_is_in_the_file_and_grey_in_the_picture(tmp_path: Path) -> None:
    image1, image2 = (as_bytes(moved(96, 128, shift, 0)) for shift in (0, 2))
    noise = np.random.default_rng(0).normal(0, 2, (2, 96, 64, 3))
    for image, own in zip((image1, image2), noise, strict=True):
        image[:, 64:] = np.rint(128 + own)  # nothing but noise in the right half
    found = gelflow.load_model(device="cpu").estimate(image1, image2)
    save(tmp_path / "half_1.png", image1 / np.float32(255))
    save(tmp_path / "half_2.png", image2 / np.float32(255))
    result = predict_pair(Learned(weights_file(None), device="cpu"), *sorted(tmp_path.glob("*.png")), tmp_path)
    field = read_flow(result.files[0])
    np.testing.assert_array_equal(field.sigma, found.sigma)
    np.testing.assert_array_equal(field.visible, found.visible > 0.5)
    shown = flow_to_colour(pictures.certain(found.flow, found.sigma), 2.0)
    np.testing.assert_array_equal((shown == UNKNOWN_COLOUR).all(axis=-1), found.sigma > UNKNOWN_PX)
    assert np.median(found.sigma[:, :48]) < 0.1
    # Near the last marks, their window still counts.
    assert (found.sigma[:, 100:] > UNKNOWN_PX).mean() > 0.8
    assert result.motions[0].unknown == pytest.approx((found.sigma > UNKNOWN_PX).mean())
