"""Normalisers on one rank and on two."""

from pathlib import Path

import pytest
import torch
import torch.distributed as dist
import torch.multiprocessing as mp

from src.losses.normalizers import any_over_ranks, mean_over_ranks


def test_at_least_one_and_the_argument_is_kept() -> None:
    count = torch.tensor([0.0, 3.0])
    assert mean_over_ranks(count).tolist() == [1, 3]
    assert count.tolist() == [0, 3]
    assert float(mean_over_ranks(torch.tensor(0))) == 1 and float(mean_over_ranks(torch.tensor(7))) == 7


def test_alone_it_is_its_own_flag() -> None:
    assert any_over_ranks(torch.tensor(True)) and not any_over_ranks(torch.tensor(False))


def _rank(rank: int, folder: str) -> None:
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=2)
    found = mean_over_ranks(torch.tensor([0, 10 * rank]))
    assert found.tolist() == [0.5, 5]  # a total of 1 at least, half of it for each
    flags = [any_over_ranks(torch.tensor(value)) for value in (rank == 1, False)]
    assert [bool(flag) for flag in flags] == [True, False]
    dist.destroy_process_group()


@pytest.mark.slow
def test_two_ranks_divide_by_the_same_mean(tmp_path: Path) -> None:
    mp.start_processes(_rank, args=(str(tmp_path),), nprocs=2, start_method="forkserver")
