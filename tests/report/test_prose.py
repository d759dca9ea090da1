"""The scores and intervals that README and docs state are those of the committed pages."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted((ROOT / "reports").glob("*.md")) + sorted((ROOT / "reports" / "tables").glob("*.md"))
PAGES += sorted((ROOT / "reports" / "performance").glob("*.md"))
# scores.md tells beside each of its tables the command that prints it, not all of which make a page.
PROSE = [ROOT / "README.md", *sorted(page for page in (ROOT / "docs").glob("*.md") if page.name != "scores.md")]
NUMBER = r"[+-]?\d+(?:\.\d+)?"
EFFECT = re.compile(rf"({NUMBER})(?: [a-z/^2%]+)? \[({NUMBER}), ({NUMBER})\]")

FIRST_SCREEN = {  # README's row: that of the pages
    "Horizon3D, phase 1": "phase 1",
    "phase 1 continued, no memory": "phase 1 continued, no memory",
    "phase 2": "Horizon3D",
    "phase 2, with a sparse neck that the paper does not have": "Horizon3D, neck (ours)",
    "RadarGNN (radar alone)": "RadarGNN",
    **{name: name for name in ("BEVFusion", "HyDRa", "CRT-Fusion", "SpaRC")},
}
SHOWN = [ROOT / "reports" / "phase2_mini.md"]
SHOWN += [
    ROOT / "reports" / "tables" / f"{name}_mini.md"
    for name in ("table1_summary", "comparison_moving", "table9_distance")
]
COLUMNS = (
    "mAP",
    "NDS",
    "mAVE",
    "AP of moving vehicles",
    *(f"mAP {r} m" for r in ("0-25", "25-50", "50-100", "100-150")),
)


def tables_of(page: Path) -> list[list[list[str]]]:
    """Cells of each table, without links and emphasis."""
    found, table = [], []
    for line in [*page.read_text().splitlines(), ""]:
        if line.startswith("|"):
            line = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", line.replace("**", ""))
            table.append([cell.strip().replace("\\", "") for cell in re.split(r"(?<!\\)\|", line.strip().strip("|"))])
        elif table:
            found.append([row for row in table if set("".join(row)) - set("-: ")])
            table = []
    return found


def scores_of(page: Path, label: str) -> dict[str, str]:
    """Metric, without its unit, to what a page has for a row: without the paper's number and the interval."""
    scores = {}
    for head, *rows in tables_of(page):
        across = head[0].startswith("metric")
        for row in zip(*[head, *rows], strict=True) if across else [head, *rows]:
            if re.sub(r" \(\d+( of \d+)? seeds?[^)]*\)", "", row[0]) == label:
                metrics = [other[0] for other in rows] if across else head[1:]
                for metric, cell in zip(metrics, row[1:], strict=True):
                    scores.setdefault(metric.split(",")[0], cell.split("|")[-1].split("[")[0].strip())
    return scores


def test_the_first_screen_has_the_scores_of_the_pages():
    (rows,) = [rows for head, *rows in tables_of(ROOT / "README.md") if head[0] == "method"]
    shown = {row[0]: row[2:] for row in rows}
    for label, row in FIRST_SCREEN.items():
        known = {metric: value for page in SHOWN for metric, value in scores_of(page, row).items()}
        assert shown[label] == [known[column] for column in COLUMNS], label


def test_the_first_screen_counts_the_claims_as_their_page_does():
    page = (ROOT / "reports" / "README.md").read_text()
    counts = re.search(r"Of \d+ claims: (.+?)\. ", page)[1]
    assert counts in (ROOT / "README.md").read_text()


def effects_of(text: str) -> set[tuple[str, ...]]:
    """Value, low and high of every `1.6 mAP [0.4, 2.7]`."""
    return {tuple(number.lstrip("+") for number in found) for found in EFFECT.findall(text.replace("\\", ""))}


def agrees(stated: tuple[str, ...], measured: tuple[str, ...]) -> bool:
    """Whether one is the other, rounded as it is stated, whichever way round the difference was taken."""
    (value, low, high), digits = map(float, measured), [len(number.partition(".")[2]) for number in stated]
    return any(
        all(abs(float(own) - other) <= 0.5 * 10**-d + 1e-9 for own, other, d in zip(stated, way, digits, strict=True))
        for way in ((value, low, high), (-value, -high, -low))
    )


def test_every_interval_in_prose_is_one_of_a_page():
    known = set().union(*(effects_of(page.read_text()) for page in PAGES))
    stated = {}
    for path in PROSE:
        text = re.sub(r"\]\([^)]*\)", "", path.read_text().replace(" [[", " [")).replace("\n", " ")
        stated[path.name] = effects_of(" ".join(text.split()))
    assert len(stated["README.md"]) > 8 and len(stated["findings.md"]) > 40, "the notation has changed"
    missing = [
        (name, *effect)
        for name, effects in stated.items()
        for effect in sorted(effects)
        if not any(agrees(effect, one) for one in known)
    ]
    assert not missing
