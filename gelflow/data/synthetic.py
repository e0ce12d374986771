"""Data sets that synth writes: image pairs with exact flow.

    DIR/dataset.json               schema_version, scene, seed, n, conventions ...
    DIR/manifest.jsonl             a line per finished sample; its `index` is the folder's number
    DIR/samples/000000/            image1.png  image2.png  flow.exr  meta.json

Only samples that the manifest lists count: a folder that it does not list may be unfinished.
"""

import json
from pathlib import Path
from typing import Any

from gelflow.data.pairs import PairRecord
from gelflow.errors import InputError
from gelflow.untrusted import parsed, read_file

SCHEMA_VERSION = 1
"""Version of the format that is understood here."""


def is_synthetic(folder: Path) -> bool:
    """Whether a folder is, or was meant to be, a data set of synth."""
    return (folder / "dataset.json").is_file() or (folder / "manifest.jsonl").is_file()


def synthetic_records(folder: Path) -> list[PairRecord]:
    """The finished samples of a synth data set, by index.

    InputError where dataset.json or the manifest is missing or damaged, comes from a newer format, lists no sample, or
    lists a file that is not there.
    """
    header, manifest = _read_header(folder / "dataset.json"), folder / "manifest.jsonl"
    records = []
    for index in sorted(_indices(manifest)):
        name = f"{index:06d}"
        sample = folder / "samples" / name
        files = sample / "image1.png", sample / "image2.png", sample / "flow.exr"
        for path in files:
            if not path.is_file():
                raise InputError(f"{path}: the file is missing although {manifest} lists sample {index}; make the data "
                                 "set again, or remove that line")  # fmt: skip
        scene = scene_and_pattern(header, sample / "meta.json")
        records.append(PairRecord(name, *files, scene=scene, origin=origin(header)))
    if not records:
        raise InputError(f"{manifest}: lists no finished sample; let synth generate finish first")
    return records


def origin(description: Any) -> str | None:
    """Hash of the scene and seed, "f2b4b82f24b5428b, 77", in dataset.json or meta.json; None where they are missing."""
    try:
        return f"{description['scene_hash']}, {description['seed']}"
    except (KeyError, TypeError):
        return None


def scene_and_pattern(header: Any, meta: Path | None = None) -> str | None:
    """Scene and kind of pattern, "gelsight_mini, dots"; where the latter is random, that of the sample's `meta`."""
    try:
        scene = header["scene"]
        kind = scene["sensor"]["pattern"].get("kind")
        if not isinstance(kind, str) and meta is not None:
            kind = json.loads(read_file(meta))["scene"]["sensor"]["pattern"]["kind"]
        return f"{scene['name']}, {kind}"
    except (KeyError, TypeError, AttributeError, OSError, ValueError, RecursionError):
        return None  # written by another program, or before patterns were recorded


def _read_header(path: Path) -> dict[str, Any]:
    try:
        header = parsed(json.loads, read_file(path), str(path))
    except FileNotFoundError as error:
        raise InputError(f"{path}: the file is missing; this is not a whole synth data set") from error
    version = header.get("schema_version") if isinstance(header, dict) else None
    if version != SCHEMA_VERSION:
        raise InputError(f"{path}: schema_version is {version!r}; this gelflow reads {SCHEMA_VERSION}")
    return dict(header)


def _indices(path: Path) -> set[int]:
    """Indices in the manifest. A last line without its line end was cut by an interruption and does not count."""
    try:
        text = read_file(path).decode("utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: the file is missing; no sample has been finished") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error})") from error
    indices = set()
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        if not line.strip():
            continue
        try:
            indices.add(int(json.loads(line)["index"]))
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise InputError(f"{path}, line {number}: not a sample's entry with an `index`") from error
    return indices
