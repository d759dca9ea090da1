import json
from pathlib import Path

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from src.ops.kernel_maps import inverse_map, strided_map, submanifold_map, temporal_map
from src.ops.sites import Sites
from src.ops.sparse_conv import neighbour_sum, plain_sparse_conv, sparse_conv
from tests.ops.maps import map_of, random_sites, stack_of

GOLDEN = np.load(Path(__file__).parents[1] / "golden" / "sparse_conv" / "cases.npz")
CASES = json.loads(str(GOLDEN["meta_json"]))


def ours(weight):
    """Dense weight [Cout, Cin, k...] as [K, Cin, Cout]."""
    return weight.flatten(2).permute(2, 1, 0)


def densify(sites, features):
    dense = features.new_zeros(*sites.shape, features.shape[1])
    dense[sites.indices().unbind(1)] = features
    return dense.movedim(-1, 1)


def gather(dense, sites):
    return dense.movedim(1, -1)[sites.indices().unbind(1)]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
@pytest.mark.parametrize("name", CASES)
def test_golden_case(name, dtype, tolerance):
    meta = CASES[name]

    def load(key):
        return torch.from_numpy(GOLDEN[f"{name}/{key}"])

    sites, order = Sites.from_indices(load("in_coords").long(), (meta["batch"], *meta["spatial_shape"]))
    features = load("in_feats").to(dtype)[order].requires_grad_()
    weight = load("weight").to(dtype).requires_grad_()
    bias = load("bias").to(dtype).requires_grad_() if meta["bias"] else None
    kernel, stride, padding = (tuple(meta[key]) for key in ("kernel", "stride", "padding"))
    if meta["mode"] == "subm":
        kernel_map, out_sites = submanifold_map(sites, kernel), sites
    elif meta["mode"] == "full":
        kernel_map, out_sites = strided_map(sites, kernel, stride, padding)
    else:
        kernel_map, out_sites = temporal_map(sites, kernel, stride, padding)
    assert out_sites.shape == (meta["batch"], *meta["out_shape"])
    assert torch.equal(out_sites.indices(), load("out_coords").long())

    out = sparse_conv(features, ours(weight), kernel_map, bias)
    out.backward(load("grad_out").to(dtype))
    found = {"out_feats": out, "grad_in": features.grad, "grad_weight": weight.grad}
    expected = {"out_feats": load("out_feats"), "grad_in": load("grad_in")[order], "grad_weight": load("grad_weight")}
    if bias is not None:
        found["grad_bias"], expected["grad_bias"] = bias.grad, load("grad_bias")
    for key, value in found.items():
        torch.testing.assert_close(value.double(), expected[key], rtol=0, atol=tolerance, msg=f"{name} {key}")


@pytest.mark.parametrize("kernel", [(3, 3), (5, 5), (5, 1), (1, 3), (3, 1, 5), (1, 1, 1)])
def test_submanifold_equals_dense_on_a_full_border(kernel):
    """Every cell active: shifts that wrapped around an edge would show."""
    shape = (2, 4, 3, 5)[: len(kernel) + 1]
    sites = random_sites(shape, torch.Size(shape).numel())
    torch.manual_seed(0)
    features, weight = torch.randn(len(sites), 3).double(), torch.randn(4, 3, *kernel).double()
    conv = {2: F.conv2d, 3: F.conv3d}[len(kernel)]
    dense = conv(densify(sites, features), weight, padding=tuple(k // 2 for k in kernel))
    out = sparse_conv(features, ours(weight), submanifold_map(sites, kernel))
    torch.testing.assert_close(out, gather(dense, sites))


@pytest.mark.parametrize(
    ("kernel", "stride", "padding"), [(3, 2, 1), (2, 2, 0), (3, 1, 1), ((3, 1), (2, 1), (1, 0)), (4, 3, 2), (1, 1, 0)]
)
def test_strided_equals_dense_where_the_window_holds_a_site(kernel, stride, padding):
    sites = random_sites((2, 9, 8), 20)
    torch.manual_seed(0)
    size = (kernel, kernel) if isinstance(kernel, int) else kernel
    features, weight = torch.randn(20, 3).double(), torch.randn(2, 3, *size).double()
    kernel_map, out_sites = strided_map(sites, kernel, stride, padding)
    dense = F.conv2d(densify(sites, features), weight, stride=stride, padding=padding)
    reached = F.conv2d(
        densify(sites, features.new_ones(20, 1)), weight.new_ones(1, 1, *size), stride=stride, padding=padding
    )
    assert torch.equal(out_sites.indices(), reached.squeeze(1).nonzero())
    torch.testing.assert_close(sparse_conv(features, ours(weight), kernel_map), gather(dense, out_sites))


INVERSE = [
    (3, 2, 1, (5, 6, 7)),
    (3, 2, 1, (6, 8, 4)),
    ((1, 3, 3), (1, 2, 2), (0, 1, 1), (3, 7, 6)),
    ((3, 1, 2), (2, 1, 2), (1, 0, 0), (5, 4, 6)),
]


@pytest.mark.parametrize(("kernel", "stride", "padding", "spatial"), INVERSE)
def test_inverse_equals_dense_transposed_at_the_finer_sites(kernel, stride, padding, spatial):
    """Values and gradients, of a dense transposed convolution that is told the finer grid's size."""
    fine = random_sites((2, *spatial), 60)
    _, coarse = strided_map(fine, kernel, stride, padding)
    kernel_map = inverse_map(fine, coarse, kernel, stride, padding)
    assert kernel_map is inverse_map(fine, Sites(coarse.shape, coarse.keys), kernel, stride, padding)
    torch.manual_seed(0)
    size = (kernel,) * 3 if isinstance(kernel, int) else kernel
    features = torch.randn(len(coarse), 3).double().requires_grad_()
    weight = torch.randn(3, 4, *size).double().requires_grad_()  # torch's order: [Cin, Cout, k...]
    dense = densify(coarse, features)
    smallest = F.conv_transpose3d(dense, weight, stride=stride, padding=padding).shape[2:]
    missing = tuple(have - least for have, least in zip(spatial, smallest, strict=True))
    whole = F.conv_transpose3d(dense, weight, stride=stride, padding=padding, output_padding=missing)
    expected = gather(whole, fine)
    out = sparse_conv(features, weight.flatten(2).permute(2, 0, 1), kernel_map)
    torch.testing.assert_close(out, expected)
    seed = torch.randn(out.shape, dtype=torch.float64)
    found, wanted = (torch.autograd.grad(y, (features, weight), seed) for y in (out, expected))
    torch.testing.assert_close(found, wanted)


def test_inverse_refuses_sites_of_another_map():
    fine = random_sites((1, 6, 6), 12)
    _, coarse = strided_map(fine, 3, 2, 1)
    with pytest.raises(ValueError, match=f"{len(coarse) - 1} coarse sites on .* are not those"):
        inverse_map(fine, Sites(coarse.shape, coarse.keys[1:]), 3, 2, 1)


@pytest.mark.parametrize("mode", ["subm", "full", "temporal", "inverse"])
def test_gradcheck(mode):
    sites = random_sites((2, 3, 3, 4), 14)
    if mode == "subm":
        kernel_map = submanifold_map(sites, 3)
    elif mode == "full":
        kernel_map, _ = strided_map(sites, 3, 2, 1)
    elif mode == "inverse":
        kernel_map = strided_map(sites, 3, 2, 1)[0].transposed
    else:
        kernel_map, _ = temporal_map(sites, 3, (2, 1, 1), 1)
    torch.manual_seed(0)
    sizes = ((kernel_map.num_inputs, 2), (27, 2, 3), (3,))
    inputs = [torch.randn(*size).double().requires_grad_() for size in sizes]
    assert torch.autograd.gradcheck(lambda x, w, b: sparse_conv(x, w, kernel_map, b), inputs)


@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal", "inverse"])
def test_formula_and_optimised_forms_agree(mode):
    """Values and all three gradients."""
    kernel_map = map_of(mode, random_sites((2, 5, 6, 7), 70))
    torch.manual_seed(0)
    sizes = ((kernel_map.num_inputs, 3), (27, 3, 4), (4,))
    inputs = [torch.randn(*size).double().requires_grad_() for size in sizes]
    results = []
    for convolve in (sparse_conv, plain_sparse_conv):
        out = convolve(inputs[0], inputs[1], kernel_map, inputs[2])
        results.append((out, *torch.autograd.grad(out.square().sum(), inputs)))
    torch.testing.assert_close(*results)


@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal"])
def test_neighbour_sum_is_the_convolution_with_unit_weights(mode):
    kernel_map = map_of(mode, random_sites((2, 6, 7, 8), 60))
    features = torch.randn(60, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    unit = torch.eye(5, dtype=torch.float64).expand(27, 5, 5)
    assert torch.allclose(neighbour_sum(features, kernel_map), sparse_conv(features, unit, kernel_map), atol=1e-12)


@pytest.mark.parametrize("counts", [(25, 18), (0, 18), (40, 0)])
@pytest.mark.parametrize("kernel", [1, 3])
def test_stacked_parts_equal_the_parts_side_by_side(kernel, counts):
    sites = random_sites((2, 6, 7), 40)
    generator = torch.Generator().manual_seed(2)
    parts = [torch.randperm(40, generator=generator)[:count].sort().values for count in counts]
    features = [torch.randn(len(rows), 4, dtype=torch.float64, generator=generator) for rows in parts]
    weights = [torch.randn(kernel**2, 4, 5, dtype=torch.float64, generator=generator) for _ in parts]
    wide = torch.cat(
        [torch.zeros(40, 4).double().index_copy(0, r, x) for r, x in zip(parts, features, strict=True)], dim=1
    )
    expected = sparse_conv(wide, torch.cat(weights, dim=1), submanifold_map(sites, kernel))
    found = sparse_conv(torch.cat(features), torch.cat(weights), stack_of(sites, kernel, parts))
    torch.testing.assert_close(found, expected)


def test_order_of_the_given_cells_does_not_matter():
    indices = random_sites((1, 6, 6), 15).indices()
    torch.manual_seed(0)
    features, weight = torch.randn(15, 4), torch.randn(9, 4, 5)
    results = []
    for shuffle in (torch.arange(15), torch.randperm(15)):
        sites, order = Sites.from_indices(indices[shuffle], (1, 6, 6))
        results.append(sparse_conv(features[shuffle][order], weight, submanifold_map(sites, 3)))
    assert torch.equal(*results)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_no_sites(dtype):
    sites = random_sites((2, 6, 6), 0)
    features = torch.zeros(0, 3, dtype=dtype, requires_grad=True)
    weight = torch.ones(9, 3, 5, dtype=dtype, requires_grad=True)
    bias = torch.ones(5, dtype=dtype, requires_grad=True)
    strided, out_sites = strided_map(sites, 3, 2, 1)
    assert out_sites.shape == (2, 3, 3) and len(out_sites) == 0
    for kernel_map in (submanifold_map(sites, 3), strided):
        out = sparse_conv(features, weight, kernel_map, bias)
        assert out.shape == (0, 5)
        out.sum().backward()
    assert features.grad.shape == (0, 3) and not weight.grad.any() and not bias.grad.any()
    three = random_sites((1, 5, 4, 4), 0)
    assert len(temporal_map(three, 3, (2, 1, 1), 1)[1]) == 0


def test_autocast_computes_in_bfloat16_and_returns_gradients_in_the_type_of_the_weights():
    sites = random_sites((1, 8, 8), 40)
    torch.manual_seed(0)
    features = torch.randn(40, 5, requires_grad=True)
    weight, bias = torch.randn(9, 5, 6, requires_grad=True), torch.randn(6, requires_grad=True)
    exact = sparse_conv(features, weight, submanifold_map(sites, 3), bias)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = sparse_conv(features, weight, submanifold_map(sites, 3), bias)
    assert out.dtype == torch.bfloat16
    torch.testing.assert_close(out.float(), exact, rtol=0.03, atol=0.1)
    out.sum().backward()
    assert features.grad.dtype == weight.grad.dtype == torch.float32


def test_nothing_the_size_of_the_pairs_is_kept_for_backward():
    sites = random_sites((1, 32, 32), 900)
    kernel_map = submanifold_map(sites, 3)
    _ = kernel_map.by_output
    features, weight = torch.randn(900, 8, requires_grad=True), torch.randn(9, 8, 8, requires_grad=True)
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda x: kept.append(x.numel()) or x, lambda x: x):
        sparse_conv(features, weight, kernel_map)
    assert len(kernel_map.inputs) > 5 * 900
    assert sum(kept) == features.numel() + weight.numel()


def test_wrong_arguments_are_named():
    kernel_map = submanifold_map(random_sites((1, 6, 6), 10), 3)
    with pytest.raises(ValueError, match="got 9 rows and 9 offsets"):
        sparse_conv(torch.zeros(9, 2), torch.zeros(9, 2, 2), kernel_map)
    with pytest.raises(ValueError, match="Cin"):
        sparse_conv(torch.zeros(10, 2), torch.zeros(9, 3, 2), kernel_map)
    with pytest.raises(ValueError, match="float64"):
        sparse_conv(torch.zeros(10, 2), torch.zeros(9, 2, 2).double(), kernel_map)
