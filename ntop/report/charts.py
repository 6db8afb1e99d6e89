"""Line and bar charts as SVG: inline in the page, which colours them, or as files of their own."""

import html
import math
from dataclasses import dataclass

import numpy as np

WIDTH, HEIGHT = 640, 300
DOTTED = 20  # curves of so few values show each; a single one would be no line
LEFT, RIGHT, TOP, BOTTOM = 62, 16, 18, 44


LEGEND_ROW = 20  # of a chart in a file of its own, pixels
# the page's light colours, for a chart that no page gives its own
STYLE = """
text { font: 12px system-ui, "Segoe UI", "DejaVu Sans", sans-serif; fill: #5f646d; }
.title { font-size: 14px; font-weight: 600; fill: #1d1f23; } .axis { fill: #1d1f23; }
.mid { text-anchor: middle; } .end { text-anchor: end; } .grid { stroke: #e3e0d8; }
.curve { fill: none; stroke-width: 2; } .bar { fill: #c2410c; }
.curve.k0 { stroke: #c2410c; } .curve.k1 { stroke: #0f766e; }
.curve.k2 { stroke: #4f46e5; } .curve.k3 { stroke: #a16207; }
.dot.k0, .key.k0 { fill: #c2410c; } .dot.k1, .key.k1 { fill: #0f766e; }
.dot.k2, .key.k2 { fill: #4f46e5; } .dot.k3, .key.k3 { fill: #a16207; }
"""


@dataclass(frozen=True)
class Chart:
    """The elements of a drawing of `WIDTH` by `height`, its title and its legend's names."""

    title: str
    height: int
    elements: str
    legend: tuple[tuple[str, int], ...] = ()  # name and kind of each line

    @property
    def figure(self) -> str:
        """A figure for the page, whose style sheet colours it."""
        keys = "".join(f'<span class="key k{k}">{_safe(name)}</span>' for name, k in self.legend)
        caption = f"{_safe(self.title)} <span class=keys>{keys}</span>" if keys else None
        return (
            f'<figure class="chart"><svg viewBox="0 0 {WIDTH} {self.height}" role="img" '
            f'aria-label="{_safe(self.title)}">{self.elements}</svg>'
            f"<figcaption>{caption or _safe(self.title)}</figcaption></figure>"
        )

    @property
    def document(self) -> str:
        """An SVG file, with title and legend in it."""
        top, names = 34, self.legend if len(self.legend) > 1 else ()
        height = top + self.height + LEGEND_ROW * len(names) + 8
        keys = []
        for row, (name, kind) in enumerate(names):
            y = top + self.height + LEGEND_ROW * row + 12
            keys.append(
                f'<rect class="key k{kind}" x="{LEFT}" y="{y - 6}" width="16" height="3"/>'
                f'<text x="{LEFT + 24}" y="{y}">{_safe(name)}</text>'
            )
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            f'width="{2 * WIDTH}" height="{2 * height}"><style>{STYLE}</style>'
            f'<rect width="{WIDTH}" height="{height}" fill="#ffffff"/>'
            f'<text class="title" x="14" y="22">{_safe(self.title)}</text>'
            f'<g transform="translate(0 {top})">{self.elements}</g>{"".join(keys)}</svg>\n'
        )


@dataclass(frozen=True)
class Line:
    """One curve; `kind` selects its colour (0 to 3)."""

    name: str
    x: list[float]
    y: list[float]
    kind: int = 0


def line_chart(lines: list[Line], *, title: str, x_label: str, y_label: str) -> Chart | None:
    """Curves over a common x axis; non-finite values are left out. None if nothing remains."""
    finite = [
        [(x, y) for x, y in zip(line.x, line.y, strict=True) if math.isfinite(y)] for line in lines
    ]
    values = [point for points in finite for point in points]
    if not values:
        return None
    x_ticks = _ticks(min(v[0] for v in values), max(v[0] for v in values))
    y_ticks = _ticks(min(v[1] for v in values), max(v[1] for v in values))
    x_span, y_span = (x_ticks[0], x_ticks[-1]), (y_ticks[0], y_ticks[-1])

    def at(point: tuple[float, float]) -> tuple[float, float]:
        x = LEFT + (point[0] - x_span[0]) / (x_span[1] - x_span[0]) * (WIDTH - LEFT - RIGHT)
        share = (point[1] - y_span[0]) / (y_span[1] - y_span[0])
        return x, HEIGHT - BOTTOM - share * (HEIGHT - TOP - BOTTOM)

    parts = []
    for tick in x_ticks:
        x, _ = at((tick, y_span[0]))
        y = HEIGHT - BOTTOM + 18
        parts.append(f'<text x="{x:.1f}" y="{y}" class="tick mid">{tick:g}</text>')
    for tick in y_ticks:
        _, y = at((x_span[0], tick))
        parts.append(
            f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text x="{LEFT - 8}" y="{y + 4:.1f}" class="tick end">{tick:g}</text>'
        )
    for line, points in zip(lines, finite, strict=True):
        placed = [at(p) for p in points]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in placed)
        parts.append(f'<polyline class="curve k{line.kind}" points="{path}"/>')
        if len(placed) <= DOTTED:
            parts += [
                f'<circle class="dot k{line.kind}" cx="{x:.1f}" cy="{y:.1f}" r="3.5"/>'
                for x, y in placed
            ]
    x_middle, y_middle = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    parts.append(f'<text x="{x_middle}" y="{HEIGHT - 6}" class="axis mid">{_safe(x_label)}</text>')
    parts.append(
        f'<text transform="translate(14 {y_middle}) rotate(-90)" class="axis mid">'
        f"{_safe(y_label)}</text>"
    )
    legend = tuple((line.name, line.kind) for line in lines)
    return Chart(title, HEIGHT, "".join(parts), legend)


def bar_chart(values: dict[str, float | None], *, title: str, unit: str) -> Chart:
    """Horizontal bars, one per entry, each with its number; a missing value says so."""
    row, label_width = 30, 110
    height = row * len(values) + 8
    largest = max((v for v in values.values() if v is not None), default=0.0) or 1.0
    parts = []
    for index, (name, value) in enumerate(values.items()):
        y = 4 + index * row
        place = f'x="{label_width - 10}" y="{y + 19}"'
        parts.append(f'<text {place} class="axis end">{_safe(name)}</text>')
        length = 0.0 if value is None else value / largest * (WIDTH - label_width - 110)
        shown = "not measured" if value is None else f"{human(value)} {unit}"
        parts.append(
            f'<rect class="bar" x="{label_width}" y="{y + 4}" width="{max(length, 1):.1f}" '
            f'height="{row - 10}" rx="3"/>'
            f'<text x="{label_width + length + 8:.1f}" y="{y + 19}" class="tick">{shown}</text>'
        )
    return Chart(title, height, "".join(parts))


def human(value: float) -> str:
    """A number with three significant digits, without exponent where a person would use none."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if isinstance(value, int) or abs(value) >= 1000:
        return f"{value:,.0f}"
    if abs(value) < 1e-3:
        return f"{value:.1e}"
    return f"{value:.{max(0, 2 - math.floor(math.log10(abs(value))))}f}"


def _ticks(low: float, high: float) -> list[float]:
    """Round numbers that span the range: 1, 2 or 5 times a power of ten apart."""
    if high - low < 1e-12:
        low, high = low - 0.5, high + 0.5
    raw = (high - low) / 5
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(m * power for m in (1, 2, 5, 10) if m * power >= raw)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [float(np.round(i * step, 12)) for i in range(first, last + 1)]


def _safe(text: str) -> str:
    return html.escape(text, quote=True)
