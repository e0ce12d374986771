"""Settings: validated once where they come in, then passed down in parts."""

from gelflow.config.settings import (
    MINIMUM_SIDE,
    REGISTRATIONS,
    LossConfig,
    ModelConfig,
    MotionConfig,
    Registration,
    RegistrationConfig,
    TrainConfig,
)

__all__ = [
    "MINIMUM_SIDE", "REGISTRATIONS", "LossConfig", "ModelConfig", "MotionConfig", "Registration", "RegistrationConfig",
    "TrainConfig",
]  # fmt: skip
