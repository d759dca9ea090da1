"""The paper's claims (`claims.yaml`): which comparisons of sweeps' rows see each, and what finished runs say of it."""

from __future__ import annotations

import dataclasses
import functools
import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from pydantic import with_config

from src.errors import ConfigError
from src.report.comparisons import LOOKS, Comparison, compare_at_looks
from src.report.json_format import CLOSED, Many, parse_as
from src.report.metric_names import Metric, find_metric
from src.report.plain_yaml import load_plain_yaml
from src.report.results import RunResult
from src.report.sweep_file import SweepConfig
from src.report.sweep_record import SweepRecord
from src.report.table_builder import is_current

logger = logging.getLogger(__name__)

CLAIMS = Path(__file__).with_name("claims.yaml")


@with_config(CLOSED)
@dataclass(kw_only=True)
class ComparisonConfig:
    """Two rows of one sweep, the first of which is claimed to be better, or which tell why a claim is as it is."""

    sweep: str
    row: str
    over: str
    metrics: Many[str]  # that decide, each by itself
    beside: Many[str] = field(default_factory=list)  # that are shown
    half_width: float | None = None  # precise enough, in the metrics' unit; null: the file's, in percentage points
    asks: str | None = None  # a question that the two rows answer; none of their metrics decides the claim then

    @property
    def text(self) -> str:
        """Both rows in words."""
        return f"{self.row} over {self.over}"


@with_config(CLOSED)
@dataclass(kw_only=True)
class ClaimConfig:
    """One claim; it holds where all its comparisons do."""

    name: str
    sentence: str
    source: str  # of the paper
    because: str = ""  # what its questions have answered at the default scale, in words
    verdict: Verdict | None = None  # that these words are about
    comparisons: Many[ComparisonConfig]


@with_config(CLOSED)
@dataclass(kw_only=True)
class ClaimsFile:
    """All claims, in the order in which they are run and shown."""

    half_width: float
    claims: Many[ClaimConfig]


KEYS = [field.name for part in (ClaimsFile, ClaimConfig, ComparisonConfig) for field in dataclasses.fields(part)]


class Verdict(StrEnum):
    """What is known of a claim, or of one measure of it."""

    SHOWS = "shows"
    NOT = "does not show"  # decided the other way round, or precise with zero inside
    UNDECIDED = "undecided"
    NOT_RUN = "not run"


@dataclass(frozen=True)
class ClaimMeasure:
    """One number by which two rows are compared."""

    comparison: ComparisonConfig
    sweep: SweepConfig  # as its file says it
    metric: Metric
    half_width: float  # in the metric's unit; 0 of what asks: no interval is precise enough for a question
    paper: float | None  # difference of the paper's numbers; None where it has none
    decides: bool


@dataclass(frozen=True)
class Claim:
    """A claim with its measures, checked against the sweeps that it names."""

    config: ClaimConfig
    measures: list[ClaimMeasure]


@dataclass(frozen=True)
class Finding:
    """What finished runs say of one measure."""

    measure: ClaimMeasure
    found: Comparison | None  # at the look it stands at
    common_seeds: int  # that both rows have; those of `found` are the pairs that count
    runs: list[tuple[RunResult, RunResult]]  # behind it, of the first row and of the second, by seed
    lacking: list[str] = field(default_factory=list)  # finished runs, by id, whose results have no such number

    @property
    def verdict(self) -> Verdict:
        """What the runs decide; nothing with fewer pairs than at the first look, `NOT_RUN` without any."""
        if self.found is None:
            return Verdict.NOT_RUN
        if self.found.favours(self.measure.metric):
            return Verdict.SHOWS
        return Verdict.NOT if self.found.settled(self.measure.half_width) else Verdict.UNDECIDED

    @property
    def is_open(self) -> bool:
        """Whether further seeds may decide it."""
        return (
            self.measure.decides
            and self.common_seeds < max(LOOKS)
            and not (self.found is not None and self.found.settled(self.measure.half_width))
        )


def load_claims(load_sweep: Callable[[str], SweepConfig], path: Path = CLAIMS) -> list[Claim]:
    """The claims of a file. Raises ConfigError naming file, claim and what is wrong with it.

    `load_sweep` reads a file of sweeps/ by its name, and raises ConfigError for one that is not there.
    """
    where = path.name
    try:
        content = load_plain_yaml(path.read_text(encoding="utf-8"))
        file = parse_as(ClaimsFile, json.dumps(content), known=KEYS)
    except (OSError, ValueError, TypeError) as error:
        raise ConfigError(f"{where}: {error}") from error
    names = [claim.name for claim in file.claims]
    if not names:
        raise ConfigError(f"{where}: claims is empty; name at least one")
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{where}: claim {name} stands more than once; each needs a name of its own")
    claims, load_sweep = [], functools.cache(load_sweep)
    for config in file.claims:
        claims.append(Claim(config, []))
        if not config.comparisons:
            raise ConfigError(f"{where}, claim {config.name}: comparisons is empty; name two rows of a sweep")
        for comparison in config.comparisons:
            here = f"{where}, claim {config.name}, {comparison.text}"
            try:
                sweep = load_sweep(comparison.sweep)
            except ConfigError as error:
                raise ConfigError(f"{here}: {error}") from error
            claims[-1].measures.extend(_measures(comparison, sweep, file.half_width, here))
        if bool(config.because) != (config.verdict is not None):
            raise ConfigError(f"{where}, claim {config.name}: because and the verdict that it is of go together")
        if not any(measure.decides for measure in claims[-1].measures):
            raise ConfigError(f"{where}, claim {config.name}: all of comparisons ask why; name one that decides")
    return claims


def _measures(comparison: ComparisonConfig, sweep: SweepConfig, half_width: float, where: str) -> list[ClaimMeasure]:
    rows = {row.label: row for row in sweep.rows}
    for label in (comparison.row, comparison.over):
        if label not in rows:
            raise ConfigError(f"{where}: {label!r} is not a row of sweeps/{sweep.name}.yaml ({', '.join(rows)})")
        if rows[label].scales is not None:
            raise ConfigError(f"{where}: row {label!r} of sweeps/{sweep.name}.yaml must be for every scale")
    if comparison.row == comparison.over:
        raise ConfigError(f"{where}: a row is compared with itself; name two rows of sweeps/{sweep.name}.yaml")
    if not comparison.metrics:
        raise ConfigError(f"{where}: metrics is empty; name at least one")
    asks = comparison.asks is not None
    if asks and not comparison.asks.strip():
        raise ConfigError(f"{where}: asks is empty; say what the rows answer, or leave it out where they decide")
    if asks and (comparison.beside or comparison.half_width is not None):
        raise ConfigError(f"{where}: beside and half_width are of what decides; what asks has metrics alone")
    measures = []
    for name in [*comparison.metrics, *comparison.beside]:
        metric = find_metric(name, where, sweep.task)
        width = half_width if comparison.half_width is None else comparison.half_width
        if not asks and comparison.half_width is None and metric.unit != "%":
            raise ConfigError(f"{where}: {name} is in {metric.unit}; give the half_width that is precise enough in it")
        if not asks and width <= 0:
            raise ConfigError(f"{where}: half_width must be above 0, but is {width}")
        ours, others = (rows[label].paper.get(name) for label in (comparison.row, comparison.over))
        paper = None if ours is None or others is None else round(ours - others, 6)
        if not asks and paper is not None and (paper > 0) != metric.higher_is_better:
            raise ConfigError(
                f"{where}: the paper's {name} is {ours:g} against {others:g}, so it does not claim that; exchange the "
                "rows"
            )
        decides = not asks and name in comparison.metrics
        measures.append(ClaimMeasure(comparison, sweep, metric, 0.0 if asks else width, paper, decides))
    return measures


def judge(claim: Claim, records: Mapping[str, SweepRecord], results: Mapping[str, RunResult]) -> list[Finding]:
    """What the finished runs of the sweeps' records (by the sweep's name) say of a claim, measure by measure."""
    findings = []
    runs_of = functools.cache(lambda name, label: _runs(records.get(name), sweeps[name], label, results))
    sweeps = {measure.comparison.sweep: measure.sweep for measure in claim.measures}
    for measure in claim.measures:
        compared = measure.comparison
        first, second = (runs_of(compared.sweep, label) for label in (compared.row, compared.over))
        values = [
            {
                seed: measure.metric.scale * run.metrics[measure.metric.name]
                for seed, run in runs.items()
                if run.metrics.get(measure.metric.name) is not None
            }
            for runs in (first, second)
        ]
        found = compare_at_looks(*values, measure.half_width, measure.metric.digits)
        common = sorted(values[0].keys() & values[1].keys())
        used = [(first[seed], second[seed]) for seed in common[: found.pairs if found else 0]]
        lacking = [
            runs[seed].run_id
            for runs, known in zip((first, second), values, strict=True)
            for seed in runs
            if seed not in known
        ]
        findings.append(Finding(measure, found, len(common), used, lacking))
    return findings


def verdict_of(findings: list[Finding]) -> Verdict:
    """Verdict on a claim: `NOT` if one measure that decides says so, else the one they agree on, else `UNDECIDED`."""
    verdicts = [finding.verdict for finding in findings if finding.measure.decides]
    if Verdict.NOT in verdicts:
        return Verdict.NOT
    if len(set(verdicts)) == 1:
        return verdicts[0]
    return Verdict.UNDECIDED


def _runs(
    record: SweepRecord | None, sweep: SweepConfig, label: str, results: Mapping[str, RunResult]
) -> dict[int, RunResult]:
    """Finished runs of a row, by seed. Warns of a record of another version of its sweep, whose row is none or another:
    it has no run of this one."""
    if record is None:
        return {}
    if record.sweep.definition_of(label) != sweep.at_scale(record.scale).definition_of(label):
        logger.warning(
            "the record of sweep %s, scale %s, has no row %r as sweeps/ defines it, which claims.yaml names; its runs "
            "count once `python -m src.study scale=%s workers=0 published=true` has recorded it again",
            *(record.name, record.scale, label, record.scale),
        )
        return {}
    runs = record.rows.get(label, {})
    return {seed: results[run_id] for seed, run_id in runs.items() if is_current(record, run_id, results)}
