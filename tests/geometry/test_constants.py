"""Constants: made once for each type, and of use to training whoever made them."""

import torch

from src.geometry.constants import arange, constant, repeat_interleave, where_scalar


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


def test_counting_is_the_head_of_one_sequence_for_every_count_up_to_a_power_of_two():
    device = torch.device("cpu")
    for count in (0, 1, 5, 8, 9):
        assert arange(count, torch.int32, device).tolist() == list(range(count))
    assert arange(5, torch.int64, device).data_ptr() == arange(8, torch.int64, device).data_ptr()
    assert repeat_interleave((2, 0, 3), device).tolist() == [0, 0, 2, 2, 2]


def test_a_number_stands_where_a_value_is_not_kept():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0]], requires_grad=True)
    kept = torch.tensor([[True], [False]])
    found = where_scalar(kept, values, -torch.inf)
    assert found.tolist() == [[1.0, 2.0], [-torch.inf, -torch.inf]]
    found[0].sum().backward()
    assert values.grad.tolist() == [[1.0, 1.0], [0.0, 0.0]]
