"""The whole model with memory: how history joins the Gaussians, padding, and every part that can be switched off."""

from dataclasses import fields, replace

import pytest
import torch

from src.errors import ConfigError
from src.models.horizon3d.gaussian_path import Sampling, SelfAttentionConfig
from src.structures.gaussians import GaussianSet
from src.structures.taxonomy import Source
from tests.models.horizon3d.small_model import dptf_config
from tests.models.moving import pose

CURRENT = 24 + 12 + 8  # Gaussians of one frame in the small configuration
PHASE_1_TERMS = {"heatmap", "box", "keypoint", "depth", "radar_objectness", "occupancy_focal", "occupancy_dice"}
CELL_TERMS = {"cell_focal", "cell_dice", "cell_lovasz", "cell_velocity"}
BEV_ONLY, GAUSSIAN_ONLY = {"gaussian_path": False}, {"bev_path": False}
TOGGLES = {  # Tables 5, 6, 7 and 13
    "both": {},
    "BEV only": BEV_ONLY,
    "Gaussian only": GAUSSIAN_ONLY,
    "BEV not compensated": BEV_ONLY | {"velocity_compensation": False},
    "Gaussian not compensated": GAUSSIAN_ONLY | {"velocity_compensation": False},
    "random": GAUSSIAN_ONLY | {"sampling": Sampling.random},
    "top opacity": GAUSSIAN_ONLY | {"sampling": Sampling.top_opacity},
    "no self-attention": {"self_attention": None},
    "one head": {"self_attention": SelfAttentionConfig(num_heads=1)},
}


def at(batch, time_s, x=0.0):
    """The frames of a batch at another time and place."""
    poses = torch.stack([pose(x)] * len(batch))
    return replace(batch, timestamps_s=torch.full((len(batch),), time_s).double(), global_from_ego=poses)


def lively(model):
    """As trained: the temporal parts, which start silent, have a say."""
    torch.manual_seed(7)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            if name.startswith("dptf.") or ".temporal_attention." in name:
                parameter.add_(0.2 * torch.randn_like(parameter))
    return model


@pytest.fixture
def with_past(make_model, make_batch):
    """A lively model in eval mode, the memory of one frame of two streams, and the next frames."""

    def build(**changes):
        model = lively(make_model(dptf=dptf_config(**changes))).eval()
        with torch.no_grad():
            _, memory = model(at(make_batch(), 10.0))
        return model, memory, at(make_batch(seed=1), 10.5, 6.0)

    return build


# ---------------------------------------------------------------- history joins the Gaussians


def test_history_comes_last_and_leaves_the_current_gaussians_as_they_are(with_past):
    model, memory, batch = with_past()
    alone, joined = model(batch)[0].kggi.gaussians, model(batch, memory)[0].kggi.gaussians
    assert len(alone) == CURRENT and len(joined) == CURRENT + 8
    for field in fields(GaussianSet):
        assert torch.equal(getattr(joined, field.name)[:, :CURRENT], getattr(alone, field.name)), field.name
    history = model.dptf.recall(memory, batch).history
    assert history.valid.any(dim=1).all()
    for field in fields(GaussianSet):
        if field.name != "features":
            assert torch.equal(getattr(joined, field.name)[:, CURRENT:], getattr(history, field.name)), field.name
    added = joined.features[:, CURRENT:] - history.features
    embedding = model.kggi.source_embedding.weight[Source.HISTORY].expand_as(added)
    torch.testing.assert_close(added, embedding, atol=1e-5, rtol=1e-5)
    assert (joined.sources[:, CURRENT:] == Source.HISTORY).all() and (joined.elapsed_s[:, CURRENT:] == 0.5).all()


def test_history_is_seen_by_what_follows(with_past):
    model, memory, batch = with_past(bev_path=False)
    with torch.no_grad():
        without, joined = model(batch)[0], model(batch, memory)[0]
    assert (joined.ocsf.gaussians.features[:, :CURRENT] - without.ocsf.gaussians.features).abs().max() > 1e-3
    assert joined.ocsf.splat.active()[:, CURRENT:].any()  # it opens cells of its own
    assert model.diagnostics(joined)["gaussians_history"] > 0


@pytest.mark.parametrize("path", [{}, {"bev_path": False}])
@pytest.mark.parametrize("change", [{"timestamps_s": 3.0}, {"global_from_ego": 1e4}])
def test_padding_of_history_contributes_nothing(with_past, path, change):
    """A memory that is too old or too far away: rows of padding in attention, sparse convolutions and splat."""
    model, memory, batch = with_past(max_age_s=2.0, **path)
    frame = memory.frames[0]
    if "timestamps_s" in change:
        frame = replace(frame, timestamps_s=frame.timestamps_s - change["timestamps_s"])
    else:
        frame = replace(frame, global_from_ego=frame.global_from_ego + change["global_from_ego"])
    with torch.no_grad():
        without, padded = model(batch)[0], model(batch, replace(memory, frames=(frame,)))[0]
    if "timestamps_s" in change:
        assert not padded.dptf.history.valid.any()
    else:  # forgotten for good
        assert padded.dptf.history is None
    before, after = without.ocsf.gaussians, padded.ocsf.gaussians
    for name in ("means", "scales", "directions", "opacity_logits", "velocities", "features"):
        torch.testing.assert_close(getattr(after, name)[:, :CURRENT], getattr(before, name), atol=1e-4, rtol=1e-4)
    for pick in (lambda o: o.ocsf.splat.bev, lambda o: o.fused_bev, lambda o: o.dptf.bev):
        assert torch.equal(pick(padded).indices, pick(without).indices)
        torch.testing.assert_close(pick(padded).features, pick(without).features, atol=1e-4, rtol=1e-4)
    assert not padded.ocsf.splat.active()[:, CURRENT:].any()


def test_some_padding_beside_real_history_contributes_nothing(with_past):
    """Whatever lies in the rows of padding."""
    model, memory, batch = with_past(bev_path=False)
    half = memory.frames[0].gaussians.map(torch.clone)
    half.valid[:, ::2] = False
    wild = half.map(torch.clone)
    padding = ~wild.valid
    wild.means[padding], wild.features[padding], wild.opacity_logits[padding] = 5.0, 100.0, 9.0
    outputs = []
    for gaussians in (half, wild):
        frame = replace(memory.frames[0], gaussians=gaussians)
        with torch.no_grad():
            outputs.append(model(batch, replace(memory, frames=(frame,)))[0])
    rows = outputs[0].ocsf.gaussians.valid
    assert torch.equal(rows, outputs[1].ocsf.gaussians.valid) and rows[:, CURRENT:].any()
    first, second = (output.ocsf.gaussians for output in outputs)
    torch.testing.assert_close(first.features[rows], second.features[rows], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(outputs[0].fused_bev.features, outputs[1].fused_bev.features, atol=1e-4, rtol=1e-4)


# ---------------------------------------------------------------- what can be switched off


def two_steps(model, first, second):
    """Two frames with one optimiser step after each; the second frame's output, terms and memory."""
    optimizer = torch.optim.SGD(model.parameters(), lr=1e-3)
    memory = None
    for batch in (first, second):
        output, memory = model(batch, memory)
        terms = model.loss(output, batch).terms
        optimizer.zero_grad()
        terms["total"].backward()
        assert terms["total"].isfinite()
        idle = {name for name, p in model.named_parameters() if p.grad is None}
        assert all(name.startswith("dptf.gaussian_path.time.") for name in idle)  # the age of a history there is not
        assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)
        optimizer.step()
    assert not idle
    return output, terms, memory


@pytest.mark.slow
@pytest.mark.parametrize("name", TOGGLES)
def test_every_row_of_the_tables_trains(make_model, make_batch, name):
    changes = TOGGLES[name]
    model = make_model(dptf=dptf_config(**changes))
    output, terms, memory = two_steps(model, at(make_batch(), 10.0), at(make_batch(seed=1), 10.5, 5.0))
    bev_terms = CELL_TERMS if changes.get("bev_path", True) else set()
    assert set(terms) == PHASE_1_TERMS | bev_terms | {"gaussian_velocity", "total"}
    for path, part in (("bev_path", "cells"), ("gaussian_path", "gaussians")):
        on = changes.get(path, True)
        assert (getattr(model.dptf, path) is not None) is on
        assert all((getattr(frame, part) is not None) is on for frame in memory.frames)
        assert any(key.startswith(f"dptf.{path}.") for key in model.state_dict()) is on
    attention = changes.get("gaussian_path", True) and changes.get("self_attention", True) is not None
    assert any(".temporal_attention." in key for key in model.state_dict()) is attention
    assert (output.dptf.history is not None) is changes.get("gaussian_path", True)
    assert (output.dptf.bev is output.fused_bev) is not changes.get("bev_path", True)
    assert len(model.eval().decode(output)) == 2


def test_radar_only_with_the_bev_path(make_model, make_batch):
    model = make_model(radar_only=True, dptf=dptf_config(gaussian_path=False), doppler=("cells", "boxes"))
    batches = [at(make_batch(seed=i, images=False), 10.0 + 0.5 * i, 5.0 * i) for i in range(2)]
    output, terms, memory = two_steps(model, *batches)
    assert set(terms) == {"heatmap", "box", "total"} | CELL_TERMS
    assert output.ocsf is None and len(memory.frames) == 2 and memory.frames[0].gaussians is None


def test_what_cannot_go_together_is_refused(make_config, make_model):
    with pytest.raises(ConfigError, match="bev_path=null and model.dptf.gaussian_path=null.*model.dptf=null"):
        dptf_config(bev_path=False, gaussian_path=False)
    with pytest.raises(ConfigError, match="model.ocsf=null makes no Gaussians.*gaussian_path=null"):
        make_config(radar_only=True, dptf=dptf_config())
    with pytest.raises(ConfigError, match="num_heads=3.*model.channels=16"):
        make_model(dptf=dptf_config(self_attention=SelfAttentionConfig(num_heads=3)))
    with pytest.raises(ConfigError, match="max_age_s=0.*positive"):
        dptf_config(max_age_s=0.0)


def test_a_memory_of_other_streams_is_refused(with_past, make_batch):
    model, memory, _ = with_past()
    with pytest.raises(ValueError, match="memory holds 2 streams, but the batch 1 frames"):
        model(at(make_batch(points=(100,), boxes=(3,)), 10.5), memory)
