"""What layers of transformers are made of: their linear layers, their MLPs, their heads."""

from __future__ import annotations

import torch
from torch import nn

from src.errors import ConfigError

NUM_HEADS = 4


def check_image_heads(channels: int) -> None:
    """Raises ConfigError for channels (`model.channels`) that the heads of image attention do not divide."""
    if channels < 1 or channels % NUM_HEADS:
        raise ConfigError(f"model.channels={channels}: must be a multiple of {NUM_HEADS}, the heads of image attention")


def linear_relu_norm(in_channels: int, channels: int) -> nn.Sequential:
    """Linear, ReLU, LayerNorm, twice."""
    layers: list[nn.Module] = []
    for width in (in_channels, channels):
        layers += [nn.Linear(width, channels), nn.ReLU(), nn.LayerNorm(channels)]
    return nn.Sequential(*layers)


def feed_forward(channels: int, ratio: int) -> nn.Sequential:
    """Linear to `ratio` times the channels, ReLU, linear back (the MLP of a transformer layer)."""
    return nn.Sequential(nn.Linear(channels, ratio * channels), nn.ReLU(), nn.Linear(ratio * channels, channels))


def attention_linear(in_channels: int, out_channels: int, zero: bool = False) -> nn.Linear:
    """Linear layer with zero bias and Xavier (or zero) weights."""
    layer = nn.Linear(in_channels, out_channels)
    nn.init.zeros_(layer.bias)
    if zero:
        nn.init.zeros_(layer.weight)
    else:
        nn.init.xavier_uniform_(layer.weight)
    return layer


def scale_shift_linear(channels: int) -> nn.Linear:
    """Linear layer to a scale and a shift per channel: ones and zeros as long as it is untrained."""
    layer = nn.Linear(channels, 2 * channels)
    nn.init.zeros_(layer.weight)
    with torch.no_grad():
        layer.bias.copy_(torch.cat([torch.ones(channels), torch.zeros(channels)]))
    return layer
