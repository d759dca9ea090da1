"""What a file of sweeps/ may say: one question, its rows or its search space, the paper's numbers, and the tables.

The dataclasses are the schema that each file, and the record of its sweep, is checked against.
"""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass, field, replace
from typing import Any

from pydantic import with_config

from src.errors import ConfigError
from src.report.json_format import CLOSED, Count, Many
from src.report.metric_names import DETECTION, find_metric
from src.training.identity import OF_A_CALL, canonical, is_of, key_of

NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]*")
"""Names of sweeps and tables, which become file names, parts of addresses and names of studies."""

MAX_COLUMNS = 8
"""Most columns of a table, that of its heads included."""

NOT_OF_VALIDATION = ("cost.", "latency.")
"""How metrics begin that no search can have for an objective: metrics.json has none of them."""

OF_TRAINING = ("phase.epochs", "phase.init_from", "optim")
"""Keys that change nothing of weights that are there."""


@with_config(CLOSED)
@dataclass(kw_only=True)
class RowConfig:
    """One row of the question: a change of configuration, trained and scored."""

    label: str
    overrides: Many[str] = field(default_factory=list)  # as after `python -m src.train`
    scale_overrides: dict[str, Many[str]] = field(default_factory=dict)  # at a scale, by its name; they come last
    paper: dict[str, float] = field(default_factory=dict)  # the paper's numbers by metric, in the paper's units
    x: float | None = None  # place on the plot's horizontal axis
    baseline: str | None = None  # label of the row this one is compared with, where it is not the file's
    weights: str | None = None  # label of the row whose weights are scored with these overrides, untrained
    scales: Many[str] | None = None  # trained at these scales only, elsewhere the paper's numbers stand alone


@with_config(CLOSED)
@dataclass(kw_only=True)
class TableConfig:
    """One table over the rows: a choice of columns, and of rows where not all have something to say."""

    name: str  # file name under reports/tables, without scale
    title: str
    columns: Many[str]  # names of src/report/metric_names.py, or another task's own
    rows: Many[str] | None = None  # labels, the paper's own rows included; null: all


@with_config(CLOSED)
@dataclass(kw_only=True)
class PlotConfig:
    """One figure over the rows that have an `x`, or bars by label when they have none."""

    metric: str
    label: str  # of the horizontal axis


@with_config(CLOSED)
@dataclass(kw_only=True)
class PaperRowConfig:
    """A row that only the paper has: another method, printed beside ours and never trained."""

    label: str
    paper: dict[str, float]


@with_config(CLOSED)
@dataclass(kw_only=True)
class DimensionConfig:
    """What a search may try for one key: a range or a list of choices."""

    low: float | None = None
    high: float | None = None
    log: bool = False
    choices: Many[Any] | None = None

    def check(self, where: str) -> None:
        """Raises ConfigError for neither or both, and for an empty or reversed range."""
        ranged = self.low is not None and self.high is not None
        if ranged == (self.choices is not None):
            raise ConfigError(f"{where}: give either low and high or choices")
        if ranged and not self.low < self.high:
            raise ConfigError(f"{where}: low must be below high, but got {self.low} and {self.high}")
        if ranged and self.log and self.low <= 0:
            raise ConfigError(f"{where}: a logarithmic range starts above 0, but got {self.low}")
        if self.choices is not None and len(self.choices) < 2:
            raise ConfigError(f"{where}: choices must be at least two, but got {self.choices}")


@with_config(CLOSED)
@dataclass(kw_only=True)
class SweepConfig:
    """One question of the paper, or of ours."""

    title: str
    question: str  # what the rows tell, one sentence
    name: str = ""  # the file's; filled in when it is read
    source: str | None = None  # the paper's table(s), as in `Table 12`
    task: str = DETECTION  # of every row, as `phase.task`
    overrides: Many[str] = field(default_factory=list)  # of every row
    scale_overrides: dict[str, Many[str]] = field(default_factory=dict)  # of every row at a scale, by its name
    baseline: str | None = None  # label of the row that differences are taken to
    latency: bool = False  # measure the latency of every finished row, one after the other
    note: str | None = None  # stands under every table: what a reader of it must know
    tables: Many[TableConfig] = field(default_factory=list)
    plots: Many[PlotConfig] = field(default_factory=list)
    rows: Many[RowConfig] = field(default_factory=list)
    paper_rows: Many[PaperRowConfig] = field(default_factory=list)
    space: dict[str, DimensionConfig] = field(default_factory=dict)  # a search instead of rows
    objective: str | None = None  # of a search, larger is better; null: detection's is NDS
    trials: Count = 0  # of a search

    def __post_init__(self) -> None:
        where = f"sweeps/{self.name or '?'}.yaml"
        if bool(self.rows) == bool(self.space):
            raise ConfigError(f"{where}: give either rows or space, and at least one entry")
        if self.task == DETECTION:
            self.objective = self.objective or "NDS"
        elif self.rows and not self.tables:
            raise ConfigError(f"{where}: give tables with the columns of task {self.task}")
        elif self.space and self.objective is None:
            raise ConfigError(f"{where}: give the objective of task {self.task}")
        if self.note is not None and not self.note.strip():
            raise ConfigError(f"{where}: note is empty; leave it out, or say what a reader of the tables must know")
        self._check_names(where)
        self._check_overrides(where)
        self._check_references(where)
        self._check_metrics(where)
        self._check_tables(where)
        self._check_search(where)

    def _check_names(self, where: str) -> None:
        """Check the names of the sweep, its tables and its rows. Raises ConfigError."""
        tables = [table.name for table in self.tables]
        for name in (self.name, *tables):
            if not NAME.fullmatch(name):
                raise ConfigError(
                    f"{where}: the name {name!r} must be of letters, digits, _ and -, and begin with a letter or digit"
                )
        if len(set(tables)) < len(tables):
            raise ConfigError(f"{where}: two tables have one name ({', '.join(tables)})")
        labels = self._labels
        if not all(label.strip() for label in labels):
            raise ConfigError(f"{where}: a label is empty; each row needs its own")
        twice = sorted({label for label in labels if labels.count(label) > 1})
        if twice:
            raise ConfigError(f"{where}: label {', '.join(twice)} stands more than once; each row needs its own")

    def _check_overrides(self, where: str) -> None:
        given = [*self.space]
        for part in (self, *self.rows):
            given += itertools.chain(part.overrides, *part.scale_overrides.values())
        if any(key_of(override) == "seed" for override in given):
            raise ConfigError(f"{where}: seed=... is no part of a sweep; seed= and seeds= of its command say them")
        of_a_call = [override for override in given if is_of(override, OF_A_CALL)]
        if of_a_call:
            raise ConfigError(f"{where}: {', '.join(of_a_call)} is of a single call, no setting of a run; leave it out")
        for row in self.rows:
            trains = [change for change in row.overrides if is_of(change, OF_TRAINING) or key_of(change) == "model"]
            if row.weights is not None and trains:
                raise ConfigError(
                    f"{where}, row {row.label!r}: {', '.join(trains)} changes nothing of weights {row.weights!r}, "
                    "which are scored as they are; leave it out, or leave weights out to train the row"
                )

    def _check_references(self, where: str) -> None:
        """Check the rows that are named as baseline or weights of others. Raises ConfigError."""
        own = {row.label: row for row in self.rows}
        for baseline in (self.baseline, *(row.baseline for row in self.rows)):
            if baseline is not None and baseline not in own:
                raise ConfigError(f"{where}: baseline {baseline!r} is not the label of a row ({', '.join(own)})")
            if baseline is not None and own[baseline].scales is not None:
                raise ConfigError(f"{where}: baseline {baseline!r} must be for every scale; leave its scales out")
        trained = [row.label for row in self.rows if row.weights is None and row.scales is None]
        for row in self.rows:
            if row.weights is not None and row.weights not in trained:
                raise ConfigError(
                    f"{where}, row {row.label!r}: weights {row.weights!r} must be the label of a row that is trained "
                    f"at every scale ({', '.join(trained) or 'there is none'})"
                )

    def _check_metrics(self, where: str) -> None:
        for row in [*self.rows, *self.paper_rows]:
            for metric in row.paper:
                find_metric(metric, f"{where}, row {row.label!r}, paper", self.task)
        for table in self.tables:
            for column in table.columns:
                find_metric(column, f"{where}, table {table.name}, columns", self.task)
        for plot in self.plots:
            find_metric(plot.metric, f"{where}, plots", self.task)

    def _check_tables(self, where: str) -> None:
        for table in self.tables:
            unknown = [label for label in table.rows or () if label not in self._labels]
            if unknown:
                raise ConfigError(f"{where}, table {table.name}: there is no row {', '.join(unknown)}")
            for key, names in (("rows", table.rows or ()), ("columns", table.columns)):
                twice = sorted({name for name in names if list(names).count(name) > 1})
                if twice:
                    raise ConfigError(f"{where}, table {table.name}: {key} names {', '.join(twice)} more than once")
            if not table.columns:
                raise ConfigError(f"{where}, table {table.name}: columns is empty; name at least one metric")
            num_rows = len(table.rows or self._labels)
            if len(table.columns) >= MAX_COLUMNS and (num_rows >= MAX_COLUMNS or self.space):
                raise ConfigError(
                    f"{where}, table {table.name}: {len(table.columns)} metrics of {num_rows} rows fit no table of "
                    f"{MAX_COLUMNS} columns, heads included, either way round; name fewer columns or rows"
                )

    def _check_search(self, where: str) -> None:
        for key, dimension in self.space.items():
            dimension.check(f"{where}, space, {key}")
        if self.space:
            objective = find_metric(self.objective, f"{where}, objective", self.task)
            if self.objective.startswith(NOT_OF_VALIDATION):
                raise ConfigError(f"{where}, objective: {self.objective} is no score of a validation; name one, as mAP")
            if not objective.higher_is_better:
                raise ConfigError(
                    f"{where}, objective: less of {self.objective} is better, but a search takes the largest; name a "
                    "score, as mAP"
                )
            if self.trials < 1:
                raise ConfigError(f"{where}: trials must be at least 1, but got {self.trials}")

    @property
    def _labels(self) -> list[str]:
        return [row.label for row in [*self.rows, *self.paper_rows]]

    @property
    def is_search(self) -> bool:
        """Whether a sampler chooses what to train."""
        return bool(self.space)

    def baseline_of(self, label: str) -> str | None:
        """Label of the row that this one's differences are taken to."""
        return next((row.baseline for row in self.rows if row.label == label and row.baseline), self.baseline)

    def definition_of(self, label: str) -> tuple[object, ...] | None:
        """What a row's runs override, in one spelling, and that of the row whose weights they are; None for no row."""
        row = next((row for row in self.rows if row.label == label), None)
        if row is None:
            return None
        settings = {key_of(override): canonical(override) for override in [*self.overrides, *row.overrides]}
        return settings, row.weights and self.definition_of(row.weights)

    def at_scale(self, scale: str) -> SweepConfig:
        """The sweep with the overrides of one scale; a row that is not for it becomes one that only the paper has."""

        def own(part: Any) -> dict[str, Any]:
            return {"overrides": [*part.overrides, *part.scale_overrides.get(scale, [])], "scale_overrides": {}}

        rows = [row for row in self.rows if row.scales is None or scale in row.scales]
        others = [PaperRowConfig(label=row.label, paper=row.paper) for row in self.rows if row not in rows]
        rows = [replace(row, **own(row)) for row in rows]
        return replace(self, **own(self), rows=rows, paper_rows=others + self.paper_rows)
