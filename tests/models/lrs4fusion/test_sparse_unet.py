import pytest
import torch
import torch.nn.functional as F

from src.errors import ConfigError
from src.models.lrs4fusion.sparse_unet import DecoderLevel, SparseUNet
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseMap
from tests.ops.maps import random_sites

NORM = {"eps": 1e-3, "momentum": 0.1}
ENCODER, DECODER = [[4], [6, 8], [8]], [[8, 8, 8], [8, 8, 4], [4, 4, 5]]


def unet():
    torch.manual_seed(0)
    return SparseUNet(3, ENCODER, DECODER, **NORM)


def random_map(sites, channels):
    return SparseMap(sites, torch.randn(len(sites), channels, generator=torch.Generator().manual_seed(1)))


def test_every_level_sees_its_own_sites_and_the_finest_are_kept():
    net, x = unet(), random_map(random_sites((2, 8, 12, 16), 120), 3)
    seen = []
    for level in net.decoder:
        level.register_forward_hook(lambda _, inputs, out: seen.append((inputs[0].sites.shape, out.sites.shape)))
    y = net(x)
    assert y.sites is x.sites and y.channels == net.out_channels == 5
    assert seen == [((2, 2, 3, 4), (2, 4, 6, 8)), ((2, 4, 6, 8), (2, 8, 12, 16)), ((2, 8, 12, 16), (2, 8, 12, 16))]
    y.features.square().sum().backward()
    assert [name for name, p in net.named_parameters() if p.grad is None] == []


def test_a_level_adds_the_lateral_and_what_came_up():
    """out = up(merge([bottom, lateral]) + sums of neighbouring channels of [bottom, lateral])."""
    level = DecoderLevel(4, 4, 5, upsamples=False, **NORM).eval()
    bottom, encoded = (random_map(random_sites((1, 4, 5, 6), 40), 4) for _ in range(2))
    encoded = SparseMap(bottom.sites, encoded.features + 1)
    lateral = level.lateral(encoded).features
    both = torch.cat([bottom.features, lateral], 1)
    sums = both[:, 0::2] + both[:, 1::2]
    merged = F.relu(level.merge.norm(level.merge.conv(bottom.with_features(both)).features)) + sums
    expected = level.up(bottom.with_features(merged))
    torch.testing.assert_close(level(bottom, encoded, None).features, expected.features)


def test_samples_do_not_mix_and_a_cloud_may_be_empty():
    net = unet().eval()
    both = random_map(random_sites((2, 8, 8, 8), 60), 3)
    first = both.indices[:, 0] == 0
    alone = SparseMap(Sites((2, 8, 8, 8), both.sites.keys[first]), both.features[first])
    torch.testing.assert_close(net(both).features[first], net(alone).features)
    net.train()
    empty = net(SparseMap(Sites((2, 8, 8, 8), both.sites.keys[:0]), both.features[:0]))
    assert empty.features.shape == (0, 5)
    empty.features.sum().backward()
    assert all(p.grad is not None and not p.grad.any() for p in net.parameters())


@pytest.mark.parametrize(
    ("encoder", "decoder", "message"),
    [
        (ENCODER, DECODER[:2], "three positive widths for each of the 3 levels"),
        (ENCODER, [[8, 8, 8], [8, 8, 4], [4, 4]], "three positive widths"),
        ([[4], [], [8]], DECODER, "at least one positive width"),
        (ENCODER, [[8, 8, 6], [8, 8, 4], [4, 4, 5]], "entry 1 begins with 8, but must with the width 8 of its encoder"),
        (ENCODER, [[8, 5, 8], [8, 8, 4], [4, 4, 5]], "its second must divide twice that"),
    ],
)
def test_widths_that_do_not_fit(encoder, decoder, message):
    with pytest.raises(ConfigError, match=message):
        SparseUNet(3, encoder, decoder, **NORM)
