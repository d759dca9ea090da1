"""Pretrained image backbones: published files loaded into our modules, completely or not at all (method 3)."""

from __future__ import annotations

import io
import re
import zipfile
from enum import Enum
from pathlib import Path

import torch
from torch import Tensor, nn

from src.errors import CheckpointError

WRAPPERS = ("state_dict", "model")
PREFIXES = ("img_backbone.", "backbone.bottom_up.")  # FCOS3D, DD3D
LISTED_KEYS = 5
LARGEST = 1e9
"""Largest size of a weight or a variance that is taken; those of published files stay far below."""


class BackboneName(Enum):
    """The image backbones; members are spelled as in the configuration."""

    resnet50 = "resnet50"
    vovnet99 = "vovnet99"
    small = "small"


def load_backbone_weights(module: nn.Module, path: str | Path, name: BackboneName) -> None:
    """Fill an image backbone from a published checkpoint file; nothing is ever downloaded.

    Takes torchvision and timm files for `resnet50`, FCOS3D and DD3D files for `vovnet99`. Every tensor of the module
    must be in the file with the same shape, and nothing else may be left over; only the classifier of a ResNet and the
    batch counters, which frozen and old batch norms lack, are exempt.

    Raises CheckpointError for a missing or unreadable file and for tensors that do not match; the module then stays as
    it was.
    """
    found = {_rename(key, name): value for key, value in _read_tensors(Path(path)).items()}
    if name is BackboneName.resnet50:
        found = {key: value for key, value in found.items() if not key.startswith("fc.")}
    expected = module.state_dict()
    for key, value in expected.items():
        if key.endswith(".num_batches_tracked"):
            found.setdefault(key, value)
    missing = [key for key in expected if key not in found]
    unexpected = [key for key in found if key not in expected]
    if missing or unexpected:
        raise CheckpointError(
            f"backbone.weights={path}: must hold exactly the tensors of {name.value}, but {_listed(missing)} are "
            f"missing and {_listed(unexpected)} are unknown; use a file made for this backbone, or null"
        )
    wrong = [
        f"{key} {list(found[key].shape)} instead of {list(value.shape)}"
        for key, value in expected.items()
        if found[key].shape != value.shape
    ]
    if wrong:
        raise CheckpointError(
            f"backbone.weights={path}: {_listed(wrong)} differ in shape from {name.value}; "
            "use a file made for this backbone"
        )
    damaged = [key for key, value in expected.items() if value.is_floating_point() and not _is_sound(found[key])]
    if damaged:
        raise CheckpointError(
            f"backbone.weights={path}: {_listed(damaged)} must hold finite numbers of at most {LARGEST:g} in size; "
            "the file is damaged: download it again"
        )
    module.load_state_dict(found)


def _read_tensors(path: Path) -> dict[str, Tensor]:
    """The backbone's tensors in a file, out of their wrapper and without their prefix."""
    if not path.is_file():
        raise CheckpointError(f"backbone.weights={path}: no such file; download it first or set backbone.weights=null")
    try:
        content = torch.load(_checked_file(path), map_location="cpu", weights_only=True)
    except MemoryError:
        raise
    except Exception as error:  # a damaged pickle fails in many ways, all of them harmless
        raise CheckpointError(
            f"backbone.weights={path}: expected a torch file with tensors only, but reading it failed "
            f"({type(error).__name__}: {str(error).splitlines()[0] if str(error) else 'no reason given'}); "
            "download it again, or save its state dict alone"
        ) from error
    for wrapper in WRAPPERS:
        if isinstance(content, dict) and isinstance(content.get(wrapper), dict):
            content = content[wrapper]
            break
    if not isinstance(content, dict):
        raise CheckpointError(f"backbone.weights={path}: expected a dict of tensors, but got {type(content).__name__}")
    content = {str(key): value for key, value in content.items()}
    for prefix in PREFIXES:
        if any(key.startswith(prefix) for key in content):
            content = {key[len(prefix) :]: value for key, value in content.items() if key.startswith(prefix)}
            break
    others = [key for key, value in content.items() if not isinstance(value, Tensor)]
    if others:
        raise CheckpointError(f"backbone.weights={path}: expected tensors only, but {_listed(others)} are none")
    return content


def _is_sound(value: Tensor) -> bool:
    plain = value.is_floating_point() and value.layout is torch.strided
    return plain and bool((value.abs() <= LARGEST).all())  # NaN is not


def _checked_file(path: Path) -> Path | io.BytesIO:
    """What to load from. Raises ValueError for an archive with damage that torch would ignore, or larger than its file.

    A file of the older format is read as a whole: torch would read as many bytes as a damaged length says.
    """
    if not zipfile.is_zipfile(path):
        return io.BytesIO(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > path.stat().st_size:
            raise ValueError("its parts are larger than the file")
        damaged = archive.testzip()
    if damaged is not None:
        raise ValueError(f"the checksum of {damaged} in it is wrong")
    return path


def _rename(key: str, name: BackboneName) -> str:
    """Our name of a published tensor; ResNet keeps the published names, V2-99 loses its slashes and repetitions."""
    if name is not BackboneName.vovnet99:
        return key
    key = re.sub(r"/norm\.", ".bn.", key).replace("/conv.", ".conv.")
    key = re.sub(r"^stem\.stem_(\d+)\.", lambda m: f"stem.{int(m[1]) - 1}.", key)
    key = re.sub(r"^stage(\d+)\.OSA\d+_(\d+)\.", lambda m: f"stages.{int(m[1]) - 2}.blocks.{int(m[2]) - 1}.", key)
    key = re.sub(r"\.layers\.(\d+)\.OSA\w+\.", r".conv_mid.\1.", key)
    key = re.sub(r"\.concat\.OSA\w+\.", ".conv_concat.", key)
    return key.replace(".ese.fc.", ".attn.fc.")


def _listed(keys: list[str]) -> str:
    """The number of keys and the first few of them."""
    if not keys:
        return "none"
    return f"{len(keys)} ({', '.join(keys[:LISTED_KEYS])}{', ...' if len(keys) > LISTED_KEYS else ''})"
