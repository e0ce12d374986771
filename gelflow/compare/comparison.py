"""What a comparison found, and its JSON.

`scores.json` holds everything but the strata of single pairs, of which it has the sums per method; so a comparison read
back can be shown again and added to.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from gelflow.compare.scores import PairScore, summarise
from gelflow.compare.speed import Speed
from gelflow.compare.strata import Stratum, merged
from gelflow.errors import InputError

_ERRORS = ("endpoint_error_px", "median_error_px")


@dataclass(frozen=True)
class Comparison:
    """Scores of methods on the same pairs of some data, method after method.

    Strata are bins over all pairs, by method, speeds those of networks alone; what was not measured is missing.
    """

    data: tuple[str, ...]
    scores: tuple[PairScore, ...]
    strata: Mapping[str, Sequence[Stratum]]
    speeds: Mapping[str, Speed]

    @property
    def pairs(self) -> list[str]:
        return list(dict.fromkeys(score.pair for score in self.scores))

    @property
    def devices(self) -> str:
        """Names of the devices that the methods ran on."""
        return " and ".join(dict.fromkeys(score.device for score in self.scores))

    def without(self, methods: Iterable[str]) -> "Comparison":
        """The comparison without some methods."""
        gone = set(methods)
        scores = tuple(score for score in self.scores if score.method not in gone)
        strata = {name: bins for name, bins in self.strata.items() if name not in gone}
        return Comparison(self.data, scores, strata, {k: v for k, v in self.speeds.items() if k not in gone})

    def with_method(self, scores: Sequence[PairScore], speed: Speed | None) -> "Comparison":
        """The comparison with one method more, given by its scores on all pairs."""
        name = scores[0].method
        strata = {**self.strata, name: merged(one for score in scores for one in score.strata)}
        speeds = {**self.speeds, name: speed} if speed else self.speeds
        return Comparison(self.data, (*self.scores, *scores), strata, speeds)

    def to_json(self) -> str:
        """JSON; numbers that are not finite (PSNR of equal images, errors of an estimate with gaps) become null."""
        answer = {
            "data": list(self.data),
            "methods": [_plain(asdict(score)) for score in summarise(self.scores)],
            "scores": [_plain({k: v for k, v in asdict(score).items() if k != "strata"}) for score in self.scores],
            "strata": {name: [_plain(asdict(one)) for one in bins] for name, bins in self.strata.items()},
            "networks": {name: asdict(speed) for name, speed in self.speeds.items()},
        }
        return json.dumps(answer, indent=1)


def read_comparison(path: Path) -> Comparison:
    """Reads what `Comparison.to_json` wrote; InputError where the file is missing, damaged or of another version."""
    try:
        answer = json.loads(path.read_text(encoding="utf-8"))
        return Comparison(
            tuple(str(source) for source in answer["data"]),
            tuple(_score(values) for values in answer["scores"]),
            {name: [_stratum(one) for one in bins] for name, bins in answer["strata"].items()},
            {name: Speed(**(one | {"size": tuple(one["size"])})) for name, one in answer["networks"].items()},
        )
    except FileNotFoundError as error:
        raise InputError(f"{path}: there is no such file; --add needs an earlier comparison in --out") from error
    except (json.JSONDecodeError, UnicodeDecodeError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not the scores of a comparison of this version ({error!r})") from error


def _score(values: Mapping[str, Any]) -> PairScore:
    names = {field.name for field in fields(PairScore)} - {"strata"}
    if set(values) != names:
        raise KeyError(*sorted(set(values) ^ names))
    restored = dict(values)
    if restored["psnr_db"] is None:
        restored["psnr_db"] = math.inf
    if restored["motion_px"] is not None:  # there is a true flow, so an error that is null was not finite
        restored |= {name: math.nan for name in _ERRORS if restored[name] is None}
    return PairScore(**restored)


def _stratum(values: Mapping[str, Any]) -> Stratum:
    return Stratum(**{**values, "error_px": math.nan if values["error_px"] is None else values["error_px"]})


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}
