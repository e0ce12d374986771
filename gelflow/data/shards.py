"""Shards in WebDataset's layout, as `python -m synth export --format webdataset` writes them.

    shard-000000.tar   uncompressed; for each sample 000000.{image1.png, image2.png, forward.npy, forward_visible.npy,
                       json} and, if it was asked for, contact.Y.npy; others are passed over;
                       the key ends at the first dot

Opening reads every tar header once, in each process, and keeps where each member lies. A pair is then read by seeking,
in any order, so that a shard data set is used like a directory. The order is that of the shards' names, then that
within a shard.

Limits: local or mounted files, no URLs. Shards do not say how many of them belong together: that one is missing
altogether is noticed only by `--resume`, which compares the number of pairs.

Reference: POSIX.1-1988 ustar; https://github.com/webdataset/webdataset.
"""

import json
import tarfile
from collections.abc import Iterator
from pathlib import Path

from gelflow.data.member import FlowMembers, Member
from gelflow.data.record import PairRecord
from gelflow.data.synthetic import origin, patterned_scene
from gelflow.errors import InputError
from gelflow.untrusted import inside, parsed

SUFFIX = ".tar"
_NEEDED = ("image1.png", "image2.png", "forward.npy", "forward_visible.npy", "json")
_BLOCK = 512
_END = bytes(2 * _BLOCK)
"""A tar file ends with two blocks of zeros (POSIX); Python's tarfile takes a damaged header for the end, too."""


def shard_files(path: Path) -> list[Path]:
    """The shards at a path, sorted by name: the file itself, or a folder's *.tar; none where there are none."""
    if path.is_dir():
        return sorted(file for file in path.glob(f"[!.]*{SUFFIX}") if file.is_file())
    return [path] if path.suffix == SUFFIX and path.is_file() else []


def shard_records(shards: list[Path]) -> list[PairRecord]:
    """The pairs in shards, in order.

    InputError where a shard is unreadable, truncated or damaged, a sample lacks a member, or a key occurs twice.
    """
    records: list[PairRecord] = []
    shard_of: dict[str, Path] = {}
    for shard in shards:
        for key, members in _samples(shard).items():
            if key in shard_of:
                raise InputError(f"{shard}: sample {key} is in {shard_of[key]}, too; open shards of different data "
                                 "sets from different folders")  # fmt: skip
            shard_of[key] = shard
            records.append(_record(shard, key, members))
    return records


def _samples(shard: Path) -> dict[str, dict[str, Member]]:
    """Members by suffix, by key."""
    samples: dict[str, dict[str, Member]] = {}
    for member in _members(shard):
        try:
            inside(member.name)
        except ValueError as error:
            raise InputError(f"{shard}: member {error}; export the shard again") from None
        folder, slash, base = member.name.rpartition("/")
        stem, _, suffix = base.partition(".")
        parts = samples.setdefault(f"{folder}{slash}{stem}", {})
        if suffix in parts:
            raise InputError(f"{member}: occurs twice; a shard may hold one sample of each key, export it again")
        parts[suffix] = member
    return samples


def _members(shard: Path) -> Iterator[Member]:
    """Where the files of a shard lie, in order."""
    end = 0
    try:
        with tarfile.open(shard, "r:") as archive:
            for info in archive:
                if info.size < 0:
                    raise tarfile.ReadError(f"{info.name!r} has a negative size")
                end = info.offset_data + -(-info.size // _BLOCK) * _BLOCK
                if info.isfile():
                    yield Member(shard, info.name, info.offset_data, info.size)
        with shard.open("rb") as file:
            file.seek(end)
            closing = file.read(len(_END))
    except (tarfile.TarError, ValueError, RecursionError, MemoryError) as error:
        raise InputError(f"{shard}: truncated, damaged or not an uncompressed tar file ({error}); copy or export it "
                         "again") from error  # fmt: skip
    except OSError as error:
        raise InputError(f"{shard}: cannot be read: {error.strerror or error}") from error
    if closing != _END:
        raise InputError(f"{shard}: truncated or damaged at byte {end}, where a file or the end of the tar should "
                         "follow; copy or export it again")  # fmt: skip


def _record(shard: Path, key: str, members: dict[str, Member]) -> PairRecord:
    missing = [name for name in _NEEDED if name not in members]
    if missing:
        raise InputError(f"{shard}: sample {key} lacks {' and '.join(missing)}; allowed are shards of "
                         "`python -m synth export --format webdataset`; export it again")  # fmt: skip
    flow = FlowMembers(members["forward.npy"], members["forward_visible.npy"], members.get("contact.Y.npy"))
    try:
        meta = parsed(json.loads, members["json"].read_bytes(), key)
    except ValueError:
        meta = None  # written by another program
    images = (members["image1.png"], members["image2.png"])
    return PairRecord(key, *images, flow, scene=patterned_scene(meta), origin=origin(meta))
