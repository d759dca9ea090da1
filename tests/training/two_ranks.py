"""Runs a test's function on two ranks."""

import os
import pickle
import socket
import time

import torch
import torch.multiprocessing as mp

DEADLINE_S = 300.0


def spawn_two(function, *arguments):
    """`function` of rank, a free port and `arguments`, a copy each, in two processes, with a deadline."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    packed = pickle.dumps(arguments)  # by value: a server of forks takes few shared tensors
    context = mp.start_processes(_unpack, (function, port, packed), nprocs=2, join=False, start_method="forkserver")
    deadline = time.monotonic() + DEADLINE_S
    try:
        while not context.join(timeout=1.0):
            assert time.monotonic() < deadline, "the two processes hang"
    finally:
        for process in context.processes:
            if process.is_alive():
                process.kill()


def _unpack(rank, function, port, packed):
    function(rank, port, *pickle.loads(packed))


def become(rank, world_size, port):
    """Tell this process who it is, as a launcher does."""
    torch.set_num_threads(1)
    if world_size > 1:
        who = {"LOCAL_RANK": rank, "RANK": rank, "WORLD_SIZE": world_size}
        who |= {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
        os.environ.update({name: str(value) for name, value in who.items()})
