import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from torch import nn

from src.models.backbones.vovnet import EffectiveSE, VoVNet99
from src.models.backbones.weights import BackboneName, load_backbone_weights

GOLDEN = Path(__file__).parents[2] / "golden" / "vovnet99"


@pytest.mark.slow
@pytest.mark.parametrize("origin", ["fcos3d", "dd3d"])
def test_published_names_load(tmp_path: Path, origin: str) -> None:
    listed = json.loads((GOLDEN / "tensors.json").read_text())
    # One stored number each: the file stays small, and every tensor is told from the others.
    marked = {e["name"]: torch.tensor(float(i)).expand(e["shape"]) for i, e in enumerate(listed)}
    if origin == "fcos3d":
        content = {"state_dict": {f"img_backbone.{k}": v for k, v in marked.items()} | {"img_neck.x": torch.ones(1)}}
    else:
        frozen = {k: v for k, v in marked.items() if not k.endswith("num_batches_tracked")}
        content = {"model": {f"backbone.bottom_up.{k}": v for k, v in frozen.items()}, "iteration": 3}
    torch.save(content, tmp_path / "weights.pth")
    model = VoVNet99()
    load_backbone_weights(model, tmp_path / "weights.pth", BackboneName.vovnet99)
    block = model.stages[2].blocks[8]
    for found, name in (
        (model.stem[0].conv.weight, "stem.stem_1/conv.weight"),
        (model.stem[2].bn.bias, "stem.stem_3/norm.bias"),
        (block.conv_mid[4].bn.running_var, "stage4.OSA4_9.layers.4.OSA4_9_4/norm.running_var"),
        (block.conv_concat.conv.weight, "stage4.OSA4_9.concat.OSA4_9_concat/conv.weight"),
        (block.attn.fc.bias, "stage4.OSA4_9.ese.fc.bias"),
    ):
        assert torch.equal(found, marked[name]), name


@pytest.mark.slow
def test_vovnet99_agrees_with_the_recorded_network(golden: Callable, tmp_path: Path) -> None:
    case = golden("vovnet99")
    torch.save(case.weights, tmp_path / "weights.pth")
    model = VoVNet99().eval()
    load_backbone_weights(model, tmp_path / "weights.pth", BackboneName.vovnet99)
    with torch.no_grad():
        for size in case.meta["inputs"]:
            x = case.input_of(size)
            case.check_map(f"{size}/stem", model.stem(x), 2e-5)
            for name, found in zip(("stage2", "stage3", "stage4", "stage5"), model(x), strict=True):
                case.check_map(f"{size}/{name}", found, 2e-5)


def test_size_and_batch_norm_mode() -> None:
    model = VoVNet99().train()
    assert sum(p.numel() for p in model.parameters()) == 69_523_520
    norms = [m for m in model.modules() if isinstance(m, nn.BatchNorm2d)]
    assert norms and not any(m.training for m in norms)
    assert all(m.weight.requires_grad and m.bias.requires_grad for m in norms)
    assert model.training and model.stages[0].training


@pytest.mark.slow
def test_every_parameter_gets_a_gradient() -> None:
    model = VoVNet99()
    sum((x**2).sum() for x in model(torch.randn(1, 3, 32, 64))).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_attention_gates_by_the_mean() -> None:
    gate = EffectiveSE(2)
    nn.init.zeros_(gate.fc.weight)
    with torch.no_grad():
        gate.fc.bias.copy_(torch.tensor([0.0, 6.0]))
    x = torch.randn(1, 2, 3, 3)
    torch.testing.assert_close(gate(x), x * torch.tensor([0.5, 1.0]).view(1, 2, 1, 1))  # relu6(0 + 3) / 6, relu6(9) / 6
