"""PNG, JSON lines and flow.exr: exact, the same bytes every time, and honest about damage."""

import json
import os
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest
from commands import refused
from kinematic_double import assert_same_flow
from PIL import Image
from samples import translation_sample

from synth.dataset.exr import OPTIONAL, channels_of, read_channels, read_flow, write_flow
from synth.dataset.images import encode_png, read_png
from synth.dataset.jsontext import jsonable, read_document, to_document, to_line
from synth.dataset.manifest import append_line, merge_lines, read_line, scan_lines
from synth.flow.field import FlowField
from synth.scene import Outputs

RNG = np.random.default_rng(0)
FLOW = translation_sample(5).flow
ATTRIBUTES: dict[str, str | int] = {"scene.hash": "abc", "seed": str(2**63), "index": 5}


def test_png_is_rgb_for_other_readers_and_other_kinds_or_damage_are_refused(tmp_path) -> None:
    """Red first: an independent reader must not see blue."""
    (tmp_path / "a.png").write_bytes(encode_png(np.full((4, 5, 3), (200, 0, 0), np.uint8)))
    assert Image.open(tmp_path / "a.png").getpixel((0, 0)) == (200, 0, 0)
    data, path = encode_png(RNG.integers(0, 255, (12, 12, 3)).astype(np.uint8)), tmp_path / "a.png"
    for size in range(len(data)):
        path.write_bytes(data[:size])
        refused(r"a\.png", read_png, path)
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :])
    refused("checksum", read_png, path)


def test_json_is_exact_and_damage_named(tmp_path) -> None:
    value = {"x": np.float64(0.1) + 0.2, "nan": np.nan, "v": np.arange(3), "t": (1, True), "s": "[\n 1]", "e": []}
    document = to_document(value)
    expected = {"x": 0.1 + 0.2, "nan": None, "v": [0, 1, 2], "t": [1, True], "s": "[\n 1]", "e": []}
    assert json.loads(document) == expected
    assert '"v": [0, 1, 2]' in document
    assert json.loads(to_line(value)) == json.loads(document)
    with pytest.raises(TypeError, match="no JSON form"):
        jsonable({"a": object()})
    (tmp_path / "a.json").write_text("{", encoding="utf-8")
    refused(r"a\.json.*not valid JSON", read_document, tmp_path / "a.json")


def _index(record):
    return int(record["index"])


def test_lines_are_found_sorted_and_repaired_and_a_damaged_one_is_named(tmp_path) -> None:
    path = tmp_path / "a.jsonl"
    for index in (3, 1, 2, 1):
        append_line(path, {"index": index, "place": path.stat().st_size if path.exists() else 0})
    table = scan_lines(path, _index)
    assert not table.tidy
    first, second = (read_line(path, table.places[index])["place"] for index in (1, 2))
    assert first > second  # the later one counts
    assert merge_lines(path, _index) == {1, 2, 3}
    assert [json.loads(line)["index"] for line in path.read_text().splitlines()] == [1, 2, 3]
    assert scan_lines(path, _index).tidy
    path.write_text('{"index": 1}\n{"ind\n{"index": 3}\n')
    refused(r"a\.jsonl: line 2 is damaged", scan_lines, path, _index)


@pytest.mark.parametrize("torn", ['{"index": 9', '{"index": 9}', '{"other": 9}\n', "\0\0\0\n"])
def test_torn_last_line_does_not_count(tmp_path, torn):
    path = tmp_path / "a.jsonl"
    append_line(path, {"index": 1})
    with path.open("a") as file:
        file.write(torn)
    table = scan_lines(path, _index)
    assert (list(table.places), table.tidy) == ([1], False)


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "flow.exr"
    write_flow(path, FLOW, ATTRIBUTES)
    return path


def test_file_as_the_library_sees_it_and_a_round_trip_to_the_bit(path) -> None:
    """Channel names, type, compression and conventions are the contract with other programs."""
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header, channels = file.header(), file.channels()
        assert header["compression"] == OpenEXR.ZIP_COMPRESSION
        assert {channel.type() for channel in channels.values()} == {OpenEXR.FLOAT}
        names = {f"{d}.{c}" for d in ("forward", "backward") for c in ("U", "V", "visible")}
        assert set(channels) == names | {"contact.Y", "R", "G", "B"}
        np.testing.assert_array_equal(channels["forward.V"].pixels, FLOW.forward[..., 1])
        assert "I1(x) = I2(x + forward(x))" in header["flow.directions"]
        assert "(c + 0.5, r + 0.5)" in header["flow.pixelCentre"]
        assert header["flow.units"] == "px"
        assert [key for key in header if key.startswith("channels.")] == ["channels.contact"]
        assert (header["scene.hash"], header["seed"], header["index"]) == ("abc", str(2**63), 5)
    found = read_flow(path)
    assert_same_flow(found, FLOW)
    assert list(found.extras) == ["contact.Y"]
    np.testing.assert_array_equal(found.extras["contact.Y"], FLOW.extras["contact.Y"], strict=True)
    before = path.read_bytes()
    write_flow(path, FLOW, ATTRIBUTES)
    assert path.read_bytes() == before
    write_flow(path, FlowField(FLOW.forward, FLOW.forward_visible), {})
    alone = read_flow(path)
    assert (alone.backward, alone.backward_visible, dict(alone.extras)) == (None, None, {})


def test_header_tells_what_the_optional_channels_are_and_missing_ones_are_listed(tmp_path) -> None:
    extras = {name: FLOW.forward_visible for names, _ in OPTIONAL.values() for name in names}
    write_flow(tmp_path / "f.exr", FlowField(FLOW.forward, FLOW.forward_visible, extras=extras), {})
    header = read_channels(tmp_path / "f.exr")[1]
    assert {key for key in header if key.startswith("channels.")} == {f"channels.{key}" for key in OPTIONAL}
    assert set(OPTIONAL) == set(Outputs.model_fields) - {"backward", "images"}
    assert "MPa" in header["channels.traction"]
    assert "per undeformed area" in header["channels.traction"]
    planes = {name: plane for name, plane in channels_of(FLOW).items() if name not in ("forward.V", "backward.visible")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(dict(header), dict(planes)).write(str(tmp_path / "part.exr"))  # It changes both dictionaries.
    refused(r"lacks the channel forward\.V; it has .*forward\.U", read_flow, tmp_path / "part.exr")
    planes["forward.V"] = planes["forward.U"]
    OpenEXR.File(header, planes).write(str(tmp_path / "part.exr"))
    refused(r"lacks the channel backward\.visible", read_flow, tmp_path / "part.exr")


def test_opencv_reads_the_forward_flow(path):
    """OpenCV reads channels called R, G, B only, if it has been built with OpenEXR at all (its 5.0 wheels have not)."""
    code = (
        "import cv2, sys, numpy as np\n"
        "if not cv2.haveImageReader(sys.argv[1]) or 'OpenEXR:                     NO' in cv2.getBuildInformation():\n"
        "    sys.exit(77)\n"
        "image = cv2.imread(sys.argv[1], cv2.IMREAD_UNCHANGED)\n"
        "np.save(sys.argv[2], image[:, :, ::-1])\n"
    )
    out, environment = path.with_name("seen.npy"), {**os.environ, "OPENCV_IO_ENABLE_OPENEXR": "1"}
    done = subprocess.run([sys.executable, "-c", code, path, out], env=environment, check=False)
    if done.returncode == 77:
        with OpenEXR.File(str(path)) as file:  # The same three channels, as the library groups them for such programs.
            seen = file.channels()["RGB"].pixels
    else:
        assert done.returncode == 0
        seen = np.load(out)
    np.testing.assert_array_equal(seen, np.dstack([FLOW.forward, FLOW.forward_visible]))


def test_every_truncation_and_damaged_pixels_are_named(path, capfd):
    data = path.read_bytes()
    for size in [*range(0, len(data), 7), int(0.9995 * len(data))]:
        path.write_bytes(data[:size])
        refused(r"flow\.exr.*(truncated|not an OpenEXR)", read_channels, path)
    assert capfd.readouterr() == ("", "")  # one message, not the library's remarks beside it
    path.write_bytes(data[:-200] + bytes(byte ^ 0xFF for byte in data[-200:]))
    refused("damaged", read_channels, path)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + b"0" * 500, b"\x76\x2f\x31\x01"])
def test_foreign_file_is_named(tmp_path, content):
    (tmp_path / "other.exr").write_bytes(content)
    refused(r"other\.exr", read_channels, tmp_path / "other.exr")
    refused(r"missing\.exr.*there is no such file", read_channels, tmp_path / "missing.exr")
