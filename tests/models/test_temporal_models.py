"""What every method with a memory must do: begin as phase 1, keep streams apart, forget what is no past, learn."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import nn

from src.models import FAMILIES
from src.reliability.checkpoints import load_model_weights
from tests.models.camera_radar_frames import crt_model, hydra_model
from tests.models.dense_bev.dense_frames import dense_model, memory_config
from tests.models.frames import drive, fill, pose
from tests.models.learning import gradients_are_finite
from tests.models.query_frames import small_model


def dense_pair():
    first = dense_model(seed=1)
    generator = torch.Generator().manual_seed(2)
    with torch.no_grad():
        for value in first.state_dict().values():  # no tensor is as it began
            if value.is_floating_point():
                value.add_(0.05 * torch.rand(value.shape, generator=generator))
    return first, dense_model(seed=3, temporal=memory_config(num_frames=2))


def crt_pair():
    first = crt_model(seed=1)
    with torch.no_grad():
        first.estimator.output.bias[0] = 0.0  # half of all cells are occupied
    return first, crt_model(phase="phase2", seed=3)


def query_pair(family):
    return small_model(family, seed=1), small_model(family, phase="phase2", seed=3)


PAIRS = {
    "dense_bev": dense_pair,
    "crt_fusion": crt_pair,
    "hydra": lambda: (hydra_model(seed=1), hydra_model(phase="phase2", seed=3)),
    **{name: lambda name=name: query_pair(name) for name in ("sparc", "petr", "far3d", "rctrans")},
}
OF_MAPS = ("dense_bev", "crt_fusion", "hydra")
"""Fused by convolutions that begin as zero; remembered queries speak from the first step."""


@pytest.fixture(params=PAIRS)
def family(request):
    return request.param


@pytest.fixture
def pair(family):
    """A phase-1 model and the phase-2 model that took its weights."""
    first, second = PAIRS[family]()
    added = re.compile(FAMILIES[family][0].new_in_temporal_phase)
    state = {f"model.{key}": value.clone() for key, value in first.state_dict().items()}
    new = load_model_weights(second, {"state_dict": state}, Path("phase1.ckpt"), added)
    assert set(new) == second.state_dict().keys() - first.state_dict().keys() and new
    assert not [key for key in first.state_dict() if added.match(key)], "none of phase 1 may be missing"
    return first, second


def remembered_frames(model, batch, memory):
    return model.diagnostics(model(batch, memory)[0])["remembered_frames"]


@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("steps", [0, 1, 3])
@pytest.mark.parametrize("family", OF_MAPS, indirect=True)
def test_untrained_memory_leaves_phase_1_to_the_last_bit(pair, training, steps):
    first, second = (model.train(training) for model in pair)
    memory, batch = fill(second, steps), drive(steps)
    second.load_state_dict(first.state_dict(), strict=False)  # batch statistics
    one, two = first(batch)[0], second(batch, memory)[0]
    assert torch.equal(one.head.logits, two.head.logits) and first(batch)[1] is None
    if not training:
        terms, more = first.loss(one, batch).terms, second.loss(two, batch).terms
        assert all(torch.equal(terms[name], more[name]) for name in terms.keys() - {"box", "total"})  # weighed by phase
    assert second.diagnostics(two)["remembered_frames"] == min(steps, 2)


def test_memory_changes_the_output_and_streams_do_not_mix(pair, family):
    """The stream that starts anew detects as without a past, the other with it."""
    model = pair[1].eval()
    if family in OF_MAPS:
        nn.init.normal_(model.temporal.norm.weight)
    memory, batch = fill(model, 3), drive(3)
    with torch.no_grad():
        both, nothing, half = (
            model(batch, past)[0].head
            for past in (memory, None, memory.select(torch.tensor([0, 1]), torch.tensor([True, False])))
        )
    # Of queries those count that are there.
    valid = torch.ones(2, 1, dtype=torch.bool) if family in OF_MAPS else nothing.valid
    both, nothing, half = (
        [logits[own.expand(len(logits))] for logits, own in zip(head.logits.view(2, -1, 12), valid, strict=True)]
        for head in (both, nothing, half)
    )
    assert not torch.allclose(both[0], nothing[0]) and not torch.allclose(both[1], nothing[1])
    torch.testing.assert_close(half[0], both[0], rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(half[1], nothing[1], rtol=1e-4, atol=1e-4)


LEARNING = [(name, 2) for name in PAIRS] + [(name, 0) for name in OF_MAPS]


@pytest.mark.parametrize(("family", "steps"), LEARNING, indirect=["family"])
def test_every_parameter_of_the_memory_learns(pair, family, steps):
    model = pair[1].train()
    memory, batch = fill(model, steps), drive(steps, boxes=(12, 12))
    optimizer, moved = torch.optim.SGD(model.parameters(), lr=1e-2 if family in OF_MAPS else 1e-3), set()
    for _ in range(2):
        model.zero_grad()
        output, _ = model(batch, memory)
        model.loss(output, batch).terms["total"].backward()
        assert gradients_are_finite(model)
        moved |= {name for name, p in model.temporal.named_parameters() if p.grad.any()}
        optimizer.step()
    assert moved == {name for name, _ in model.temporal.named_parameters()}


@pytest.mark.parametrize("shape", [{"points": (0, 0)}, {"boxes": (0, 0)}])
def test_empty_frames_pass_through_the_memory(pair, shape):
    model = pair[1].train()
    batch = drive(1, **shape)
    batch.image_valid[:] = False
    output, memory = model(batch, fill(model, 1))
    assert model.loss(output, batch).terms["total"].isfinite() and memory.batch_size == 2


def test_a_memory_of_other_streams_is_refused(pair):
    model = pair[1].eval()
    with pytest.raises(ValueError, match="2 streams, but the batch 1 frames"):
        model(drive(1, points=(10,), boxes=(1,)), fill(model, 1))


def test_a_jump_of_the_clock_or_the_pose_empties_the_memory(pair):
    model = pair[1].eval()
    memory, batch = fill(model, 2), drive(2)
    late = replace(batch, timestamps_s=batch.timestamps_s + 100.0)
    far = replace(batch, global_from_ego=torch.stack([pose(1000.0), pose(2000.0)]))
    with torch.no_grad():
        assert remembered_frames(model, late, memory) == remembered_frames(model, far, memory) == 0
        assert remembered_frames(model, batch, memory) == 2
