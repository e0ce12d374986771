"""What is known of one pair before it is read."""

from dataclasses import dataclass
from pathlib import Path

from gelflow.data.member import FlowMembers, Member
from gelflow.files.exr import Direction


@dataclass(frozen=True)
class PatternedScene:
    """A scene's name and the kind of its gel's pattern; its text is "gelsight_mini, dots"."""

    name: str
    pattern: str

    @property
    def bare(self) -> bool:
        """Whether the gel has no pattern."""
        return self.pattern == "none"

    def __str__(self) -> str:
        return f"{self.name}, {self.pattern}"


@dataclass(frozen=True)
class PairRecord:
    """Where one pair lies on disk: in files of its own, or in a shard.

    Attributes:
        name: Unique within its data set.
        image1, image2: Image files of one size.
        flow: EXR file, or members of a shard, with the exact flow in both directions, or None.
        markers: CSV file with tracked dots (columns x1, y1, x2, y2 in px), or None.
        scene: Of a synthetic pair, or None.
        origin: Hash of its data set's scene, and its seed; or None.
        direction: Which of the flows in an EXR file is from image 1 to image 2.
    """

    name: str
    image1: Path | Member
    image2: Path | Member
    flow: Path | FlowMembers | None = None
    markers: Path | None = None
    scene: PatternedScene | None = None
    origin: str | None = None
    direction: Direction = "forward"
