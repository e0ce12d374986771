"""Several cameras: one scene rendered from each, its files, and everything that reads them."""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from commands import refused
from render_scenes import FAST, SCALAR, flat_surface, plain, rendered, small_sensor
from tiny_scene import CONTACT, LIGHTS, SENSOR, fingerprint, own_cache, write_tiny

from synth.dataset.export import export, left_out
from synth.dataset.exr import read_flow, write_flow
from synth.dataset.reader import read_dataset
from synth.inspect import inspect, tables, write_html, write_sheet
from synth.pipeline.generate import generate
from synth.render.renderer import Renderer
from synth.scene import FurtherCamera, Mirror, Render, Sensor
from synth.scene.template import load_scene
from synth.verify import verify_dataset

VIEW = "width = 40, height = 30, fx = 95, fy = 95, cx = 20, cy = { normal = [15.0, 0.2] }, read_noise = 0.001"
LEFT = f'further_cameras = [{{ name = "left", position_mm = [-2.0, 0.5, 19.0], {VIEW} }}]'
TEXT = SENSOR.replace("[sensor.camera]", f"{LEFT}\n[sensor.camera]") + LIGHTS + CONTACT
OTHER = {"width": 48, "height": 40, "fx": 120.0, "fy": 120.0, "cx": 24.0, "cy": 20.0, "position_mm": (2.0, 0.0, 19.0)}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cameras")
    with pytest.MonkeyPatch.context() as patch:
        own_cache(patch)
        generate(load_scene(write_tiny(folder, TEXT)), 2, folder / "data")
    return folder / "data"


def test_each_camera_has_its_files_and_is_read_and_exported_by_its_name(dataset, tmp_path) -> None:
    names, data = {"image1.png", "image2.png", "flow.exr"}, read_dataset(dataset)
    for index in (0, 1):
        assert set(data.entry(index).sha256) == names | {"meta.json", "surface.npz"} | {f"left/{n}" for n in names}
        assert data.check_hashes(index) == []
    header = json.loads((dataset / "samples" / "000000" / "meta.json").read_text())
    assert header["scene"]["sensor"]["further_cameras"][0]["name"] == "left"
    main, left = data.read(0), data.read(0, "left")
    assert (main.image1.shape, left.image1.shape, left.image2.shape) == ((24, 32, 3), (30, 40, 3), (30, 40, 3))
    assert left.flow.forward.shape == (30, 40, 2)
    np.testing.assert_array_equal(left.displacement2, main.displacement2)
    np.testing.assert_array_equal(main.further["left"].image2, left.image2)
    refused(r"no camera 'right'.*left", data.read, 0, "right")
    assert export(dataset, "flo", tmp_path / "left", camera="left") == 2
    files = tmp_path / "left" / "data"
    assert np.frombuffer((files / "000000_flow.flo").read_bytes()[4:12], "<i4").tolist() == [40, 30]
    np.testing.assert_array_equal(cv2.imread(str(files / "000000_img2.ppm"))[..., ::-1], left.image2)
    assert left_out(dataset, "", "flo").endswith(", pairs of left")
    assert left_out(dataset, "left", "flo").endswith(", pairs of the main camera")


def test_verify_checks_every_camera(dataset, tmp_path):
    report = verify_dataset(dataset)
    assert report.ok, report.record()
    names = {check.name for check in report.samples[0].checks}
    assert {"forward flow", "left: forward flow", "left: backward visibility"} <= names
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    path = copy / "samples" / "000001" / "left" / "flow.exr"
    flow = read_flow(path)
    flow.forward[15, 20, 0] += np.float32(0.05)
    write_flow(path, flow, {})
    damaged = verify_dataset(copy)
    failed = {check.name for check in damaged.samples[1].checks if not check.passed}
    assert {"files", "left: forward flow"} <= failed
    assert "forward flow" not in failed
    shutil.rmtree(path.parent)
    assert not verify_dataset(copy).samples[1].ok


def test_inspection_shows_every_camera(dataset, tmp_path):
    found = inspect(dataset)
    assert [numbers["name"] for numbers in found.numbers] == ["000000", "000000/left", "000001", "000001/left"]
    assert [numbers["width"] for numbers in found.numbers] == [32, 40, 32, 40]
    assert found.about["inspected"] == 2
    assert found.spread(2) == [0, 1]  # all cameras of a sample or none
    assert found.spread(4) == [0, 1, 2, 3]
    sample = inspect(dataset / "samples" / "000001")
    assert len(sample.places) == len(tables(sample)) == 2
    for name, inspection in (("dataset", found), ("sample", sample)):
        write_sheet(inspection, tmp_path / f"{name}.png")
        write_html(inspection, tmp_path / f"{name}.html")
        assert "left" in (tmp_path / f"{name}.html").read_text()
    alone = inspect(dataset / "samples" / "000001" / "left")
    assert alone.numbers[0]["name"] == "000001/left"


def test_a_sample_without_a_cameras_file_is_made_again(dataset, tmp_path, monkeypatch):
    own_cache(monkeypatch)
    copy = Path(shutil.copytree(dataset, tmp_path / "copy"))
    (copy / "samples" / "000001" / "left" / "flow.exr").unlink()
    summary = generate(load_scene(write_tiny(tmp_path, TEXT)), 2, copy)
    assert (summary.made, summary.found) == (1, 1)
    assert fingerprint(copy) == fingerprint(dataset)


def _with_other(**changes: object) -> Sensor:
    camera = FurtherCamera.model_validate({"name": "other", **OTHER, **changes})
    return small_sensor(1.45).model_copy(update={"further_cameras": (camera,)})


def test_a_further_camera_changes_no_bit_of_the_main_one():
    frames = []
    for sensor in (small_sensor(1.45), _with_other()):
        surface, render = flat_surface(sensor), Render(samples_per_pixel=9, max_depth=2)
        frames.append(Renderer(sensor, render, surface, plain(), FAST).radiances(surface.material, 5))
    assert [list(frame) for frame in frames] == [[""], ["", "other"]]
    np.testing.assert_array_equal(frames[0][""], frames[1][""])
    assert frames[1]["other"].shape == (40, 48, 3)
    assert frames[1]["other"].mean() > 0


def test_names_sizes_lights_and_scalar_variants_that_further_cameras_cannot_have_are_refused() -> None:
    sensor = json.loads(_with_other().model_dump_json())
    with pytest.raises(ValueError, match="names must differ"):
        Sensor.model_validate({**sensor, "further_cameras": 2 * sensor["further_cameras"]})
    refused(r"further_cameras 'other': sensor.lights\[0\].*between the camera", rendered, _with_other(fx=40.0, fy=40.0))
    mirror = Mirror(position_mm=(3.0, 0.0, 12.0), normal=(-1, 0, 0), size_mm=(4.0, 4.0))
    mirrored = small_sensor(1.45).model_copy(update={"mirrors": (mirror,)})
    for sensor in (mirrored, small_sensor(1.45, lens="fisheye", distortion=(0.0, 0.0, 0.0, 0.0))):
        refused("needs LLVM 16 or newer", rendered, sensor, variant=SCALAR)
