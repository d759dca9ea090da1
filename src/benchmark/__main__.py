"""`python -m src.benchmark [suite=...] [scale=...] [out=DIR]`: what things cost, as Markdown and JSON in DIR.

suite=model     the configured model part by part: time forward and with backward, arithmetic, memory traffic, share of
                the roofline bound on this machine, peak memory. With phase=phase2 the memory is full, but an untrained
                model holds no cell worth remembering: model.dptf.bev_path.memory_threshold=0 keeps all. The weights
                are random unless checkpoint=PATH (of the same configuration) is given
suite=ops       each heavy operation beside GEMM, other libraries and naive implementations, in turns
suite=scaling   cost against range, objects, radar points, Gaussians and memory, the configured model beside others that
                read radar and cameras (the dense baseline)
suite=training  frames per second of the phase's training step, with its loader and without
suite=latency   a frame of the trained model checkpoint=PATH, part by part, with full memory in phase 2, over the frames
                that it was validated on; into DIR/latency.json, where DIR is the run's folder if tables are to show it
suite=soak      memory, time and handles over thousands of streamed frames, in inference and in training (phase=phase2)
suite=metric    our metric against the official evaluator on one val-sized problem
suite=reader    frames per second of the reader on one core
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from src.benchmark.machine import busy_warning, describe_machine
from src.benchmark.page import markdown, page_name, page_of, write_page
from src.benchmark.suite_latency import latency_page, measure_latency
from src.benchmark.suite_metric import compare_with_devkit
from src.benchmark.suite_model import benchmark_model
from src.benchmark.suite_ops import benchmark_ops
from src.benchmark.suite_reader import benchmark_reader
from src.benchmark.suite_scaling import benchmark_scaling
from src.benchmark.suite_soak import benchmark_soak
from src.benchmark.suite_training import benchmark_training
from src.config import BenchmarkSuite, Config, compose_config
from src.errors import DataError
from src.reliability.allocator import tune_cpu_allocator
from src.reliability.command import run_command
from src.training.run_folder import make_writable, write_json

VAL_SIZED = {"num_samples": 3000, "gts": 25, "preds": 300}
"""About the size of the official val split with a full submission."""

SUITES: dict[BenchmarkSuite, Callable[[Config, dict[str, Any]], dict[str, Any]]] = {
    BenchmarkSuite.model: benchmark_model,
    BenchmarkSuite.ops: benchmark_ops,
    BenchmarkSuite.scaling: benchmark_scaling,
    BenchmarkSuite.training: benchmark_training,
    BenchmarkSuite.soak: benchmark_soak,
    BenchmarkSuite.metric: lambda config, tree: compare_with_devkit(**VAL_SIZED, seed=config.seed),
    BenchmarkSuite.reader: lambda config, tree: benchmark_reader(config),
}
"""What measures each suite, of the configuration and the same as a plain tree."""


def main(overrides: list[str]) -> None:
    """Measure one suite, print its page, and keep it as JSON and Markdown in `out` when given."""
    config, tree = compose_config(overrides)
    if config.suite is BenchmarkSuite.model and not any(word.startswith("data.batch_size=") for word in overrides):
        config.data.batch_size = 1
    tune_cpu_allocator()
    if config.out:
        make_writable(Path(config.out), "out")
    if config.suite is BenchmarkSuite.latency:
        report_latency(config, overrides)
        return
    machine = describe_machine()
    warning = busy_warning(machine)
    if warning:
        print(warning)
    page = page_of(config.suite.value, overrides, machine, SUITES[config.suite](config, tree))
    print(markdown(page))
    if config.out:
        name = page_name(config)
        write_page(Path(config.out), name, page)
        print(f"written: {Path(config.out) / name}.md and .json")
    if page["result"].get("agrees") is False:
        raise DataError("our metric and the official evaluator disagree on this problem; see the numbers above")


def report_latency(config: Config, overrides: list[str]) -> None:
    """Measure a checkpoint, write `latency.json` into `out`, and print the page."""
    content = measure_latency(config, overrides)
    if config.out:  # first: what took long is safe
        write_json(Path(config.out) / "latency.json", content)
    page = latency_page(content, overrides)
    warning = busy_warning(page["machine"])
    if warning:
        print(warning)
    print(markdown(page))
    if config.out:
        print(f"written: {Path(config.out) / 'latency.json'}")


if __name__ == "__main__":
    run_command(main)
