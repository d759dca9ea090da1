"""A convolution with a residual and a ReLU against its layers one by one."""

import pytest
import torch
import torch.nn.functional as F

from src.ops.conv_relu import conv_relu

NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
DEVICES = ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, NO_GPU])]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("stride", [1, 2])
@pytest.mark.parametrize("residual", [False, True])
def test_layers_one_by_one(device, stride, residual):
    draw = torch.Generator().manual_seed(stride)
    x, weight, bias = (torch.randn(*shape, generator=draw) for shape in ((2, 4, 8, 6), (5, 4, 3, 3), (5,)))
    expected = F.conv2d(x, weight, bias, stride, 1)
    added = torch.randn(expected.shape, generator=draw) if residual else None
    expected = F.relu(expected if added is None else expected + added)
    inputs = [None if value is None else value.to(device) for value in (x, weight, bias, added)]
    found = conv_relu(*inputs[:3], (stride, stride), (1, 1), inputs[3])
    torch.testing.assert_close(found.cpu(), expected, rtol=1e-3, atol=1e-3)  # TF32
    assert added is None or torch.equal(inputs[3].cpu(), added)
