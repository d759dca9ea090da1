import resource
import subprocess
import sys

import pytest
import torch
from torch import nn

from src.errors import CheckpointError
from src.training.checkpoints import AtomicCheckpointIO, load_model_weights, read_checkpoint


def content(model):
    return {"state_dict": {f"model.{k}": v for k, v in model.state_dict().items()}, "horizon3d": {"config": {"a": 1}}}


def test_round_trip(tmp_path):
    model, other = nn.Linear(3, 2), nn.Linear(3, 2)
    path = tmp_path / "deep" / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(model), path)
    checkpoint = read_checkpoint(path)
    load_model_weights(other, checkpoint, path)
    assert torch.equal(model.weight, other.weight) and checkpoint["horizon3d"]["config"] == {"a": 1}
    assert [p.name for p in path.parent.iterdir()] == ["last.ckpt"]


@pytest.mark.parametrize("damage", ["empty", "truncated", "flipped", "text", "foreign", "other values"])
def test_damaged_files_are_named(tmp_path, damage):
    path = tmp_path / "x.ckpt"
    model = nn.Linear(30, 20)
    AtomicCheckpointIO().save_checkpoint(content(model), path)
    data = path.read_bytes()
    flipped = bytearray(data)
    flipped[data.index(model.weight.detach().numpy().tobytes())] ^= 0xFF  # one bit pattern of one weight
    if damage == "foreign":
        torch.save({"weights": torch.zeros(2)}, path)
    elif damage == "other values":
        torch.save({"state_dict": {"model.weight": "hello"}, "horizon3d": {"config": {}}}, path)
    else:
        path.write_bytes(
            {"empty": b"", "truncated": data[: len(data) // 2], "flipped": bytes(flipped), "text": b"hello"}[damage]
        )
    with pytest.raises(CheckpointError, match=r"x\.ckpt"):
        read_checkpoint(path)


def test_code_in_a_checkpoint_is_not_run(tmp_path):
    canary = tmp_path / "canary"

    class Malicious:
        def __reduce__(self):
            return (open, (str(canary), "w"))

    path = tmp_path / "x.ckpt"
    torch.save({"state_dict": Malicious(), "horizon3d": {}}, path)
    with pytest.raises(CheckpointError, match="nothing in it was executed"):
        read_checkpoint(path)
    assert not canary.exists()


def test_a_checkpoint_of_another_model_names_the_keys(tmp_path):
    with pytest.raises(CheckpointError, match=r"bias.*weight is \[2, 3\], the model has \[2, 4\]"):
        load_model_weights(nn.Linear(4, 2), content(nn.Linear(3, 2, bias=False)), tmp_path / "x.ckpt")


def test_weights_that_are_not_finite_are_refused(tmp_path):
    model = nn.Linear(3, 2)
    broken = content(model)
    broken["state_dict"]["model.bias"] = torch.tensor([0.0, float("nan")])
    with pytest.raises(CheckpointError, match="not finite, bias"):
        load_model_weights(model, broken, tmp_path / "x.ckpt")
    assert torch.isfinite(model.bias).all()


def test_missing_file(tmp_path):
    with pytest.raises(CheckpointError, match="does not exist"):
        read_checkpoint(tmp_path / "nothing.ckpt")


def test_a_full_disk_keeps_the_older_checkpoint(tmp_path):
    path = tmp_path / "last.ckpt"
    AtomicCheckpointIO().save_checkpoint(content(nn.Linear(3, 2)), path)
    before = path.read_bytes()
    code = f"""
import resource, torch
from src.training.checkpoints import AtomicCheckpointIO
resource.setrlimit(resource.RLIMIT_FSIZE, (20000, {resource.RLIM_INFINITY}))
AtomicCheckpointIO().save_checkpoint({{"state_dict": {{"w": torch.zeros(100000)}}}}, {str(path)!r})
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert result.returncode != 0
    assert "MiB are free" in result.stderr
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
