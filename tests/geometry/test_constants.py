"""Constants: made once for each type, and of use to training whoever made them."""

import torch

from src.geometry.constants import constant


def test_the_same_tensor_every_time_and_one_for_each_type():
    device = torch.device("cpu")
    table = ((1, 2), (3, 4))
    first = constant(table, torch.int64, device)
    assert first is constant(((1, 2), (3, 4)), torch.int64, device) and first.tolist() == [[1, 2], [3, 4]]
    assert constant(table, torch.float64, device).dtype == torch.float64


def test_what_inference_made_takes_part_in_training():
    with torch.inference_mode():
        made = constant((0.5, 7.25), torch.float32, torch.device("cpu"))
    weight = torch.ones(2, requires_grad=True)
    (weight * made).sum().backward()
    assert weight.grad.tolist() == [0.5, 7.25]
