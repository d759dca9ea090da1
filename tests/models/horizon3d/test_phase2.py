"""The model with memory: phase 1's outputs from phase 1's weights, what gradients reach, frames without anything."""

import re
from dataclasses import fields, replace
from functools import partial
from pathlib import Path

import pytest
import torch

from src.models.horizon3d.dptf_memory import DPTFMemory
from src.models.horizon3d.model_config import Horizon3DConfig
from src.reliability.checkpoints import load_model_weights
from tests.models import frames
from tests.models.horizon3d.cells import rows_at
from tests.models.horizon3d.small_model import dptf_config
from tests.models.moving import UTM, tensors_of
from tests.models.surroundings import DIAGONALS

ADDED = re.compile(Horizon3DConfig.new_in_temporal_phase)

VARIANTS = {
    "both": ({}, {}),
    "cells only": ({"gaussian_path": False}, {}),
    "gaussians only": ({"bev_path": False}, {}),
    "no self-attention": ({"self_attention": None}, {}),
    "dilating": ({"spatial_dilation": True}, {}),
    "radar only": ({"gaussian_path": False}, {"radar_only": True}),
}
EVERYTHING = {"memory_threshold": 0.0}  # an untrained occupancy head stays below any other


@pytest.fixture
def drive():
    """The drive, of which one stream begins at the origin of the global frame."""
    return partial(frames.drive, headings=DIAGONALS, origins=(UTM, (0.0, 0.0)))


@pytest.fixture
def pair(make_model):
    """A phase-1 model whose every tensor is random, and the phase-2 model that took its weights."""

    def build(changes, model_changes):
        first = make_model(seed=1, **model_changes)
        generator = torch.Generator().manual_seed(2)
        with torch.no_grad():
            for value in first.state_dict().values():
                if value.is_floating_point():
                    value.add_(0.05 * torch.rand(value.shape, generator=generator))
        second = make_model(seed=3, dptf=dptf_config(**EVERYTHING, **changes), **model_changes)
        state = {f"model.{key}": value.clone() for key, value in first.state_dict().items()}
        new = load_model_weights(second, {"state_dict": state}, Path("phase1.ckpt"), ADDED)
        assert set(new) == second.state_dict().keys() - first.state_dict().keys()
        return first, second

    return build


def same(first, second):
    """Whether two dataclasses of tensors are equal to the last bit."""
    pairs = [(getattr(first, field.name), getattr(second, field.name)) for field in fields(first)]
    return all(torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b for a, b in pairs)


def fill(model, drive, steps, **changes):
    """DPTFMemory after some frames, and the frame that follows."""
    frame = partial(drive, **changes)
    return frames.fill(model, steps, frame), frame(steps)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in VARIANTS if name != "dilating"])
@pytest.mark.parametrize("training", [False, True])
def test_the_first_frame_is_phase_1_to_the_last_bit(pair, drive, name, training):
    """Specification section 15 point 8; under dropout and batch statistics with the same random numbers.

    Dilating convolutions give the head more cells to judge, which no initial value can undo.
    """
    first, second = (model.train(training) for model in pair(*VARIANTS[name]))
    batch = drive(0)
    for memory in (None, DPTFMemory(())):
        outputs = []
        for model in (first, second):
            torch.manual_seed(9)
            outputs.append(model(batch, memory if model is second else None)[0])
        one, two = outputs
        assert torch.equal(one.head.logits, two.head.logits)
        assert torch.equal(one.fused_bev.features, two.dptf.bev.features)
        assert one.kggi is None or same(one.kggi.gaussians, two.kggi.gaussians)
        assert one.ocsf is None or same(one.ocsf.gaussians, two.ocsf.gaussians)
        if not training:
            boxes = list(zip(first.decode(one), second.decode(two), strict=True))
            assert all(same(a, b) for a, b in boxes) and sum(len(a) for a, _ in boxes) > 0
    terms, more = first.loss(one, batch).terms, second.loss(two, batch).terms
    assert all(torch.equal(terms[name], more[name]) for name in terms if name != "total")
    assert first(batch)[1] is None


def test_a_lane_that_starts_beside_one_with_memory_gives_phase_1s_output(pair, drive):
    first, second = (model.eval() for model in pair({}, {}))
    memory, batch = fill(second, drive, 2)
    memory = memory.select(torch.tensor([0, 1]), torch.tensor([True, False]))
    with torch.no_grad():
        one, two = first(batch)[0], second(batch, memory)[0]
    mine, theirs = one.fused_bev.indices[:, 0] == 1, two.dptf.bev.indices[:, 0] == 1
    assert torch.equal(one.fused_bev.indices[mine], two.dptf.bev.indices[theirs])
    torch.testing.assert_close(one.head.logits[mine], two.head.logits[theirs], rtol=1e-4, atol=1e-4)
    assert (two.dptf.bev.indices[:, 0] == 0).sum() > (two.fused_bev.indices[:, 0] == 0).sum()


@pytest.mark.slow
@pytest.mark.parametrize("training", [False, True])
@pytest.mark.parametrize("autocast", [False, True])
def test_an_untrained_bev_path_adds_nothing_to_a_full_memory(pair, drive, training, autocast):
    """F_fuse unchanged on its cells and zero on those that only the memory has."""
    _, model = pair({}, {})
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        memory, batch = fill(model.train(training), drive, 4)
        output, _ = model(batch, memory)
    fused, bev = output.fused_bev, output.dptf.bev
    assert len(memory.frames) == 3 and sorted(output.dptf.warped.indices[:, 1].unique().tolist()) == [0, 1, 2]
    assert torch.equal(rows_at(bev, fused.indices), fused.features)
    foreign = fused.sites.rows_of(bev.indices) < 0
    assert foreign.sum() > 20 and not bev.features[foreign].any()


def test_an_untrained_self_attention_adds_nothing_to_a_full_memory(pair, drive):
    _, model = pair({}, {})
    memory, batch = fill(model.eval(), drive, 3)
    layers, added = model.ocsf.encoder.layers, []
    for layer in layers:
        layer.temporal_attention.register_forward_hook(lambda _, args, out: added.append(out))
    with torch.no_grad():
        with_attention = model(batch, memory)[0]
        assert with_attention.dptf.history.valid.any(1).all()
        assert len(added) == len(layers) and not any(out.any() for out in added)
        for layer in layers:
            layer.temporal_attention = None
        without = model(batch, memory)[0]
    assert torch.equal(with_attention.head.logits, without.head.logits)
    assert same(with_attention.ocsf.gaussians, without.ocsf.gaussians)


@pytest.mark.slow
@pytest.mark.parametrize("variant", VARIANTS.values(), ids=VARIANTS)
def test_every_parameter_has_had_a_gradient_after_one_step_with_memory(make_model, drive, variant):
    """Zero-initialised outputs hide what is behind them in the first of the two steps."""
    changes, model_changes = variant
    model = make_model(dptf=dptf_config(**EVERYTHING, **changes), **model_changes)
    optimizer, moved = torch.optim.SGD(model.parameters(), lr=1e-2), set()
    _, memory = model(drive(0, boxes=(12, 12)))
    for step in (1, 2):
        batch = drive(step, boxes=(12, 12))  # every class, hence every branch of the head
        output, memory = model(batch, memory)
        optimizer.zero_grad()
        model.loss(output, batch).terms["total"].backward()
        assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
        moved |= {name for name, p in model.named_parameters() if p.grad.any()}
        optimizer.step()
    still = {name for name, _ in model.named_parameters()} - moved
    # An L1 term pulls a bias by +-1 per object, which an even number of objects can cancel exactly.
    assert [name for name in sorted(still) if not (name.startswith("head.regressions") and name.endswith("bias"))] == []


def test_no_gradient_flows_into_the_frame_before(make_model, drive):
    model, memory = make_model(dptf=dptf_config(**EVERYTHING)), None
    before, memory = model(drive(0), memory)
    assert not any(tensor.requires_grad for tensor in tensors_of(memory))
    batch = drive(1)
    output, memory = model(batch, memory)
    assert output.dptf.history.valid.any() and len(output.dptf.warped.indices)
    past = [before.fused_bev.features, before.ocsf.gaussians.means, before.ocsf.gaussians.velocities]
    past += [before.ocsf.gaussians.features, before.dptf.cells.velocities, before.dptf.cells.occupancy_logits]
    assert all(value.requires_grad for value in past)
    gradients = torch.autograd.grad(model.loss(output, batch).terms["total"], past, allow_unused=True)
    assert all(gradient is None for gradient in gradients)


EMPTY = {
    "no radar now": {"points": (0, 0)},
    "no radar in one stream": {"points": (120, 0)},
    "no boxes": {"boxes": (0, 0)},
    "nothing": {"points": (0, 0), "boxes": (0, 0)},
}


@pytest.mark.slow
@pytest.mark.parametrize("now", EMPTY.values(), ids=EMPTY)
@pytest.mark.parametrize("past", [{}, {"points": (0, 0)}], ids=["a full memory", "a memory without radar"])
@pytest.mark.parametrize("radar_only", [False, True])
def test_empty_frames_with_memory_give_finite_losses_and_gradients(make_model, drive, past, now, radar_only):
    dptf = dptf_config(**EVERYTHING, gaussian_path=not radar_only)
    model = make_model(dptf=dptf, radar_only=radar_only)
    memory, _ = fill(model, drive, 2, **past)
    batch = drive(2, **now)
    output, after = model(batch, memory)
    terms = model.loss(output, batch).terms
    terms["total"].backward()
    assert all(value.isfinite() for value in terms.values())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())
    assert all(tensor.isfinite().all() for tensor in tensors_of(after))
    with torch.no_grad():
        output, _ = model.eval()(batch, memory)
    assert output.head.logits.isfinite().all() and len(model.decode(output)) == 2


def test_no_visible_gaussian_and_no_radar_now_or_before(make_model, drive):
    model = make_model(dptf=dptf_config(**EVERYTHING))
    with torch.no_grad():
        for layer in model.ocsf.encoder.layers:
            layer.refinement.output.bias[6] = -30.0  # opacity: nothing opens a cell
    memory, batch = fill(model, drive, 2, points=(0, 0))
    output, _ = model(batch, memory)
    assert len(output.dptf.bev) == len(output.dptf.warped.indices) == 0 and not output.dptf.history.valid.any()
    terms = model.loss(output, batch).terms
    terms["total"].backward()
    assert all(value.isfinite() for value in terms.values())
    assert all(p.grad is not None and p.grad.isfinite().all() for p in model.parameters())


def test_streams_with_memory_equal_single_streams(pair, drive):
    _, model = pair({}, {})
    memory, batch = fill(model.eval(), drive, 2)
    with torch.no_grad():
        model.dptf.bev_path.norms[-1].weight.fill_(1.0)
        both = model(batch, memory)[0]
        for stream in (0, 1):
            rows = batch.radar_batch == stream
            pick = slice(stream, stream + 1)
            single = replace(
                batch,
                radar_points=batch.radar_points[rows],
                radar_batch=batch.radar_batch[rows] * 0,
                tokens=batch.tokens[pick],
                boxes=batch.boxes[pick],
                **{
                    name: getattr(batch, name)[pick]
                    for name in ("timestamps_s", "global_from_ego", "aug_from_ego", "images", "image_valid")
                },
                pix_from_aug=batch.pix_from_aug[pick],
                streams=batch.streams[pick],
                starts=batch.starts[pick],
            )
            alone = model(single, memory.select(torch.tensor([stream]), torch.tensor([True])))[0]
            mine = both.dptf.bev.indices[:, 0] == stream
            assert torch.equal(both.dptf.bev.indices[mine, 1:], alone.dptf.bev.indices[:, 1:])
            torch.testing.assert_close(both.head.logits[mine], alone.head.logits, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("spoilt", ["repeated", "reversed", "too old", "jump"])
def test_an_unusable_past_is_as_none(pair, drive, spoilt):
    _, model = pair({}, {})
    memory, batch = fill(model.eval(), drive, 2)
    before = memory.frames[0].timestamps_s
    stamps = {"repeated": before, "reversed": before - 5.0, "too old": before + 6.01, "jump": before + 0.5}[spoilt]
    memory = replace(memory, frames=memory.frames[:1])
    poses = batch.global_from_ego.clone()
    poses[:, 0, 3] += 70.0 if spoilt == "jump" else 0.0
    batch = replace(batch, timestamps_s=stamps, global_from_ego=poses)
    with torch.no_grad():
        spoilt_output, alone = model(batch, memory)[0], model(batch)[0]
    assert torch.equal(spoilt_output.dptf.bev.indices, alone.dptf.bev.indices)
    torch.testing.assert_close(spoilt_output.head.logits, alone.head.logits, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_memory_under_autocast_is_halved_where_it_may_be_and_stays_finite(make_model, drive):
    model, memory = make_model(dptf=dptf_config(**EVERYTHING)), None
    for step in range(3):
        batch = drive(step)
        with torch.autocast("cpu", torch.bfloat16):
            output, memory = model(batch, memory)
            terms = model.loss(output, batch).terms
        terms["total"].backward()
    assert all(value.dtype == torch.float32 and value.isfinite() for value in terms.values())
    assert output.dptf.cells.velocities.dtype == output.dptf.warped.xy.dtype == torch.float32
    newest = memory.frames[0]
    assert newest.cells.features.dtype == newest.gaussians.features.dtype == torch.bfloat16
    assert newest.cells.xy.dtype == newest.gaussians.means.dtype == torch.float32
    plain = model.dptf.recall(memory, drive(3))
    with torch.autocast("cpu", torch.bfloat16):
        halved = model.dptf.recall(memory, drive(3))
    assert torch.equal(halved.warped.indices, plain.warped.indices)
    assert torch.equal(halved.warped.xy, plain.warped.xy)
    assert torch.equal(halved.history.means, plain.history.means)
    assert torch.equal(halved.history.velocities, plain.history.velocities)


@pytest.mark.slow
def test_memory_does_not_grow_over_30_frames_and_survives_its_state(make_model, drive):
    config = dptf_config(**EVERYTHING)
    model, memory, sizes = make_model(dptf=config).eval(), None, []
    with torch.no_grad():
        for step in range(30):
            _, memory = model(drive(step, points=(60, 50)), memory)
            sizes.append(sum(tensor.numel() for tensor in tensors_of(memory)))
            if step == 20:
                memory = model.restore_memory(memory.state())
    assert len(memory.frames) == config.num_frames == 3
    bound = 2 * 3 * (200 * (2 + 2 + 16 + 1) + 18) + 2 * 2 * 8 * (4 * 2 + 4 + 16)  # cells, poses, Gaussians
    assert max(sizes) <= bound and max(sizes[3:]) <= 1.2 * min(sizes[3:])
