"""flow.exr: round trip, channels and header as other programs see them, and damaged files."""

import os
import subprocess
import sys

import numpy as np
import OpenEXR
import pytest
from samples import translation_sample

from synth.dataset.exr import channels_of, read_channels, read_flow, write_flow
from synth.dataset.exr_channels import OPTIONAL
from synth.errors import InputError
from synth.flow.field import FlowField
from synth.scene import Outputs

FLOW = translation_sample(5).flow
ATTRIBUTES: dict[str, str | int] = {"scene.hash": "abc", "seed": str(2**63), "index": 5}


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "flow.exr"
    write_flow(path, FLOW, ATTRIBUTES)
    return path


def test_round_trip_is_exact_and_bytes_are_the_same(path):
    found = read_flow(path)
    for name in ("forward", "forward_visible", "backward", "backward_visible"):
        np.testing.assert_array_equal(getattr(found, name), getattr(FLOW, name), strict=True)
    assert list(found.extras) == ["contact.Y"]
    np.testing.assert_array_equal(found.extras["contact.Y"], FLOW.extras["contact.Y"], strict=True)
    before = path.read_bytes()
    write_flow(path, FLOW, ATTRIBUTES)
    assert path.read_bytes() == before
    write_flow(path, FlowField(FLOW.forward, FLOW.forward_visible), {})
    alone = read_flow(path)
    assert (alone.backward, alone.backward_visible, dict(alone.extras)) == (None, None, {})


def test_file_as_the_library_sees_it(path):
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


def test_header_tells_what_the_optional_channels_are(tmp_path):
    extras = {name: FLOW.forward_visible for part in OPTIONAL.values() for name in part.names}
    write_flow(tmp_path / "f.exr", FlowField(FLOW.forward, FLOW.forward_visible, extras=extras), {})
    header = read_channels(tmp_path / "f.exr")[1]
    assert {key for key in header if key.startswith("channels.")} == {f"channels.{key}" for key in OPTIONAL}
    assert set(OPTIONAL) == set(Outputs.model_fields) - {"backward"}
    assert "MPa" in header["channels.traction"]
    assert "per undeformed area" in header["channels.traction"]


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
        with pytest.raises(InputError, match=r"flow\.exr.*(truncated|not an OpenEXR)"):
            read_channels(path)
    assert capfd.readouterr() == ("", "")  # one message, not the library's remarks beside it
    path.write_bytes(data[:-200] + bytes(byte ^ 0xFF for byte in data[-200:]))
    with pytest.raises(InputError, match="damaged"):
        read_channels(path)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + b"0" * 500, b"\x76\x2f\x31\x01"])
def test_foreign_file_is_named(tmp_path, content):
    (tmp_path / "other.exr").write_bytes(content)
    with pytest.raises(InputError, match=r"other\.exr"):
        read_channels(tmp_path / "other.exr")
    with pytest.raises(InputError, match=r"missing\.exr.*No such file"):
        read_channels(tmp_path / "missing.exr")


def test_missing_channels_are_listed(tmp_path):
    planes = {name: plane for name, plane in channels_of(FLOW).items() if name not in ("forward.V", "backward.visible")}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(dict(header), dict(planes)).write(str(tmp_path / "part.exr"))  # It changes both dictionaries.
    with pytest.raises(InputError, match=r"lacks the channel forward\.V; it has .*forward\.U"):
        read_flow(tmp_path / "part.exr")
    planes["forward.V"] = planes["forward.U"]
    OpenEXR.File(header, planes).write(str(tmp_path / "part.exr"))
    with pytest.raises(InputError, match=r"lacks the channel backward\.visible"):
        read_flow(tmp_path / "part.exr")
