"""Escaping of labels and notes in markup, where what people write is shown and never interpreted; Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

MARKDOWN = str.maketrans(
    {"&": "&amp;", "<": "&lt;", ">": "&gt;", "\n": " ", "\r": " "} | {mark: f"\\{mark}" for mark in "\\|*`[]"}
)
LATEX = str.maketrans(
    {mark: f"\\{mark}" for mark in "%&$#_{}"}
    | {"\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}"}
    | {"<": "\\textless{}", ">": "\\textgreater{}", "|": "\\textbar{}", "[": "{[}", "]": "{]}"}
    | {"±": "$\\pm$", "–": "--", "−": "$-$", "×": "$\\times$", "→": "$\\to$", "≥": "$\\geq$", "≤": "$\\leq$"}
    | {"ε": "$\\varepsilon$", "τ": "$\\tau$", "\n": " ", "\r": " "}
)


def escape_markdown(text: str) -> str:
    """Escape a text for a cell of a Markdown table or a paragraph."""
    return text.translate(MARKDOWN)


def as_code(words: Iterable[str]) -> str:
    """Settings as code within a cell of a Markdown table."""
    return f"`{' '.join(words).replace('`', chr(39)).replace('|', chr(92) + '|')}`"


def markdown_table(head: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of cells that are Markdown already."""
    first, *others = (f"| {' | '.join(cells)} |" for cells in (head, *rows))
    return "\n".join([first, "|---" * len(head) + "|", *others])


def escape_latex(text: str) -> str:
    """Escape a text for LaTeX's text mode."""
    return text.translate(LATEX)
