"""`python -m src.benchmark [suite=...] [scale=...] [out=DIR]`: what things cost, as Markdown and JSON in DIR.

suite=model     the configured model part by part: time forward and with backward, arithmetic, memory traffic, share of
                the roofline bound on this machine, peak memory. With phase=phase2 the memory is full, but an untrained
                model holds no cell worth remembering: model.dptf.bev_path.memory_threshold=0 keeps all. The weights
                are random unless checkpoint=PATH (of the same configuration) is given; a phase that learns from LiDAR
                rays alone takes a made frame: no world is written for it
suite=ops       each heavy operation beside GEMM, other libraries and naive implementations, in turns
suite=scaling   cost against range, objects, radar points, Gaussians and memory, the configured model beside the
                dense baseline; of a model that reads LiDAR, alone, against range
suite=training  frames per second of the phase's training step, with its loader and without
suite=latency   a frame of the trained model checkpoint=PATH, part by part, with full memory in phase 2, over the frames
                that it was validated on; into DIR/latency.json, where DIR is the run's folder if tables are to show it.
                Without a checkpoint, of the configured model with fresh weights that are as busy as trained ones
suite=soak      memory, time and handles over thousands of streamed frames, in inference and in training (phase=phase2)
suite=metric    our metric against the official evaluator on one val-sized problem
suite=launches  launches, waits and uploads of a frame and of a training step on a GPU, counted on a simulated one
suite=gpu       frames and steps on a GPU: wall and busy time, waits, beside what suite=launches counts
suite=reader    frames per second of the reader on one core
"""

from __future__ import annotations

import importlib
from pathlib import Path

from src.benchmark.machine import busy_warning, describe_machine
from src.benchmark.page import markdown, page_name, page_of, write_page
from src.benchmark.suite_latency import latency_page, measure_latency
from src.config import BenchmarkSuite, Config, compose_config, refuse_options_of_others
from src.errors import DataError
from src.reliability.command import run_command
from src.reliability.cpu import tune_cpu
from src.training.run_folder import make_writable, write_json


def main(overrides: list[str]) -> None:
    """Measure one suite, print its page, and keep it as JSON and Markdown in `out` when given."""
    config, tree = compose_config(overrides)
    refuse_options_of_others(config, "benchmark")
    of_one_frame = config.suite in (BenchmarkSuite.model, BenchmarkSuite.launches, BenchmarkSuite.gpu)
    if of_one_frame and not any(word.startswith("data.batch_size=") for word in overrides):
        config.data.batch_size = 1
    tune_cpu()
    if config.out:
        make_writable(Path(config.out), "out")
    if config.suite is BenchmarkSuite.latency:
        report_latency(config, overrides)
        return
    machine = describe_machine()
    warning = busy_warning(machine)
    if warning:
        print(warning)
    suite = importlib.import_module(f"src.benchmark.suite_{config.suite.value}")
    page = page_of(config.suite.value, overrides, machine, suite.measure(config, tree))
    if config.out:  # first: what took long is safe
        name = page_name(config)
        write_page(Path(config.out), name, page)
    print(markdown(page))
    if config.out:
        print(f"written: {Path(config.out) / name}.md and .json")
    if page["result"].get("agrees") is False:
        raise DataError("our metric and the official evaluator disagree on this problem; see the numbers above")


def report_latency(config: Config, overrides: list[str]) -> None:
    """Measure a checkpoint, write `latency.json` into `out`, and print the page."""
    content = measure_latency(config, overrides)
    if config.out:  # first: what took long is safe
        write_json(Path(config.out) / "latency.json", content)
    print(markdown(latency_page(content, overrides)))
    if config.out:
        print(f"written: {Path(config.out) / 'latency.json'}")


if __name__ == "__main__":
    run_command(main)
