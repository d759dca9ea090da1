import pytest
import torch
import torch.nn.functional as F

from src.errors import ConfigError
from src.models.lrs4fusion.ray_head import RayHead, RayHeadConfig

CONV = [6, 5, 4, 4, 4, 3]


def settings(**changes):
    values = {"num_samples": 200, "encode_channels": 7, "conv_channels": CONV, "mlp_channels": [8, 6]}
    return RayHeadConfig(**(values | changes))


def test_lengths_are_the_papers():
    assert settings(num_samples=2000).lengths == [2000, 999, 498, 248, 123, 60, 29]
    assert 8 * settings(num_samples=1982).lengths[-1] == 8 * settings(num_samples=2045).lengths[-1] == 232
    assert settings(num_samples=1981).lengths[-1] == 28 and settings(num_samples=2046).lengths[-1] == 30
    assert settings(num_samples=190).lengths[-1] == 1
    with pytest.raises(ConfigError, match="num_samples=189: must be at least 190 for 6 convolutions"):
        settings(num_samples=189)


def plain(head, occupancy):
    """The formula as it is written: every sample encoded to all channels first."""
    places = head.places.to(occupancy.dtype)
    x = head.occupancy(occupancy[..., None]) + head.place(places[:, None])  # [R, N, C]
    x = x.transpose(1, 2)
    for conv in head.convs:
        x = F.relu(conv(x))
    x = x.flatten(1)
    for layer in head.mlp[:-1]:
        x = F.relu(layer(x))
    return head.mlp[-1](x)[:, 0] * head.reach_m


def test_the_folded_encoding_changes_nothing():
    """Values and the gradients of every parameter."""
    torch.manual_seed(0)
    head = RayHead(settings(), 50.0).double()
    occupancy = torch.rand(5, 200, dtype=torch.float64, requires_grad=True)
    inputs = (occupancy, *head.parameters())
    results = []
    for forward in (head, lambda x: plain(head, x)):
        out = forward(occupancy)
        results.append((out, *torch.autograd.grad(out.square().sum(), inputs)))
    torch.testing.assert_close(*results)
    assert results[0][0].shape == (5,)


def test_samples_lie_evenly_in_the_middle_of_their_steps():
    samples = RayHead(settings(), 50.0).samples_m
    assert samples[0] == pytest.approx(0.125) and samples[-1] == pytest.approx(49.875)
    torch.testing.assert_close(samples.diff(), torch.full((199,), 0.25))


def test_an_untrained_head_tells_rays_apart():
    """Matter 10 m deep from 2 to 180 m away; with torch's own initialisation all ranges lie within 2 cm."""
    config = settings(num_samples=512, encode_channels=32, conv_channels=[32, 16, 16, 16, 8, 8], mlp_channels=[32, 16])
    begin = torch.linspace(2, 180, 64)[:, None]
    for seed in range(3):
        torch.manual_seed(seed)
        head = RayHead(config, 200.0)
        occupancy = ((head.samples_m >= begin) & (head.samples_m < begin + 10)).float()
        assert head(occupancy).std() > 1.0


@pytest.mark.slow
def test_it_learns_where_occupancy_begins():
    torch.manual_seed(0)
    head = RayHead(settings(num_samples=256, encode_channels=16, conv_channels=[16] * 5 + [8]), 50.0)
    optimizer = torch.optim.Adam(head.parameters(), lr=3e-3)
    for _ in range(150):
        truth = torch.rand(64) * 45 + 2
        occupancy = (head.samples_m > truth[:, None]).float()
        loss = (head(occupancy) - truth).abs().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert loss < 3.0  # 11 for the same answer to every ray
