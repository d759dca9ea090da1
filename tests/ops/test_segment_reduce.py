import torch

from src.ops.fixed_shapes import Capacities, FixedShapes, in_fixed_shapes
from src.ops.segment_reduce import (
    gather_segment_sum,
    inverse_rows,
    paired_dot,
    permute_rows,
    rank_per_sample,
    segment_max,
    segment_mean,
    segment_softmax,
    segment_sum,
    segments,
    topk_per_sample,
    weighted_segment_sum,
)


def test_segments_keep_the_order_of_their_pairs():
    order, starts = segments(torch.tensor([2, 0, 2, 0]), 4)
    assert order.tolist() == [1, 3, 0, 2]
    assert starts.tolist() == [0, 2, 2, 4, 4]


def test_gather_segment_sum_by_hand():
    values = torch.tensor([[1.0], [10.0], [100.0]])
    picks, starts = torch.tensor([0, 2, 1]), torch.tensor([0, 2, 2, 3])
    assert gather_segment_sum(values, picks, starts).tolist() == [[101.0], [0.0], [10.0]]
    assert gather_segment_sum(values, picks, starts, torch.tensor([2.0, 1.0, 3.0])).tolist() == [[102.0], [0.0], [30.0]]
    assert gather_segment_sum(values, picks[:0], torch.zeros(3, dtype=torch.int64)).tolist() == [[0.0], [0.0]]


def test_segment_sum_and_mean():
    values = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    rows = torch.tensor([2, 0, 2])
    assert segment_sum(values, rows, 3).tolist() == [[3.0, 4.0], [0.0, 0.0], [6.0, 8.0]]
    assert segment_mean(values, rows, 3).tolist() == [[3.0, 4.0], [0.0, 0.0], [3.0, 4.0]]
    assert segment_mean(values[:0], rows[:0], 2).tolist() == [[0.0, 0.0]] * 2
    double = values.double().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: segment_mean(x, rows, 3), double)


def test_weighted_segment_sum_gradients():
    torch.manual_seed(0)
    picks, segment = torch.tensor([0, 2, 0, 1, 2]), torch.tensor([0, 0, 2, 2, 2])
    values, weights = torch.randn(3, 2).double().requires_grad_(), torch.randn(5).double().requires_grad_()
    for by_pick in (None, torch.argsort(picks, stable=True)):
        assert torch.autograd.gradcheck(
            lambda v, w, by=by_pick: weighted_segment_sum(v, w, picks, segment, 4, by), (values, weights)
        )
    dense = torch.zeros(4, 2).double().index_add(0, segment, weights[:, None] * values[picks])
    torch.testing.assert_close(weighted_segment_sum(values, weights, picks, segment, 4), dense)


def test_row_products_in_chunks(monkeypatch):
    monkeypatch.setattr("src.ops.segment_reduce.CPU_CHUNK", 3)
    a, b = torch.randn(4, 5), torch.randn(6, 5)
    rows_a, rows_b = torch.randint(0, 4, (10,)), torch.randint(0, 6, (10,))
    torch.testing.assert_close(paired_dot(a, rows_a, b, rows_b), (a[rows_a] * b[rows_b]).sum(1))


def test_topk_per_sample_by_hand():
    scores, sample = torch.tensor([0.1, 0.9, 0.5, 0.5, 0.7]), torch.tensor([0, 0, 0, 2, 2])
    assert topk_per_sample(scores, sample, 3, 2).tolist() == [[1, 2], [-1, -1], [4, 3]]
    assert topk_per_sample(scores[:0], sample[:0], 2, 2).tolist() == [[-1, -1], [-1, -1]]
    with in_fixed_shapes(FixedShapes(Capacities(9, 9, 9, 9), (3, 3))):  # what is of sample 1 is padding
        assert topk_per_sample(scores, sample.clamp(max=1), 1, 2).tolist() == [[1, 2]]
        assert topk_per_sample(scores, sample.clamp(max=1), 1, 7).tolist() == [[1, 2, 0, -1, -1, -1, -1]]
    order, rank = rank_per_sample(scores, sample)
    assert order.tolist() == [1, 2, 0, 4, 3] and rank.tolist() == [0, 1, 2, 0, 1]


def test_inverse_rows_by_hand():
    assert inverse_rows(torch.tensor([3, 0, 4]), 5).tolist() == [1, -1, -1, 0, 2]
    assert inverse_rows(torch.zeros(0, dtype=torch.int64), 2).tolist() == [-1, -1]


def test_permuted_rows_and_their_gradient():
    values = torch.randn(4, 3, dtype=torch.float64, requires_grad=True)
    there, back = torch.tensor([2, -1, 0, -1, 3]), torch.tensor([2, -1, 0, 4])
    found = permute_rows(values, there, back)
    zeros = torch.zeros(3, dtype=torch.float64)
    torch.testing.assert_close(found, torch.stack([values[2], zeros, values[0], zeros, values[3]]))
    assert torch.autograd.gradcheck(lambda x: permute_rows(x, there, back), values)
    empty = torch.zeros(0, 3, requires_grad=True)
    none = permute_rows(empty, torch.tensor([-1, -1]), torch.zeros(0, dtype=torch.int64))
    none.sum().backward()
    assert none.tolist() == [[0.0] * 3] * 2 and empty.grad.shape == (0, 3)


def test_segment_max_by_hand():
    values = torch.tensor([[-3.0, 1.0], [-2.0, 0.5], [7.0, -1.0]], dtype=torch.float64, requires_grad=True)
    out = segment_max(values, torch.tensor([2, 2, 0]), 4)
    assert out.tolist() == [[7, -1], [0, 0], [-2, 1], [0, 0]]
    out.backward(torch.tensor([[1.0, 2], [3, 4], [5, 6], [7, 8]]).double())
    assert values.grad.tolist() == [[0, 6], [5, 0], [1, 2]]
    assert segment_max(values[:0], torch.zeros(0, dtype=torch.int64), 2).tolist() == [[0, 0], [0, 0]]


def test_segment_softmax_is_one_of_every_row():
    scores = torch.tensor([1.0, 80.0, 2.0, 90.0, -200.0], dtype=torch.float64, requires_grad=True)
    rows = torch.tensor([0, 2, 0, 2, 3])
    found = segment_softmax(scores, rows, 5)
    wanted = torch.zeros(5, dtype=torch.float64)
    for row in (0, 2, 3):
        wanted[rows == row] = scores.detach()[rows == row].softmax(0)
    torch.testing.assert_close(found.detach(), wanted)
    assert torch.autograd.gradcheck(lambda x: segment_softmax(x, rows, 5), scores)
    assert segment_softmax(scores[:0], rows[:0], 2).shape == (0,)
