"""Where a run computes, and how it reports and fails (`trainer`)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import torch

from src.errors import require_least
from src.reliability.processes import check_devices


class Accelerator(Enum):
    """Where a run computes; `auto` takes a GPU where torch sees one."""

    auto = "auto"
    cpu = "cpu"
    gpu = "gpu"


class OnNonfinite(Enum):
    """What happens at a step whose loss or gradients are not finite; either way a dump of it is left."""

    stop = "stop"  # the training ends there and says why
    skip = "skip"  # weights and optimiser stay as they were, the step is counted; too many in a row end the training


@dataclass(kw_only=True)
class TrainerConfig:
    """Where a run computes, how often it reports, and what it does when something goes wrong with its numbers."""

    accelerator: Accelerator
    devices: int  # processes on each machine
    num_nodes: int  # machines
    log_every_steps: int
    checkpoint_every_steps: int | None  # null: after every epoch
    num_pictures: int  # validation frames drawn at the end
    on_nonfinite: OnNonfinite
    deterministic: bool  # refuse operations whose result differs from run to run, of which a GPU has some

    def __post_init__(self) -> None:
        least_of = {"devices": 1, "num_nodes": 1, "log_every_steps": 1, "checkpoint_every_steps": 1, "num_pictures": 0}
        require_least(self, "trainer", least_of)

    @property
    def num_processes(self) -> int:
        """Ranks that train together."""
        return self.devices * self.num_nodes

    @property
    def processes(self) -> tuple[str, int, int]:
        """Accelerator, devices and nodes, as `reliability/processes.py` asks for them."""
        return self.accelerator.value, self.devices, self.num_nodes

    def device(self) -> torch.device:
        """For a command of one process: a GPU where there is one and `accelerator` does not say otherwise.

        Raises ConfigError where it asks for a GPU that is not there.
        """
        check_devices(self.accelerator.value, 1)
        on_gpu = torch.cuda.is_available() and self.accelerator is not Accelerator.cpu
        return torch.device("cuda" if on_gpu else "cpu")
