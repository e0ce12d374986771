"""PNG, npz and JSON lines: exact, the same bytes every time, and honest about damage."""

import json

import numpy as np
import pytest
from PIL import Image

from synth.dataset.images import encode_png, read_png
from synth.dataset.jsontext import jsonable, read_document, to_document, to_line
from synth.dataset.lines import append_line, merge_lines, read_line, scan_lines
from synth.dataset.npz import encode_npz, read_npz
from synth.errors import InputError

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("shape", [(7, 9), (7, 9, 3)])
def test_png_round_trip(tmp_path, dtype, shape):
    image = RNG.integers(0, np.iinfo(dtype).max, shape, endpoint=True).astype(dtype)
    (tmp_path / "a.png").write_bytes(encode_png(image))
    np.testing.assert_array_equal(read_png(tmp_path / "a.png"), image, strict=True)
    assert encode_png(image) == encode_png(image.copy(order="F"))


def test_png_is_rgb_for_other_readers(tmp_path):
    """Red first: an independent reader must not see blue."""
    image = np.zeros((4, 5, 3), np.uint8)
    image[..., 0] = 200
    (tmp_path / "a.png").write_bytes(encode_png(image))
    assert Image.open(tmp_path / "a.png").getpixel((0, 0)) == (200, 0, 0)


def test_png_of_another_kind_is_refused():
    for image in (np.zeros((4, 4), np.float32), np.zeros((4, 4, 4), np.uint8)):
        with pytest.raises(ValueError, match="uint8 or uint16"):
            encode_png(image)  # type: ignore[arg-type]


def test_every_truncated_png_and_a_flipped_bit_are_found(tmp_path):
    data, path = encode_png(RNG.integers(0, 255, (12, 12, 3)).astype(np.uint8)), tmp_path / "a.png"
    for size in range(len(data)):
        path.write_bytes(data[:size])
        with pytest.raises(InputError, match=r"a\.png"):
            read_png(path)
    middle = len(data) // 2
    path.write_bytes(data[:middle] + bytes([data[middle] ^ 4]) + data[middle + 1 :])
    with pytest.raises(InputError, match="checksum"):
        read_png(path)


def test_npz_round_trip_and_bytes(tmp_path):
    arrays = {"a": RNG.normal(size=(3, 2)), "b": np.arange(4, dtype=np.int32), "n": np.array(4)}
    (tmp_path / "a.npz").write_bytes(encode_npz(arrays))
    found = read_npz(tmp_path / "a.npz", ("a", "b", "n"))
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array, strict=True)
    assert encode_npz(arrays) == encode_npz(arrays)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"no archive", "half"])
def test_damaged_npz_is_named(tmp_path, content):
    whole = encode_npz({"a": RNG.normal(size=100)})
    (tmp_path / "a.npz").write_bytes(whole[: len(whole) // 2] if content == "half" else content)
    with pytest.raises(InputError, match=r"a\.npz"):
        read_npz(tmp_path / "a.npz", ("a",))
    (tmp_path / "a.npz").write_bytes(whole)
    with pytest.raises(InputError, match="lacks the array b"):
        read_npz(tmp_path / "a.npz", ("b",))


def test_json_is_strict_and_exact(tmp_path):
    value = {"x": np.float64(0.1) + 0.2, "nan": np.nan, "v": np.arange(3), "t": (1, True), "s": "[\n 1]", "e": []}
    document = to_document(value)
    expected = {"x": 0.1 + 0.2, "nan": None, "v": [0, 1, 2], "t": [1, True], "s": "[\n 1]", "e": []}
    assert json.loads(document) == expected
    assert '"v": [0, 1, 2]' in document
    assert json.loads(to_line(value)) == json.loads(document)
    with pytest.raises(TypeError, match="no JSON form"):
        jsonable({"a": object()})
    (tmp_path / "a.json").write_text("{", encoding="utf-8")
    with pytest.raises(InputError, match=r"a\.json.*not valid JSON"):
        read_document(tmp_path / "a.json")


def _index(record):
    return int(record["index"])


def test_lines_are_found_sorted_and_repaired(tmp_path):
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


@pytest.mark.parametrize("torn", ['{"index": 9', '{"index": 9}', '{"other": 9}\n', "\0\0\0\n"])
def test_torn_last_line_does_not_count(tmp_path, torn):
    path = tmp_path / "a.jsonl"
    append_line(path, {"index": 1})
    with path.open("a") as file:
        file.write(torn)
    table = scan_lines(path, _index)
    assert (list(table.places), table.tidy) == ([1], False)


def test_damaged_line_in_the_middle_is_named(tmp_path):
    path = tmp_path / "a.jsonl"
    path.write_text('{"index": 1}\n{"ind\n{"index": 3}\n')
    with pytest.raises(InputError, match=r"a\.jsonl: line 2 is damaged"):
        scan_lines(path, _index)
