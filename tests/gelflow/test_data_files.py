"""Images and flow files: what is written comes back; what is broken is named."""

import errno
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image, ImageOps
from textures import as_bytes, moved, save

from gelflow.arrays import FlowArray
from gelflow.errors import InputError
from gelflow.files.atomic import replacing
from gelflow.files.exr import read_channels, read_flow, write_flow
from gelflow.files.flo import write_flo
from gelflow.files.image import read_image, read_pair, write_png


def some_flow() -> FlowArray:
    flow = np.random.default_rng(0).normal(size=(17, 23, 2)).astype(np.float32)
    flow[2, 3] = np.nan
    return flow


def test_flo_is_middleburys_layout_as_opencv_reads_it_and_exr_keeps_every_bit(tmp_path: Path) -> None:
    write_flo(tmp_path / "a.flo", some_flow())
    found = cv2.readOpticalFlow(str(tmp_path / "a.flo"))
    np.testing.assert_array_equal(np.where(found > 1e9, np.nan, found), some_flow())
    write_flo(tmp_path / "a.flo", np.arange(12, dtype=np.float32).reshape(2, 3, 2))
    data = (tmp_path / "a.flo").read_bytes()
    assert (data[:4], np.frombuffer(data, "<i4", 2, 4).tolist()) == (b"PIEH", [3, 2])
    assert np.frombuffer(data, "<f4", -1, 12).tolist() == list(range(12))
    visible = np.ones((17, 23), bool)
    visible[5] = False
    write_flow(tmp_path / "a.exr", some_flow(), visible)
    field = read_flow(tmp_path / "a.exr")
    np.testing.assert_array_equal(field.flow, some_flow())
    visible[2, 3] = False  # no gel there
    np.testing.assert_array_equal(field.visible, visible)
    assert sorted(read_channels(tmp_path / "a.exr")) == ["forward.U", "forward.V", "forward.visible"]
    with pytest.raises(InputError, match=r"a\.exr.*backward\.U"):
        read_flow(tmp_path / "a.exr", "backward")


@pytest.mark.parametrize("name", ["a.png", "a.jpg", "a.exr"])
def test_truncated_missing_and_foreign_files_are_named(tmp_path: Path, capfd, name: str) -> None:
    path = tmp_path / name
    read = read_flow if path.suffix == ".exr" else read_image
    with pytest.raises(InputError, match=name):
        read(path)
    if path.suffix == ".exr":
        write_flow(path, some_flow())
    else:
        save(path, moved(40, 50, 0, 0))
    read(path)
    data = path.read_bytes()
    for broken in (*(data[: int(share * len(data))] for share in (0, 0.02, 0.3, 0.7, 0.99)), b"something else" * 20):
        path.write_bytes(broken)
        with pytest.raises(InputError, match=name):
            read(path)
    assert capfd.readouterr() == ("", "")  # the libraries below keep quiet


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_bit_depths_give_the_same_image(tmp_path: Path, dtype: type) -> None:
    largest = np.iinfo(dtype).max
    image = moved(20, 30, 0, 0)
    assert cv2.imwrite(str(tmp_path / "a.png"), np.rint(image * largest).astype(dtype)[..., ::-1])
    # Rounding to the bit depth: half a step.
    np.testing.assert_allclose(read_image(tmp_path / "a.png"), image, atol=0.5001 / largest)


def test_grey_and_alpha_are_read_and_a_flipped_bit_two_sizes_and_one_pixel_refused(tmp_path: Path) -> None:
    rgb = as_bytes(moved(20, 30, 0, 0))
    assert cv2.imwrite(str(tmp_path / "grey.png"), rgb[..., 0])
    assert cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([rgb[..., ::-1], rgb[..., 0]]))
    write_png(tmp_path / "new" / "a.png", rgb)
    for name, expected in (("grey", np.dstack([rgb[..., 0]] * 3)), ("alpha", rgb), ("new/a", rgb)):
        np.testing.assert_array_equal(np.rint(read_image(tmp_path / f"{name}.png") * 255), expected)
    save(tmp_path / "a.png", moved(40, 50, 0, 0))
    data = bytearray((tmp_path / "a.png").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "a.png").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png.*damaged"):
        read_image(tmp_path / "a.png")
    for name, size in (("d", (20, 30)), ("b", (20, 31)), ("c", (1, 1))):
        save(tmp_path / f"{name}.png", moved(*size, 0, 0))
    with pytest.raises(InputError, match=r"30 x 20 px.*31 x 20 px"):
        read_pair(tmp_path / "d.png", tmp_path / "b.png")
    with pytest.raises(InputError, match=r"c\.png: 1 x 1 px"):
        read_pair(tmp_path / "c.png", tmp_path / "c.png")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_photograph_is_turned_as_its_exif_says(tmp_path: Path, orientation: int) -> None:
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    # Two decoders of one JPEG file differ in how they enlarge its colours.
    for name, tolerance in (("a.png", 1e-3), ("a.jpg", 8)):
        Image.fromarray(as_bytes(moved(24, 40, 0, 0))).save(tmp_path / name, exif=exif, quality=95)
        turned = np.asarray(ImageOps.exif_transpose(Image.open(tmp_path / name)))
        np.testing.assert_allclose(read_image(tmp_path / name) * 255, turned, rtol=0, atol=tolerance)


def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail() -> None:
        with replacing(path) as temporary:
            temporary.write_text("half")
            raise OSError(errno.ENOSPC, "disk full")

    with pytest.raises(OSError, match=r"disk full.*a\.txt"):
        fail()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
