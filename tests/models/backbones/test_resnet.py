from collections.abc import Callable

import pytest
import torch

from src.models.backbones.resnet import BasicBlock, Bottleneck, ResNet


@pytest.mark.slow
def test_resnet50_agrees_with_the_recorded_network(golden: Callable) -> None:
    case = golden("resnet50")
    model = ResNet(Bottleneck, [64, 128, 256, 512], [3, 4, 6, 3]).eval()
    model.load_state_dict({name: value for name, value in case.weights.items() if not name.startswith("fc.")})
    with torch.no_grad():
        for size in case.meta["inputs"]:
            x = case.input_of(size)
            case.check_map(f"{size}/stem", model.stem(x), 2e-5)
            for name, found in zip(("layer1", "layer2", "layer3", "layer4"), model(x), strict=True):
                case.check_map(f"{size}/{name}", found, 2e-5)


def test_resnet50_has_the_published_size() -> None:
    model = ResNet(Bottleneck, [64, 128, 256, 512], [3, 4, 6, 3])
    assert sum(p.numel() for p in model.parameters()) == 23_508_032
    assert model.out_channels == [256, 512, 1024, 2048]


def test_basic_blocks_keep_the_identity_where_nothing_changes() -> None:
    model = ResNet(BasicBlock, [16, 32, 64, 128], [2, 2, 2, 2])
    names = {name for name, _ in model.named_parameters()}
    assert not any(name.startswith("layer1.0.downsample") for name in names)
    assert "layer2.0.downsample.0.weight" in names and not any(n.startswith("layer2.1.downsample") for n in names)


@pytest.mark.parametrize(("height", "width"), [(64, 96), (32, 32)])
def test_stages_have_strides_4_to_32(height: int, width: int) -> None:
    model = ResNet(BasicBlock, [8, 8, 16, 16], [1, 1, 1, 1])
    shapes = [tuple(x.shape[1:]) for x in model(torch.randn(2, 3, height, width))]
    strides = (4, 8, 16, 32)
    assert shapes == [(c, height // s, width // s) for c, s in zip(model.out_channels, strides, strict=True)]
