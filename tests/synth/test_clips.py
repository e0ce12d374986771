"""Clips: all recorded states of a press, from generation to every reader. And datasets without pictures."""

import io
import json
import re
import shutil
import subprocess
import sys
from base64 import b64decode
from pathlib import Path

import numpy as np
import pytest
from commands import refused, said
from PIL import Image
from tiny_scene import TEXT, fingerprint, home, own_cache, write_tiny

from gelflow import PairDataset
from synth.cli import main
from synth.dataset.export import export
from synth.dataset.exr import read_channels, write_flow
from synth.dataset.reader import Dataset, read_dataset
from synth.dataset.sample_reader import ClipData
from synth.dataset.shard import Shard
from synth.dataset.tracks import states_columns
from synth.pipeline.generate import Scheduling, generate
from synth.planning import job_variant, plan, predict
from synth.press.press import MeshRule
from synth.render.renderer import Renderer
from synth.sampling import draw
from synth.scene.template import Template, load_scene
from synth.simulate.solve import simulate_press
from synth.verify import verify_dataset
from synth.verify.camera import ForwardCamera
from synth.verify.sheet import Sheet

pytestmark = pytest.mark.usefixtures("one_cache")
STEPS = 6
CLIPS = [
    'sampling.kind="clips"', f"motion.steps={STEPS}", "motion.depth_mm=0.3", "motion.shear_mm=[0.3, 0.0]",
    "contact.friction=0.4", "outputs.contact=true", "outputs.slip=true", "outputs.previous=true",
]  # fmt: skip


@pytest.fixture(scope="module")
def template() -> Template:
    return load_scene(write_tiny(home()), CLIPS)


@pytest.fixture(scope="module")
def made(template: Template) -> Path:
    """Two clips of one sensor and one of another, never changed."""
    with pytest.MonkeyPatch.context() as patch:
        own_cache(patch)
        generate(template, 3, home() / "clips")
    return home() / "clips"


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "copy"))


@pytest.fixture(scope="module")
def dataset(made: Path) -> Dataset:
    return read_dataset(made)


def test_a_clip_is_all_states_of_a_press_each_pictured_once(made: Path, dataset: Dataset) -> None:
    files = {"meta.json", "surface.npz", "states.csv", "markers.csv"}
    files |= {f"frames/{frame:06d}.png" for frame in range(STEPS + 1)}
    files |= {f"flow/{frame:06d}.exr" for frame in range(1, STEPS + 1)}
    for index, clip in enumerate(dataset):
        folder, entry = made / "clips" / f"{index:06d}", dataset.entry(index)
        assert {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()} == files
        assert set(entry.sha256) == files
        assert (entry.trajectory, entry.frames, clip.meta["frames"]) == (index, (0, 1, 2, 3, 4, 5, 6), [*range(7)])
        assert (len(clip), len(clip.images), len(clip.flows)) == (STEPS + 1, STEPS + 1, STEPS)
        assert clip.states.dtype.names == states_columns(clip.meta["scene"])
        assert [*clip.states["frame"]] == [*range(STEPS + 1)]
        np.testing.assert_allclose(clip.states["time_s"], np.arange(STEPS + 1) / 25)
        for axis, name in enumerate(("fx_n", "fy_n", "fz_n")):
            np.testing.assert_array_equal(clip.states[name], [row[axis] for row in entry.force_n])
        assert (clip.states["fz_n"][0], clip.states["contact_area_mm2"][0], clip.states["depth_mm"][0]) == (0, 0, 0)
        assert (np.diff(clip.states["depth_mm"]) >= 0).all()
        assert (clip.states["contact_area_mm2"][1:] > 0).all()
        assert clip.states["shear_x_mm"][-1] == 0.3
        assert entry.max_flow_px == pytest.approx(max(np.nanmax(np.hypot(*flow.forward.T)) for flow in clip.flows))
        assert sum((one != two).any() for one, two in zip(clip.images, clip.images[1:], strict=False)) == STEPS
    # Frames at rest of one sensor differ by their noise alone, of which each frame of each clip has its own.
    rest = [clip.images[0].astype(float) for clip in dataset]
    assert 0 < np.abs(rest[0] - rest[1]).mean() < 3 < np.abs(rest[0] - rest[2]).mean()


def test_every_frame_is_verified_and_a_wrong_one_is_named(made: Path, copy: Path) -> None:
    report = verify_dataset(made)
    assert report.ok, report.record()
    for frame, channel, check in ((4, "forward.U", "forward flow"), (2, "previous.V", "previous flow")):
        path = copy / "clips" / "000001" / "flow" / f"{frame:06d}.exr"
        flow = read_dataset(copy).read_clip(1).flows[frame - 1]
        if channel == "forward.U":
            flow.forward[12, 16, 0] += 0.05
        else:
            flow.extras[channel][12, 16] += 0.05
        write_flow(
            path, flow, {k: v for k, v in read_channels(path)[1].items() if k in ("seed", "index", "scene.hash")}
        )
        bad = [one for one in verify_dataset(copy).samples[1].checks if not one.passed]
        assert check in [one.name for one in bad]
        assert next(one for one in bad if one.name == check).detail.startswith(f"frame {frame}: worst at row 12")
        shutil.copy(made / path.relative_to(copy), path)


def test_a_thousand_points_followed_through_the_frames_have_the_flow_of_their_pixels(tmp_path: Path) -> None:
    """Points, places and pixels are those of verification, which shares no code with what wrote the flow."""
    larger = {"width": 48, "height": 36, "fx": 123, "fy": 123, "cx": 24, "cy": 18}
    sensor = [f"sensor.camera.{key}={value}" for key, value in larger.items()]
    generate(load_scene(write_tiny(tmp_path), [*CLIPS, *sensor]), 1, tmp_path / "d")
    dataset = read_dataset(tmp_path / "d")
    clip, camera = dataset.read_clip(0), ForwardCamera.of(dataset.scene_of(0).sensor)
    pixels = np.random.default_rng(0).permutation(48 * 36)[:1000]
    row, column = np.divmod(pixels, 48)
    states = [clip.surface.positions(moved) for moved in clip.displacements]
    seen = Sheet(camera, clip.surface.triangles, states[0], 48, 36).seen(np.column_stack([column, row]) + 0.5)
    assert (seen.triangle >= 0).all()
    for positions, flow in zip(states[1:], clip.flows, strict=True):
        there = camera.see(seen.positions(clip.surface.triangles, positions))
        # float32 of flows below 4 px rounds to 2e-7 px, the root search of the other camera leaves some 1e-7 px.
        followed = there - np.column_stack([column, row]) - 0.5
        np.testing.assert_allclose(flow.forward[row, column], followed, rtol=0, atol=1e-5)
    assert np.abs(clip.flows[-1].forward).max() > 0.5


def test_dots_are_tracked_where_they_are_painted_and_move_with_the_flow(dataset: Dataset) -> None:
    for clip in dataset:
        tracks = clip.markers.reshape(-1, STEPS + 1)
        assert len(tracks) >= 35  # a grid of 1 mm under 7.8 x 5.9 mm
        assert (tracks["id"] == np.arange(len(tracks))[:, None]).all()
        assert (tracks["frame"] == np.arange(STEPS + 1)).all()
        for axis, motion in (("x", "u"), ("y", "v")):
            np.testing.assert_allclose(tracks[axis] - tracks[axis][:, :1], tracks[motion], atol=1e-12)
        inside = (tracks["x"][:, 0] > 2) & (tracks["x"][:, 0] < 30) & (tracks["y"][:, 0] > 2) & (tracks["y"][:, 0] < 22)
        at = tracks[inside & tracks["visible"].all(axis=1).astype(bool)]
        for frame in (0, STEPS):
            grey = clip.images[frame].mean(axis=2)
            dots = grey[at["y"][:, frame].astype(int), at["x"][:, frame].astype(int)]
            # Dots of .2 to .3 mm radius are 1.6 to 2.4 px wide; lights make the gel's brightness vary across it.
            assert dots.mean() < 0.85 * grey.mean()
        last = clip.flows[-1].forward[at["y"][:, 0].astype(int), at["x"][:, 0].astype(int)]
        # The pixel's centre is up to .7 px from the dot; the flow changes by less than .2 px over a px there.
        np.testing.assert_allclose(last, np.column_stack([at["u"][:, -1], at["v"][:, -1]]), rtol=0, atol=0.2)


def test_a_slide_is_gross_slip_and_slip_is_told_where_there_is_contact(tmp_path: Path) -> None:
    slides = ["contact.friction=0.05", "motion.shear_mm=[0.6, 0.0]", "outputs.images=false"]
    generate(load_scene(write_tiny(tmp_path), [*CLIPS[:3], *CLIPS[5:], *slides]), 1, tmp_path / "d")
    (clip,) = read_dataset(tmp_path / "d")
    for flow in clip.flows:
        assert (np.isfinite(flow.extras["slip.Y"]) == (flow.extras["contact.Y"] == 1)).all()
    assert (clip.states["gross_slip"] == (clip.states["slip_ratio"] == 1)).all()
    assert clip.states["gross_slip"][[0, -1]].tolist() == [0, 1]
    # Of the 23 pixels in contact those of the front, a strip of about one pixel, came to touch since: about 7.
    assert np.nanmean(clip.flows[-1].extras["slip.Y"]) > 0.5


@pytest.mark.slow
def test_forces_of_a_steady_slide_hardly_vary_on_the_mesh_of_slip() -> None:
    """A ball slides over two elements of a pad whose rims are far; what varies from frame to frame is the mesh's."""
    ball = 'contact.indenter={ shape = "sphere", radius_mm = 4.0 }'
    motion = "motion={ depth_mm = 0.6, position_mm = [-0.8, 0.0], shear_mm = [1.6, 0.0], steps = 16 }"
    slides = [ball, motion, "contact.friction=0.4", 'sampling.kind="clips"', "outputs.slip=true"]
    scene = draw(load_scene("gelsight_mini", slides), 0, 0)
    states = simulate_press(MeshRule.of(scene).press(scene)).states
    force = np.array([state.force_n for state in states if state.shear_mm[0] > 0.55])
    assert all(state.slip_ratio > 1 - 1e-6 for state in states if state.shear_mm[0] > 0.55)
    # With the default mesh, of 4 elements across, the pull varied by 8 %, with this one of 12 by .5 %: asked are 3 %.
    assert (np.ptp(force[:, [0, 2]], axis=0) / force[:, [0, 2]].mean(axis=0)).max() < 0.015


@pytest.mark.processes
@pytest.mark.parametrize("solver", ["single", "batched"])
def test_a_clip_that_is_killed_within_is_made_again_to_the_same_bits(
    template: Template, made: Path, tmp_path: Path, solver: str
) -> None:
    """The process ends while it writes the third flow of the second clip; workers and shards give the same files."""
    changes = ['numerics={ element = "p1p1", solver = "batched", cells = [8, 6, 2] }'] if solver == "batched" else []
    path = write_tiny(tmp_path)
    program = """
import os, sys
import synth.dataset.sample_files as files
from synth.pipeline.generate import generate
from synth.scene.template import load_scene
write, count = files.write_flow, iter(range(10**6))
files.write_flow = lambda *given: os._exit(9) if next(count) == 8 else write(*given)
generate(load_scene(sys.argv[1], sys.argv[3:]), 3, sys.argv[2])
"""
    out, overrides = tmp_path / "out", [*CLIPS, *changes]
    killed = subprocess.run([sys.executable, "-c", program, str(path), str(out), *overrides], capture_output=True)
    assert killed.returncode == 9, killed.stderr
    assert len((out / "manifest.jsonl").read_text().splitlines()) == 1
    assert list((out / "clips").glob(".*partial*"))
    again = load_scene(path, overrides)
    summary = generate(again, 3, out, scheduling=Scheduling(workers=2 if solver == "single" else None))
    assert (summary.found, summary.made) == (1, 2)
    if solver == "single":
        assert fingerprint(out) == fingerprint(made)
        return
    whole = tmp_path / "whole"
    for number in (1, 0):
        generate(again, 3, whole, scheduling=Scheduling(shard=Shard(number, 2)))
    assert fingerprint(out) == fingerprint(whole)
    assert verify_dataset(out).ok


def test_files_that_went_missing_are_made_again_with_one_picture_a_frame(template, made, copy, monkeypatch) -> None:
    rendered = []
    radiances = Renderer.radiances
    monkeypatch.setattr(Renderer, "radiances", lambda *given: rendered.append(given) or radiances(*given))
    (copy / "clips" / "000001" / "frames" / "000003.png").unlink()
    (copy / "clips" / "000002" / "meta.json").write_text("{}")
    assert generate(template, 3, copy).made == 2
    assert len(rendered) == 2 * (STEPS + 1)  # of two sensors, whose frames at rest are shared by their clips
    assert fingerprint(copy) == fingerprint(made)


def test_any_two_frames_are_a_pair_with_exact_flow(dataset: Dataset) -> None:
    clip: ClipData = dataset.read_clip(0)
    from_rest = clip.pair(0, 3)
    np.testing.assert_array_equal(from_rest.forward, clip.flows[2].forward)
    np.testing.assert_array_equal(from_rest.images[1], clip.images[3])
    neighbours = clip.pair(3, 4)
    stored = [clip.flows[3].extras[f"previous.{part}"] for part in ("U", "V")]
    np.testing.assert_array_equal(neighbours.forward, np.stack(stored, axis=-1))
    np.testing.assert_array_equal(neighbours.meta["force_n"], [clip.meta["force_n"][k] for k in (3, 4)])
    np.testing.assert_array_equal(clip.pair(3, 0).forward, from_rest.backward)
    refused("frames 1, 7: give two of 0 to 6", clip.pair, 1, 7)
    refused("holds clips, not pairs", dataset.read, 0)
    assert len(clip.images[2:4]) == 2


def test_gelflow_reads_clips_from_rest_and_frames_apart(made: Path, dataset: Dataset) -> None:
    clip = dataset.read_clip(1)
    rest, next_, third = (PairDataset(made, frames_apart=apart) for apart in (None, 1, 3))
    assert (len(rest), len(next_), len(third)) == (3 * STEPS, 3 * STEPS, 3 * (STEPS - 2))
    assert rest.names[STEPS + 3] == "000001-000000-000004"
    np.testing.assert_array_equal(np.moveaxis(rest[STEPS + 3]["flow"].numpy(), 0, -1), clip.flows[3].forward)
    np.testing.assert_array_equal(rest.truth(STEPS + 3).contact, clip.flows[3].extras["contact.Y"] == 1)
    assert next_.names[STEPS + 3] == "000001-000003-000004"
    np.testing.assert_array_equal(next_[STEPS + 3]["flow"].numpy()[0], clip.flows[3].extras["previous.U"])
    # float32 in [0, 1]: rounded to at most 2^-24, by one division.
    image = np.moveaxis(next_[STEPS + 3]["image1"].numpy(), 0, -1) * 255
    np.testing.assert_allclose(image, clip.images[3], atol=1e-4)
    known = [np.isfinite(item["flow"].numpy()).any() for item in third]
    assert known == 3 * [True, False, False, False]  # from rest alone
    refused("frames_apart = 0: at least 1", PairDataset, made, None, 0)


def test_without_images_nothing_is_rendered_and_the_rest_is_the_same(
    template: Template, dataset: Dataset, tmp_path: Path, capsys
) -> None:
    """In fresh processes: neither the driver nor its workers load a renderer, which takes a second to import."""
    program = """
import sys
from synth.pipeline.generate import generate
from synth.pipeline.worker_pool import render_on_one_core
from synth.planning import plan
from synth.scene.template import load_scene
scene = load_scene(sys.argv[1], sys.argv[3:])
render_on_one_core(plan(scene))
generate(scene, 1, sys.argv[2])
assert not {"mitsuba", "drjit"} & set(sys.modules)
"""
    out, overrides = tmp_path / "d", [*CLIPS, "outputs.images=false"]
    command = [sys.executable, "-c", program, str(write_tiny(tmp_path)), str(out), *overrides]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (clip,) = read_dataset(out)
    assert (len(clip.images), clip.pair(0, 2).images, clip.pair(1, 2).images) == (0, (), ())
    assert clip.meta["image"] == {"width": 32, "height": 24, "channels": None, "bits": None}
    assert verify_dataset(out).ok
    # Another scene's hash draws another instance: the same geometry is asked for by common draws.
    pair = [load_scene(write_tiny(tmp_path), [*CLIPS, "sampling.common_draws=true", f"outputs.images={on}"])
            for on in ("true", "false")]  # fmt: skip
    for number, one in enumerate(pair):
        generate(one, 1, tmp_path / str(number))
    with_images, without = (next(iter(read_dataset(tmp_path / str(number)))) for number in (0, 1))
    for one, two in zip(with_images.flows, without.flows, strict=True):
        np.testing.assert_array_equal(one.forward, two.forward)
        np.testing.assert_array_equal(one.extras["slip.Y"], two.extras["slip.Y"])
    assert (with_images.states == without.states).all()
    refused("has no images; it was made with outputs.images = false", PairDataset, out)
    assert "samples" in said(capsys, main, "inspect", out, "--html", tmp_path / "p.html", "--png", tmp_path / "p.png")
    assert predict(plan(pair[1], job_variant(pair[1], "cpu"))).seconds_per_pair["render"] == 0


def test_pairs_without_images_are_read_and_verified(tmp_path: Path) -> None:
    generate(load_scene(write_tiny(tmp_path), ["outputs.images=false"]), 1, tmp_path / "d")
    (sample,) = read_dataset(tmp_path / "d")
    assert (sample.images, sample.image1) == ((), None)
    assert verify_dataset(tmp_path / "d").ok
    refused("holds no images, which --format npz is not for", export, tmp_path / "d", "npz", tmp_path / "o")


def test_inspect_plays_the_film_and_tells_the_states(made: Path, dataset: Dataset, tmp_path: Path, capsys) -> None:
    command = ("inspect", made, "--html", tmp_path / "p.html", "--png", tmp_path / "p.png", "--json")
    found = json.loads(said(capsys, main, *command))
    assert [one["frames"] for one in found["samples"]] == 3 * [[0, STEPS]]
    clip = dataset.read_clip(2)
    assert found["samples"][2]["states"]["fz_n"] == clip.states["fz_n"].tolist()
    page = (tmp_path / "p.html").read_text()
    films = [Image.open(io.BytesIO(b64decode(text))) for text in re.findall(r"data:image/webp;base64,([^\"]+)", page)]
    assert [(film.n_frames, film.size) for film in films] == 3 * [(STEPS + 1, (64, 24))]  # image and flow
    films[2].seek(STEPS)
    shown = np.asarray(films[2].convert("RGB"))[:, :32].astype(float)
    assert np.abs(shown - clip.images[STEPS]).mean() < np.abs(shown - clip.images[0]).mean()
    assert "script" not in page
    one = json.loads(said(capsys, main, "inspect", made / "clips" / "000001", "--json"))
    assert one["samples"][0] == found["samples"][1]


def test_clips_as_hdf5_hold_what_the_clips_hold(made: Path, dataset: Dataset, tmp_path: Path, capsys) -> None:
    h5py = pytest.importorskip("h5py")
    assert "left out: surface.npz" in said(capsys, main, "export", made, "--format", "hdf5", "--out", tmp_path / "o")
    with h5py.File(tmp_path / "o" / "dataset.hdf5") as whole:
        assert (len(whole["data"]), whole["data"].attrs["total"]) == (3, 3 * (STEPS + 1))
        for number, clip in enumerate(dataset):
            demo, obs = whole[f"data/demo_{number}"], whole[f"data/demo_{number}/obs"]
            assert demo.attrs["num_samples"] == len(demo["actions"]) == len(demo["dones"]) == STEPS + 1
            np.testing.assert_array_equal(obs["rgb"], np.array(clip.images))
            np.testing.assert_array_equal(obs["flow"][1:], [flow.forward for flow in clip.flows])
            np.testing.assert_array_equal(obs["slip.Y"][1:], [flow.extras["slip.Y"] for flow in clip.flows])
            assert (obs["flow"][0] == 0).all()
            tracks = clip.markers.reshape(-1, STEPS + 1)
            np.testing.assert_array_equal(obs["marker"][4, 1, :, 0], tracks["x"][:, 4])
            np.testing.assert_array_equal(obs["marker"][4, 0, :, 1], tracks["y"][:, 0])
            np.testing.assert_array_equal(obs["wrench"][:, 2], clip.states["fz_n"])
            np.testing.assert_array_equal(demo["actions"][:-1, 1], clip.states["shear_x_mm"][1:])
    with h5py.File(tmp_path / "o" / "hdf5" / "1.hdf5") as episode:
        assert json.loads(episode.attrs["meta"]) == dataset.read_clip(1).meta
        np.testing.assert_array_equal(episode["states/slip_ratio"], dataset.read_clip(1).states["slip_ratio"])
    export(made, "hdf5", tmp_path / "again")
    for name in ("dataset.hdf5", "hdf5/2.hdf5"):
        assert (tmp_path / "o" / name).read_bytes() == (tmp_path / "again" / name).read_bytes()
    refused(
        "holds clips, which --format flo is not for; allowed: hdf5, lerobot, rrd", export, made, "flo", tmp_path / "flo"
    )


def test_clips_as_a_lerobot_dataset_are_tables_of_frames(made: Path, dataset: Dataset, tmp_path: Path, capsys) -> None:
    pq = pytest.importorskip("pyarrow.parquet")
    command = ("export", made, "--format", "lerobot", "--out", tmp_path / "o")
    assert "markers.csv" in said(capsys, main, *command)
    info = json.loads((tmp_path / "o" / "meta" / "info.json").read_text())
    assert (info["total_episodes"], info["total_frames"], info["fps"]) == (3, 3 * (STEPS + 1), 25)
    rows = [
        row for k in range(3) for row in pq.read_table(tmp_path / f"o/data/chunk-000/file-{k:03d}.parquet").to_pylist()
    ]
    assert set(rows[0]) == set(info["features"])
    assert [row["index"] for row in rows] == [*range(3 * (STEPS + 1))]
    for number, clip in enumerate(dataset):
        for frame, row in enumerate(rows[number * (STEPS + 1) : (number + 1) * (STEPS + 1)]):
            image = np.asarray(Image.open(io.BytesIO(row["observation.images.tactile"]["bytes"])))
            np.testing.assert_array_equal(image, clip.images[frame])
            assert row["observation.wrench"][2] == clip.states["fz_n"][frame]
            assert row["action"][1] == clip.states["shear_x_mm"][min(frame + 1, STEPS)]
            if frame:
                np.testing.assert_array_equal(np.float32(row["tactile.flow"]), clip.flows[frame - 1].forward)
                np.testing.assert_array_equal(row["tactile.slip.Y"], clip.flows[frame - 1].extras["slip.Y"])
    stats = json.loads((tmp_path / "o" / "meta" / "stats.json").read_text())
    wrench = np.array([row["observation.wrench"] for row in rows])
    for name in ("min", "max", "mean", "std"):  # of three clips, one after the other
        np.testing.assert_allclose(stats["observation.wrench"][name], getattr(wrench, name)(axis=0), rtol=1e-9)
    pictures = np.array([clip.images[frame] for clip in dataset for frame in range(STEPS + 1)]) / 255
    np.testing.assert_allclose(np.ravel(stats["observation.images.tactile"]["std"]), pictures.std(axis=(0, 1, 2)))


@pytest.mark.slow
def test_lerobots_own_loader_reads_the_clips(made: Path, dataset: Dataset, tmp_path: Path) -> None:
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    export(made, "lerobot", tmp_path / "o")
    loaded = lerobot.LeRobotDataset("clips", root=tmp_path / "o", delta_timestamps={"action": [0.0, 0.04]})
    assert (len(loaded), loaded.num_episodes) == (3 * (STEPS + 1), 3)
    clip, item = dataset.read_clip(1), loaded[STEPS + 1 + 4]
    # Pictures are float32 in [0, 1], rounded by one division.
    picture = np.moveaxis(item["observation.images.tactile"].numpy(), 0, -1) * 255
    np.testing.assert_allclose(picture, clip.images[4], atol=1e-4)
    np.testing.assert_array_equal(item["tactile.flow"].numpy(), clip.flows[3].forward)
    np.testing.assert_allclose(item["action"][:, 1], clip.states["shear_x_mm"][5:7], rtol=1e-6)
    assert (item["task"], int(item["frame_index"]), int(item["episode_index"])) == ("tiny", 4, 1)


def test_clips_as_recordings_hold_pictures_flow_markers_and_wrench(made: Path, dataset: Dataset, tmp_path) -> None:
    chunk = pytest.importorskip("rerun.chunk")
    export(made, "rrd", tmp_path / "o")
    assert sorted(file.name for file in (tmp_path / "o").iterdir()) == [f"00000{k}.rrd" for k in range(3)]
    columns: dict[str, list] = {}
    for part in chunk.RrdReader(tmp_path / "o" / "000002.rrd").stream():
        batch = part.to_record_batch()
        for name in set(batch.schema.names) - {"log_time"}:  # when this test ran, in ns
            columns.setdefault(f"{part.entity_path} {name}", []).extend(batch.column(name).to_pylist())
    clip = dataset.read_clip(2)
    assert columns["/force_n frame"] == [*range(STEPS + 1)]
    assert [row[2] for row in columns["/force_n Scalars:scalars"]] == clip.states["fz_n"].tolist()
    assert [time.total_seconds() for time in columns["/slip_ratio time"]] == clip.states["time_s"].tolist()
    assert bytes(columns["/tactile Image:buffer"][3][0]) == clip.images[3].tobytes()
    marks = clip.markers[clip.markers["frame"] == 4]
    expected = np.column_stack([marks["x"], marks["y"]]).astype(np.float32)
    np.testing.assert_array_equal(columns["/tactile/markers Points2D:positions"][4], expected)
    for name in ("/tactile/flow", "/tactile/slip.Y", "/tactile/motion"):
        assert len(columns[f"{name} frame"]) >= STEPS


def test_plan_tells_seconds_and_bytes_of_a_clip_and_pairs_have_no_frame_before(made: Path, tmp_path, capsys) -> None:
    path = write_tiny(tmp_path)
    options = [word for change in CLIPS for word in ("--set", change)]
    found = json.loads(said(capsys, main, "plan", "--scene", path, *options, "--json"))
    assert set(found["seconds_per_clip"]) == {"simulate", "render", "flow"}
    # What is kept beside images and flow, some 20 kB, is as much as these at 32 x 24 pixels.
    size = sum(file.stat().st_size for file in (made / "clips" / "000000").rglob("*.[pe][nx][gr]"))
    assert size / 3 < found["bytes_per_clip"] < 3 * size
    assert "predicted per clip" in said(capsys, main, "plan", "--scene", path, *options)
    for name in ("slip", "previous"):
        message = rf'outputs\.{name} = true: pairs have no frame before; give sampling\.kind = "clips"'
        refused(message, lambda name=name: load_scene(path, [f"outputs.{name}=true"]).corners)


def test_further_cameras_have_frames_flow_and_markers_of_their_own(tmp_path: Path, capsys) -> None:
    h5py = pytest.importorskip("h5py")
    view = "width = 40, height = 30, fx = 95, fy = 95, cx = 20, cy = 15, read_noise = 0.002"
    left = f'further_cameras = [{{ name = "left", position_mm = [-2.0, 0.5, 19.0], {view} }}]\n[sensor.camera]'
    text = TEXT.replace("[sensor.camera]", left)
    generate(load_scene(write_tiny(tmp_path, text), [*CLIPS[:1], *CLIPS[4:], "motion.steps=2"]), 1, tmp_path / "d")
    dataset = read_dataset(tmp_path / "d")
    main_clip, clip = dataset.read_clip(0), dataset.read_clip(0, "left")
    assert set(dataset.entry(0).sha256) >= {"left/frames/000002.png", "left/flow/000001.exr", "left/markers.csv"}
    assert (clip.images[1].shape, clip.pair(1, 2).forward.shape) == ((30, 40, 3), (30, 40, 2))
    stored = [clip.flows[1].extras[f"previous.{part}"] for part in ("U", "V")]
    np.testing.assert_array_equal(clip.pair(1, 2).forward, np.stack(stored, axis=-1))
    assert (main_clip.states == clip.states).all()
    assert np.abs(main_clip.markers["x"][:9] - clip.markers["x"][:9]).max() > 1
    checks = [check.name for check in verify_dataset(tmp_path / "d").samples[0].checks if check.passed]
    assert {"forward flow", "left: forward flow", "left: previous visibility"} <= set(checks)
    assert verify_dataset(tmp_path / "d").ok
    found = json.loads(said(capsys, main, "inspect", tmp_path / "d", "--html", tmp_path / "p.html", "--json"))
    assert [one["name"] for one in found["samples"]] == ["000000", "000000/left"]
    assert (tmp_path / "p.html").read_text().count("data:image/webp") == 2
    refused("has no camera 'right'; beside the main camera it has: left", dataset.read_clip, 0, "right")
    export(tmp_path / "d", "hdf5", tmp_path / "o")
    with h5py.File(tmp_path / "o" / "hdf5" / "0.hdf5") as episode:
        np.testing.assert_array_equal(episode["tactile/left/rgb"], np.array(clip.images))
