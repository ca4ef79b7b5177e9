"""Line charts as SVG: scales, round numbers on the axes, lines, bands, stacks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from itertools import pairwise

import numpy as np

from visctrl.contracts import Array

#: Size of a chart's canvas, and what is left around its plot: left, top, right, bottom (px).
WIDTH, HEIGHT = 440.0, 230.0
MARGINS = (48.0, 12.0, 10.0, 30.0)
#: Number of colours in the page's style sheet.
COLOURS = 8
#: Most points of one line: a longer one shows the extremes of groups of ticks.
_MOST_POINTS = 900
#: Outliers are cut off where all values span so many times what nine out of ten do.
_OUTLIERS = 8.0


@dataclass(frozen=True)
class Line:
    """One line of a chart.

    sd : standard deviations, for a band of two on either side; None draws none.
    colour : number of a colour of the style sheet, from 0.
    style : ``solid``, ``dashed`` or ``step`` (holds each value until the next).
    """

    name: str
    values: Array
    colour: int
    sd: Array | None = None
    style: str = "solid"


@dataclass(frozen=True)
class Chart:
    """A chart over time.

    stacked : the lines' values are added up and drawn as areas.
    from_zero : the axis begins at 0.
    note : a line below.
    """

    title: str
    unit: str
    t: Array
    lines: Sequence[Line]
    stacked: bool = False
    from_zero: bool = False
    note: str = ""


@dataclass(frozen=True)
class Scale:
    """Maps values low…high to pixels first…last."""

    low: float
    high: float
    first: float
    last: float

    def __call__(self, values: Array) -> Array:
        """Return pixels."""
        share = (np.asarray(values) - self.low) / (self.high - self.low)
        return self.first + share * (self.last - self.first)

    def at(self, value: float) -> float:
        """Return the pixel of one value."""
        return float(self(np.array(value)))


def draw_chart(chart: Chart, shades: Sequence[tuple[float, float]] = ()) -> str:
    """Return a chart as a ``<figure>`` with title and legend.

    Parameters
    ----------
    chart : Chart
        What to draw; empty values (NaN) leave gaps.
    shades : sequence of (begin, end)
        Times (s) to shade.
    """
    lines = _stacked(chart.lines) if chart.stacked else list(chart.lines)
    left, top, right, bottom = MARGINS
    finite = chart.t[np.isfinite(chart.t)]
    begin, end = (float(finite[0]), float(finite[-1])) if finite.size else (0.0, 1.0)
    x = Scale(begin, max(end, begin + 1e-3), left, WIDTH - right)
    y = Scale(*value_range(lines, chart.from_zero or chart.stacked), HEIGHT - bottom, top)
    wide, high = WIDTH - left - right, HEIGHT - top - bottom
    parts = [_shade(x.at(a), x.at(b), top, high) for a, b in shades]
    parts += _grid(x, y)
    # A nested picture cuts off what lies outside the plot.
    parts.append(
        f'<svg x="{left:g}" y="{top:g}" width="{wide:g}" height="{high:g}" '
        f'viewBox="{left:g} {top:g} {wide:g} {high:g}">'
    )
    parts += _areas(chart.t, lines, x, y) if chart.stacked else _bands(chart.t, lines, x, y)
    for line in lines:
        d = line_path(x(chart.t), _bounded(y(line.values)), step=line.style == "step")
        parts.append(f'<path class="line c{line.colour}{_dash(line)}" d="{d}"/>')
    parts.append(f'<line class="cursor" y1="0" y2="{HEIGHT:g}"/></svg>')
    title = escape(chart.title)
    note = f'<p class="note">{escape(chart.note)}</p>' if chart.note else ""
    return (
        f'<figure class="chart" data-x="{_ends(x)}" data-y="{_ends(y)}"'
        f"{' data-stacked' if chart.stacked else ''}><figcaption><b>{title}</b>"
        f'<span class="unit">{escape(chart.unit)}</span>{_legend(lines)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" aria-label="{title}">'
        f"{''.join(parts)}</svg>{note}</figure>"
    )


def value_range(lines: Sequence[Line], from_zero: bool) -> tuple[float, float]:
    """Return the ends of an axis: all values but far outliers, and bands where they are small."""
    known = [line.values[np.isfinite(line.values)] for line in lines]
    values = np.concatenate([*known, np.zeros(0)])
    if not values.size:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    few, most = (float(q) for q in np.percentile(values, [5.0, 95.0]))
    if most > few and high - low > _OUTLIERS * (most - few):
        margin = 0.5 * (most - few)
        low, high = max(low, few - margin), min(high, most + margin)
    room = 0.5 * (high - low) or np.inf
    lowest, highest = low, high
    for line in lines:
        if line.sd is not None:
            shown = (line.values >= low) & (line.values <= high) & np.isfinite(line.sd)
            if shown.any():
                values, spread = line.values[shown], 2.0 * line.sd[shown]
                lowest = min(lowest, max(low - room, float((values - spread).min())))
                highest = max(highest, min(high + room, float((values + spread).max())))
    low, high = lowest, highest
    if from_zero:
        low = min(low, 0.0)
    pad = 0.04 * (high - low) or 0.05 * abs(high) or 1.0
    return (low if from_zero and low == 0.0 else low - pad), high + pad


def round_steps(low: float, high: float, most: int) -> list[float]:
    """Return at most ``most`` + 1 round numbers between two values: 1, 2 or 5 times 10^k apart."""
    rough = (high - low) / most
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(
        factor * power for factor in (1.0, 2.0, 5.0, 10.0) if factor * power >= rough * 0.999
    )
    first = math.ceil(low / step - 1e-9)
    last = math.floor(high / step + 1e-9)
    return [round(k * step, 12) for k in range(first, last + 1)]


def number(value: float) -> str:
    """Return an axis label."""
    if value != 0.0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:.6g}".replace("-", "−")


def line_path(x: Array, y: Array, *, step: bool = False) -> str:
    """Return the path data of a line through (x, y), with gaps where one is not finite."""
    parts = []
    for first, last in _runs(np.isfinite(x) & np.isfinite(y)):
        u, v = _thinned(x[first:last], y[first:last], len(x))
        if step and len(u) > 1:
            u, v = np.repeat(u, 2)[1:], np.repeat(v, 2)[:-1]
        parts.append("M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(u, v, strict=True)))
        if last - first == 1:
            parts.append("h0.1")
    return "".join(parts)


def area_path(x: Array, below: Array, above: Array) -> str:
    """Return the path data of the area between two lines, with gaps where one is not finite."""
    parts = []
    for first, last in _runs(np.isfinite(x) & np.isfinite(below) & np.isfinite(above)):
        u, v = _thinned(x[first:last], above[first:last], len(x))
        w, z = _thinned(x[first:last], below[first:last], len(x))
        outline = [*zip(u, v, strict=True), *zip(w[::-1], z[::-1], strict=True)]
        parts.append("M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in outline) + "Z")
    return "".join(parts)


def _stacked(lines: Sequence[Line]) -> list[Line]:
    total = np.zeros(len(lines[0].values))
    summed = []
    for line in lines:
        total = total + np.nan_to_num(line.values)
        summed.append(Line(line.name, total, line.colour))
    return summed


def _bounded(pixels: Array) -> Array:
    """Return pixels that a renderer can draw; what lies far outside the plot stays outside."""
    return np.asarray(np.clip(pixels, -5.0 * HEIGHT, 5.0 * HEIGHT))


def _runs(good: np.ndarray) -> Iterator[tuple[int, int]]:
    """Yield the index ranges in which ``good`` is true."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], good, [False])).astype(np.int8)))
    yield from zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)


def _thinned(x: Array, y: Array, total: int) -> tuple[Array, Array]:
    """Return the lowest and highest point of each group of points, in order.

    There are some hundred groups among ``total`` points, of which these are a part.
    """
    groups = max(1, _MOST_POINTS * len(x) // (2 * total))
    if total <= _MOST_POINTS or len(x) <= 2 * groups:
        return x, y
    edges = np.linspace(0, len(x), groups + 1).astype(int)
    kept = {0, len(x) - 1}
    for first, last in pairwise(edges.tolist()):
        kept |= {first + int(y[first:last].argmin()), first + int(y[first:last].argmax())}
    some = sorted(kept)
    return x[some], y[some]


def _shade(begin: float, end: float, top: float, high: float) -> str:
    wide = max(end - begin, 0.5)
    return f'<rect class="shade" x="{begin:.1f}" y="{top:g}" width="{wide:.1f}" height="{high:g}"/>'


def _areas(t: Array, lines: Sequence[Line], x: Scale, y: Scale) -> list[str]:
    """Return the area below each line and above the one before it."""
    levels = [np.full(len(t), y.first), *(y(line.values) for line in lines)]
    return [
        f'<path class="area c{line.colour}" d="{area_path(x(t), below, above)}"/>'
        for line, (below, above) in zip(lines, pairwise(levels), strict=True)
    ]


def _bands(t: Array, lines: Sequence[Line], x: Scale, y: Scale) -> list[str]:
    """Return the bands of two standard deviations."""
    bands = []
    for line in lines:
        if line.sd is not None:
            below, above = (_bounded(y(line.values + k * line.sd)) for k in (-2.0, 2.0))
            area = area_path(x(t), below, above)
            bands.append(f'<path class="band c{line.colour}" d="{area}"/>')
    return bands


def _grid(x: Scale, y: Scale) -> list[str]:
    parts = []
    for value in round_steps(y.low, y.high, 5):
        at = y.at(value)
        zero = " zero" if value == 0.0 else ""
        parts.append(
            f'<path class="grid{zero}" d="M{x.first:g} {at:.1f}H{x.last:g}"/>'
            f'<text class="label" x="{x.first - 6:g}" y="{at + 3.5:.1f}" text-anchor="end">'
            f"{number(value)}</text>"
        )
    for value in round_steps(x.low, x.high, 9):
        at = x.at(value)
        parts.append(
            f'<path class="grid" d="M{at:.1f} {y.first:g}V{y.last:g}"/>'
            f'<text class="label" x="{at:.1f}" y="{y.first + 14:g}" text-anchor="middle">'
            f"{number(value)}</text>"
        )
    parts.append(
        f'<text class="label" x="{x.last:g}" y="{y.first + 27:g}" text-anchor="end">t [s]</text>'
    )
    return parts


def _ends(scale: Scale) -> str:
    return f"{scale.low:.9g},{scale.high:.9g},{scale.first:g},{scale.last:g}"


def _dash(line: Line) -> str:
    return " dashed" if line.style == "dashed" else ""


def _legend(lines: Sequence[Line]) -> str:
    items = (
        f'<span class="key c{line.colour}{_dash(line)}"><i></i>{escape(line.name)}'
        f"{' ± 2σ' if line.sd is not None else ''} <output></output></span>"
        for line in lines
    )
    return f'<span class="legend">{"".join(items)}</span>'
