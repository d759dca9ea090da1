import math

import pytest
import torch
import torch.nn.functional as F

from src.geometry.bev_grid import BEVGrid
from src.ops import deform_sample
from src.ops.deform_sample import attend_views_reference, deform_attend_bev, deform_attend_images, sample_sparse_bev
from src.ops.sites import Sites

GRID = BEVGrid(cells=(6, 8), cell_m=0.8, centre_m=(0.4, -0.2), z_range_m=(-3.0, 5.0))


def scene(channels=3, points=60):
    generator = torch.Generator().manual_seed(0)
    linear = torch.randperm(2 * 48, generator=generator)[:25].sort().values
    values = torch.randn(25, channels, generator=generator, dtype=torch.float64)
    xy = torch.rand(points, 2, generator=generator, dtype=torch.float64) * torch.tensor([9.0, 7.0])
    xy = xy - torch.tensor([4.1, 3.7])  # beyond the grid on every side
    batch = torch.randint(0, 2, (points,), generator=generator)
    return values, Sites.from_linear(linear, (2, 6, 8)), xy, batch


def dense_sample(values, sites, points, batch):
    dense = values.new_zeros(2, 6, 8, values.shape[1])
    dense = dense.index_put(sites.indices().unbind(1), values).movedim(3, 1)
    half = points.new_tensor(GRID.half_extent_m)
    places = ((points - points.new_tensor(GRID.centre_m)) / half)[:, None, None]
    return F.grid_sample(dense[batch], places, align_corners=False, padding_mode="zeros").flatten(1)


def test_sampling_equals_grid_sample_on_the_dense_map():
    values, sites, points, batch = scene()
    leaves = [values.requires_grad_(), points.requires_grad_()]
    ours, dense = sample_sparse_bev(values, sites, points, batch, GRID), dense_sample(values, sites, points, batch)
    torch.testing.assert_close(ours, dense)
    weight = torch.randn_like(ours)
    for a, b in zip(
        torch.autograd.grad((ours * weight).sum(), leaves),
        torch.autograd.grad((dense * weight).sum(), leaves),
        strict=True,
    ):
        torch.testing.assert_close(a, b)


def test_sampling_at_a_centre_between_cells_and_at_the_border():
    sites, _ = Sites.from_indices(torch.tensor([[0, 2, 3], [0, 2, 4], [1, 2, 3]]), (2, 6, 8))
    values = torch.tensor([[1.0], [3.0], [100.0]])
    centre = GRID.centre_of(torch.tensor([2, 3]))
    points = torch.stack([centre, centre + torch.tensor([0.4, 0.0]), centre + torch.tensor([0.0, 0.4]), centre])
    out = sample_sparse_bev(values, sites, points, torch.tensor([0, 0, 0, 1]), GRID)
    torch.testing.assert_close(out, torch.tensor([[1.0], [2.0], [0.5], [100.0]]))
    outside = torch.tensor([[1e30, 0.0], [math.nan, 0.0], [0.0, -math.inf]])
    assert not sample_sparse_bev(values, sites, outside, torch.zeros(3, dtype=torch.int64), GRID).nan_to_num().any()


def test_any_leading_shape_and_float32_weights_for_bfloat16_values():
    values, sites, points, batch = scene()
    flat = sample_sparse_bev(values, sites, points, batch, GRID)
    shaped = sample_sparse_bev(values, sites, points.view(3, 4, 5, 2), batch.view(3, 4, 5), GRID)
    assert torch.equal(shaped.view(60, 3), flat)
    half = sample_sparse_bev(values.bfloat16(), sites, points.float(), batch, GRID)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.double(), flat, rtol=0.02, atol=0.02)


def test_nothing_to_sample():
    empty = Sites.from_linear(torch.zeros(0, dtype=torch.int64), (2, 6, 8))
    values = torch.zeros(0, 4, requires_grad=True)
    points = torch.zeros(5, 2, requires_grad=True)
    out = sample_sparse_bev(values, empty, points, torch.zeros(5, dtype=torch.int64), GRID)
    assert out.shape == (5, 4) and not out.any()
    out.sum().backward()
    assert not points.grad.any()
    values, sites, points, batch = scene()
    assert sample_sparse_bev(values, sites, points[:0], batch[:0], GRID).shape == (0, 3)


def test_bev_attention_against_dense_and_gradcheck():
    values, sites, points, batch = scene(channels=4, points=12)
    values, points, batch = values.view(-1, 2, 2), points.view(4, 3, 2), batch[:4]
    weights = torch.rand(4, 2, 3, dtype=torch.float64)
    inputs = [x.requires_grad_() for x in (values, points, weights)]
    sampled = dense_sample(values.flatten(1), sites, points.flatten(0, 1), batch.repeat_interleave(3)).view(4, 3, 2, 2)
    expected = torch.einsum("qphc,qhp->qhc", sampled, weights).flatten(1)
    torch.testing.assert_close(deform_attend_bev(values, sites, points, batch, weights, GRID), expected)
    assert torch.autograd.gradcheck(lambda v, p, w: deform_attend_bev(v, sites, p, batch, w, GRID), inputs)


@pytest.fixture(params=["by image", "all images"])
def form(request, monkeypatch):
    """What a CPU does, and what a GPU does."""
    if request.param == "all images":
        monkeypatch.setattr(deform_sample, "_sum_by_image", lambda *inputs: attend_views_reference(*inputs[:3]))


def pyramid(batch=2, queries=5, views=3):
    heads, points, generator = 2, 4, torch.Generator().manual_seed(0)

    def normal(*size):
        return torch.randn(*size, generator=generator, dtype=torch.float64)

    values = [normal(batch, views, heads * 3, 16 // s, 24 // s) for s in (4, 8)]
    pixels = torch.rand(batch, queries, views, points, 2, generator=generator, dtype=torch.float64)
    pixels = (pixels * 1.5 - 0.25) * torch.tensor([24.0, 16.0])  # (u, v), a third outside
    return values, pixels, normal(batch, queries, heads, views, 2, points)


def plain_images(values, pixels, weights):
    """Every view, level and point; maps sampled cell by cell in their own coordinates."""
    batch, queries, views, points, _ = pixels.shape
    heads = weights.shape[2]
    out = 0
    for level, maps in enumerate(values):
        stride = 16 / maps.shape[3]
        size = pixels.new_tensor([maps.shape[4], maps.shape[3]])
        place = pixels / stride - 0.5  # centre of cell j is at stride * (j + 0.5) pixels
        for view in range(views):
            normal = (2 * place[:, :, view] + 1) / size - 1
            sampled = F.grid_sample(maps[:, view], normal, align_corners=False).view(batch, heads, 3, queries, points)
            out = out + torch.einsum("bhcqp,bqhp->bqhc", sampled, weights[:, :, :, view, level])
    return out.flatten(2)


@pytest.mark.usefixtures("form")
def test_image_attention_equals_every_view_sampled():
    values, pixels, weights = pyramid()
    out = deform_attend_images(values, pixels, (16, 24), weights)
    torch.testing.assert_close(out, plain_images(values, pixels, weights))


@pytest.mark.usefixtures("form")
def test_image_attention_reads_cell_centres():
    """Cell (1, 2) at stride 8 has its centre at pixel u = 20, v = 12."""
    level = torch.zeros(1, 1, 1, 2, 3)
    level[0, 0, 0, 1, 2] = 1.0
    pixels = torch.tensor([[20.0, 12.0], [16.0, 12.0], [24.0, 12.0], [28.0, 12.0]]).view(1, 4, 1, 1, 2)
    out = deform_attend_images([level], pixels, (16, 24), torch.ones(1, 4, 1, 1, 1, 1))
    torch.testing.assert_close(out.flatten(), torch.tensor([1.0, 0.5, 0.5, 0.0]))


@pytest.mark.usefixtures("form")
def test_image_attention_gradients():
    values, pixels, weights = pyramid(batch=1, queries=3, views=2)
    inputs = [x.requires_grad_() for x in (*values, pixels, weights)]
    assert torch.autograd.gradcheck(lambda a, b, p, w: deform_attend_images([a, b], p, (16, 24), w), inputs)


@pytest.mark.usefixtures("form")
def test_invisible_points_count_for_nothing():
    values, pixels, weights = pyramid()
    visible = torch.rand(pixels.shape[:4], generator=torch.Generator().manual_seed(5)) < 0.5
    visible[:, 2] = False
    out = deform_attend_images(values, pixels, (16, 24), weights, visible)
    masked = weights * visible[:, :, None, :, None].double()
    torch.testing.assert_close(out, plain_images(values, pixels, masked))
    assert not out[:, 2].any()
    # Projections behind a camera may be anything.
    wild = torch.where(visible[..., None], pixels, math.nan)
    torch.testing.assert_close(deform_attend_images(values, wild, (16, 24), weights, visible & True), out)
    assert not deform_attend_images(values, pixels, (16, 24), weights, visible & False).any()


@pytest.mark.usefixtures("form")
@pytest.mark.parametrize(("batch", "queries"), [(1, 0), (0, 5)])
def test_image_attention_of_nothing(batch, queries):
    values, pixels, weights = pyramid(batch, queries)
    assert deform_attend_images(values, pixels, (16, 24), weights).shape == (batch, queries, 6)


def test_wrong_shapes_are_named():
    values, sites, points, batch = scene()
    with pytest.raises(ValueError, match="expected as many rows"):
        sample_sparse_bev(values[:3], sites, points, batch, GRID)
    with pytest.raises(ValueError, match=r"weights \[Q, heads, P\]"):
        deform_attend_bev(values[:, None], sites, points.view(20, 3, 2), batch[:20], torch.zeros(20, 3, 1), GRID)
    images, pixels, weights = pyramid()
    with pytest.raises(ValueError, match="does not divide"):
        deform_attend_images(images, pixels, (16, 25), weights)
    with pytest.raises(ValueError, match="weights: expected"):
        deform_attend_images(images[:1], pixels, (16, 24), weights)
