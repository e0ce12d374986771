"""Shards that synth exports, read as they are: the same bits as from the data set; damage is named."""

import gzip
import io
import pickle
import shutil
import tarfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from commands import refused
from samples import synth_sample, write_dataset

from gelflow.data import PairDataset
from gelflow.data.open import holds_pairs
from synth.dataset import export as exporting
from synth.dataset.sample import Sample

INDICES = (0, 1, 999999, 1000000)  # With a gap, and with the last key before the first in the order of texts


def write_both(parent: Path, samples: list[Sample]) -> tuple[Path, Path]:
    write_dataset(parent / "data", samples, n=10**6 + 1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "SAMPLES_PER_SHARD", 2)
        exporting.export(parent / "data", "webdataset", parent / "shards")
    return parent / "data", parent / "shards"


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    torch.set_num_threads(1)
    return write_both(tmp_path_factory.mktemp("shards"), [synth_sample(index) for index in INDICES])


@pytest.fixture
def shard(both: tuple[Path, Path], tmp_path: Path) -> Path:
    return Path(shutil.copy(both[1] / "shard-000000.tar", tmp_path))


def bits(item: dict[str, torch.Tensor | str]) -> dict[str, tuple[object, ...]]:
    """Every part of a sample with its type, shape and bytes: NaN equals itself, 0 does not equal -0."""
    parts = {key: value.numpy() if isinstance(value, torch.Tensor) else np.array(value) for key, value in item.items()}
    return {key: (part.dtype, part.shape, part.tobytes()) for key, part in parts.items()}


def all_bits(dataset: PairDataset) -> list[dict[str, tuple[object, ...]]]:
    return [bits(dataset[index]) for index in range(len(dataset))]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_shards_give_the_bits_of_the_data_set(tmp_path: Path, dtype: type) -> None:
    folders = write_both(tmp_path, [synth_sample(index, dtype) for index in INDICES])
    data, shards = map(PairDataset, folders)
    assert len(list(folders[1].glob("*.tar"))) == 2
    assert shards.names == data.names == [f"{index:06d}" for index in INDICES]
    assert shards.digest == data.digest
    assert {str(record.scene) for record in (*shards.records, *data.records)} == {"flat, none"}
    assert set(shards[0]) == {"image1", "image2", "name", "bare", "flow", "visible"}
    assert shards[0]["bare"] is True
    assert all_bits(shards) == all_bits(data)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_exports_as_flo_are_pairs_and_shards_have_the_contact(tmp_path: Path, dtype: type) -> None:
    samples = [synth_sample(index, dtype) for index in (0, 1)]
    contact = np.zeros((64, 64), np.float32)
    contact[20:30, 5:9] = 1.0
    samples[1].flow.extras["contact.Y"] = contact
    folders = write_both(tmp_path, samples)
    data, shards = map(PairDataset, folders)
    np.testing.assert_array_equal(shards.truth(1).contact, contact == 1)
    assert shards.truth(0).contact is data.truth(0).contact is None
    exporting.export(folders[0], "flo", tmp_path / "flo")
    for folder in (tmp_path / "flo", tmp_path / "flo" / "data"):
        assert holds_pairs(folder)
        chairs = PairDataset(folder)
        assert chairs.names == data.names
        for index in (0, 1):
            np.testing.assert_array_equal(chairs.images(index), data.images(index))
    (tmp_path / "flo" / "data" / "000001_img2.ppm").unlink()
    refused(r"000001_img2\.ppm: the file is missing", PairDataset, tmp_path / "flo")


def test_one_shard_alone_workers_and_copies_read_the_same(both: tuple[Path, Path]) -> None:
    expected = all_bits(PairDataset(both[0]))
    shard = PairDataset(both[1] / "shard-000001.tar")
    assert shard.names == ["999999", "1000000"]
    assert all_bits(shard) == expected[2:]
    dataset = PairDataset(both[1])
    dataset[0]  # before the workers start: whatever this left open they would share
    loader = torch.utils.data.DataLoader(dataset, batch_size=None, num_workers=2, multiprocessing_context="fork")
    assert [bits(item) for item in loader] == expected
    assert all_bits(pickle.loads(pickle.dumps(dataset))) == expected


def header_flipped(data: bytes, members: list[tarfile.TarInfo]) -> bytes:
    place = members[7].offset + 3
    return data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]


DAMAGE: dict[str, Callable[[bytes, list[tarfile.TarInfo]], bytes]] = {
    "inside a member": lambda data, members: data[: members[-2].offset_data + 100],
    "inside a header": lambda data, members: data[: members[-1].offset + 100],
    "between members": lambda data, members: data[: members[-1].offset],
    "between samples": lambda data, members: data[: members[7].offset],
    "in the last padding": lambda data, members: data[: members[-1].offset_data + members[-1].size],
    "header flipped": header_flipped,
    "zipped": lambda data, _: gzip.compress(data),
    "text": lambda *_: b"not a tar file " * 100,
    "nothing": lambda *_: b"",
}


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_truncated_and_damaged_shards_are_named(shard, damage) -> None:
    assert len(PairDataset(shard)) == 2
    with tarfile.open(shard) as archive:
        members = archive.getmembers()
    shard.write_bytes(damage(shard.read_bytes(), members))
    for path in (shard, shard.parent):
        refused(r"shard-000000\.tar: .*truncated", PairDataset, path)


def rewrite(shard: Path, change: Callable[[str, bytes], Iterator[tuple[str, bytes]]]) -> None:
    """Replaces each member (name, content) by those that `change` yields for it."""
    with tarfile.open(shard) as archive:
        members = [(info.name, archive.extractfile(info).read()) for info in archive]  # type: ignore[union-attr]
    with tarfile.open(shard, "w", format=tarfile.USTAR_FORMAT) as archive:
        for name, content in members:
            for new, data in change(name, content):
                info = tarfile.TarInfo(new)
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))


@pytest.mark.parametrize("suffix", ["image1.png", "image2.png", "forward.npy", "forward_visible.npy", "json"])
def test_a_missing_member_is_named(shard: Path, suffix: str) -> None:
    rewrite(shard, lambda name, data: iter([(name, data)] if name != f"000001.{suffix}" else []))
    refused(rf"shard-000000\.tar: sample 000001 lacks {suffix};", PairDataset, shard)


def test_two_samples_of_one_key_are_named(shard: Path) -> None:
    shutil.copy(shard, shard.with_name("other.tar"))
    refused(r"shard-000000\.tar: sample 000000 is in .*other\.tar, too", PairDataset, shard.parent)
    rewrite(shard, lambda name, data: iter([(name.replace("000001", "000000"), data)]))
    refused(r"shard-000000\.tar, member 000000\.image1\.png: occurs twice", PairDataset, shard)


@pytest.mark.parametrize("place", ["../{}", "/{}"])
def test_a_shard_does_not_lead_out_of_its_folder(shard: Path, place: str) -> None:
    rewrite(shard, lambda name, data: iter([(place.format(name), data)]))
    refused("leads out of its folder", PairDataset, shard)


def _npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, allow_pickle=array.dtype == object)
    return buffer.getvalue()


@pytest.mark.parametrize(("suffix", "content", "words"), [
    ("image2.png", lambda data: data[:300] + bytes([data[300] ^ 1]) + data[301:], "damaged image .*checksum"),
    ("image2.png", lambda data: data[:-20], "truncated or damaged image"),
    ("image2.png", lambda data: b"GIF" + data[3:], "not a PNG"),
    ("image2.png", lambda data: b"", "not a PNG"),
    ("forward.npy", lambda data: b"", r"not a readable \.npy"),
    ("forward.npy", lambda data: data[:-4], r"not a readable \.npy"),
    ("forward.npy", lambda data: data[:50], r"not a readable \.npy"),
    ("forward.npy", lambda data: data.replace(b"'shape': (", b"'shape': ["), r"not a readable \.npy"),
    ("forward.npy", lambda data: data.replace(b"(64, 64, 2)", b"(6444444444444, 64, 2)"), r"not a readable \.npy"),
    ("forward.npy", lambda data: _npy(np.zeros((64, 64, 2))), "float64"),
    ("forward.npy", lambda data: _npy(np.array([[{}]])), "Object"),
    ("forward.npy", lambda data: _npy(np.zeros((64, 64), np.float32)), "shapes"),
    ("forward_visible.npy", lambda data: _npy(np.zeros((64, 60), np.uint8)), "shapes"),
])  # fmt: skip
def test_a_damaged_member_is_named(shard: Path, suffix: str, content: Callable[[bytes], bytes], words: str) -> None:
    rewrite(shard, lambda name, data: iter([(name, content(data) if name == f"000001.{suffix}" else data)]))
    dataset = PairDataset(shard)
    member = r"shard-000000\.tar, member 000001\.(forward|image2)[^ ]*"
    refused(rf"{member}: .*({words})", dataset.__getitem__, 1)
    dataset[0]


def test_a_shard_that_changes_after_opening_is_named(shard: Path) -> None:
    dataset = PairDataset(shard)
    shard.write_bytes(shard.read_bytes()[:1000])
    refused(r"member 000000\.image1\.png: ends after \d+ of \d+ bytes", dataset.__getitem__, 0)
    shard.unlink()
    for read in (dataset.images, dataset.truth):
        refused(r"shard-000000\.tar", read, 0)


def test_what_holds_no_sample_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.tar"
    for names, words in (([], "holds no image pair"),
                         (["notes.txt"], r"a\.tar: sample notes lacks image1\.png and .*synth export")):  # fmt: skip
        with tarfile.open(path, "w") as archive:
            for name in names:
                archive.addfile(tarfile.TarInfo(name))
        refused(words, PairDataset, tmp_path)
    path.unlink()
    path.mkdir()  # a folder of that name is no shard
    refused("no image pairs", PairDataset, tmp_path)
