"""The sequential decoder: radar before cameras, places that move on, embeddings that tokens share, pruned layers."""

from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F

from src.errors import ConfigError
from src.geometry.bev_grid import BEVGrid
from src.models.heads.decode import DecodeConfig
from src.models.heads.query_head import SetPredictionHead
from src.models.layers.position_embedding import PositionEmbeddingConfig
from src.models.layers.views import CameraViews
from src.models.rctrans.sequential_decoder import SequentialDecoder, SequentialDecoderConfig
from src.structures.queries import Queries
from tests.models.frames import GRID as FINE
from tests.models.frames import SIZE, make_batch

GRID = BEVGrid(cells=(24, 32), cell_m=1.6, centre_m=FINE.centre_m, z_range_m=FINE.z_range_m)
C, RADAR, IMAGE = 8, 3, 5


def make(num_layers=3, num_inference_layers=2, num_radar_cells=None):
    torch.manual_seed(0)
    config = SequentialDecoderConfig(
        num_layers=num_layers, num_inference_layers=num_inference_layers, num_heads=2, num_radar_cells=num_radar_cells
    )
    position = PositionEmbeddingConfig(num_depth_bins=4, depth_range_m=[2.0, 32.0], z_range_m=[-10.0, 10.0])
    head = SetPredictionHead(DecodeConfig(score_threshold=0.0, max_boxes=10), C, FINE, 1.0)
    torch.nn.init.normal_(head.box[-1].weight, std=2.0)  # boxes far from where queries stand
    return SequentialDecoder(config, position, C, RADAR, IMAGE, GRID), head


def scene():
    batch = make_batch()
    level = torch.randn(2, 4, IMAGE, SIZE[0] // 16, SIZE[1] // 16)
    views = CameraViews([level], batch.pix_from_aug, batch.image_valid, SIZE)
    places = torch.rand(2, 9, 3) * torch.tensor([48.0, 36.0, 2.0]) - torch.tensor([22.0, 19.0, 0.0])
    every = torch.ones(2, 6, dtype=torch.bool)
    queries = Queries.unknown(torch.randn(2, 6, C), places[:, :6], every)
    past = Queries.unknown(torch.randn(2, 3, C), places[:, 6:], torch.tensor([[True, False, True]] * 2))
    return queries, past, torch.randn(2, RADAR, *GRID.cells), views


@torch.no_grad()
@pytest.mark.parametrize("with_past", [False, True])
def test_every_layer_looks_at_the_radar_then_at_the_cameras_from_where_the_last_one_led(with_past):
    (decoder, head), (queries, past, radar, views) = make(), scene()
    past = past if with_past else None
    layers, features = decoder(queries, past, radar, views, head)
    assert len(layers) == len(features) == 3
    cells, pixels = decoder.radar_tokens(radar), decoder.image_tokens(views)
    centers = queries.centers
    for layer, prediction, feature in zip(decoder.layers, layers, features, strict=True):
        for part, tokens, embed in (
            (layer.radar, cells, decoder.plane),
            (layer.camera, pixels, lambda places: decoder.perspective.of_points(places, views)),
        ):
            further = past and (past.features + embed(past.centers), past.features, past.valid)
            queries = replace(queries, features=part(queries, embed(centers), further, tokens))
        torch.testing.assert_close(feature, decoder.norm(queries.features))
        torch.testing.assert_close(prediction.codes, head(feature, queries).codes)
        assert (prediction.codes[..., :3] - centers).norm(dim=-1).max() > 1.0
        centers = prediction.codes[..., :3]
        queries = replace(queries, centers=centers)


@torch.no_grad()
def test_later_layers_are_pruned_in_inference():
    (decoder, head), (queries, past, radar, views) = make(), scene()
    taught, kept = (decoder.train(mode)(queries, past, radar, views, head)[0] for mode in (True, False))
    assert (len(taught), len(kept)) == (3, 2)
    assert all(torch.equal(one.codes, other.codes) for one, other in zip(taught[:2], kept, strict=True))


@torch.no_grad()
def test_a_cells_key_has_the_embedding_of_its_centre_and_a_missing_cameras_pixels_are_padding():
    (decoder, _), (_, _, radar, views) = make(), scene()
    key, value, valid = decoder.radar_tokens(radar)
    row, col = 5, 17
    xy = torch.tensor([GRID.x_min_m + 17.5 * 1.6, GRID.y_min_m + 5.5 * 1.6])
    cell = row * 32 + col
    torch.testing.assert_close(key[1, cell] - value[1, cell], decoder.plane(xy), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(value[1, cell], F.layer_norm(decoder.radar_value(radar)[1, :, row, col], (C,)))
    assert valid.all() and valid.shape == (2, 24 * 32)
    views.valid[0, 1] = False
    _, value, valid = decoder.image_tokens(views)
    assert valid.view(2, 4, 24).all(2).tolist() == [[True, False, True, True], [True] * 4]
    pixel = F.layer_norm(decoder.image_value(views.levels[0][1])[2, :, 3, 4], (C,))
    torch.testing.assert_close(value.view(2, 4, 4, 6, C)[1, 2, 3, 4], pixel)


@torch.no_grad()
def test_a_query_told_to_looks_at_the_nearest_cells_alone():
    (decoder, head), (queries, _, radar, views) = make(num_layers=1, num_inference_layers=1, num_radar_cells=4), scene()
    layer, x, centers = decoder.layers[0].radar, queries.features, queries.centers
    codes = decoder(queries, None, radar, views, head)[0][0].codes
    key, _, _ = decoder.radar_tokens(radar)
    places = F.pad(decoder.places_m, (0, 1)).expand(2, -1, -1)
    near = torch.cdist(centers[..., :2], places[..., :2]).topk(4, largest=False).indices  # [B, Q, 4]
    picked = torch.zeros(2, 6, places.shape[1], dtype=torch.bool).scatter_(2, near, True)
    x = layer(queries, decoder.plane(centers), None, (centers, key, places, picked))
    found = replace(queries, features=x)
    pixels, rays = decoder.image_tokens(views), decoder.perspective.of_points(centers, views)
    found = replace(found, features=decoder.layers[0].camera(found, rays, None, pixels))
    torch.testing.assert_close(codes, head(decoder.norm(found.features), found).codes)
    far = picked.any(1).logical_not().view(2, 1, *GRID.cells)
    assert far.sum() > 1400, "of 1536"
    moved = torch.where(F.max_pool2d((~far).float(), 5, 1, 2) > 0, radar, radar + 5.0)  # 5: what two convolutions see
    torch.testing.assert_close(decoder(queries, None, moved, views, head)[0][0].codes, codes)
    everywhere, _ = make(num_layers=1, num_inference_layers=1)
    alike = everywhere(queries, None, radar, views, head)[0][0].codes
    assert not torch.allclose(everywhere(queries, None, moved, views, head)[0][0].codes, alike)


def test_gradients_do_not_pass_from_place_to_place():
    (decoder, head), (queries, _, radar, views) = make(), scene()
    queries.centers.requires_grad_()
    layers, _ = decoder(queries, None, radar, views, head)
    (grad,) = torch.autograd.grad(layers[1].codes[..., :3].sum(), head.box[-1].bias, retain_graph=True)
    torch.testing.assert_close(grad[:3], torch.full((3,), 12.0))  # of 2 samples of 6 queries, one layer alone
    assert grad[3:].eq(0).all()


def test_mistakes_are_named():
    with pytest.raises(ConfigError, match="num_inference_layers=4.*num_layers=3"):
        make(num_inference_layers=4)
    with pytest.raises(ConfigError, match="num_inference_layers=0"):
        make(num_inference_layers=0)
    with pytest.raises(ConfigError, match="model.decoder.num_radar_cells=0: must be at least 1"):
        make(num_radar_cells=0)
