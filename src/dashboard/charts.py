"""Figures as inline SVG: lines with intervals, points, bars and dots by category.

Text and axes take the page's colour, so figures follow light and dark; colours stand in the style sheet (classes s0 to
s7). Series differ by marker and dash as well as by colour, and every point says its number when pointed at.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from markupsafe import Markup, escape

WIDTH, HEIGHT = 420, 230  # of a figure's plot, in its own units: about pixels on a phone
GLYPH = 6.5  # average width of a letter
COLOURS = 8
DASHES = ("", "6 3", "2 3")
MARKERS = (
    "M-3.4 0a3.4 3.4 0 1 0 6.8 0a3.4 3.4 0 1 0-6.8 0Z",
    "M-3-3H3V3H-3Z",
    "M0-4L3.8 3H-3.8Z",
    "M0-4.3L4.3 0L0 4.3L-4.3 0Z",
    "M0 4L3.8-3H-3.8Z",
    "M-1.2-4H1.2V-1.2H4V1.2H1.2V4H-1.2V1.2H-4V-1.2H-1.2Z",
)
Scale = Callable[[float], float]  # from a number to its place on the figure


class ChartPoint(NamedTuple):
    """A point of a line."""

    x: float
    y: float
    bounds: tuple[float, float] | None = None  # of its interval
    note: str = ""  # what it says; empty: label and number


@dataclass(frozen=True, kw_only=True)
class Series:
    """One line; a label of no letters has no entry in the legend: the figure's title says what is shown."""

    label: str
    points: Sequence[ChartPoint]
    style: int = 0  # colour, marker and dash; equal for lines that belong together, which share a legend entry
    joined: bool = True  # by a line


@dataclass(frozen=True, kw_only=True)
class Bars:
    """A value with the bounds of its interval for every category; None where there is none."""

    label: str
    values: Sequence[tuple[float, float, float] | None]
    style: int = 0


def nice_ticks(low: float, high: float, count: int = 5) -> list[float]:
    """Multiples of 1, 2 or 5 times a power of ten that lie within [low, high], about `count` of them."""
    if not high > low:
        return [low]
    rough = (high - low) / count
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(power * factor for factor in (1, 2, 5, 10) if power * factor >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [round(number * step, 12) for number in range(first, last + 1)]


def tick_text(value: float) -> str:
    """A number on an axis: no needless zeros, thousands as k, a true minus."""
    size = abs(value)
    if size >= 1e6:
        text = f"{value / 1e6:g}M"
    elif size >= 1e4:
        text = f"{value / 1e3:g}k"
    else:
        text = f"{value:g}"
    return text.replace("-", "\N{MINUS SIGN}", 1) if value < 0 else text


def line_chart(
    title: str,
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    *,
    x_ticks: Sequence[tuple[float, str]] | None = None,
    y_span: float | None = None,
    log_x: bool = False,
    markers: bool = True,
) -> Markup:
    """Lines, or points alone where they are not joined, over a number.

    `x_ticks` are all on the axis. Series without a finite point are left out; a figure without any says so. `log_x`
    leaves out what is not positive; `y_span` asks for a vertical axis at least as long, for figures side by side.
    """
    drawn = [kept for one in series if (kept := _finite(one, log_x)).points]
    if not drawn:
        return _nothing(title)
    points = [point for one in drawn for point in one.points]
    xs = [point.x for point in points] + [x for x, _ in x_ticks or ()]
    xs = [math.log10(x) for x in xs] if log_x else xs
    ends = [end for point in points for end in (point.y, *(point.bounds or ()))]
    y_low, y_high = _padded(min(ends), max(ends), 0.08, y_span)
    x_low, x_high = _padded(min(xs), max(xs), 0.06 if markers else 0.0)
    y_marks = nice_ticks(y_low, y_high)
    left = 22 + max(len(tick_text(mark)) for mark in y_marks) * GLYPH
    right, top, bottom = WIDTH - 12, 10, HEIGHT - 40

    def x_of(x: float) -> float:
        return left + ((math.log10(x) if log_x else x) - x_low) / (x_high - x_low) * (right - left)

    def y_of(y: float) -> float:
        return bottom - (y - y_low) / (y_high - y_low) * (bottom - top)

    parts = _y_axis(y_marks, y_of, left, right, y_label, (top + bottom) / 2)
    marks = list(x_ticks or _x_marks(x_low, x_high, log_x))
    parts += _x_axis([(x_of(x), text) for x, text in marks], left, right, bottom, x_label)
    for one in drawn:
        parts.append(_line(one, x_of, y_of, markers))
    joined = any(one.joined for one in drawn)
    legend, height = _legend([(one.label, one.style) for one in drawn], HEIGHT, joined, markers)
    described = f"{y_label} over {x_label}. " + "; ".join(_described(one) for one in drawn[:8])
    return _figure(title, described, parts + legend, height)


def category_chart(
    title: str,
    categories: Sequence[str],
    series: Sequence[Bars],
    unit: str,
    digits: int = 1,
    dots: bool = False,
) -> Markup:
    """Horizontal bars from zero with their numbers, or (`dots`) one marker per series on a line for each category."""
    ends = [max(found) for one in series for found in one.values if found is not None]
    if not ends or not categories:
        return _nothing(title)
    top_value = max(ends) if max(ends) > 0 else 1.0
    room = max(7, min(22, max(len(name) for name in categories)))
    left, right = 14 + room * 1.08 * GLYPH, WIDTH - (14 if dots else 44)
    step, pad = (17.0, 2.0) if dots else (13.0, 6.0)
    tall = step if dots else step * len(series) + pad

    def x_of(value: float) -> float:
        return left + max(0.0, value) / top_value * (right - left)

    bottom = 8 + tall * len(categories)
    marks = [(x_of(mark), tick_text(mark)) for mark in nice_ticks(0, top_value, 5)]
    parts = [f'<line class="grid" x1="{x:.1f}" x2="{x:.1f}" y1="6" y2="{bottom:.1f}"/>' for x, _ in marks]
    parts += _x_axis(marks, left, right, bottom, unit)
    for place, name in enumerate(categories):
        y = 8 + tall * place
        shown = name if len(name) <= room else name[: room - 1] + "\N{HORIZONTAL ELLIPSIS}"
        parts.append(
            f'<text class="end" x="{left - 6:.1f}" y="{y + (tall - pad) / 2 + 4:.1f}">'
            f"{escape(shown)}<title>{escape(name)}</title></text>"
        )
        for number, one in enumerate(series):
            value, low, high = one.values[place] or (0.0, 0.0, 0.0)
            text = "\N{EN DASH}" if one.values[place] is None else f"{value:.{digits}f}"
            said = text + (f" [{low:.{digits}f}, {high:.{digits}f}]" if high > low else "")
            said = "no value" if one.values[place] is None else said
            note = f"{name}{', ' if one.label else ''}{one.label}: {said}"
            if dots:
                if one.values[place] is not None:
                    aside = (number - (len(series) - 1) / 2) * min(2.5, 10 / len(series))  # equal values stay apart
                    parts.append(_marker(one.style, x_of(value), y + 8 + aside, note))
                continue
            parts.append(_bar(one.style, left, y + step * number, step - 2, x_of(value), note))
            if high > low:
                parts.append(_whisker(x_of(low), x_of(high), y + step * number + 5.5))
            after = x_of(max(value, high)) + 5
            parts.append(f'<text class="number" x="{after:.1f}" y="{y + step * number + 9.5:.1f}">{text}</text>')
    entries = [(one.label, one.style) for one in series]
    legend, height = _legend(entries, bottom + 38, False, dots, bars=not dots)
    described = f"{unit} by category. " + "; ".join(one.label for one in series)
    return _figure(title, described, parts + legend, height)


def _finite(one: Series, log_x: bool) -> Series:
    points = [point for point in one.points if math.isfinite(point.x) and math.isfinite(point.y)]
    return replace(one, points=[point for point in points if point.x > 0 or not log_x])


def _padded(low: float, high: float, share: float, span: float | None = None) -> tuple[float, float]:
    """An axis a little longer than its values, at least `span` long, never of no length."""
    if high - low < 1e-9 * max(abs(low), abs(high), 1e-9):
        half = max(abs(high), 1.0) * 0.05
        low, high = low - half, high + half
    if span is not None and high - low < span:
        middle = (low + high) / 2
        low, high = middle - span / 2, middle + span / 2
    margin = (high - low) * share
    return low - margin, high + margin


def _x_marks(low: float, high: float, log_x: bool) -> list[tuple[float, str]]:
    if not log_x:
        return [(mark, tick_text(mark)) for mark in nice_ticks(low, high, 6)]
    powers = range(math.floor(low), math.ceil(high) + 1)
    factors = (1,) if high - low > 2 else (1, 2, 5)
    marks = [factor * 10.0**power for power in powers for factor in factors]
    marks = [mark for mark in marks if low - 1e-9 <= math.log10(mark) <= high + 1e-9]
    if len(marks) < 2:  # a short piece of a logarithmic axis
        marks = [mark for mark in nice_ticks(10**low, 10**high, 6) if mark > 0]
    return [(mark, tick_text(mark)) for mark in marks]


def _x_axis(marks: Sequence[tuple[float, str]], left: float, right: float, bottom: float, label: str) -> list[str]:
    """The axis, its ticks, their texts as far as they do not touch, and what it shows."""
    parts = [f'<line class="axis" x1="{left:.1f}" x2="{right:.1f}" y1="{bottom:.1f}" y2="{bottom:.1f}"/>']
    taken = -math.inf
    for x, text in sorted(marks):
        parts.append(f'<line class="axis" x1="{x:.1f}" x2="{x:.1f}" y1="{bottom:.1f}" y2="{bottom + 4:.1f}"/>')
        half = len(text) * GLYPH / 2
        centre = min(x, WIDTH - half - 1)
        if centre - half >= taken + 5:
            parts.append(f'<text class="middle" x="{centre:.1f}" y="{bottom + 16:.1f}">{escape(text)}</text>')
            taken = centre + half
    parts.append(
        f'<text class="middle muted" x="{(left + right) / 2:.1f}" y="{bottom + 32:.1f}">{escape(label)}</text>'
    )
    return parts


def _y_axis(
    marks: Sequence[float], y_of: Scale, left: float, right: float, label: str, middle: float
) -> list[str]:  # fmt: skip
    parts = []
    for mark in marks:
        y = y_of(mark)
        parts.append(f'<line class="grid" x1="{left:.1f}" x2="{right:.1f}" y1="{y:.1f}" y2="{y:.1f}"/>')
        parts.append(f'<text class="end" x="{left - 5:.1f}" y="{y + 3.8:.1f}">{tick_text(mark)}</text>')
    parts.append(
        f'<text class="middle muted" transform="translate(10 {middle:.1f}) rotate(-90)">{escape(label)}</text>'
    )
    return parts


def _line(one: Series, x_of: Scale, y_of: Scale, markers: bool) -> str:
    places = [(x_of(point.x), y_of(point.y)) for point in one.points]
    parts = []
    if one.joined and len(places) > 1:
        path = "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        parts.append(f'<path class="line" d="M{path}"{_dashed(one.style)}/>')
    for (x, _), point in zip(places, one.points, strict=True):
        if point.bounds is not None:
            parts.append(_whisker(*map(y_of, point.bounds), x, upright=True))
    if markers or len(places) == 1:
        for (x, y), point in zip(places, one.points, strict=True):
            note = point.note or f"{one.label}{': ' if one.label else ''}{point.y:.6g}"
            parts.append(_marker(one.style, x, y, note))
    name = f"<title>{escape(one.label)}</title>" if one.label else ""
    return f'<g class="s{one.style % COLOURS}">{"".join(parts)}{name}</g>'


def _dashed(style: int) -> str:
    dash = DASHES[style // COLOURS % len(DASHES)]
    return f' stroke-dasharray="{dash}"' if dash else ""


def _marker(style: int, x: float, y: float, note: str) -> str:
    shape = MARKERS[style % len(MARKERS)]
    title = f"<title>{escape(note)}</title>" if note else ""
    return f'<path class="mark s{style % COLOURS}" transform="translate({x:.1f} {y:.1f})" d="{shape}">{title}</path>'


def _bar(style: int, left: float, y: float, height: float, end: float, note: str) -> str:
    return (
        f'<rect class="bar s{style % COLOURS}{" hollow" if style else ""}" x="{left:.1f}" y="{y:.1f}" '
        f'width="{max(0.0, end - left):.1f}" height="{height:.1f}"><title>{escape(note)}</title></rect>'
    )


def _whisker(low: float, high: float, across: float, upright: bool = False) -> str:
    if upright:
        path = f"M{across:.1f} {low:.1f}V{high:.1f}M{across - 3:.1f} {low:.1f}h6M{across - 3:.1f} {high:.1f}h6"
    else:
        path = f"M{low:.1f} {across:.1f}H{high:.1f}M{low:.1f} {across - 3:.1f}v6M{high:.1f} {across - 3:.1f}v6"
    return f'<path class="whisker" d="{path}"/>'


def _legend(
    entries: Sequence[tuple[str, int]], y: float, lines: bool, markers: bool, bars: bool = False
) -> tuple[list[str], float]:
    """Named entries in rows that fit the width, each once; and the height that the figure now needs."""
    distinct = [entry for entry in dict.fromkeys(entries) if entry[0]]
    if not distinct:
        return [], y
    parts, x = [], 14.0
    y += 8
    for label, style in distinct:
        room = 60
        shown = label if len(label) <= room else label[: room - 1] + "\N{HORIZONTAL ELLIPSIS}"
        wide = 30 + len(shown) * GLYPH
        if x > 14 and x + wide > WIDTH:
            x, y = 14.0, y + 16
        sample = ""
        if bars:
            sample = _bar(style, 0, -8, 9, 14, "")
        else:
            if lines:
                sample += f'<path class="line s{style % COLOURS}" d="M0-4H16"{_dashed(style)}/>'
            if markers:
                sample += _marker(style, 8, -4, "")
        parts.append(f'<g transform="translate({x:.1f} {y:.1f})">{sample}<text x="20" y="0">{escape(shown)}</text></g>')
        x += wide + 8
    return parts, y + 10


def _described(one: Series) -> str:
    first, last = one.points[0], one.points[-1]
    return f"{one.label}: from {first[1]:.4g} at {first[0]:g} to {last[1]:.4g} at {last[0]:g}"


def _nothing(title: str) -> Markup:
    words = "No values yet."
    return _figure(title, words, [f'<text x="12" y="40">{words}</text>'], 60)


def _figure(title: str, description: str, parts: Sequence[str], height: float) -> Markup:
    return Markup(
        f'<figure class="chart"><figcaption>{escape(title)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {height:.0f}" role="img"><title>{escape(title)}</title>'
        f"<desc>{escape(description)}</desc>{''.join(parts)}</svg></figure>"
    )
