"""Building kernel maps (rulebooks) of sparse convolution from sets of sites."""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

from src.geometry.constants import arange, constant, where_scalar
from src.ops.fixed_shapes import fixed_shapes
from src.ops.kernel_map import KernelMap, TableMap, counts_kept
from src.ops.moved_keys import NONE, Axis, moved_keys
from src.ops.neighbour_table import moved_table, neighbour_table, stacked_table
from src.ops.site_index import SiteIndex
from src.ops.sites import HALO, Sites, padded_sites

Size = int | tuple[int, ...]


def makes_tables(sites: Sites) -> bool:
    """Whether maps of these sites are made as tables: on a GPU; a CPU multiplies pair by pair."""
    return sites.device.type != "cpu"


def submanifold_map(sites: Sites, kernel_size: Size) -> KernelMap:
    """Map whose outputs are the inputs: sites never dilate. Kernel sizes are odd, at most 5; cached on the sites.

    Raises ValueError for an even or too large kernel.
    """
    kernel = _odd_kernel(sites, kernel_size)
    key = ("submanifold", kernel)
    if key not in sites.cache:
        sites.cache[key] = _build_submanifold(sites, kernel)
    return sites.cache[key]


def strided_map(sites: Sites, kernel_size: Size, stride: Size, padding: Size) -> tuple[KernelMap, Sites]:
    """Map to every output cell whose window holds at least one site (stride 1 dilates the set); cached on the sites.

    Output cell p sees input cell p * stride - padding + k, as in a dense torch convolution, and the output grid has its
    size. Raises ValueError when the kernel does not fit the padded grid.
    """
    kernel = per_axis(kernel_size, sites.ndim, "kernel_size")
    strides, pads = per_axis(stride, sites.ndim, "stride"), per_axis(padding, sites.ndim, "padding")
    key = ("strided", kernel, strides, pads)
    if key not in sites.cache:
        sites.cache[key] = _build_strided(sites, kernel, strides, pads)
    return sites.cache[key]


def inverse_map(fine: Sites, coarse: Sites, kernel_size: Size, stride: Size, padding: Size) -> KernelMap:
    """The strided map from `fine` to `coarse` read backwards, as of a transposed convolution; cached on `fine`.

    Raises ValueError unless `coarse` is what the strided map makes of `fine`.
    """
    forward, reached = strided_map(fine, kernel_size, stride, padding)
    if reached is not coarse and (reached.shape != coarse.shape or not torch.equal(reached.keys, coarse.keys)):
        raise ValueError(
            f"{len(coarse)} coarse sites on {coarse.shape} are not those that kernel_size={kernel_size}, "
            f"stride={stride}, padding={padding} makes of the {len(fine)} fine ones ({len(reached)} on "
            f"{reached.shape}); give the sites that the strided convolution started from"
        )
    return forward.transposed


def window_map(inputs: Sites, outputs: Sites, kernel_size: Size) -> KernelMap:
    """Map from one set of sites to another of the same grid: each output sees the inputs in the window around it.

    Raises ValueError for different grids, or a kernel that is even or too large.
    """
    if inputs.shape != outputs.shape:
        raise ValueError(f"a window joins sites of one grid, but got shapes {inputs.shape} and {outputs.shape}")
    kernel = _odd_kernel(outputs, kernel_size)
    if makes_tables(outputs):
        table, bits = neighbour_table(inputs.keys, outputs.keys, _taps(outputs, kernel, centred=True))
        return TableMap(table, len(inputs), bits=bits)
    pairs = _pairs(inputs, _corners(outputs, kernel), kernel, torch.Size(kernel).numel())
    return KernelMap(*pairs, len(inputs), len(outputs))


def stacked_map(
    sites: Sites,
    kernel_size: Size,
    places: tuple[Tensor, Tensor],  # [n] each, row of either subset at each of the sites, -1 for none
    counts: tuple[int, int],  # rows of either
) -> KernelMap:
    """Map from two subsets of the sites, whose features are stacked row below row, to all of the sites.

    Kernel offsets run through the one and then the other: convolving the stack with the stacked weights equals a
    submanifold convolution of the subsets concatenated as channels, zero-filled where a subset lacks a site, without
    computing with the zeros.
    """
    base = submanifold_map(sites, kernel_size)
    if makes_tables(sites):
        table, bits = stacked_table(base.table, places, counts[0])
        return TableMap(table, sum(counts), bits=bits)
    inputs, outputs, pairs = [], [], []
    for place, before in zip(places, (0, counts[0]), strict=True):
        seen = place.to(torch.int32).index_select(0, base.inputs)
        kept = (seen >= 0).nonzero().squeeze(1)
        inputs.append(seen.index_select(0, kept) + before)
        outputs.append(base.outputs.index_select(0, kept))
        pairs.append(counts_kept(kept, base))
    return KernelMap(torch.cat(inputs), torch.cat(outputs), tuple(torch.cat(pairs).tolist()), sum(counts), len(sites))


def temporal_map(sites: Sites, kernel_size: Size, stride: Size, padding: Size) -> tuple[KernelMap, Sites]:
    """Map over (t, y, x) that strides over time but never dilates over the plane (method 6.1); cached on the sites.

    Output (t', y, x) exists exactly if an input slot in its temporal window has a site at the same (y, x); the weights
    still reach the spatial neighbours. `stride` is (s, 1, 1), the spatial padding half the spatial kernel.
    Raises ValueError for another stride or padding.
    """
    kernel = per_axis(kernel_size, sites.ndim, "kernel_size")
    strides, pads = per_axis(stride, sites.ndim, "stride"), per_axis(padding, sites.ndim, "padding")
    if any(s != 1 for s in strides[1:]) or any(2 * p + 1 != k for p, k in zip(pads[1:], kernel[1:], strict=True)):
        raise ValueError(
            f"stride={strides}, padding={pads}, kernel_size={kernel}: behind the time axis the stride must be 1 "
            "and the padding half of an odd kernel, otherwise the plane would change"
        )
    if max(pads) > HALO or kernel[0] - 1 - pads[0] > HALO:
        raise ValueError(f"kernel_size={kernel}, padding={pads}: a tap may reach at most {HALO} cells beyond the grid")
    key = ("temporal", kernel, strides, pads)
    if key not in sites.cache:
        sites.cache[key] = _build_temporal(sites, kernel, strides, pads)
    return sites.cache[key]


def pruned_map(
    sites: Sites,
    wide: Tensor,  # [n] bool
    kernel_size: Size,
    stride: Size,
    padding: Size,
) -> tuple[KernelMap, Sites]:
    """The strided map without the outputs that only sites which are not `wide` reach, but for each site's own.

    Its own output is the cell that it lies in, cell // stride. Every output that stays sees all inputs in its window.
    Waits for a GPU once. Raises ValueError where a site's own output might lie outside its window.
    """
    kernel = per_axis(kernel_size, sites.ndim, "kernel_size")
    strides, pads = per_axis(stride, sites.ndim, "stride"), per_axis(padding, sites.ndim, "padding")
    if any(pad + step > size for pad, step, size in zip(pads, strides, kernel, strict=True)) or max(pads) > HALO:
        raise ValueError(f"kernel_size={kernel}, stride={strides}, padding={pads}: no window reaches its whole cell")
    tap_steps = [torch.Size(kernel[axis + 1 :]).numel() for axis in range(sites.ndim)]
    steps, first, per_tap = constant((strides, pads, tuple(tap_steps)), torch.int64, sites.device)
    own = ((first + sites.indices()[:, 1:] % steps) * per_tap).sum(1)  # [n] the tap between a site and its own output
    taps = arange(torch.Size(kernel).numel(), torch.int64, sites.device)[:, None]
    out = _reached(
        sites, _output_shape(sites.shape, kernel, strides, pads), kernel, strides, pads, wide | (taps == own)
    )
    return _map_between(sites, out, kernel, strides, pads), out


def _odd_kernel(sites: Sites, kernel_size: Size) -> tuple[int, ...]:
    kernel = per_axis(kernel_size, sites.ndim, "kernel_size")
    if any(size % 2 == 0 or size > 2 * HALO + 1 for size in kernel):
        raise ValueError(f"kernel_size={kernel}: a submanifold kernel must be odd and at most {2 * HALO + 1} per axis")
    return kernel


def _corners(sites: Sites, kernel: tuple[int, ...]) -> Tensor:  # [n] int64
    """Key of the first cell of the odd kernel around each site."""
    return sites.keys - _reach(sites, kernel)


def _reach(sites: Sites, kernel: tuple[int, ...]) -> int:
    """From the key under the first tap of an odd kernel to that under its centre."""
    return sum(size // 2 * step for size, step in zip(kernel, sites.strides[1:], strict=True))


def _taps(sites: Sites, kernel: tuple[int, ...], centred: bool = False) -> Tensor:  # [K] int64
    """What each kernel tap adds to the key of the first, or to that of the centre."""
    first = -_reach(sites, kernel) if centred else 0
    cells = itertools.product(*(range(size) for size in kernel))
    steps = tuple(first + sum(i * step for i, step in zip(cell, sites.strides[1:], strict=True)) for cell in cells)
    return constant(steps, torch.int64, sites.device)


def _build_submanifold(sites: Sites, kernel: tuple[int, ...]) -> KernelMap:
    """Search the offsets before the centre only; those behind it are their mirror images."""
    num, device = len(sites), sites.device
    half = torch.Size(kernel).numel() // 2
    if half and makes_tables(sites):
        table, bits = neighbour_table(sites.keys, sites.keys, _taps(sites, kernel, centred=True))
        return TableMap(table, num, mirrored=True, bits=bits)
    rows = arange(num, torch.int32, device)
    if half == 0:
        return KernelMap(rows, rows, (num,), num, num, mirrored=True, identity=True)
    inputs, outputs, counts = _pairs(sites, _corners(sites, kernel), kernel, half)
    blocks_in, blocks_out = inputs.split(counts), outputs.split(counts)
    return KernelMap(
        torch.cat([inputs, rows, *blocks_out[::-1]]),
        torch.cat([outputs, rows, *blocks_in[::-1]]),
        (*counts, num, *counts[::-1]),
        num,
        num,
        mirrored=True,
    )


def _build_strided(
    sites: Sites, kernel: tuple[int, ...], stride: tuple[int, ...], padding: tuple[int, ...]
) -> tuple[KernelMap, Sites]:
    shape = _output_shape(sites.shape, kernel, stride, padding)
    if (makes_tables(sites) or fixed_shapes() is not None) and max(padding) <= HALO:
        out = _reached(sites, shape, kernel, stride, padding)
        return _map_between(sites, out, kernel, stride, padding), out
    out = Sites(shape, sites.keys)
    cells = sites.indices()
    targets, valid = cells[:, 0] * out.strides[0], torch.ones_like(cells[:, 0], dtype=torch.bool)
    for axis in range(sites.ndim):
        # One more leading axis per kernel axis: [k0, ..., n] output keys and whether the tap meets the output lattice.
        taps = arange(kernel[axis], torch.int64, sites.device)[:, None]
        moved = cells[:, axis + 1] + padding[axis] - taps  # [k, n]
        coarse = torch.div(moved, stride[axis], rounding_mode="floor")
        fits = (coarse * stride[axis] == moved) & (coarse >= 0) & (coarse < shape[axis + 1])
        targets = targets.unsqueeze(-2) + coarse * out.strides[axis + 1]
        valid = valid.unsqueeze(-2) & fits
    taps, inputs, counts = _hits(valid.flatten(0, -2))
    reached = targets.flatten().index_select(0, taps * len(sites) + inputs)
    out.keys, outputs = torch.unique(reached, return_inverse=True)
    return KernelMap(inputs.to(torch.int32), outputs.to(torch.int32), counts, len(sites), len(out)), out


def _build_temporal(
    sites: Sites, kernel: tuple[int, ...], stride: tuple[int, ...], padding: tuple[int, ...]
) -> tuple[KernelMap, Sites]:
    shape = _output_shape(sites.shape, kernel, stride, padding)
    # The temporal taps alone decide which outputs exist.
    ones = (1,) * (sites.ndim - 1)
    zeros = (0,) * (sites.ndim - 1)
    first = (kernel[0], *ones), (stride[0], *ones), (padding[0], *zeros)
    if makes_tables(sites) or fixed_shapes() is not None:
        reached = _reached(sites, shape, *first)
    else:
        _, reached = _build_strided(sites, *first)
    out = Sites(shape, reached.keys)
    return _map_between(sites, out, kernel, stride, padding), out


def _reached(
    sites: Sites,
    shape: tuple[int, ...],
    kernel: tuple[int, ...],
    stride: tuple[int, ...],
    padding: tuple[int, ...],
    kept: Tensor | None = None,  # [K, n] bool, the taps through which a site counts
) -> Sites:
    """Every cell of the coarse grid whose window holds a site. Waits for a GPU once, for their number."""
    taps = itertools.product(*(range(size) for size in kernel))
    shifts = tuple(tuple(pad - k for pad, k in zip(padding, tap, strict=True)) for tap in taps)
    coarse = Sites(shape, sites.keys)
    ones, zeros = (1,) * sites.ndim, (0,) * sites.ndim
    candidates = moved_keys(sites.keys, *_moved(sites, coarse, ones, stride, (zeros, shape[1:])), shifts)
    candidates = (candidates if kept is None else where_scalar(kept, candidates, NONE)).flatten()
    if fixed_shapes() is not None:
        return padded_sites(candidates, shape)
    # What fits nowhere is the largest key, which is there at least once and cut off.
    return Sites(shape, torch.unique(torch.cat([candidates, constant((NONE,), torch.int64, sites.device)]))[:-1])


def _moved(
    sites: Sites,
    target: Sites,  # whose grid
    factors: tuple[int, ...],
    divisors: tuple[int, ...],
    limits: tuple[tuple[int, ...], tuple[int, ...]],  # low and high of the cells there
) -> tuple[tuple[int, int], tuple[Axis, ...]]:
    """How `moved_keys` takes the sites to another grid."""
    sizes = tuple(size + HALO for size in sites.shape[1:])
    columns = (sites.strides[1:], sizes, factors, divisors, *limits, target.strides[1:])
    return (sites.strides[0], target.strides[0]), tuple(zip(*columns, strict=True))


def _map_between(
    sites: Sites, out: Sites, kernel: tuple[int, ...], stride: tuple[int, ...], padding: tuple[int, ...]
) -> KernelMap:
    """The map between two sets that are known."""
    # From each output to the first cell of its window.
    low, high = (-HALO,) * sites.ndim, tuple(size + HALO for size in sites.shape[1:])
    plan = _moved(out, sites, stride, (1,) * sites.ndim, (low, high))
    shift = tuple(-pad for pad in padding)
    if makes_tables(sites):
        table, bits = moved_table(sites.keys, out.keys, *plan, shift, _taps(sites, kernel))
        return TableMap(table, len(sites), bits=bits)
    corners = moved_keys(out.keys, *plan, (shift,))[0]
    return KernelMap(*_pairs(sites, corners, kernel, torch.Size(kernel).numel()), len(sites), len(out))


def _pairs(
    sites: Sites,
    corners: Tensor,  # [m] int64, key of the first kernel tap of every output
    kernel: tuple[int, ...],
    num_taps: int,
) -> tuple[Tensor, Tensor, tuple[int, ...]]:  # [pairs] int32, [pairs] int32
    """Inputs, outputs and counts of the pairs of the first `num_taps` taps, on a CPU.

    The taps of one kernel row lie side by side, so one look-up serves the whole row.
    """
    row_step = sites.strides[-2]
    rows = tuple(
        sum(offset * step // row_step for offset, step in zip(lead, sites.strides[1:-1], strict=True))
        for lead in itertools.islice(
            itertools.product(*(range(size) for size in kernel[:-1])), -(-num_taps // kernel[-1])
        )
    )
    windows = SiteIndex.of(sites).windows(corners, constant(rows, torch.int64, sites.device), kernel[-1])
    taps, outputs, counts = _hits(windows.found()[:num_taps])
    return windows.sites(taps, outputs), outputs.to(torch.int32), counts


def _hits(
    found: Tensor,  # [K, m] bool
) -> tuple[Tensor, Tensor, tuple[int, ...]]:
    """Rows and columns [hits] int64 of what was found, row by row, and how many in each row."""
    counts = found.sum(1)
    taps = torch.repeat_interleave(counts, output_size=int(counts.sum()))
    hits = torch.nonzero_static(found.reshape(-1), size=len(taps)).squeeze(1)
    return taps, hits - taps * found.shape[1], tuple(counts.tolist())


def _output_shape(
    shape: tuple[int, ...], kernel: tuple[int, ...], stride: tuple[int, ...], padding: tuple[int, ...]
) -> tuple[int, ...]:
    sizes = [(n + 2 * p - k) // s + 1 for n, k, s, p in zip(shape[1:], kernel, stride, padding, strict=True)]
    if min(sizes) < 1:
        raise ValueError(f"kernel_size={kernel} does not fit spatial shape {shape[1:]} with padding {padding}")
    return (shape[0], *sizes)


def per_axis(value: Size, ndim: int, name: str) -> tuple[int, ...]:
    """One number for each spatial axis, of one for all or one for each. Raises ValueError for other numbers of them."""
    sizes = (value,) * ndim if isinstance(value, int) else tuple(value)
    if len(sizes) != ndim or min(sizes) < (0 if name == "padding" else 1):
        raise ValueError(f"{name}={value}: expected one number or {ndim}, one per spatial axis, none too small")
    return sizes
