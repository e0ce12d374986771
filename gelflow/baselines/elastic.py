"""DIS medium corrected by this project's elastic refinement (`gelflow.models.elastic`). Not one of the paper's methods.

The refinement learns nothing and starts from any flow, so what it adds to a network has to be held against what it
adds to the best classical method. Its settings are those of the preset `real`.
"""

from dataclasses import dataclass, field

from gelflow.baselines.classical import DIS
from gelflow.baselines.tensors import as_array, as_tensor, chosen_device
from gelflow.config import ElasticConfig
from gelflow.errors import InputError
from gelflow.overrides import train_config
from gelflow.raster import FlowArray, ImageArray

PRESET = "real"


def preset_elastic() -> ElasticConfig:
    """The settings of the elastic refinement where nothing else gives any: those of the preset `real`.

    Raises:
        InputError: The preset has none.
    """
    config = train_config(PRESET).model.elastic
    if config is None:
        raise InputError(f"the preset {PRESET} has no [model.elastic], whose settings the elastic refinement takes")
    return config


@dataclass(frozen=True)
class ElasticDIS:
    """DIS medium on the processor, then the elastic refinement at the images' own size.

    Attributes:
        device: Where the refinement runs: "auto", "cpu" or "cuda".
        config: Its settings.
    """

    device: str = "cpu"
    config: ElasticConfig = field(default_factory=preset_elastic)
    name: str = "DIS medium + elastic"

    def __post_init__(self) -> None:
        object.__setattr__(self, "device", chosen_device(self.device))

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        """See `Method.flow`."""
        from gelflow.models.elastic import refined

        start = DIS("medium").flow(image1, image2)
        first, second = as_tensor(image1, self.device), as_tensor(image2, self.device)
        return as_array(refined(as_tensor(start, self.device), first, second, self.config))
