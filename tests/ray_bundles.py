"""LiDAR rays to known ends."""

import torch

from src.structures.ray_bundle import RayBundle


def rays_to(ends, *, origin=(0.0, 0.0, 0.0), times_s=0.0, speeds=torch.nan, steps=0, batch=0):
    """One ray to each of R ends (ego metres) from one origin; the others are one value for all, or one each."""
    ends = torch.as_tensor(ends, dtype=torch.float32).reshape(-1, 3)
    origins = torch.tensor(origin, dtype=torch.float32).expand_as(ends).clone()
    away = ends - origins
    ranges = away.norm(dim=1)

    def each(value, dtype):
        return torch.as_tensor(value, dtype=dtype).expand(len(ends)).clone()

    return RayBundle(
        origins=origins, directions=away / ranges[:, None].clamp(min=1e-9), ranges=ranges,
        times_s=each(times_s, torch.float32), speeds=each(speeds, torch.float32),
        steps=each(steps, torch.int64), batch=each(batch, torch.int64),
    )  # fmt: skip
