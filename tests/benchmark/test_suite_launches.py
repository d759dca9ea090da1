"""What a frame and a step would launch and wait for on a GPU: the simulated device counts right, and budgets hold."""

import json
import re
from pathlib import Path

import pytest
import torch

from src.benchmark.plain_kernels import KERNELS
from src.benchmark.simulated_device import DEVICE, simulated_device
from src.geometry.constants import upload
from src.ops import backend
from src.ops.segment_reduce import segment_sum
from tests.running import call, command

# Of the debug scale, phase 2: an architecture of the same parts. A change that needs more says why here.
BUDGETS = {
    "a frame": {"launches": 635, "waits": 23, "uploads": 1},
    "a frame in fixed shapes": {"launches": 373, "waits": 1, "uploads": 1},  # its boxes back, the frame there
    "a training step": {"launches": 3069, "waits": 31, "uploads": 6},
}


def counted(run):
    with simulated_device() as tally:
        values = torch.arange(6.0).to(DEVICE)
        tally.__init__()
        run(values)
    assert not tally.mixed
    return tuple(tally.totals()[name] for name in ("launches", "waits", "uploads"))


@pytest.mark.parametrize(
    ("run", "launches", "waits", "uploads"),
    [
        (lambda x: (x + 1).view(2, 3), 1, 0, 0),  # views cost nothing
        (lambda x: torch.zeros(3, device=DEVICE), 1, 0, 0),  # a factory writes
        (lambda x: float(x.sum()), 1, 1, 0),
        (lambda x: x[x > 2], 2, 1, 0),  # the host waits for the size
        (lambda x: torch.bincount(x.long()), 2, 2, 0),  # for the least and for the largest
        (lambda x: x.cpu(), 0, 1, 0),
        (lambda x: torch.tensor([1, 2], device=DEVICE), 0, 1, 1),  # of pageable memory: it waits
        (lambda x: torch.tensor([1, 2]).pin_memory().to(DEVICE, non_blocking=True), 0, 0, 1),
        (lambda x: torch.linalg.inv(torch.eye(2, device=DEVICE)), 2, 1, 0),  # for the error flag
        (lambda x: torch.repeat_interleave(x.long(), output_size=15), 2, 0, 0),
    ],
)
def test_launches_waits_and_uploads_of_single_operations(run, launches, waits, uploads):
    assert counted(run) == (launches, waits, uploads)


def test_tensors_of_two_devices_in_one_operation_are_found():
    with simulated_device() as tally:
        torch.ones(2).to(DEVICE) + torch.ones(2)
    assert [name for name, _ in tally.mixed] == ["add"]


def test_values_are_those_of_the_cpu():
    values, rows = torch.randn(5, 3), torch.tensor([1, 0, 1, 3, 0])
    with simulated_device():
        found = segment_sum(values.to(DEVICE), rows.to(DEVICE), 4).cpu()
    assert torch.equal(found, segment_sum(values, rows, 4))


def test_tensors_of_one_type_are_uploaded_together():
    host = [torch.tensor([[1.0, 2.0]]), torch.tensor([3]), torch.zeros(0, 2), torch.tensor([True, False])]
    with simulated_device() as tally:
        moved = upload([*host, host[1] + 1], torch.device(DEVICE))
        assert tally.totals()["uploads"] == 3 and tally.totals()["waits"] == 0
        found = [tensor.cpu() for tensor in moved]
    assert all(torch.equal(one, other) for one, other in zip(found, [*host, torch.tensor([4])], strict=True))


def test_every_kernel_that_is_launched_has_a_plain_form_of_its_name():
    sources = [path.read_text() for path in Path(backend.__file__).parent.glob("kernels/*_triton.py")]
    launched = {name for source in sources for name in re.findall(r"^ +(_\w+)\[", source, re.MULTILINE)}
    assert launched == set(KERNELS)


def test_a_frame_and_a_training_step_keep_their_budgets(tmp_path):
    full_memory = "model.dptf.bev_path.memory_threshold=0"
    command("benchmark", "suite=launches", "scale=debug", "phase=phase2", full_memory, f"out={tmp_path}")
    page = json.loads((tmp_path / "launches_horizon3d_phase2_debug.json").read_text())["result"]
    for name, budget in BUDGETS.items():
        parts = {row["part"]: row for row in page[name]}
        spent = {key: parts["whole"][key] for key in budget}
        assert all(spent[key] <= budget[key] for key in budget), (name, spent)
        inner = [row for part, row in parts.items() if part != "whole" and (":" not in part or "decode" in part)]
        assert sum(row["launches"] for row in inner) == spent["launches"]


def test_autocast_is_refused_with_what_to_give_instead(tmp_path):
    overrides = ("suite=launches", "scale=debug", "phase=phase2", "precision=bf16-mixed", f"out={tmp_path}")
    result = call("benchmark.__main__", *overrides, expect=3)
    assert "precision=bf16-mixed" in result.stderr and "give precision=32-true" in result.stderr
    assert not any(tmp_path.iterdir())
