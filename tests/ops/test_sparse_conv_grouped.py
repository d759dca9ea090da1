import pytest
import torch

from src.ops.sparse_conv_cpu import cpu_sparse_conv
from src.ops.sparse_conv_grouped import grouped_sparse_conv
from tests.ops.maps import map_of, random_sites


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("mode", ["submanifold", "strided", "temporal", "inverse", "empty"])
def test_one_launch_for_all_offsets_gives_the_same(mode, dtype):
    """The form of a GPU without Triton, on a CPU."""
    sites = random_sites((2, 5, 6, 7), 0 if mode == "empty" else 70)
    kernel_map = map_of("submanifold" if mode == "empty" else mode, sites)
    results = []
    for convolve in (cpu_sparse_conv, grouped_sparse_conv):
        torch.manual_seed(0)
        x = torch.randn(kernel_map.num_inputs, 3).to(dtype).requires_grad_()
        w, b = torch.randn(27, 3, 5).to(dtype).requires_grad_(), torch.randn(5).to(dtype).requires_grad_()
        out = convolve(x, w, kernel_map, b)
        (out * torch.randn(out.shape).to(dtype)).sum().backward()
        results.append((out.detach().float(), x.grad.float(), w.grad.float(), b.grad.float()))
    tolerance = 1e-5 if dtype == torch.float32 else 0.05
    for blocked, grouped in zip(*results, strict=True):
        scale = blocked.abs().max().item() if blocked.numel() else 1.0
        torch.testing.assert_close(grouped, blocked, rtol=0, atol=tolerance * max(scale, 1.0))
