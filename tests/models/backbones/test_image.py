from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from src.errors import ConfigError
from src.models.backbones.image import (
    FPN,
    ImageEncoder,
    ImageEncoderConfig,
    NeckName,
    build_backbone,
    count_black_rows,
)
from src.models.backbones.weights import BackboneName

SMALL = ImageEncoderConfig(
    name=BackboneName.small,
    image_size_px=[64, 96],
    weights=None,
    lr_multiplier=1.0,
    neck=NeckName.fpn,
    neck_channels=16,
    trim_padding=False,
    widths=[8, 8, 16, 16],
    blocks=[1, 1, 1, 1],
)


def random_images(batch: int = 2, views: int = 3, height: int = 64, width: int = 96) -> torch.Tensor:
    return torch.randint(1, 256, (batch, views, 3, height, width), dtype=torch.uint8)


def published(name: BackboneName) -> ImageEncoderConfig:
    return replace(SMALL, name=name, neck_channels=256, widths=None, blocks=None)


@pytest.mark.parametrize(
    ("name", "millions", "neck_millions"), [(BackboneName.resnet50, 26.2, 2.69), (BackboneName.vovnet99, 71.9, 2.36)]
)
def test_parameter_counts(name: BackboneName, millions: float, neck_millions: float) -> None:
    with torch.device("meta"):
        backbone = build_backbone(published(name))
        neck = FPN(backbone.out_channels, 256)
    own = sum(p.numel() for p in backbone.parameters()) / 1e6
    added = sum(p.numel() for p in neck.parameters()) / 1e6
    assert own + added == pytest.approx(millions, rel=0.005)
    assert added == pytest.approx(neck_millions, rel=0.005)


def test_levels_have_their_shapes_and_every_parameter_a_gradient() -> None:
    encoder = ImageEncoder(SMALL)
    levels = encoder(random_images())
    assert [tuple(x.shape) for x in levels] == [(2, 3, 16, 64 // s, 96 // s) for s in encoder.strides]
    assert encoder.strides == (8, 16, 32) and encoder.channels == 16
    sum((x**2).sum() for x in levels).backward()
    assert [name for name, p in encoder.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_single_map_neck() -> None:
    encoder = ImageEncoder(replace(SMALL, neck=NeckName.secondfpn16, neck_channels=32))
    levels = encoder(random_images())
    assert encoder.strides == (16,) and [tuple(x.shape) for x in levels] == [(2, 3, 32, 4, 6)]
    (levels[0] ** 2).sum().backward()
    assert all(p.grad is not None and p.grad.any() for p in encoder.parameters())


def test_views_and_samples_do_not_mix_in_evaluation() -> None:
    encoder = ImageEncoder(SMALL).eval()
    images = random_images()
    changed = images.clone()
    changed[1, 0] = 255 - changed[1, 0]
    with torch.no_grad():
        for before, after in zip(encoder(images), encoder(changed), strict=True):
            same = (before == after).flatten(2).all(2)
            assert same.tolist() == [[True] * 3, [False, True, True]]


def test_fpn_adds_the_coarser_level_upwards() -> None:
    neck = FPN([1, 1, 1, 1], 1)
    for conv in neck.laterals:
        nn.init.ones_(conv.weight)
    for conv in neck.outputs:
        nn.init.dirac_(conv.weight)
    stages = [torch.zeros(1, 1, 8, 8)] + [torch.full((1, 1, s, s), v) for s, v in ((4, 1.0), (2, 10.0), (1, 100.0))]
    stages[2][0, 0, 0, 1] = 20.0
    fine, middle, coarse = neck(stages)
    assert coarse.item() == 100
    assert middle[0, 0].tolist() == [[110, 120], [110, 110]]
    assert fine[0, 0, 0].tolist() == [111, 111, 121, 121] and fine[0, 0, 2].tolist() == [111] * 4


@pytest.mark.slow
def test_normalisation_follows_the_backbone() -> None:
    pixel = torch.tensor([124, 116, 104], dtype=torch.uint8).view(1, 3, 1, 1).expand(1, 3, 32, 32)
    rgb = ImageEncoder(SMALL).normalise(pixel)[0, :, 0, 0]
    expected = (torch.tensor([124, 116, 104]) / 255 - torch.tensor([0.485, 0.456, 0.406])) / torch.tensor(
        [0.229, 0.224, 0.225]
    )
    torch.testing.assert_close(rgb, expected, atol=1e-5, rtol=1e-4)
    bgr = ImageEncoder(published(BackboneName.vovnet99))
    found = bgr.normalise(pixel)[0, :, 0, 0]
    expected = torch.tensor([0.47 / 57.375, -0.28 / 57.12, 0.325 / 58.395])
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=1e-3)


def test_trimmed_rows_come_back_as_zeros_and_the_rest_keeps_its_place() -> None:
    encoder = ImageEncoder(replace(SMALL, trim_padding=True, image_size_px=[128, 96])).eval()
    images = random_images(height=128)
    images[:, :, :, :70] = 0  # two whole stride-32 rows and a part of the third
    images[0, 1] = 0  # a missing camera holds nobody back
    below = ImageEncoder(replace(SMALL)).eval()
    below.load_state_dict(encoder.state_dict())
    with torch.no_grad():
        for stride, whole, part in zip(encoder.strides, encoder(images), below(images[:, :, :, 64:]), strict=True):
            assert whole.shape[-2:] == (128 // stride, 96 // stride)
            assert not whole[..., : 64 // stride, :].any()
            assert torch.equal(whole[..., 64 // stride :, :], part)


def test_only_rows_black_in_every_view_are_skipped() -> None:
    views = torch.zeros(2, 3, 128, 32, dtype=torch.uint8)
    assert count_black_rows(views) == 96  # something must be left
    views[0, :, 100:] = 9
    assert count_black_rows(views) == 96
    views[1, 2, 40, 7] = 1
    assert count_black_rows(views) == 32
    views[1, 2, 31, 7] = 1
    assert count_black_rows(views) == 0


def test_images_of_another_size_or_type_are_refused() -> None:
    encoder = ImageEncoder(SMALL)
    with pytest.raises(ValueError, match=r"\[B, N, 3, 64, 96\] uint8"):
        encoder(random_images(width=64))
    with pytest.raises(ValueError, match="uint8"):
        encoder(random_images().float())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image_size_px": [60, 96]}, r"image_size_px=\[60, 96\]: must be \[height, width\], each a multiple of 32"),
        ({"widths": None}, "widths=None: backbone.name=small needs four"),
        ({"blocks": [1, 1]}, r"blocks=\[1, 1\]"),
        ({"name": BackboneName.resnet50}, "must be null, only"),
        ({"neck": NeckName.secondfpn16, "neck_channels": 30}, "neck_channels=30"),
        ({"weights": "x.pth"}, "weights=x.pth: must be null, there are none"),
        ({"lr_multiplier": -1.0}, "lr_multiplier=-1.0"),
    ],
)
def test_impossible_settings_are_refused(change: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(SMALL, **change)


@pytest.mark.slow
def test_pretrained_weights_fill_the_backbone(tmp_path: Path) -> None:
    config = published(BackboneName.resnet50)
    source = build_backbone(config)
    torch.save(source.state_dict(), tmp_path / "resnet50.pth")
    encoder = ImageEncoder(replace(config, weights=str(tmp_path / "resnet50.pth")))
    for name, value in source.state_dict().items():
        assert torch.equal(encoder.backbone.state_dict()[name], value), name
    assert not any(key.startswith(("mean", "std")) for key in encoder.state_dict())
