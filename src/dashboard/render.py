"""Pages from the board: the Jinja templates, and what each of them is given; for the live and the exported dashboard.

Everything is escaped by the templates; no page names anything outside itself and the dashboard's own addresses.
"""

from __future__ import annotations

import base64
import functools
import hashlib
import logging
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from src.dashboard.board import Board, Run, Sweep
from src.dashboard.figures import headline, run_figures, sweep_figures
from src.dashboard.folders import Picture
from src.report.metric_names import METRICS, Metric
from src.report.score_tables import metrics_of
from src.report.sweep_table import format_score
from src.report.time_left import duration
from src.training.identity import leaves, train_command

TEMPLATES = Path(__file__).parent / "templates"
SUMMARY = tuple(METRICS[name] for name in ("mAP", "NDS", "mAVE"))
GROUPS = (("Summary", ""), ("What a memory is for", "measures."), ("By distance", "ranges."), ("By speed", "speeds."),
          ("By class", "classes."), ("Latency", "latency."))  # fmt: skip
DRAWN_BY_PAGES = ("curves", "scores")
"""Pictures of a run folder that pages draw themselves, from the numbers."""
Address = Callable[..., str]


@dataclass(frozen=True, kw_only=True)
class Page:
    """One page: a section with its id, its title and its content, which is HTML."""

    id: str
    title: str
    content: Markup


@dataclass(frozen=True, kw_only=True)
class MetricRow:
    """One number of a run beside another's, as shown; `raw` is in the table's unit."""

    metric: Metric
    raw: float
    value: str
    interval: str  # over scenes
    other: str
    difference: str


logger = logging.getLogger(__name__)
MACHINE_PATH = re.compile(r"""(?<![\w.])/(?:(?:home|Users)/[^\s/'"]+|root|tmp)((?:/[^\s/'"<>()\[\],:;]+)+)/?""")
"""An absolute path below a home or a temporary folder, and what of it does not name the machine's user."""


class Renderer:
    """Renders pages with the addresses of one kind of dashboard.

    `address(kind, name="")` gives the address of `overview` (name: an anchor on it), of a `sweep` or of a `run`;
    `source(picture)` where a picture is to be had, None where it is left out.
    """

    def __init__(self, address: Address, source: Callable[[Picture], str | None], live: bool) -> None:
        self.live = live
        self.environment = _environment()
        self.environment.globals.update(address=address, live=live, summary=SUMMARY)
        self.environment.filters["src"] = source
        self.environment.filters["local"] = (lambda text: text) if live else shortened_paths

    def document(self, board: Board, pages: list[Page], mark: str = "") -> str:
        """The whole HTML document around one page, or around all of them."""
        note = (
            "Live from this machine, read only."
            if self.live
            else "Exported from the results: complete in itself, opens without a network."
        )
        return self._without_broken(board, lambda shown: self._content(
            "page.html", board=shown, pages=pages, mark=mark, note=note, style=Markup(asset("style.css")),
            script=Markup(asset("script.js")), policy=content_policy(self.live),
        ))  # fmt: skip

    def overview(self, board: Board) -> Page:
        """All sweeps and all runs; one that cannot be shown is listed as broken."""
        content = self._without_broken(board, lambda shown: self._content("overview.html", board=shown))
        return Page(id="overview", title="Experiments", content=content)

    def sweep(self, board: Board, sweep: Sweep) -> Page:
        """One sweep: tables, figures, runs, failures; or why it cannot be shown."""
        title = ", ".join([sweep.record.sweep.title, sweep.record.scale, *sweep.record.changes])
        return self._page_or_error(f"sweep-{sweep.key}", title, lambda: self._sweep(board, sweep))

    def run(self, board: Board, run: Run, against: Run | None = None) -> Page:
        """One run, alone beside its baseline's numbers, or side by side with another one; or why it cannot be shown."""
        return self._page_or_error(f"run-{run.run_id}", run_name(run), lambda: self._run(board, run, against))

    def compare(self, board: Board) -> Page:
        """Where the exported file puts two runs side by side; or why it cannot be shown."""

        def draw() -> Markup:
            runs = sorted((run for run in board.runs.values() if run.result), key=run_name)
            return self._content("compare.html", runs=runs)

        return self._page_or_error("compare", "Two runs side by side", draw)

    def _page_or_error(self, page_id: str, title: str, draw: Callable[[], Markup]) -> Page:
        """The page, or one with the error message where a record or a result makes it fail: others are still shown."""
        try:
            content = draw()
        except Exception as error:
            logger.exception("page %s cannot be shown", page_id)
            content = self._content("broken.html", title=title, fault=fault(error))
        return Page(id=page_id, title=title, content=content)

    def _without_broken(self, board: Board, draw: Callable[[Board], Markup]) -> Markup:
        """Draw the whole board; the sweeps and runs that make this fail are left out and listed as broken."""
        try:
            return draw(board)
        except Exception:
            logger.exception("the board cannot be shown whole")
        broken, sweeps, runs = dict(board.broken), [], {}

        def is_sound(name: str, **alone: Any) -> bool:
            try:
                draw(replace(board, **({"sweeps": [], "runs": {}} | alone)))
            except Exception as error:
                broken[name] = fault(error)
                return False
            return True

        for sweep in board.sweeps:
            if is_sound(f"sweeps/{sweep.key}.json", sweeps=[sweep]):
                sweeps.append(sweep)
        for run_id, run in board.runs.items():
            if is_sound(run_id, runs={run_id: run}):
                runs[run_id] = run
        return draw(replace(board, sweeps=sweeps, runs=runs, broken=broken))

    def _sweep(self, board: Board, sweep: Sweep) -> Markup:
        record = sweep.record
        states = record.runs
        failed = [
            (run, board.folders.log_tail(run.log) if run.log else None)
            for run in states.values()
            if run.state == "failed"
        ]
        listed = [(label, board.runs[run_id], states[run_id]) for label, run_id in record.labelled]
        return self._content(
            "sweep.html", board=board, sweep=sweep, failed=failed, runs=listed, figures=sweep_figures(board, sweep)
        )

    def _run(self, board: Board, run: Run, against: Run | None) -> Markup:
        baseline = board.baseline_of(run)
        other, other_name = (against, run_name(against)) if against else baseline or (None, "")
        config = flat_config(run.result.config if run.result else board.folders.config(run.run_id))
        difference = None
        if config and other is not None and other.result:
            difference = config_difference(config, flat_config(other.result.config))
        both = other is not None and (against is not None or run.result is not None)
        shown = {"this run": run, other_name: other} if both else {"": run}
        pictures = shown_pictures(board, run)
        theirs = {picture.name: picture for picture in shown_pictures(board, against)} if against else {}
        pairs = [(one, theirs[one.name]) for one in pictures if one.name in theirs]
        log = board.folders.log_tail(f"{run.run_id}/log.txt")
        if log is None and run.planned and run.planned.log:
            log = board.folders.log_tail(run.planned.log)
        return self._content(
            "run.html", board=board, run=run, against=against, other=other, other_name=other_name, config=config,
            difference=difference, pictures=pictures, pairs=pairs, metrics=metric_rows(run, other), log=log,
            figures=run_figures(board, shown),
            choices=_other_runs(board, run) if self.live else [], command=command_of(run),
            progress=_progress(board, run),
            idle=max(0.0, board.now - (board.folders.written(run.run_id) or board.now)),
        )  # fmt: skip

    def _content(self, template: str, **values: Any) -> Markup:
        return Markup(self.environment.get_template(template).render(**values))


def fault(error: Exception) -> str:
    """What went wrong, in a line."""
    return f"{type(error).__name__}: {error}"


def shortened_paths(text: str) -> str:
    """Absolute paths below home and temporary folders by their last two parts at most."""
    return MACHINE_PATH.sub(lambda found: ".../" + "/".join(found[1].split("/")[1:][-2:]), text)


@functools.cache
def asset(name: str) -> str:
    """The style sheet or the script."""
    return (TEMPLATES / name).read_text()


def content_policy(live: bool) -> str:
    """What a page may load: its own style and script, and pictures of the dashboard itself."""

    def digest(name: str) -> str:
        return f"'sha256-{base64.b64encode(hashlib.sha256(asset(name).encode()).digest()).decode()}'"

    own, pictures = ("'self'", "data: 'self'") if live else ("'none'", "data:")
    policy = (
        f"default-src 'none'; style-src {digest('style.css')}; script-src {digest('script.js')}; "
        f"img-src {pictures}; connect-src {own}; form-action {own}; base-uri 'none'"
    )
    return policy + ("; frame-ancestors 'none'" if live else "")


def shown_pictures(board: Board, run: Run) -> list[Picture]:
    """A run's pictures, less those that pages draw themselves."""
    return [picture for picture in board.folders.pictures(run.run_id) if picture.kind not in DRAWN_BY_PAGES]


def run_name(run: Run) -> str:
    """What a run is called beside others: its row or settings, phase, seed."""
    seed = f", seed {run.seed}" if run.seed is not None else ""
    sweep = f"{run.rows[0][0].rpartition('_')[0]}: " if run.rows else ""
    title = run.title if len(run.title) <= 70 else run.title[:69] + "\N{HORIZONTAL ELLIPSIS}"
    return f"{sweep}{title}{seed} ({run.phase} {run.run_id[-8:]})"


def command_of(run: Run) -> str | None:
    """What trains this run."""
    overrides = run.result.overrides if run.result else run.planned.overrides if run.planned else None
    return train_command(overrides) if overrides is not None else None


def flat_config(tree: dict[str, Any]) -> list[tuple[str, str]]:
    """Dotted keys and values of a configuration, in its order."""
    words = {None: "null", True: "true", False: "false"}

    def written(value: Any) -> str:
        text = words[value] if value is None or isinstance(value, bool) else str(value)
        return text.replace("\n", " ")

    return [(key, written(value)) for key, value in leaves(tree).items()]


def config_difference(mine: list[tuple[str, str]], theirs: list[tuple[str, str]]) -> list[tuple[str, str, str]]:
    """Keys whose values differ; a dash where one side lacks the key."""
    left, right = dict(mine), dict(theirs)
    keys = dict.fromkeys([*left, *right])
    absent = "\N{EN DASH}"
    return [(key, left.get(key, absent), right.get(key, absent)) for key in keys if left.get(key) != right.get(key)]


def metric_rows(run: Run, other: Run | None) -> dict[str, list[MetricRow]]:
    """Every number of a run by group, in the table's units, beside the other run's."""
    groups: dict[str, list[MetricRow]] = {}
    if run.result is None:
        return groups
    theirs = other.result.metrics if other is not None and other.result is not None else {}
    for metric in metrics_of(run.result):
        value = run.result.metrics.get(metric.name)
        if value is None:
            continue
        group = next(title for title, prefix in reversed(GROUPS) if metric.name.startswith(prefix))
        against = theirs.get(metric.name)
        change = "" if against is None else signed((value - against) * metric.scale, metric.digits)
        bounds = run.result.intervals.get(metric.name)
        between = "" if bounds is None else " – ".join(number(bound, metric) for bound in bounds)
        groups.setdefault(group, []).append(
            MetricRow(metric=metric, raw=round(value * metric.scale, 6), value=number(value, metric), interval=between,
                      other=number(against, metric), difference=change)
        )  # fmt: skip
    return groups


def number(value: float | None, metric: Metric) -> str:
    """A metric's value in the table's unit; empty for None."""
    return "" if value is None else format_score(value * metric.scale, None, metric)


def signed(value: float, digits: int) -> str:
    """A number with its sign, a typographic minus where it is negative."""
    return f"{round(value, digits) + 0.0:+.{digits}f}".replace("-", "\N{MINUS SIGN}")


def _other_runs(board: Board, run: Run) -> list[Run]:
    """Runs that a run can be compared with, those of its own scale first."""
    others = [(other.scale != run.scale, run_name(other), other.run_id) for other in board.runs.values()]
    return [board.runs[run_id] for *_, run_id in sorted(others) if run_id != run.run_id]


def _progress(board: Board, run: Run) -> str:
    points = [curve[-1][0] for curve in board.folders.curves(run.run_id).values()] if run.result is None else []
    return f"{int(max(points)) + 1}" if points else ""


def _runs_of(board: Board, scale: str) -> list[Run]:
    """Runs of one scale: what trains first, then by row and seed, those outside sweeps last."""
    order = ("running", "failed", "stopped", "waiting", "pruned", "done")

    def place(run: Run) -> tuple:
        return order.index(run.state), not run.rows, run.rows[:1], run.phase, run.title, run.seed or 0, run.run_id

    return sorted((run for run in board.runs.values() if run.scale == scale), key=place)


def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(TEMPLATES), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters.update(
        clock=lambda seconds: time.strftime("%H:%M:%S", time.localtime(seconds)),
        date=lambda seconds: time.strftime("%Y-%m-%d %H:%M", time.localtime(seconds)),
        duration=duration,
        headline=headline,
        lines=lambda pairs: "\n".join(f"{key} = {value}" for key, value in pairs),
        name=run_name,
        number=number,
        other_rows=lambda run: "; ".join(f"{key}: {label}" for key, label in run.rows[1:]),
        runs_of=_runs_of,
        slug=lambda text: re.sub(r"[^a-z0-9]+", "-", text.lower()),
        value=lambda run, metric: run.result.metrics.get(metric.name) if run.result else None,
    )  # fmt: skip
    return environment
