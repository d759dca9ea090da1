"""What of RCTrans no other query detector has: a radar map, pruned layers, mistakes in its settings."""

import pytest
import torch

from src.errors import ConfigError
from tests.models.frames import drive, fill, make_batch
from tests.models.learning import parameters_that_stay
from tests.models.query_frames import small_model


def test_every_parameter_learns():
    assert parameters_that_stay(small_model("rctrans"), make_batch(boxes=(12, 12)), lr=1e-3) == []


@torch.no_grad()
def test_boxes_and_memory_come_from_the_layer_that_inference_keeps():
    model = small_model("rctrans", phase="phase2").eval()
    memory, batch = fill(model, 1), drive(1)
    kept, after = model(batch, memory)
    model.decoder.train()
    taught, also_after = model(batch, memory)
    assert (len(kept.layers), len(taught.layers)) == (1, 2)
    assert torch.equal(kept.head.codes, taught.head.codes)
    assert not torch.equal(taught.head.codes, taught.layers[1].codes)
    assert torch.equal(after.frames[0].features, also_after.frames[0].features)
    assert torch.equal(after.frames[0].centers, also_after.frames[0].centers)


@torch.no_grad()
def test_the_radar_is_seen_and_pillars_are_counted():
    model, batch = small_model("rctrans").eval(), make_batch()
    output, _ = model(batch)
    points = model.radar_encoder.grid.cell_of(batch.radar_points[:, :2])
    keys = torch.cat([batch.radar_batch[:, None], points], 1)[model.grid.contains(batch.radar_points[:, :2])]
    assert 0 < model.diagnostics(output)["pillars"] <= len(keys.unique(dim=0)) / 2  # an encoded pillar may be all zero
    batch.radar_points[batch.radar_batch == 0, 4:6] += 20.0
    moved, _ = model(batch)
    same = [torch.equal(one, other) for one, other in zip(output.head.logits, moved.head.logits, strict=True)]
    assert same == [False, True]


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ("model.image_stride_px=5", r"stride \[8, 16, 32\] px, but the model asks for \[5\]"),
        ("model.num_queries=0", "num_queries=0"),
        ("model.pillar_cells=5", r"pillar_cells=5: must divide grid.cells=\[48, 64\]"),
        ("model.pillar_cells=4", "12 x 16 pillars.*multiple of 8"),
        ("model.decoder.num_inference_layers=3", "num_inference_layers=3.*num_layers=2"),
    ],
)
def test_mistakes_are_named(overrides, message):
    with pytest.raises(ConfigError, match=message):
        small_model("rctrans", overrides)
