import zipfile
from pathlib import Path

import pytest
import torch

from src.errors import CheckpointError
from src.models.backbones.resnet import Bottleneck, ResNet
from src.models.backbones.weights import BackboneName, load_backbone_weights


def tiny() -> ResNet:
    return ResNet(Bottleneck, [4, 4, 4, 4], [1, 1, 1, 1])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "weights.pth"


def test_torchvision_file_loads_without_its_classifier(path: Path) -> None:
    source, target = tiny(), tiny()
    content = source.state_dict() | {"fc.weight": torch.ones(10, 16), "fc.bias": torch.ones(10)}
    content = {key: value for key, value in content.items() if not key.endswith("num_batches_tracked")}  # as old files
    torch.save(content, path)
    load_backbone_weights(target, path, BackboneName.resnet50)
    for name, value in source.state_dict().items():
        assert torch.equal(target.state_dict()[name], value), name


def refused(path: Path, content: object) -> str:
    torch.save(content, path)
    model = tiny()
    before = {name: value.clone() for name, value in model.state_dict().items()}
    with pytest.raises(CheckpointError) as caught:
        load_backbone_weights(model, path, BackboneName.resnet50)
    assert all(torch.equal(value, before[name]) for name, value in model.state_dict().items())
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_missing_and_unknown_tensors_are_named(path: Path) -> None:
    content = dict(tiny().state_dict())
    content["layer9.weight"] = content.pop("layer1.0.conv1.weight")
    message = refused(path, content)
    assert "1 (layer1.0.conv1.weight) are missing" in message and "1 (layer9.weight) are unknown" in message


def test_long_lists_are_shortened(path: Path) -> None:
    message = refused(path, {"conv1.weight": torch.ones(1)})
    assert ", ...)" in message and message.count("layer") < 10


def test_other_shapes_are_refused(path: Path) -> None:
    content = dict(tiny().state_dict())
    content["conv1.weight"] = torch.ones(5, 3, 7, 7)
    assert "conv1.weight [5, 3, 7, 7] instead of [4, 3, 7, 7]" in refused(path, content)


def test_weights_of_another_network_are_refused(path: Path) -> None:
    message = refused(path, {"model": {"backbone.bottom_up.stem.stem_1/conv.weight": torch.ones(64, 3, 3, 3)}})
    assert "stem.stem_1/conv.weight" in message


@pytest.mark.parametrize("content", [[1, 2], {"epoch": 3}, torch.ones(2)])
def test_content_that_is_no_state_dict_is_refused(path: Path, content: object) -> None:
    assert "expected" in refused(path, content)


def test_unreadable_files_are_refused(path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such file"):
        load_backbone_weights(tiny(), path, BackboneName.resnet50)
    torch.save(tiny().state_dict(), path)
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(CheckpointError, match="reading it failed"):
        load_backbone_weights(tiny(), path, BackboneName.resnet50)
    path.write_bytes(b"")
    with pytest.raises(CheckpointError, match="reading it failed"):
        load_backbone_weights(tiny(), path, BackboneName.resnet50)


class Intruder:
    """Not a tensor: must never be unpickled."""

    def __reduce__(self) -> tuple:
        return (pytest.fail, ("code of the file was run",))


def test_code_in_a_file_is_never_run(path: Path) -> None:
    assert "tensors only" in refused(path, {"conv1.weight": Intruder()})


@pytest.mark.parametrize("value", [float("nan"), float("-inf"), 1e30])
def test_weights_that_cannot_be_are_refused(path: Path, value: float) -> None:
    content = tiny().state_dict()
    content["bn1.running_var"][1] = value
    assert "1 (bn1.running_var)" in refused(path, content) and "download it again" in refused(path, content)


def test_tensors_of_other_kinds_are_refused(path: Path) -> None:
    content = tiny().state_dict()
    for other in (content["bn1.weight"].to(torch.complex64), content["bn1.weight"].to_sparse(), torch.ones(4).bool()):
        assert "bn1.weight" in refused(path, content | {"bn1.weight": other})


def test_a_flipped_bit_is_found_by_the_checksum(path: Path) -> None:
    torch.save(tiny().state_dict(), path)
    content = bytearray(path.read_bytes())
    at = content.index(tiny().state_dict()["bn1.weight"].numpy().tobytes())
    content[at + 2] ^= 1  # 1.0 becomes 1.0078, which torch reads without a word
    path.write_bytes(content)
    with pytest.raises(CheckpointError, match="checksum of .* is wrong"):
        load_backbone_weights(tiny(), path, BackboneName.resnet50)


def test_an_archive_larger_than_its_file_is_refused(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(50_000_000))
    with pytest.raises(CheckpointError, match="larger than the file"):
        load_backbone_weights(tiny(), path, BackboneName.resnet50)


def test_the_older_format_is_read_too(path: Path) -> None:
    source, target = tiny(), tiny()
    torch.save(source.state_dict(), path, _use_new_zipfile_serialization=False)
    load_backbone_weights(target, path, BackboneName.resnet50)
    assert torch.equal(target.conv1.weight, source.conv1.weight)
