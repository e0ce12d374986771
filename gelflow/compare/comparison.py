"""What a comparison found, and its JSON.

`scores.json` holds everything but the strata of single pairs, of which it has the sums per method.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gelflow.compare.scores import PairScore, summarise
from gelflow.compare.speed import Speed
from gelflow.compare.strata import Stratum, merged
from gelflow.methods.name import MethodName


@dataclass(frozen=True)
class Comparison:
    """Scores of methods on the same pairs of some data, method after method.

    Strata are bins over all pairs, by method, speeds those of networks alone; what was not measured is missing.
    """

    data: tuple[str, ...]
    scores: tuple[PairScore, ...]
    strata: Mapping[MethodName, Sequence[Stratum]]
    speeds: Mapping[MethodName, Speed]

    @property
    def pairs(self) -> list[str]:
        return list(dict.fromkeys(score.pair for score in self.scores))

    @property
    def devices(self) -> str:
        return " and ".join(dict.fromkeys(score.device for score in self.scores))

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
            "methods": [_plain(vars(score)) for score in summarise(self.scores)],
            "scores": [_plain({k: v for k, v in vars(score).items() if k != "strata"}) for score in self.scores],
            "strata": {str(name): [_plain(vars(one)) for one in bins] for name, bins in self.strata.items()},
            "networks": {str(name): vars(speed) for name, speed in self.speeds.items()},
        }
        return json.dumps(answer, indent=1, default=str)  # names and scenes as their text


def _plain(record: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in record.items()}
