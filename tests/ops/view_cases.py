"""Samples of image attention: two frames, three cameras, one of them missing in the second frame."""

import torch

BAND_M, SIZE_PX, HEADS, LEVELS = (-3.0, 5.0), (32, 64), 4, 2


def make_case(queries=11, points=5):
    """points, heights, matrices, valid, logits, camera and what is visible, of which one query is nowhere."""
    draw = torch.Generator().manual_seed(queries)
    xy = 40 * torch.rand(2, queries, points, 2, generator=draw) - 20
    xy[:, :1] = 1e6
    heights = torch.randn(2, queries, points, generator=draw)
    forward = torch.tensor([[32.0, -30.0, 0.0, 5.0], [16.0, 0.0, -30.0, 4.0], [1.0, 0.0, 0.0, 0.3], [0, 0, 0, 1.0]])
    turned = torch.tensor([-1.0, -1.0, 1.0, 1.0])
    matrices = torch.stack([forward, forward * turned, forward]).repeat(2, 1, 1, 1)
    matrices[1] = matrices[1] @ torch.tensor([[0.8, -0.6, 0, 1], [0.6, 0.8, 0, 0], [0, 0, 1.1, 0], [0, 0, 0, 1]])
    valid = torch.tensor([[True, True, True], [True, True, False]])
    visible = torch.rand(2, queries, 3, points, generator=draw) < 0.4
    visible[:, :1] = False
    logits = torch.randn(2, queries, 3 * HEADS * LEVELS * points, generator=draw)
    camera = torch.randn(2, 3, HEADS * LEVELS * points, generator=draw)
    return xy, heights, matrices, valid, logits, camera, visible
