"""Compile every kernel for a GPU that need not be there; run by test_without_a_gpu.py.

Prints a line of JSON for each: its name, bytes of shared memory, and whether it multiplies on tensor cores.

The operations run up to their launches on tensors of the CPU, which fill nothing: only shapes and types matter.
"""

import json
import sys

import torch
from triton.backends.compiler import GPUTarget
from triton.runtime import driver
from triton.runtime.jit import JITFunction

from src.geometry.bev_grid import BEVGrid
from src.ops.distinct_keys import Groups
from src.ops.gaussian_cells import gaussian_cells
from src.ops.gaussian_shapes import AttributeLimits
from src.ops.initial_gaussians import Attributes, Keypoints, Slots
from src.ops.kernel_maps import submanifold_map
from src.ops.kernels import (
    add_layer_norm_triton,
    box_codes_triton,
    candidate_sort_keys_triton,
    cell_keys_triton,
    deform_sample_triton,
    distinct_keys_triton,
    farthest_point_triton,
    frame_motion_triton,
    gather_cells_triton,
    gaussian_cells_triton,
    gaussian_shapes_triton,
    initial_gaussians_triton,
    moved_keys_triton,
    neighbour_table_triton,
    radial_correction_triton,
    score_and_lift_pixels_triton,
    segment_reduce_triton,
    sparse_conv_triton,
    splat_triton,
    view_samples_triton,
)
from src.ops.sites import Sites


class Target:
    """What the compiler asks of a driver: an Nvidia GPU of the compute capability given on the command line."""

    def get_current_target(self):
        return GPUTarget("cuda", int(sys.argv[1]), 32)

    def get_current_device(self):
        return 0

    def get_current_stream(self, device=None):
        return 0


def compile_only(launch):
    def run(self, *arguments, grid, warmup, **options):
        kernel = launch(self, *arguments, grid=grid, warmup=True, **options)
        assert kernel.asm["cubin"]
        products = "mma" in kernel.asm["ptx"]
        print(json.dumps({"kernel": self.__name__, "shared": kernel.metadata.shared, "tensor_cores": products}))

    return run


def main():
    driver.set_active(Target())
    JITFunction.run = compile_only(JITFunction.run)
    kernels = (
        *(box_codes_triton, candidate_sort_keys_triton, cell_keys_triton, deform_sample_triton),
        *(distinct_keys_triton, farthest_point_triton, frame_motion_triton),
        *(gaussian_cells_triton, gaussian_shapes_triton, initial_gaussians_triton, moved_keys_triton),
        *(neighbour_table_triton, radial_correction_triton, score_and_lift_pixels_triton, segment_reduce_triton),
        *(sparse_conv_triton, splat_triton, add_layer_norm_triton, gather_cells_triton),
        view_samples_triton,
    )
    for module in kernels:
        module.runs_kernels = lambda tensor: True
    valid = torch.ones(2, 700, dtype=torch.bool)
    farthest_point_triton.farthest_points_triton(torch.zeros(2, 700, 2), valid, torch.zeros(2).long(), 20)

    for count in (80, 8000):
        distinct_keys_triton.distinct_keys_triton(torch.arange(count), 2**62, 50)
        distinct_keys_triton.grouped_keys_triton(torch.arange(count), 70, 50)
    neighbour_table_triton.neighbour_table_triton(*(torch.arange(size) for size in (80, 80, 9)))
    neighbour_table_triton.transposed_table_triton(torch.zeros(9, 80, dtype=torch.int32), 80)
    neighbour_table_triton.moved_table_triton(
        *(torch.arange(80), torch.arange(40), (120, 35), ((12, 10, 1, 2, 0, 5, 7),) * 2, (1, 0), torch.arange(9))
    )
    for dtype in (torch.int32, torch.int64):
        places = (torch.zeros(80, dtype=torch.int32), torch.zeros(80, dtype=dtype))
        neighbour_table_triton.stacked_table_triton(torch.zeros(9, 80, dtype=torch.int32), places, 40)
    kernel_map = submanifold_map(Sites.from_linear(torch.arange(80), (1, 8, 10)), 3)
    for dtype, c_in, c_out in ((torch.float32, 5, 16), (torch.float32, 96, 128), (torch.bfloat16, 96, 128)):
        features, weight = torch.zeros(80, c_in, dtype=dtype), torch.zeros(9, c_in, c_out, dtype=dtype)
        inputs = [features.requires_grad_(), weight.requires_grad_()]
        out = sparse_conv_triton.sparse_conv_triton(*inputs, kernel_map, torch.zeros(c_out, dtype=dtype))
        torch.autograd.grad(out, inputs, torch.zeros_like(out))
        operands = (features.detach(), weight.detach(), kernel_map, None, out.detach())
        sparse_conv_triton.sparse_conv_relu_triton(*operands)

    for dtype, channels in ((torch.float32, 7), (torch.bfloat16, 128)):
        groups = Groups(torch.arange(80), torch.arange(9))
        values = torch.zeros(80, channels, dtype=dtype)
        segment_reduce_triton.group_sum_triton(values, groups, channels == 7)
        segment_reduce_triton.gather_rows_triton(values, torch.arange(40, dtype=torch.int32))
        segment_reduce_triton.gather_rows_triton(values, torch.arange(40))
    places, samples = torch.zeros(80, 5), torch.zeros(8).long()
    for points, dtype in ((places[:, :2], torch.float32), (places[:, :3], torch.float64)):
        frame = (0.0, 1.0, 2.0)[: points.shape[1]]
        cell_keys_triton.cell_keys_triton(points, samples, None, frame, frame, (1, 5, 6, 7)[: len(frame) + 1], dtype)
    cell_keys_triton.cell_keys_triton(
        places[:, :2], samples, places[:, 0] > 0, (0.0, 1.0), (1.0, 1.0), (1, 5, 6), torch.float32, 1
    )
    moved_keys_triton.moved_keys_triton(torch.arange(80), (120, 35), ((12, 10, 1, 2, 0, 5, 7),) * 2, ((1, 0),))

    # Nothing fills what kernels make, so pairs and occupied cells are given.
    splat_triton.occupied_cells = lambda occupied, log_free, support, *limits: (torch.arange(len(support)), 0)
    grid = BEVGrid(cells=(8, 10), cell_m=0.8, centre_m=(0.0, 0.0), z_range_m=(-3.0, 5.0))
    radial_correction_triton.radial_votes_triton(torch.zeros(9, 7), torch.zeros(9).long(), grid)
    radial_correction_triton.radial_correction_triton(
        torch.zeros(9, 2), *[torch.arange(9)] * 2, torch.zeros(9, 2), grid
    )
    cell_keys_triton.cell_centres_triton(torch.arange(80), grid)
    table, points, shares = torch.arange(80), torch.zeros(7, 3, 2), torch.zeros(7, 4, 3)
    for dtype in (torch.float32, torch.bfloat16):
        values = torch.zeros(80, 4, 32, dtype=dtype)
        deform_sample_triton.attend_cells_triton(values, table, points, torch.zeros(7).long(), shares, grid)
    deform_sample_triton.attend_views_triton(
        [torch.zeros(2, 128, 8, 9)], torch.zeros(2, 7, 3, 2), torch.zeros(1, 7, 4, 2, 1, 3)
    )
    radial_correction_triton.radial_correction_triton(
        torch.zeros(9, 2), torch.zeros(1, 9, 2), torch.arange(9), torch.zeros(9, 2), grid, True
    )
    matrices, valid = torch.zeros(1, 2, 4, 4), torch.ones(1, 2, dtype=torch.bool)
    places = (torch.zeros(1, 7, 3, 2), torch.zeros(1, 7, 3), (-3.0, 5.0), matrices, valid, (32, 64))
    view_samples_triton.view_sampling_locations_triton(*places)
    seen = torch.ones(1, 7, 2, 3, dtype=torch.bool)
    view_samples_triton.view_attention_weights_triton(torch.zeros(1, 7, 48), torch.zeros(1, 2, 24), seen, 4)
    pairs = [torch.zeros(1, 7, 2)] * 3
    gaussian_shapes_triton.sampling_points_triton(torch.zeros(1, 7, 6), torch.zeros(5, 2), *pairs)
    limits = AttributeLimits((0.2, 3.0), 4.0, 30.0, 10.0)
    gaussian_shapes_triton.refined_attributes_triton(
        torch.zeros(1, 7, 9), pairs[0], torch.zeros(2), torch.ones(2), limits
    )
    cells = (torch.zeros(9).long(), torch.zeros(80, 3).long(), torch.zeros(9).long(), torch.zeros(9))
    radar = (torch.arange(9), torch.zeros(9, 2))
    box_codes_triton.decoded_boxes_triton(torch.zeros(9, 10), *cells, 0.1, grid, ((0,) * 12,) * 4, radar, True)
    now = (torch.zeros(1, 4, 4).double(), torch.zeros(1).double())
    present = torch.ones(2, 1, dtype=torch.bool)
    frame_motion_triton.relative_motion_triton(
        now, torch.zeros(1, 4, 4), tuple(torch.stack([x, x]) for x in now), present, 4.0, 100.0, True
    )
    rest = (present.expand(2, 7), torch.zeros(2, 4, 4), torch.zeros(2), present[:, 0], 0.3, grid)
    frame_motion_triton.warp_gaussians_triton((torch.zeros(2, 7, 2),) * 4, *rest)
    for dtype in (torch.float32, torch.bfloat16):
        rows, affine = torch.zeros(1, 7, 128, dtype=dtype), (torch.ones(128), torch.zeros(128))
        aged = (rows, torch.zeros(1, 7))
        add_layer_norm_triton.add_layer_norm_triton(rows, affine, 1e-5, rows, True, rows, aged)
        add_layer_norm_triton.relu_norm_columns_triton(rows, 1e-5)
    sites, classes = Sites.from_linear(torch.arange(80), (1, 8, 10)), ((0, 1), (2, 3))
    candidate_sort_keys_triton.candidate_sort_keys_triton(torch.zeros(80, 3), sites, classes, True)
    candidate_sort_keys_triton.unpack_candidates_triton(torch.zeros(2, 5).long(), classes, 3)
    score_and_lift_pixels_triton.score_and_lift_pixels_triton(
        *(torch.zeros(1, 2, 4, 5), torch.zeros(1, 2, 7, 4, 5), torch.zeros(7), matrices, valid, (32, 40), grid, None)
    )
    gather_cells_triton.gather_cells_triton(
        torch.zeros(9, 128), torch.zeros(9, 3).long(), torch.zeros(1, 4).long(), grid
    )
    slots = Slots(torch.zeros(9, 135), torch.zeros(9).long(), torch.zeros(2, 2), torch.zeros(128))
    found = [Keypoints(torch.zeros(1, n, 2), torch.ones(1, n) > 0, torch.zeros(1, n, 135)) for n in (4, 3)]
    past = (*pairs, torch.zeros(1, 7), pairs[0], torch.zeros(1, 7, 128), torch.zeros(1, 7).long())
    past = Attributes(*past, torch.zeros(1, 7), torch.ones(1, 7) > 0)
    for keypoints, history in ((found, past), ([], None)):
        initial_gaussians_triton.initial_gaussians_triton(slots, keypoints, history, torch.zeros(2), limits, 1)
    direction = torch.tensor([[1.0, 0.0]])
    gaussian = (torch.zeros(1, 2), torch.ones(1, 2), direction, torch.zeros(1), torch.zeros(1, 128))
    inputs = [x.requires_grad_() for x in gaussian]
    pairs, support = gaussian_cells(*inputs[:3], torch.zeros(1).long(), grid, 1, 3.0)
    shapes, batch, choice = [x.detach() for x in inputs[:3]], torch.zeros(1).long(), (grid, 80, 3.0)
    gaussian_cells_triton.padded_pairs_triton(*shapes, batch, *choice, 9)
    windows = gaussian_cells_triton.all_windows(*shapes, grid, 3.0)
    gaussian_cells_triton.all_candidates(windows, *shapes[1:], batch, *choice, 9, True)
    log_free, features, *_ = splat_triton.splat_triton(*inputs, pairs, (support, 0.1, 99, 80))
    torch.autograd.grad(log_free.sum() + features.sum(), inputs)


if __name__ == "__main__":
    main()
