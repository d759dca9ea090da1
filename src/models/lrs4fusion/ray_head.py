"""LiDAR forecasting: the range of a ray from occupancy along it, by convolutions in one dimension (lrs 5.8)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from src.errors import ConfigError, require_least
from src.losses.normalizers import full_precision

KERNEL, STRIDE = 4, 2


@dataclass(kw_only=True)
class RayHeadConfig:
    """Settings of the head (`model.ray_head`). Raises ConfigError for too few samples for its convolutions."""

    num_samples: int  # N, along every ray
    encode_channels: int
    conv_channels: list[int]
    mlp_channels: list[int]

    def __post_init__(self) -> None:
        require_least(self, "model.ray_head", {"encode_channels": 1})
        for name in ("conv_channels", "mlp_channels"):
            if not getattr(self, name) or min(getattr(self, name)) < 1:
                raise ConfigError(f"model.ray_head.{name}={getattr(self, name)}: must list positive widths")
        if self.lengths[-1] < 1:
            least = 1
            for _ in self.conv_channels:
                least = STRIDE * (least - 1) + KERNEL
            raise ConfigError(
                f"model.ray_head.num_samples={self.num_samples}: must be at least {least} for "
                f"{len(self.conv_channels)} convolutions of width {KERNEL} and stride {STRIDE}"
            )

    @property
    def lengths(self) -> list[int]:
        """Number of samples before and after every convolution; none pads."""
        lengths = [self.num_samples]
        for _ in self.conv_channels:
            lengths.append((lengths[-1] - KERNEL) // STRIDE + 1)
        return lengths


class RayHead(nn.Module):
    """Occupancy at N even samples of a ray to its range.

    e_n = L(o_n) + L(s_n / r_max), convolutions with ReLU, all samples through an MLP, times r_max. Runs in float32 also
    under autocast: its output is metres.
    """

    full_precision_parts = ("",)

    def __init__(
        self,
        config: RayHeadConfig,
        reach_m: float,  # r_max
    ) -> None:
        super().__init__()
        self.reach_m = reach_m
        places = (torch.arange(config.num_samples) + 0.5) / config.num_samples
        self.register_buffer("places", places, persistent=False)  # s_n / r_max
        width = config.encode_channels
        self.occupancy, self.place = nn.Linear(1, width), nn.Linear(1, width)
        widths = [width, *config.conv_channels]
        self.convs = nn.ModuleList(
            nn.Conv1d(before, after, KERNEL, STRIDE) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        widths = [config.lengths[-1] * widths[-1], *config.mlp_channels, 1]
        self.mlp = nn.ModuleList(
            nn.Linear(before, after) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        self._initialize()

    def _initialize(self) -> None:
        """Encodings of zero mean over what they encode, and Kaiming's weights (ours).

        torch's own fade through eight layers of ReLU: an untrained head gives all rays one range within centimetres,
        many channels die, and with some seeds the head learns little.
        """
        for layer in (*self.convs, *self.mlp[:-1]):
            nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
            nn.init.zeros_(layer.bias)
        for encoding in (self.occupancy, self.place):
            with torch.no_grad():
                encoding.bias.copy_(-0.5 * encoding.weight[:, 0])

    @property
    def samples_m(self) -> Tensor:  # [N]
        """Distances of the samples from the ray's origin."""
        return self.places * self.reach_m

    def forward(
        self,
        occupancy: Tensor,  # [R, N] probabilities at `samples_m`
    ) -> Tensor:  # [R] m
        with torch.autocast(occupancy.device.type, enabled=False):
            occupancy = full_precision(occupancy)
            inputs = torch.stack([occupancy, self.places.to(occupancy.dtype).expand_as(occupancy)], dim=1)  # [R, 2, N]
            # The encoding is linear, so it goes into the first convolution: 2 channels a sample in place of 128.
            first, *others = self.convs
            encode = torch.cat([self.occupancy.weight, self.place.weight], dim=1)  # [C, 2]
            weight = torch.einsum("ock,ci->oik", first.weight, encode)
            bias = first.bias + first.weight.sum(2) @ (self.occupancy.bias + self.place.bias)
            x = F.relu(F.conv1d(inputs, weight, bias, STRIDE))
            for conv in others:
                x = F.relu(conv(x))
            x = x.flatten(1)
            *hidden, last = self.mlp
            for layer in hidden:
                x = F.relu(layer(x))
            return last(x).squeeze(1) * self.reach_m
