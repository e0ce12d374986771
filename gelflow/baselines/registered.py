"""DIS medium, registered (`gelflow.models.registration`). Not one of the paper's methods.

Registration learns nothing and starts from any flow. What it adds to a network has to be compared with what it adds to
the best classical method.
"""

from dataclasses import dataclass

from gelflow.arrays import FlowArray, ImageArray
from gelflow.baselines.classical import dis
from gelflow.baselines.tensors import as_array, as_tensor
from gelflow.config import RegistrationConfig


@dataclass(frozen=True)
class RegisteredDIS:
    """DIS medium on the processor, then registration, on a device, at the images' own size."""

    aim: str
    settings: RegistrationConfig
    device: str = "cpu"

    @property
    def name(self) -> str:
        return f"DIS medium+{self.aim}"

    def flow(self, image1: ImageArray, image2: ImageArray) -> FlowArray:
        from gelflow.models.registration import registered

        start = dis("medium").flow(image1, image2)
        first, second = as_tensor(image1, self.device), as_tensor(image2, self.device)
        return as_array(registered(as_tensor(start, self.device), first, second, self.settings))
