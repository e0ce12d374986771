"""Data sets that synth writes: image pairs with exact flow.

    DIR/dataset.json               schema_version, scene, seed, n, conventions ...
    DIR/manifest.jsonl             a line per finished sample; its `index` is the folder's number
    DIR/samples/000000/            image1.png  image2.png  flow.exr  meta.json
    DIR/clips/000000/              of clips: frames/000000.png ...  flow/000001.exr ... (from frame 0)  meta.json

Only samples that the manifest lists count: a folder that it does not list may be unfinished.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from gelflow.data.record import PairRecord, PatternedScene
from gelflow.errors import InputError
from gelflow.files.exr import Direction
from gelflow.untrusted import parsed, read_file

SCHEMA_VERSION = 1
"""Version of the format that is understood here."""


def is_synthetic(folder: Path) -> bool:
    """Whether a folder is, or was meant to be, a data set of synth."""
    return (folder / "dataset.json").is_file() or (folder / "manifest.jsonl").is_file()


def synthetic_records(folder: Path, frames_apart: int | None = None) -> list[PairRecord]:
    """The pairs of a synth data set, by index: its samples, or of clips pairs of frames.

    Of clips each frame with that at rest, or those that many frames apart; of these the flow is known from rest, and
    from one frame to the next where the clip has it. InputError where dataset.json or the manifest is missing or
    damaged, comes from a newer format, lists no sample, or lists a file that is not there, and where nothing was
    rendered.
    """
    header, manifest = _read_header(folder / "dataset.json"), folder / "manifest.jsonl"
    outputs, of_clips = _part(header, "outputs"), _part(header, "sampling").get("kind") == "clips"
    if outputs.get("images") is False:
        raise InputError(f"{folder}: has no images; it was made with outputs.images = false")
    records = []
    for index, frames in sorted(_finished(manifest).items()):
        name = f"{index:06d}"
        sample = folder / ("clips" if of_clips else "samples") / name
        scene = patterned_scene(header, sample / "meta.json")
        if of_clips:
            found = _clip_pairs(name, sample, frames, frames_apart, outputs.get("previous") is True)
        else:
            found = [PairRecord(name, sample / "image1.png", sample / "image2.png", sample / "flow.exr")]
        for record in found:
            for path in (record.image1, record.image2, record.flow):
                if isinstance(path, Path) and not path.is_file():
                    raise InputError(f"{path}: the file is missing although {manifest} lists sample {index}; make the "
                                     "data set again, or remove that line")  # fmt: skip
        records += [replace(record, scene=scene, origin=origin(header)) for record in found]
    if not records:
        raise InputError(f"{manifest}: lists no finished sample; let synth generate finish first")
    return records


def _clip_pairs(name: str, clip: Path, frames: int, apart: int | None, has_previous: bool) -> list[PairRecord]:
    pairs = [(0, k) for k in range(1, frames)] if apart is None else [(k, k + apart) for k in range(frames - apart)]
    records = []
    for first, second in pairs:
        direction: Direction = "previous" if first else "forward"
        known = first == 0 or (apart == 1 and has_previous)
        image1, image2 = (clip / "frames" / f"{frame:06d}.png" for frame in (first, second))
        flow = clip / "flow" / f"{second:06d}.exr" if known else None
        records.append(PairRecord(f"{name}-{first:06d}-{second:06d}", image1, image2, flow, direction=direction))
    return records


def _part(header: dict[str, Any], name: str) -> dict[str, Any]:
    """A table of the scene; empty where there is none."""
    scene = header.get("scene")
    part = scene.get(name) if isinstance(scene, dict) else None
    return part if isinstance(part, dict) else {}


def origin(description: Any) -> str | None:
    """Hash of the scene and seed, "f2b4b82f24b5428b, 77", in dataset.json or meta.json; None where they are missing."""
    try:
        return f"{description['scene_hash']}, {description['seed']}"
    except (KeyError, TypeError):
        return None


def patterned_scene(header: Any, meta: Path | None = None) -> PatternedScene | None:
    """Scene and kind of pattern; where the latter is random, that of the sample's `meta`."""
    try:
        scene = header["scene"]
        kind = scene["sensor"]["pattern"].get("kind")
        if not isinstance(kind, str) and meta is not None:
            kind = json.loads(read_file(meta))["scene"]["sensor"]["pattern"]["kind"]
        return PatternedScene(str(scene["name"]), str(kind))
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


def _finished(path: Path) -> dict[int, int]:
    """Indices in the manifest, and how many frames each sample has.

    A last line without its line end was cut by an interruption and does not count.
    """
    try:
        text = read_file(path).decode("utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{path}: the file is missing; no sample has been finished") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not a text file ({error})") from error
    found = {}
    for number, line in enumerate(text.split("\n")[:-1], start=1):
        if not line.strip():
            continue
        try:
            entry = json.loads(line)
            found[int(entry["index"])] = len(entry.get("frames", (0, 1)))
        except (KeyError, TypeError, AttributeError, ValueError, OverflowError, RecursionError) as error:
            raise InputError(f"{path}, line {number}: not a sample's entry with an `index`") from error
    return found
