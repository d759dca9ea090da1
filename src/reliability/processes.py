"""Several processes that train one model: who starts them, what they agree on, how they end.

`python -m src.train trainer.devices=N` starts the same command once per device (`launch`); torchrun and SLURM start the
processes themselves. From then on all ways are the same: each process is inside `process_group`, one of them is the
main process, and what only one may decide or write goes through `decided_by_main` and `is_main_process`.
"""

from __future__ import annotations

import ctypes
import inspect
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from types import FrameType
from typing import Any, TypeVar

import lightning as L
import torch
import torch.distributed as dist
from lightning.fabric.plugins.environments import (
    ClusterEnvironment,
    LightningEnvironment,
    SLURMEnvironment,
    TorchElasticEnvironment,
)
from lightning.fabric.plugins.environments.lightning import find_free_network_port
from lightning.pytorch.strategies import DDPStrategy, Strategy
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from src.errors import ConfigError, DataError, DivergedError, HorizonError, InterruptedRunError
from src.reliability.command import INTERRUPT_GRACE_S, signal_name

logger = logging.getLogger(__name__)
T = TypeVar("T")

STEP_TIMEOUT = timedelta(minutes=5)
"""How long a process waits for the others within a step before it calls them hung."""
DECISION_TIMEOUT = timedelta(hours=12)
"""How long the others wait for the main process, which may be writing a data set."""
TERMINATION_GRACE_S = 20.0
"""What the other processes get to end by themselves once one has failed."""
REPORT_DELAY_S = 10.0
"""How long a process that lost another waits before its own message: the failing rank's message comes first."""
_SETTLE_S = 0.5  # processes that end this close together end for one reason, which is that of the lowest rank
_LOST_PEER = ("gloo/", "NCCL", "TCPStore", "closed by peer", "reset by peer")
_SET_PDEATHSIG = 1  # of Linux' prctl: a signal to the child when the thread that started it dies
# Looked up here: between fork and exec, a lock that another thread of the parent held would never be free again.
_PRCTL = ctypes.CDLL(None).prctl if sys.platform == "linux" else None

_decisions: dist.ProcessGroup | None = None


# ---------------------------------------------------------------- who and how many


def check_devices(accelerator: str, devices: int, num_nodes: int = 1) -> None:
    """Raise ConfigError when this machine, or whoever started the processes, does not fit the configuration.

    `devices` counts processes per node: one per GPU, or as many as wanted on the CPU, where more than there are cores
    are only warned of.
    """
    gpus = torch.cuda.device_count() or int(torch.backends.mps.is_available())
    if accelerator == "gpu" and not gpus:
        raise ConfigError(
            "trainer.accelerator=gpu, but torch sees no GPU on this machine; use trainer.accelerator=cpu, or install a "
            "torch build for your GPU"
        )
    on_cpu = accelerator == "cpu" or not gpus
    if not on_cpu and devices > gpus:
        raise ConfigError(
            f"trainer.devices={devices}, but torch sees {gpus} GPU{'s' * (gpus > 1)} here; use trainer.devices={gpus}, "
            "or trainer.accelerator=cpu for processes without GPUs"
        )
    cores = os.cpu_count() or 1
    if on_cpu and devices > cores:
        logger.warning("trainer.devices=%d: that many processes on %d cores are slower than fewer", devices, cores)
    started, wanted = _number_started(), devices * num_nodes
    if started is not None and started != wanted:
        raise ConfigError(
            f"{started} process(es) were started, but trainer.devices={devices} times trainer.num_nodes={num_nodes} "
            f"makes {wanted}; one process per device must be started, by srun or torchrun, or none (plain python)"
        )
    if started is None and num_nodes > 1:
        raise ConfigError(
            f"trainer.num_nodes={num_nodes}: start the command with srun or torchrun on the nodes; one node cannot "
            "start processes on another"
        )


def created_externally() -> bool:
    """Whether this process is one of several already: started by torchrun, by SLURM or by `launch`."""
    return _cluster().creates_processes_externally


def is_main_process() -> bool:
    """Whether this process alone writes and prints; true for a single process."""
    cluster = _cluster()
    if isinstance(cluster, LightningEnvironment):
        return cluster.node_rank() == 0 and cluster.local_rank() == 0
    return cluster.global_rank() == 0


def _cluster() -> ClusterEnvironment:
    """How the processes find each other, asked in Lightning's order; its own is also that of `launch`."""
    if TorchElasticEnvironment.detect():
        return TorchElasticEnvironment()
    if SLURMEnvironment.detect():
        try:
            return SLURMEnvironment(auto_requeue=False)  # runs resume from their own checkpoints
        except RuntimeError as error:
            raise ConfigError(f"SLURM: {error}") from None
    return LightningEnvironment()


def _number_started() -> int | None:
    """How many processes whoever started this one says there are; None when nobody did."""
    cluster = _cluster()
    if not isinstance(cluster, LightningEnvironment):
        return cluster.world_size()
    return int(os.environ.get("WORLD_SIZE", 1)) if cluster.creates_processes_externally else None


# ---------------------------------------------------------------- starting


def launch(module: str, overrides: Sequence[str], devices: int) -> None:
    """Run `python -m module overrides` once per device of this machine and wait for all.

    When one process fails, the log says which and how; the others get some seconds to end by themselves and are then
    killed. SIGTERM and Ctrl-C are passed on as SIGTERM, a later second Ctrl-C kills. Raises SystemExit with the exit
    code of the process that failed, 1 if it was killed.
    """
    ranks: list[subprocess.Popen] = []
    stops: list[float] = []

    def stop(number: int, frame: FrameType | None) -> None:
        stops.append(time.monotonic())
        again = number == signal.SIGINT and stops[-1] - stops[0] > INTERRUPT_GRACE_S
        _signal_all(ranks, signal.SIGKILL if again else signal.SIGTERM)

    # The processes inherit an ignored SIGINT: Ctrl-C in a terminal reaches them once, as the SIGTERM from here.
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)}
    signal.signal(signal.SIGTERM, stop)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        port = str(find_free_network_port())
        rendezvous = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port, "WORLD_SIZE": str(devices)}
        # Below errors torch's C++ would advise against looking for unused parameters, see `build_strategy`.
        rendezvous["TORCH_CPP_LOG_LEVEL"] = os.environ.get("TORCH_CPP_LOG_LEVEL", "ERROR")
        for rank in range(devices):
            identity = {"NODE_RANK": "0", "LOCAL_RANK": str(rank), "RANK": str(rank)}
            command = [sys.executable, "-m", module, *overrides]
            ranks.append(subprocess.Popen(command, env=os.environ | rendezvous | identity, preexec_fn=die_with_parent))
        signal.signal(signal.SIGINT, stop)
        if stops:
            _signal_all(ranks, signal.SIGTERM)
        code = _wait_for_all(ranks, stops)
    finally:
        _signal_all(ranks, signal.SIGKILL)
        for number, handler in before.items():
            signal.signal(number, handler)
    if code:
        raise SystemExit(code)


def _wait_for_all(ranks: list[subprocess.Popen], stops: list[float]) -> int:
    """Wait until all have ended, with a time limit once one has failed; returns the most specific exit code."""
    while (states := [process.poll() for process in ranks]).count(None) and not any(states):
        time.sleep(0.1)
    interrupted = InterruptedRunError.exit_code
    if any(states):
        time.sleep(_SETTLE_S)
        failed, code = next((rank, code) for rank, process in enumerate(ranks) if (code := process.poll()))
        if code != interrupted and not stops:
            logger.warning("process %d of %d %s; ending the others", failed, len(ranks), _how_it_ended(code))
        _end_all(ranks)
    codes = [process.returncode for process in ranks]
    specific = [code for code in codes if code in (ConfigError.exit_code, DataError.exit_code, DivergedError.exit_code)]
    if not any(codes) or specific:
        return specific[0] if specific else 0
    return interrupted if interrupted in codes or stops else 1


def _how_it_ended(code: int) -> str:
    if code >= 0:
        return f"ended with exit code {code}"
    why = ", as the system does when memory is short" if -code == signal.SIGKILL else ""
    return f"was killed by {signal_name(-code)}{why}"


def _end_all(ranks: list[subprocess.Popen]) -> None:
    """Wait for the processes that are left, and kill those that have not ended after TERMINATION_GRACE_S."""
    deadline = time.monotonic() + TERMINATION_GRACE_S
    while None in [process.poll() for process in ranks] and time.monotonic() < deadline:
        time.sleep(0.1)
    left = [rank for rank, process in enumerate(ranks) if process.poll() is None]
    for rank in left:
        logger.warning("process %d of %d did not end within %.0f s; killing it", rank, len(ranks), TERMINATION_GRACE_S)
        ranks[rank].kill()
    for rank in left:
        ranks[rank].wait()


def _signal_all(ranks: list[subprocess.Popen], number: int) -> None:
    for process in ranks:
        process.send_signal(number)  # does nothing to one that has ended


def die_with_parent(number: int = signal.SIGKILL) -> None:
    """In a new process: get this signal when the launching one is killed, which can pass nothing on (Linux only)."""
    if sys.platform == "linux":
        _PRCTL(_SET_PDEATHSIG, number)


# ---------------------------------------------------------------- together


@contextmanager
def process_group(accelerator: str, devices: int, num_nodes: int = 1) -> Iterator[None]:
    """Connect the processes for the time within; nothing happens for a single one.

    Only the main process logs below warnings. Raises HorizonError instead of torch's errors when another process was
    lost or late, after `REPORT_DELAY_S`: the failing rank reports the reason itself.
    """
    if devices * num_nodes == 1:
        yield
        return
    cluster = _cluster()
    if isinstance(cluster, LightningEnvironment):
        cluster.set_world_size(devices * num_nodes)
        cluster.set_global_rank(cluster.node_rank() * devices + cluster.local_rank())
    if not is_main_process():
        logging.getLogger().setLevel(logging.WARNING)
    os.environ["MASTER_ADDR"], os.environ["MASTER_PORT"] = cluster.main_address, str(cluster.main_port)
    backend = _backend(accelerator)
    try:
        dist.init_process_group(
            backend,
            store=_rendezvous_store(cluster),
            rank=cluster.global_rank(),
            world_size=cluster.world_size(),
            timeout=STEP_TIMEOUT,
            device_id=torch.device("cuda", cluster.local_rank()) if backend == "nccl" else None,
        )
        _decision_group()
        yield
    except RuntimeError as error:
        if not any(word in str(error) for word in _LOST_PEER):
            raise
        reason = str(error).splitlines()[0]
        late = "timed out" in reason.lower() or "timeout" in reason.lower()
        if not late:  # a hanging rank has no message of its own
            with suppress(KeyboardInterrupt):  # whoever ends this process meanwhile need not wait
                time.sleep(REPORT_DELAY_S)
        what = "hangs or is cut off" if late else "ended, its message says why"
        raise HorizonError(
            f"another process of this run {what} ({reason}); the same command resumes from the last checkpoint"
        ) from error
    finally:
        end_processes()


def _rendezvous_store(cluster: ClusterEnvironment) -> dist.Store:
    """The store in which the processes exchange addresses, under a prefix of its own for each attempt.

    torchrun keeps one store for all its restarts, and there the addresses of ended processes would still stand. Agents
    of several nodes count restarts each for themselves, so there the count cannot tell attempts apart.
    """
    where = next(dist.rendezvous("env://", cluster.global_rank(), cluster.world_size(), timeout=STEP_TIMEOUT))
    one_agent = os.environ.get("GROUP_WORLD_SIZE", "1") == "1"
    attempt = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0") if one_agent else "0"
    return dist.PrefixStore(f"attempt {attempt}", where[0])


def end_processes() -> None:
    """Disconnect from the others, which need not do the same at this moment; safe to call twice or without a group.

    The main process calls it before work of its own, or the others' end would look like a failure to it.
    """
    global _decisions
    _decisions = None
    if dist.is_available() and dist.is_initialized():
        dist.destroy_process_group()


def decided_by_main(decide: Callable[[], T]) -> T:
    """Result of `decide`, which runs in the main process only; the others wait for it, for hours if need be.

    Every process must call it at the same place. What `decide` raises ends all of them: the main process with the error
    itself, the others silently with its exit code. The result must be a plain value.
    """
    if not several_processes():
        return decide()
    answer: list[Any] = [None]
    failure: BaseException | None = None
    if is_main_process():
        try:
            answer[0] = (None, decide())
        except BaseException as error:
            failure = error
            answer[0] = (error.exit_code if isinstance(error, HorizonError) else 1, None)
    dist.broadcast_object_list(answer, src=0, group=_decision_group())
    if failure is not None:
        raise failure
    code, value = answer[0]
    if code is not None:
        raise SystemExit(code)
    return value


def several_processes() -> bool:
    """Whether this is one of several ranks."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def _decision_group() -> dist.ProcessGroup:
    """A group of the same processes with a longer timeout, on the CPU, so that no GPU waits in a kernel."""
    global _decisions
    if _decisions is None:
        _decisions = dist.new_group(backend="gloo", timeout=DECISION_TIMEOUT)
    return _decisions


def _backend(accelerator: str) -> str:
    return "nccl" if accelerator != "cpu" and torch.cuda.is_available() else "gloo"


# ---------------------------------------------------------------- Lightning


def build_strategy(accelerator: str, devices: int, num_nodes: int = 1) -> Strategy | str:
    """What a Trainer takes as `strategy`: "auto" for one process, else data parallel training of several.

    Gradients are averaged over the processes. Parameters may go unused in a step of one process or of all: the branch
    of a keypoint source, history Gaussians or an attention over them has nothing to do where frames hold no radar
    points, no active Gaussians or no past, and loss terms can be switched off. So DDP has to look which were used.
    """
    if devices * num_nodes == 1:
        return "auto"
    # Batch statistics are per device, and in validation the processes may have different numbers of batches: DDP must
    # not exchange buffers in its forward. `SharedStatistics` does it where it matters. (Older torch: another name.)
    known = inspect.signature(DistributedDataParallel).parameters
    sync = "forward_sync_buffers" if "forward_sync_buffers" in known else "broadcast_buffers"
    return DDPStrategy(
        cluster_environment=_cluster(),
        process_group_backend=_backend(accelerator),
        timeout=STEP_TIMEOUT,
        find_unused_parameters=True,
        **{sync: False},
    )


class SharedStatistics(L.Callback):
    """Before validation, and at the end of an epoch, all processes take the mean of their norms' running statistics.

    Then several processes score the model that one process would find in the checkpoint, and its statistics are those
    of the whole batch. Belongs behind callbacks that exchange the weights for validation.
    """

    def on_validation_epoch_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Every process comes here once per validation."""
        self.on_train_epoch_end(trainer, module)

    @torch.no_grad()
    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Before the checkpoint of the epoch is written."""
        values = list(running_statistics(module).values()) if several_processes() else []
        if values:
            mean = torch.cat(values) / dist.get_world_size()
            dist.all_reduce(mean)
            for value, shared in zip(values, mean.split([len(value) for value in values]), strict=True):
                value.copy_(shared)


def running_statistics(module: nn.Module) -> dict[str, torch.Tensor]:
    """Mean and variance of every batch norm, by name."""
    return {name: value for name, value in module.named_buffers() if name.endswith(("running_mean", "running_var"))}


def gather_by_rank(value: Any) -> list[Any]:
    """The `value`s of all ranks in their order; every rank must call it. One value without a process group."""
    if not several_processes():
        return [value]
    values: list[Any] = [None] * dist.get_world_size()
    dist.all_gather_object(values, value)
    return values
