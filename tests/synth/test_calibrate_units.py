"""A scene that covers several calibrated units."""

from pathlib import Path

import pytest
import tomli_w
from commands import complaint, said

from synth.cli import main
from synth.scene.template import load_scene


def _unit(folder: Path, **changes: object) -> Path:
    """A folder of calibrate's with the lights of `digit`, changed."""
    content = load_scene("digit", ["sensor.camera.vignetting=0.2"]).content
    content["sensor"]["camera"] |= changes.pop("camera", {})
    red, green, blue = content["sensor"]["lights"]
    for light, place in ((red, [0.0, -11.9, 5.5]), (green, [-9.4, 3.0, 5.5]), (blue, [9.4, 3.0, 5.5])):
        light |= {"position_mm": place, "power": 1900.0}
    content["sensor"]["lights"] = changes.pop("lights", lambda *lights: list(lights))(red, green, blue)
    folder.mkdir()
    (folder / "scene.toml").write_text(tomli_w.dumps(content))
    return folder


def test_what_differs_between_units_is_a_distribution_and_the_rest_is_kept(tmp_path: Path, capsys) -> None:
    """Lights in another order belong together; one that a unit lacks is dark there."""
    first = _unit(tmp_path / "a")
    moved = {"position_mm": [0.8, -11.9, 5.5], "power": 1500.0, "color": [1.0, 0.1, 0.25]}
    second = _unit(
        tmp_path / "b",
        lights=lambda red, green, blue: [green, red | moved],
        camera={"vignetting": 0.3, "rest_map": "m.png"},
    )
    (second / "m.png").touch()
    out = tmp_path / "units"
    assert "covers 2 units with 3 lights" in said(capsys, main, "calibrate", "--units", first, second, "--out", out)
    content = load_scene(out / "scene.toml").content
    red, green, blue = content["sensor"]["lights"]
    assert red["position_mm"] == [{"uniform": [0.0, 0.8]}, -11.9, 5.5]
    assert (red["power"], red["color"]) == ({"uniform": [1500.0, 1900.0]}, [1.0, {"uniform": [0.1, 0.2]}, 0.25])
    assert green == load_scene(first / "scene.toml").content["sensor"]["lights"][1]
    assert blue["power"]["uniform"][0] == 0
    camera = content["sensor"]["camera"]
    assert (camera["vignetting"], "rest_map" in camera) == ({"uniform": [0.2, 0.3]}, False)


@pytest.mark.parametrize(
    ("camera", "message"),
    [({"width": 160}, "sensor.camera.width is '240' and '160'; give units of one kind"),
     ({"lens": "fisheye"}, "sensor.camera")],
)  # fmt: skip
def test_units_of_two_kinds_are_refused(tmp_path: Path, capsys, camera: dict, message: str) -> None:
    first, second = _unit(tmp_path / "a"), _unit(tmp_path / "b", camera=camera)
    assert message in complaint(capsys, main, "calibrate", "--units", first, second, "--out", tmp_path / "c")


def test_one_unit_is_refused(tmp_path: Path, capsys) -> None:
    said = complaint(capsys, main, "calibrate", "--units", _unit(tmp_path / "a"), "--out", tmp_path / "b")
    assert "--units: give two or more" in said
