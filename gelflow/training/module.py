"""The optimisation as a Lightning module: one step, one validation, the optimiser and its learning rate.

The module knows at which step of the whole run it starts, so that learning rate and logs of a resumed run go on where
they were.
"""

import copy
import math
from typing import Any

import lightning as L
import torch
from torch import Tensor
from torch.optim import Adam
from torch.optim.lr_scheduler import LambdaLR
from torch.optim.swa_utils import get_ema_multi_avg_fn

from gelflow.config import MINIMUM_SIDE, TrainConfig
from gelflow.errors import InputError
from gelflow.losses import flow_loss, self_supervised_loss
from gelflow.losses.augmentation_consistency import consistency_loss, transformed_pair
from gelflow.losses.denoising import denoising_loss
from gelflow.losses.photometric import photometric_loss, visible_in_both_images
from gelflow.models import GelFlow
from gelflow.models.estimate import estimate_flow
from gelflow.models.recorded import GraphedNetwork
from gelflow.models.registration import registered
from gelflow.models.specks import without_specks
from gelflow.ops.warp import inside, warp

LOG_EVERY = 10
"""Steps between entries in the logs."""
METRICS = ("endpoint_error_px", "no_motion_endpoint_error_px", "psnr_db", "no_motion_psnr_db", "photometric_loss")
"""Results of a validation: mean over the pairs that have them."""


def learning_rate_factor(config: TrainConfig, step: int) -> float:
    """The learning rate of a step (0 .. steps-1) over its peak: a linear rise, then constant or a half cosine to 0."""
    if step < config.warmup_steps:
        return (step + 1) / config.warmup_steps
    if config.schedule == "constant":
        return 1.0
    share = (step - config.warmup_steps) / (config.steps - config.warmup_steps)
    return 0.5 * (1 + math.cos(math.pi * min(share, 1.0)))


class FlowModule(L.LightningModule):
    """Training of one network, from the state that it has after `start` steps, with optimiser and moving average.

    It holds the results of the last validation, see `validation_metrics`, and the loss of the last step, detached.
    """

    def __init__(
        self,
        config: TrainConfig,
        model: GelFlow,
        start: int = 0,
        optimiser: dict[str, Any] | None = None,
        average: dict[str, Any] | None = None,
    ) -> None:
        super().__init__()
        self.config = config
        self.model = model
        if model.denoiser is not None:
            # What a step does not use must not ask for a gradient: neither several devices nor a recording allow it.
            alone = config.supervision == "registered"
            model.requires_grad_(not alone)
            model.denoiser.requires_grad_(alone)
        self.average = None
        if config.ema_decay > 0:
            self.average = copy.deepcopy(model).eval().requires_grad_(False)
            if average is not None:
                self.average.load_state_dict(average)
        self._graphed: GraphedNetwork | None = None
        self.start = start
        self.optimiser_state = optimiser
        self.metrics: dict[str, float] = {}
        self.last_loss: Tensor = torch.zeros(())
        self._sums: dict[str, Tensor] = {}

    @property
    def network(self) -> Any:
        """The network as it is called once a step: recorded where the configuration asks for it."""
        return self._graphed or self.model

    def on_fit_start(self) -> None:
        """Records the network's passes on a CUDA device, where the configuration asks for it."""
        if self.config.cuda_graph and self.config.supervision != "registered" and self.device.type == "cuda":
            self._graphed = GraphedNetwork(self.model)

    @property
    def step(self) -> int:
        """Optimiser steps done, those before this session included."""
        return self.start + self.trainer.global_step

    def configure_optimizers(self) -> Any:
        """Adam, at its former state where there is one."""
        optimiser = Adam(self.model.parameters(), lr=self.config.learning_rate, weight_decay=self.config.weight_decay)
        if self.optimiser_state is not None:
            optimiser.load_state_dict(self.optimiser_state)
        schedule = LambdaLR(optimiser, lambda count: learning_rate_factor(self.config, self.start + count))
        return {"optimizer": optimiser, "lr_scheduler": {"scheduler": schedule, "interval": "step"}}

    def training_step(self, batch: dict[str, Any], _: int) -> Tensor:
        """The loss of one batch."""
        image1, image2 = batch["image1"], batch["image2"]
        if self.config.supervision == "registered":
            loss, parts = self._denoising(image1, image2, batch["flow"])
        elif self.config.supervision == "flow":
            loss, parts = flow_loss(self.network(image1, image2), batch["flow"], self.config.loss)
        elif self.config.supervision == "mixed":
            loss, parts = self._mixed(image1, image2, batch.get("flow"))
        else:
            loss, parts = self._self_supervised(image1, image2)
        self.last_loss = loss.detach()
        if (self.step + 1) % LOG_EVERY == 0:
            rate = self.config.learning_rate * learning_rate_factor(self.config, self.step)
            self.write({"train/loss": float(loss.detach()), "train/learning_rate": rate}
                        | {f"train/{name}": float(value) for name, value in parts.items()}, self.step + 1)  # fmt: skip
        return loss

    def _denoising(self, image1: Tensor, image2: Tensor, truth: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of the denoiser, on the network's registered flow."""
        model, settings = self.model, self.config.model.registration
        assert model.denoiser is not None
        assert settings is not None
        with torch.no_grad(), torch.autocast(image1.device.type, enabled=False):
            network = model(image1, image2)[0]
        image1 = without_specks(network, image1, image2)
        flow = registered(network, image1, image2, settings)
        return denoising_loss(model.denoiser, flow, network, image1, image2, truth)

    def _mixed(self, image1: Tensor, image2: Tensor, truth: Tensor | None) -> tuple[Tensor, dict[str, Tensor]]:
        """The endpoint loss of the pairs with a flow and the weighted self-supervised loss of the others.

        Each is a mean over its pairs and counts with their share of the batch.
        """
        pairs = image1.shape[0]
        known = torch.zeros(pairs, dtype=torch.bool, device=image1.device)
        if truth is not None:
            known = torch.isfinite(truth).all(dim=1).flatten(1).any(dim=1)
        share = known.float().mean()
        image1, image2 = self._directions(image1, image2)
        flows = self.network(image1, image2)
        loss = image1.new_zeros(())
        parts: dict[str, Tensor] = {}
        if truth is not None and bool(known.any()):
            supervised, parts = flow_loss([flow[:pairs][known] for flow in flows], truth[known], self.config.loss)
            loss = loss + share * supervised
        if not bool(known.all()):
            others = ~known.repeat(image1.shape[0] // pairs)
            alone, more = self._loss_of_images([flow[others] for flow in flows], image1[others], image2[others])
            loss, parts = loss + (1 - share) * self.config.mixed_self * alone, parts | more
        return loss, parts

    def _self_supervised(self, image1: Tensor, image2: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of pairs without an exact flow."""
        image1, image2 = self._directions(image1, image2)
        return self._loss_of_images(self.network(image1, image2), image1, image2)

    def _directions(self, image1: Tensor, image2: Tensor) -> tuple[Tensor, Tensor]:
        """The pairs, and after them the same with their images exchanged where occlusion asks for both directions."""
        if self.config.loss.occlusion != "forward_backward":
            return image1, image2
        return torch.cat([image1, image2]), torch.cat([image2, image1])

    def _loss_of_images(self, flows: list[Tensor], image1: Tensor, image2: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """The self-supervised loss of flows of `_directions`, with a second pass where lambda_ar asks for one."""
        config, visible = self.config.loss, None
        in_stage = not config.second_stage or self.step >= config.second_stage * self.config.steps
        if config.occlusion == "forward_backward" and in_stage:
            there, back = flows[0].chunk(2)
            visible = visible_in_both_images(flows[0], torch.cat([back, there]))
        loss, parts = self_supervised_loss(flows, image1, image2, config, visible)
        if config.lambda_ar > 0 and in_stage:
            # Fixed by (seed, step), so that a resumed run shows the same.
            random = torch.Generator().manual_seed(self.config.seed * 1_000_003 + self.step)
            first, second, target, pixels = transformed_pair(image1, image2, flows[0].detach(), random)
            # Not `network`, which a step may call only once.
            consistency = config.lambda_ar * consistency_loss(self.model(first, second)[0], target, pixels)
            loss, parts = loss + consistency, parts | {"consistency": consistency.detach()}
        return loss, parts

    def optimizer_step(self, *arguments: Any, **options: Any) -> None:
        """An optimiser step, and the average of the weights after it: before any callback saves the state."""
        super().optimizer_step(*arguments, **options)
        if self.average is not None:
            kept, new = list(self.average.parameters()), list(self.model.parameters())
            get_ema_multi_avg_fn(self.config.ema_decay)(kept, new, None)

    @property
    def evaluated(self) -> GelFlow:
        """The network that is validated and kept: the average where there is one."""
        return self.model if self.average is None else self.average

    def on_validation_epoch_start(self) -> None:
        self._sums = {}

    def validation_step(self, batch: dict[str, Any], _: int) -> None:
        """Adds one pair's metrics, in px of its own images."""
        check_side(batch, self.config)
        flow = estimate_flow(self.evaluated, batch["image1"], batch["image2"], self.config.image_size)
        for name, value in validation_metrics(batch, flow, self.config).items():
            if torch.isfinite(value):
                addend = torch.stack([value.double(), torch.ones_like(value, dtype=torch.float64)])
                self._sums[name] = self._sums.get(name, torch.zeros_like(addend)) + addend

    def on_validation_epoch_end(self) -> None:
        """Means over all pairs of all processes, into `metrics` and the logs."""
        means = {}
        for name in METRICS:
            sums = self._sums.get(name, torch.zeros(2, dtype=torch.float64, device=self.device))
            if self.trainer.world_size > 1:
                sums = torch.as_tensor(self.all_gather(sums)).sum(dim=0)
            if sums[1] > 0:
                means[name] = float(sums[0] / sums[1])
        self.metrics = means
        self.write({f"validation/{name}": value for name, value in means.items()}, self.step)

    def write(self, values: dict[str, float], step: int) -> None:
        """Puts values into all logs."""
        for logger in self.loggers:
            logger.log_metrics(values, step)


def check_side(batch: dict[str, Any], config: TrainConfig) -> None:
    """Refuses a validation pair, as a batch of one, that is too small for the network; the message names the pair."""
    rows, columns = batch["image1"].shape[-2:]
    if config.image_size is None and min(rows, columns) < MINIMUM_SIDE:
        raise InputError(f"validation pair {batch['name'][0]}: {rows}x{columns} px, but each side must be at least "
                         f"{MINIMUM_SIDE} px; set image_size to enlarge the images")  # fmt: skip


def validation_metrics(batch: dict[str, Any], flow: Tensor, config: TrainConfig) -> dict[str, Tensor]:
    """How good the flow of one pair is: against the truth where there is one, and by the warped image.

    Scalars by the names in `METRICS`; endpoint errors only where a flow is known. The others are NaN where the flow
    leads out of the image everywhere. PSNR is that of floats over the pixels that stay inside the image, not the 8-bit
    one of the comparison tables.
    """
    image1, image2 = batch["image1"], batch["image2"]
    still = torch.zeros_like(flow)
    metrics = {
        "psnr_db": _psnr(image1, image2, flow),
        "no_motion_psnr_db": _psnr(image1, image2, still),
        "photometric_loss": photometric_loss(image1, image2, flow, config.loss.alpha),
    }
    if not inside(flow).any():  # nothing was compared
        metrics |= {name: metrics[name] * torch.nan for name in ("psnr_db", "photometric_loss")}
    if "flow" in batch:
        truth = batch["flow"]
        known = torch.isfinite(truth).all(dim=1)
        metrics["endpoint_error_px"] = (flow - truth).norm(dim=1)[known].mean()
        metrics["no_motion_endpoint_error_px"] = truth.norm(dim=1)[known].mean()
    return metrics


def _psnr(image1: Tensor, image2: Tensor, flow: Tensor) -> Tensor:
    mask = inside(flow)
    squared = ((warp(image2, flow) - image1).square() * mask).sum() / (3 * mask.sum()).clamp(min=1)
    return -10 * torch.log10(squared.clamp(min=1e-10))
