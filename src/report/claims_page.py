"""The pages of the claims: what was run, which hold here and why, each with the command that says so."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping

from src.report.claims import Claim, Finding, Verdict, verdict_of
from src.report.comparisons import LOOKS
from src.report.escaping import as_code, escape_markdown, markdown_table
from src.report.results import RunResult
from src.report.sweep_record import SweepRecord
from src.report.sweep_table import MISSING, format_paper
from src.report.sweep_text import SYNTHETIC, describe_epochs, describe_machines, describe_starts, sweep_settings

logger = logging.getLogger(__name__)

HEADS = ("claim", "measure", "paper", "here", "seeds", "verdict", "command")
REASON_HEADS = ("claim", "question", "rows", "here", "command")

_FEW, _MOST = ", ".join(map(str, sorted(LOOKS)[:-1])), max(LOOKS)
RULE = f"""Rows are compared by runs of the same seed: the mean difference, tested with {_FEW} and {_MOST}
pairs and no other number, each time with an interval of 1 - 0.05/{len(LOOKS)}, so that stopping at the first
look that decides keeps the error at 5 %. *Shows*: the interval is beyond zero on the claimed side; *does not show*: it
is beyond zero on the other side, or contains zero and is as narrow as [claims.yaml](../src/report/claims.yaml) asks;
else *undecided*: with fewer than {_MOST} pairs more of them may decide it. A claim shows where all its measures do.
What is in italics decides nothing. More of it: [docs/scores.md](../docs/scores.md#when-a-claim-holds)."""


WHY = f"""Further measures of the rows that the claims compare, and further rows, that tell what lies behind a claim;
its number stands before each. They were chosen after results were seen and decide nothing: each interval is of
1 - 0.05/{len(LOOKS)} by itself."""


def claims_page(
    findings: list[tuple[Claim, list[Finding]]],
    records: Mapping[str, SweepRecord],
    scale: str,
    picture: str,
    why: str | None,
    in_words: bool,
) -> str:
    """The page; `records` are of the claims' sweeps by name.

    `picture` and `why`, the page of what lies behind the claims if there is one, are addresses seen from it; `in_words`
    where the file of claims says what has been found at this scale.
    """
    verdicts = [verdict_of(found) for _, found in findings]
    counts = ", ".join(f"{v} {verdicts.count(v)}" for v in Verdict if v in verdicts)
    parts = [
        f"# The paper's claims, scale {scale}",
        f"Of {len(findings)} claims: {counts}. Written by `python -m src.report scale={scale}` from the results of the "
        f"sweeps; `python -m src.study scale={scale} published=true` trains what is missing.",
        f"![Each claim's effect with its interval, and the paper's effect]({picture})",
        f"## What was run\n\n{_what_was_run(findings, records, scale)}",
        f"## The claims\n\n{RULE}\n\n{_table(findings, scale)}",
    ]
    words = []
    for number, (claim, found) in enumerate(findings, start=1):
        if not in_words or not claim.config.because or not is_answered(found):
            continue
        if claim.config.verdict is verdict_of(found):
            words.append(f"* **{number}** {escape_markdown(claim.config.because)}")
        else:
            logger.warning(
                "claims.yaml, claim %s: because speaks of the verdict %r, but the results say %r; it is left out until "
                "both are written anew",
                *(claim.config.name, str(claim.config.verdict), str(verdict_of(found))),
            )
    if why is not None:
        parts += [f"## Why\n\nWhat lies behind the claims: [the numbers]({why})."]
        parts += ["\n".join(words)] if words else []
    return "\n\n".join(parts) + "\n"


def is_answered(found: Iterable[Finding]) -> bool:
    """Whether anything is known of what asks why a claim holds or does not."""
    return any(one.measure.comparison.asks is not None and one.found is not None for one in found)


def why_page(findings: list[tuple[Claim, list[Finding]]], scale: str, claims: str) -> str:
    """What lies behind the claims, whose page is at `claims`; empty where nothing of it has been run."""
    reasons = _reasons(findings, scale)
    if not reasons:
        return ""
    title = f"# Behind the paper's claims, scale {scale}"
    return f"{title}\n\n[The claims]({claims}). {WHY}\n\n{reasons}\n"


def command_of(sweep: str, findings: Iterable[Finding], scale: str) -> str:
    """What trains the rows of a sweep with all seeds that findings on it stand on, at least those of the first look."""
    used = (run for one in findings if one.measure.comparison.sweep == sweep for pair in one.runs for run in pair)
    seeds = max([min(LOOKS), *(run.seed + 1 for run in used)])
    return f"python -m src.sweep +sweep={sweep} scale={scale} seeds={seeds}"


def _what_was_run(findings: list[tuple[Claim, list[Finding]]], records: Mapping[str, SweepRecord], scale: str) -> str:
    worlds: dict[str, set[str]] = {}
    runs: dict[str, RunResult] = {}
    pairs: list[tuple[RunResult, RunResult]] = []
    for _, found in findings:
        for finding in _of_claims(found):
            pairs += finding.runs
            for result in (run for pair in finding.runs for run in pair):
                data = f"{result.dataset}, split {result.data.get('split', 'unknown')}"
                worlds.setdefault(data, set()).add(finding.measure.comparison.sweep)
                runs[result.run_id] = result
    if len(worlds) > 1:
        data = "; ".join(f"{world} ({', '.join(sorted(sweeps))})" for world, sweeps in worlds.items())
    else:
        data = next(iter(worlds), "none yet")
    seeds = len({run.seed for run in runs.values()})
    parts = [f"Data: {data}", f"scale {scale}", f"{len(runs)} runs of up to {seeds} seeds"]
    parts += [*describe_epochs(runs.values()), *describe_machines(runs.values())]
    text = f"{'; '.join(parts)}."
    if any(run.data["name"] == SYNTHETIC for run in runs.values()):
        text += " Data and scale are not the paper's: compare signs and order, not sizes."
    if starts := describe_starts(pairs):
        text += f" {starts}"
    own: dict[str, list[str]] = {}
    for sweep in sorted({sweep for sweeps in worlds.values() for sweep in sweeps}):
        own.setdefault(" ".join(sweep_settings(records[sweep])), []).append(f"`{sweep}`")
    own.pop("", None)
    text = escape_markdown(text)
    if own:
        text += "\n\nSweeps with settings of their own, the same in all their rows:\n"
        text += "".join(f"\n- {', '.join(sweeps)}: {as_code([settings])}" for settings, sweeps in own.items())
    return text


def _table(findings: list[tuple[Claim, list[Finding]]], scale: str) -> str:
    lines = []
    for number, (claim, found) in enumerate(findings, start=1):
        title = f"**{number}. {escape_markdown(claim.config.sentence)}** ({escape_markdown(claim.config.source)})"
        lines.append([title, "", "", "", "", f"**{verdict_of(found)}**", ""])
        before = ""
        for finding in _of_claims(found):
            measure, metric = finding.measure, finding.measure.metric
            text, command = measure.comparison.text, command_of(measure.comparison.sweep, _of_claims(found), scale)
            first, before = text != before, text
            lines.append(
                [
                    escape_markdown(text) if first else "",
                    metric.heading if measure.decides else f"*{metric.heading}*",
                    format_paper(measure.paper, metric, signed=True),
                    MISSING if finding.found is None else finding.found.numbers,
                    MISSING if finding.found is None else str(finding.found.pairs),
                    str(finding.verdict) if measure.decides else "",
                    as_code([command]) if first else "",
                ]
            )
    return markdown_table(HEADS, lines)


def _of_claims(found: list[Finding]) -> list[Finding]:
    """Findings on what is claimed or shown beside it, without those of comparisons that ask why."""
    return [one for one in found if one.measure.comparison.asks is None]


def _reasons(findings: list[tuple[Claim, list[Finding]]], scale: str) -> str:
    """The comparisons that ask why, of claims for which one has been answered; empty where none is."""
    lines = []
    for number, (claim, found) in enumerate(findings, start=1):
        if not is_answered(found):
            continue
        for comparison in (one for one in claim.config.comparisons if one.asks is not None):
            answers = [one for one in found if one.measure.comparison is comparison and one.found is not None]
            told = "; ".join(map(_answer, answers)) or str(Verdict.NOT_RUN)
            command = as_code([command_of(comparison.sweep, answers, scale)])
            lines.append(
                [str(number), escape_markdown(comparison.asks), escape_markdown(comparison.text), told, command]
            )
    return markdown_table(REASON_HEADS, lines) if lines else ""


def _answer(finding: Finding) -> str:
    """One measure of a question: what less of is better is marked, and what the paper has for it is told."""
    metric, paper = finding.measure.metric, finding.measure.paper
    less = "" if metric.higher_is_better else ", less is better"
    told = "" if paper is None else f" (paper {format_paper(paper, metric, signed=True)})"
    return f"{metric.heading}{less}: {finding.found.text}{told}, {finding.found.pairs} seeds"
