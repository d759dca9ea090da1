"""A benchmark's page: the same content as JSON and as Markdown."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from src.benchmark.machine import busy_warning
from src.config import BenchmarkSuite, Config
from src.files.atomic_write import write_whole
from src.report.escaping import markdown_table
from src.training.run_folder import current_commit, write_json

ONE_MODEL = (
    BenchmarkSuite.model,
    BenchmarkSuite.training,
    BenchmarkSuite.soak,
    BenchmarkSuite.launches,
    BenchmarkSuite.gpu,
)
GPU_NOTE = "Measured without a GPU. On one: the command above with `trainer.accelerator=gpu precision=bf16-mixed`."


def gpu_notes(device: torch.device) -> list[str]:
    """For a suite that also measures on GPUs: the note how to, if this device is none; else no note."""
    return [] if device.type == "cuda" else [GPU_NOTE]


def page_of(suite: str, overrides: list[str], machine: dict[str, Any], result: dict[str, Any]) -> dict[str, Any]:
    """The content of a page, as it stands in the JSON file."""
    return {"suite": suite, "overrides": overrides, "commit": current_commit(), "machine": machine, "result": result}


def page_name(config: Config) -> str:
    """Name of a suite's files: with model and phase where one is measured, with the scale, and with `gpu` on one."""
    if config.suite is BenchmarkSuite.metric:
        return config.suite.value
    of_one_model = config.suite in ONE_MODEL
    of_one_model |= config.suite is BenchmarkSuite.scaling and "lidar" in config.model.sensors
    which = [config.model.name, config.phase.name] if of_one_model else []
    device = ["gpu"] if config.suite is not BenchmarkSuite.reader and config.trainer.device().type == "cuda" else []
    return "_".join([config.suite.value, *which, config.scale, *device])


def write_page(folder: Path, name: str, page: dict[str, Any]) -> None:
    """`name.json` and `name.md` in the folder."""
    write_json(folder / f"{name}.json", page)
    write_whole(folder / f"{name}.md", markdown(page) + "\n")


def markdown(page: dict[str, Any]) -> str:
    """The page as Markdown.

    Of the result, `notes` [str] become paragraphs, a list of rows (dicts) a table under its name, with the columns in
    the order in which rows first name them, `picture` an image, and everything else a list of numbers.
    """
    command = " ".join(["python -m src.benchmark", *page["overrides"]])
    lines = [f"# Benchmark: {page['suite']}", "", f"`{command}`", ""]
    lines += [f"- {name}: {value}" for name, value in page["machine"].items() if value is not None]
    warning = busy_warning(page["machine"])
    lines += ["", f"**{warning}**"] if warning else []
    content = dict(page["result"])
    for note in content.pop("notes", []):
        lines += ["", note]
    picture = content.pop("picture", None)
    if picture:
        lines += ["", f"![{page['suite']}]({picture})"]
    plain = []
    for name, value in content.items():
        if isinstance(value, list):
            lines += ["", f"## {name}", "", table(value)]
        elif value is not None:
            plain.append((name, value))
    lines += [""] if plain else []
    for name, value in plain:
        shown = value if isinstance(value, dict) else {name: value}
        prefix = f"{name}: " if isinstance(value, dict) else ""
        lines.append(f"- {prefix}{', '.join(f'{key} {number(item)}' for key, item in shown.items())}")
    return "\n".join(lines)


def table(rows: list[dict[str, Any]]) -> str:
    """Rows as a Markdown table; what a row lacks is left blank."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    cells = (["" if row.get(name) is None else number(row[name]) for name in columns] for row in rows)
    return markdown_table(columns, cells)


def number(value: Any) -> str:
    """Three digits for a float, thousands apart for an integer."""
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
