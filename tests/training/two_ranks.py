"""Runs a test's function on two ranks."""

import socket
import time

import torch.multiprocessing as mp

DEADLINE_S = 300.0


def spawn_two(function, *arguments):
    """`function` of rank, a free port and `arguments` in two processes, with a deadline."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    context = mp.spawn(function, (port, *arguments), nprocs=2, join=False)
    deadline = time.monotonic() + DEADLINE_S
    try:
        while not context.join(timeout=1.0):
            assert time.monotonic() < deadline, "the two processes hang"
    finally:
        for process in context.processes:
            if process.is_alive():
                process.kill()
