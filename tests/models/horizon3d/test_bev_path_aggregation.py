"""BEV path: sparse aggregation over time, against a dense convolution and with empty inputs (Fig. 5)."""

import pytest
import torch
import torch.nn.functional as F

from src.models.horizon3d.bev_path import WarpedCells
from tests.models.horizon3d.cells import FULL, TINY, C, bev_of, make_path, random_cells, rows_at


def warped_of(indices, features=None, elapsed_s=None, num_frames=8):
    """Warped cells at (batch, slot, row, col), half a second per slot."""
    indices = torch.as_tensor(indices, dtype=torch.int64).reshape(-1, 4)
    elapsed = 0.5 * (num_frames - indices[:, 1]).float() if elapsed_s is None else elapsed_s
    features = torch.ones(len(indices), C) if features is None else features
    zeros = torch.zeros(len(indices), 2)
    return WarpedCells(indices, zeros, zeros, elapsed, features)


def input_of_first_conv(path, fused, warped):
    seen = []
    handle = path.convs[0].register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    path.aggregate(fused, warped)
    handle.remove()
    return seen[0]


def test_sources_in_one_slot_and_cell_are_averaged():
    path = make_path(TINY, num_frames=2).eval()
    fused, _ = bev_of(torch.tensor([[0, 1, 1]]), TINY, torch.full((1, C), 5.0))
    values = torch.tensor([1.0, 2.0, 6.0, 4.0])[:, None].expand(-1, C)
    warped = warped_of([[0, 1, 1, 1], [0, 1, 1, 1], [0, 1, 1, 1], [0, 0, 1, 1]], values, num_frames=2)
    x = input_of_first_conv(path, fused, warped)
    assert x.sites.shape == (1, 3, 5, 6)
    assert x.indices.tolist() == [[0, 0, 1, 1], [0, 1, 1, 1], [0, 2, 1, 1]]
    assert x.features[:, 0].tolist() == [4.0, 3.0, 5.0]
    torch.testing.assert_close(x.features[:, C:], path.time(torch.tensor([1.0, 0.5, 0.0])))


def sites_after(path, fused, warped):
    shapes = [input_of_first_conv(path, fused, warped).sites.shape[1]]
    handles = [conv.register_forward_hook(lambda *args: shapes.append(args[2].sites.shape[1])) for conv in path.convs]
    path.aggregate(fused, warped)
    for handle in handles:
        handle.remove()
    return shapes


@pytest.mark.parametrize(
    ("num_frames", "slots"), [(8, [9, 5, 3, 2, 1]), (1, [2, 1]), (2, [3, 2, 1]), (3, [4, 2, 1]), (5, [6, 3, 2, 1])]
)
@pytest.mark.parametrize("dilating", [False, True])
def test_time_is_halved_until_one_slot_is_left_and_every_slot_counts(num_frames, slots, dilating):
    path = make_path(TINY, num_frames=num_frames, spatial_dilation=dilating).eval()
    fused, _ = bev_of(torch.tensor([[0, 2, 2]]), TINY)
    indices = [[0, slot, 2, 2] for slot in range(num_frames)]
    features = torch.rand(num_frames, C, requires_grad=True)
    assert sites_after(path, fused, warped_of(indices, features, num_frames=num_frames)) == slots
    with torch.no_grad():
        path.norms[-1].weight.fill_(1.0)
    path.aggregate(fused, warped_of(indices, features, num_frames=num_frames)).features.square().sum().backward()
    assert features.grad.abs().sum(1).gt(0).all()


@pytest.mark.parametrize("num_frames", [1, 2, 3, 8])
def test_output_sites_are_the_columns_of_either_input_unless_dilating(num_frames):
    now = torch.tensor([[0, 0, 0], [0, 2, 2], [1, 4, 5]])
    past = torch.tensor([[0, 0, 2, 2], [0, num_frames - 1, 4, 4], [1, num_frames // 2, 0, 5]])
    columns = sorted({(0, 0, 0), (0, 2, 2), (1, 4, 5), (0, 4, 4), (1, 0, 5)})
    fused, _ = bev_of(now, TINY, torch.rand(3, C), 2)
    path = make_path(TINY, num_frames=num_frames).eval()
    output = path.aggregate(fused, warped_of(past, num_frames=num_frames))
    assert [tuple(cell) for cell in output.indices.tolist()] == columns
    alone = path.aggregate(fused, None)
    assert alone.sites is fused.sites and torch.equal(alone.features, fused.features)
    dilating = make_path(TINY, num_frames=num_frames, spatial_dilation=True).eval()
    grown = dilating.aggregate(fused, warped_of(past, num_frames=num_frames))
    assert len(grown) > len(columns) and set(columns) <= {tuple(cell) for cell in grown.indices.tolist()}
    assert torch.equal(rows_at(grown, fused.indices), fused.features)


@pytest.mark.parametrize("dilating", [False, True])
@pytest.mark.parametrize("num_frames", [2, 3, 8])
def test_aggregation_equals_a_dense_convolution_masked_to_the_sites(num_frames, dilating):
    """Independent oracle in float64: conv3d with stride (2, 1, 1), norm, ReLU, then the sites' mask."""
    path = make_path(TINY, num_frames=num_frames, spatial_dilation=dilating).double().eval()
    path.time.float()  # it always works in float32
    generator = torch.Generator().manual_seed(num_frames)
    with torch.no_grad():
        for norm in path.norms:
            for values, low in ((norm.running_mean, -0.5), (norm.running_var, 0.5), (norm.weight, 0.5)):
                values.copy_(torch.rand(C, generator=generator) + low)
            norm.bias.copy_(torch.randn(C, generator=generator))
    now, _, features = random_cells(9, 2, TINY, 1)
    slots = num_frames + 1
    numbers = torch.randperm(2 * num_frames * 30, generator=generator)[: 12 * num_frames].sort().values
    past = torch.stack([numbers // (30 * num_frames), numbers // 30 % num_frames, numbers // 6 % 5, numbers % 6], 1)
    old = torch.randn(len(past), C, generator=generator).double()
    fused, _ = bev_of(now, TINY, features.double(), 2)
    warped = warped_of(past, old, num_frames=num_frames)

    x, mask = torch.zeros(2, C + 32, slots, 5, 6).double(), torch.zeros(2, 1, slots, 5, 6).double()
    with torch.no_grad():
        ages = torch.zeros(2, slots)
        ages[past[:, 0], past[:, 1]] = warped.elapsed_s
        times = path.time(ages.flatten()).double().view(2, slots, -1)  # all at once: float32 rounds by their number
        for cells, rows in (
            (past, old),
            (torch.cat([now[:, :1], torch.full((9, 1), num_frames), now[:, 1:]], 1), fused.features),
        ):
            b, t, row, col = cells.unbind(1)
            x[b, :, t, row, col] = torch.cat([rows, times[b, t]], 1)
            mask[b, 0, t, row, col] = 1
        for number, (conv, norm) in enumerate(zip(path.convs, path.norms, strict=True)):
            weight = conv.weight.permute(2, 1, 0).unflatten(2, (3, 3, 3))
            x = F.conv3d(x, weight, stride=(2, 1, 1), padding=1)
            x = F.batch_norm(x, norm.running_mean, norm.running_var, norm.weight, norm.bias, False, eps=norm.eps)
            window = torch.ones(1, 1, 3, *((3, 3) if dilating else (1, 1))).double()
            pad = (1, 1, 1) if dilating else (1, 0, 0)
            mask = (F.conv3d(mask, window, stride=(2, 1, 1), padding=pad) > 0).double()
            x = (x if number == len(path.convs) - 1 else x.relu()) * mask
        expected = x[:, :, 0]
        expected[now[:, 0], :, now[:, 1], now[:, 2]] += fused.features
        output = path.aggregate(fused, warped)
    assert torch.equal(output.indices, mask[:, 0, 0].nonzero())
    torch.testing.assert_close(output.to_dense(), expected, rtol=0, atol=1e-9)


def test_time_embedding_tells_old_from_new():
    path = make_path(TINY).eval()
    with torch.no_grad():
        path.norms[-1].weight.fill_(1.0)
    fused, _ = bev_of(torch.tensor([[0, 1, 1]]), TINY)
    outputs = [
        path.aggregate(fused, warped_of([[0, 7, 1, 1]], elapsed_s=torch.tensor([age]))).features for age in (0.5, 1.5)
    ]
    assert not torch.allclose(*outputs)


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("num_now", [0, 1, 6])
@pytest.mark.parametrize("num_past", [None, 0, 1, 7])
def test_empty_maps_and_memories_stay_finite_and_keep_every_parameter_in_the_graph(training, num_now, num_past):
    path = make_path(TINY, num_frames=3).train(training)
    with torch.no_grad():
        path.norms[-1].weight.fill_(1.0)
    cells, _, features = random_cells(max(num_now, 1), 2, TINY, 4)
    fused, _ = bev_of(cells[:num_now], TINY, features[:num_now].clone().requires_grad_(), 2)
    warped = None
    if num_past is not None:
        past = torch.stack([torch.ones(7), torch.arange(7) % 3, torch.arange(7) % 5, torch.arange(7) % 6], 1).long()
        warped = warped_of(past[:num_past], num_frames=3)
    prediction, output = path.predict(fused), path.aggregate(fused, warped)
    assert len(output) >= max(num_now, num_past or 0) and output.features.isfinite().all()
    parts = (prediction.occupancy_logits, prediction.velocities, output.features)
    sum(part.square().sum() for part in parts).backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in path.parameters())


@pytest.mark.slow
def test_a_full_memory_at_full_size():
    """8 frames x 4096 cells beside 20000 current ones at C = 128, in seconds on one core."""
    path, generator = make_path(FULL, 128).eval(), torch.Generator().manual_seed(0)
    places = [torch.randperm(384 * 384, generator=generator)[:4096] for _ in range(8)]
    past = torch.cat([torch.stack([p * 0, p * 0 + slot, p // 384, p % 384], 1) for slot, p in enumerate(places)])
    now = torch.randperm(384 * 384, generator=generator)[:20000]
    features = torch.randn(20000, 128, generator=generator)
    fused, _ = bev_of(torch.stack([now * 0, now // 384, now % 384], 1), FULL, features)
    with torch.no_grad():
        output = path.aggregate(fused, warped_of(past, torch.randn(len(past), 128, generator=generator)))
    assert torch.equal(rows_at(output, fused.indices), fused.features)
    assert 20000 < len(output) <= 20000 + 8 * 4096
