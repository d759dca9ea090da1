"""Gated fusion on the union of two sets of cells."""

import copy

import pytest
import torch

from src.models.horizon3d.sparse_fusion import SparseFusion
from src.ops.sites import Sites
from src.structures.sparse_bev import SparseBEV
from tests.models.horizon3d.cells import rows_at

SHAPE = (2, 20, 20)


def make_map(cells):
    indices = torch.tensor(cells, dtype=torch.int64).reshape(-1, 3)
    sites, _ = Sites.from_indices(indices, SHAPE)
    return SparseBEV(sites, torch.randn(len(sites), 8))


@pytest.mark.parametrize("skip_zeros", [False, True])
def test_equations_11_and_12_on_one_cell_by_hand(skip_zeros):
    torch.manual_seed(0)
    fusion = SparseFusion(8, 1, identity_start=False).eval()
    fusion.skip_zeros = skip_zeros
    gaussian, radar = make_map([[0, 3, 3]]), make_map([[0, 3, 3]])
    f_g = gaussian.features[0] / (1 + 1e-5) ** 0.5  # batch norm with its initial running statistics
    f_r = radar.features[0] / (1 + 1e-5) ** 0.5
    both = torch.cat([f_g, f_r])
    w_g = torch.sigmoid(both @ fusion.gate_gaussian.weight[0] + fusion.gate_gaussian.bias)
    w_r = torch.sigmoid(both @ fusion.gate_radar.weight[0] + fusion.gate_radar.bias)
    h = torch.cat([w_g * f_g, w_r * f_r])
    # A lone cell meets only the centre of each 3x3 kernel; batch norms divide by the same constant.
    inner = torch.relu(h @ fusion.conv1.weight[4] / (1 + 1e-5) ** 0.5)
    expected = torch.relu(inner @ fusion.conv2.weight[4] / (1 + 1e-5) ** 0.5 + h @ fusion.shortcut.weight[0])
    torch.testing.assert_close(fusion(gaussian, radar).features[0], expected)


@pytest.mark.parametrize("kernel", [1, 3])
def test_union_of_cells_and_samples_apart(kernel):
    torch.manual_seed(0)
    fusion = SparseFusion(8, kernel, identity_start=False).eval()
    gaussian, radar = make_map([[0, 3, 3], [1, 5, 5]]), make_map([[0, 3, 4], [1, 5, 5], [1, 9, 9]])
    out = fusion(gaussian, radar)
    assert out.indices.tolist() == [[0, 3, 3], [0, 3, 4], [1, 5, 5], [1, 9, 9]]
    radar.features[1:] += 1.0  # sample 1 only
    assert torch.equal(fusion(gaussian, radar).features[:2], out.features[:2])


@pytest.mark.parametrize("kernel", [1, 3])
def test_an_identity_start_passes_the_radar_map_through(kernel):
    """Batch norm of an untrained layer in eval mode divides by sqrt(1 + eps)."""
    fusion = SparseFusion(8, kernel, identity_start=True).eval()
    gaussian, radar = make_map([[0, 3, 3], [0, 3, 4]]), make_map([[0, 3, 4], [1, 5, 5]])
    out = fusion(gaussian, radar)
    assert not rows_at(out, torch.tensor([[0, 3, 3]])).any()
    torch.testing.assert_close(rows_at(out, radar.indices), radar.features.relu() / (1 + 1e-5) ** 0.5)
    fusion.train()
    stay = {name for name, _ in fusion.named_parameters()}
    optimizer = torch.optim.SGD(fusion.parameters(), lr=0.1)
    for _ in range(2):  # what lies behind a zero takes a step longer
        optimizer.zero_grad()
        fusion(gaussian, radar).features.square().sum().backward()
        stay -= {name for name, value in fusion.named_parameters() if value.grad.any()}
        optimizer.step()
    assert stay == set()


@pytest.mark.parametrize("cells", [([], [[0, 1, 1]]), ([[0, 1, 1]], []), ([], [])])
def test_empty_branches(cells):
    fusion = SparseFusion(8, 1, identity_start=False).train()
    out = fusion(make_map(cells[0]), make_map(cells[1]))
    out.features.sum().backward()
    assert out.features.isfinite().all() and len(out) == len(cells[0]) + len(cells[1])


@pytest.mark.parametrize("training", [True, False])
@pytest.mark.parametrize("kernel", [1, 3])
def test_skipping_zeros_agrees_with_the_equations(kernel, training):
    """Values, gradients and running statistics."""
    torch.manual_seed(0)
    fast = SparseFusion(8, kernel, identity_start=False).double().train(training)
    for norm in (fast.norm_gaussian, fast.norm_radar, fast.norm1, fast.norm2):
        torch.nn.init.uniform_(norm.weight, 0.5, 2.0)
        torch.nn.init.uniform_(norm.bias, -1.0, 1.0)
    literal = copy.deepcopy(fast)
    literal.skip_zeros = False
    cells = torch.randperm(2 * 20 * 20, generator=torch.Generator().manual_seed(1))
    maps = []
    for part in (cells[:150], cells[100:300]):
        sites = Sites.from_linear(part.sort().values, SHAPE)
        maps.append(SparseBEV(sites, torch.randn(len(sites), 8, dtype=torch.float64, requires_grad=True)))
    weight = torch.randn(300, 8, dtype=torch.float64)
    results = []
    for fusion in (fast, literal):
        out = fusion(*maps)
        leaves = [part.features for part in maps] + list(fusion.parameters())
        grads = torch.autograd.grad((out.features * weight).sum(), leaves)
        results.append((out.indices, out.features, *grads, *fusion.buffers()))
    torch.testing.assert_close(*results)
