"""Where PETR's layers predict from: the anchors, in all of them."""

import torch
from torch import nn

from src.models.heads.decode import DecodeConfig
from src.models.heads.query_head import SetPredictionHead
from src.models.petr.decoder import PETRDecoder, PETRDecoderConfig
from src.structures.queries import Queries
from tests.models.frames import GRID


def test_every_layers_boxes_are_relative_to_the_anchors():
    torch.manual_seed(0)
    head = SetPredictionHead(DecodeConfig(score_threshold=0.0, max_boxes=10), 8, GRID, 1.0)
    nn.init.constant_(head.box[-1].bias, 0.0)
    with torch.no_grad():
        head.box[-1].bias[0] = 3.0
        head.box[-1].weight.zero_()
    decoder = PETRDecoder(PETRDecoderConfig(num_layers=3, num_heads=2), 8, GRID)
    centers = torch.randn(1, 4, 3)
    queries = Queries.unknown(torch.zeros(1, 4, 8), centers, torch.ones(1, 4, dtype=torch.bool))
    images = (torch.randn(1, 6, 8), torch.randn(1, 6, 8), torch.ones(1, 6, dtype=torch.bool))
    layers, _ = decoder(queries, None, images, head)
    for layer in layers:
        torch.testing.assert_close(layer.codes[..., :3], centers + torch.tensor([3.0, 0.0, 0.0]))
    assert not torch.equal(layers[0].logits, layers[2].logits)
