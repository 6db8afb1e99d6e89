"""The report page: what it shows as plain records, and their rendering into one HTML file."""

import html
from dataclasses import dataclass
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from ntop.report.charts import Chart
from ntop.report.figures import Figure
from ntop.report.pictures import Picture, Skeleton, skeleton_svg
from ntop.storage.atomic import write_bytes

TEMPLATE_PATH = Path(__file__).parent / "template.html"
TABLE_STYLE = """
body { font: 15px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; color: #1d1f23;
  background: #ffffff; margin: 20px; }
p { max-width: 75ch; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: 6px 12px; border-bottom: 1px solid #e3e0d8; }
th:first-child, td:first-child { text-align: left; } th { color: #5f646d; }
tr.total td { font-weight: 600; border-top: 2px solid #e3e0d8; }
"""


@dataclass(frozen=True)
class Strip:
    """One actor's way through the stages."""

    title: str
    pictures: tuple[Picture, ...]
    note: str = ""


@dataclass(frozen=True)
class Sheet:
    """The nine views of a set in compass order (three rows, north up), and one view's layers."""

    index: int
    title: str
    pictures: tuple[Picture, ...]
    layers: tuple[Picture, ...] = ()


@dataclass(frozen=True)
class Table:
    """A table with a sentence before it; `total` marks the last row as a sum."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    text: str = ""
    total: bool = False


@dataclass(frozen=True)
class Comparison:
    """Rows of pictures to be compared, with a table of their scores."""

    text: str
    rows: tuple[tuple[Picture, ...], ...]
    table: Table


@dataclass(frozen=True)
class Page:
    """Everything the report shows; empty parts are left out of the page."""

    title: str
    headline: str
    lead: str
    tiles: tuple[Figure, ...]
    figures: tuple[Figure, ...]
    provenance: tuple[tuple[str, str], ...]
    strips: tuple[Strip, ...] = ()
    sheets: tuple[Sheet, ...] = ()
    heldout: tuple[Comparison, ...] = ()
    truth: tuple[Comparison, ...] = ()
    stripes: Comparison | None = None
    curves: tuple[Chart, ...] = ()
    statistics: Table | None = None
    costs: tuple[Chart, ...] = ()
    cost_table: Table | None = None

    @property
    def strip_columns(self) -> int:
        """How many pictures the longest strip has."""
        return max((len(strip.pictures) for strip in self.strips), default=1)

    @property
    def contents(self) -> tuple[tuple[str, str], ...]:
        """Anchors and names of the sections that exist."""
        sections = (
            ("making", "From camera to label", self.strips),
            ("views", "Nine views", self.sheets),
            ("heldout", "Held-out camera", self.heldout),
            ("truth", "Truth", self.truth),
            ("stripes", "Stripes", self.stripes),
            ("training", "Training", self.curves),
            ("statistics", "Contents", self.statistics),
            ("figures", "All figures", self.figures),
            ("costs", "Time and memory", self.costs),
            ("provenance", "Provenance", self.provenance),
        )
        return tuple((anchor, name) for anchor, name, content in sections if content)


def render_page(page: Page) -> str:
    """The page as one self-contained HTML document."""
    environment = Environment(
        autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters["overlay_svg"] = _overlay
    environment.filters["table"] = _table
    return environment.from_string(TEMPLATE_PATH.read_text(encoding="utf-8")).render(page=page)


def write_page(page: Page, path: Path) -> None:
    """Write the report."""
    write_bytes(path, render_page(page).encode())


def table_document(table: Table) -> str:
    """A table as an HTML file of its own."""
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><style>{TABLE_STYLE}</style>"
        f"<p>{html.escape(table.text)}</p>{_table(table)}</html>\n"
    )


def _overlay(overlay: Skeleton, picture: Picture) -> Markup:
    return Markup(skeleton_svg(overlay, width=picture.width, height=picture.height))


def _table(table: Table) -> Markup:
    def cells(tag: str, values: tuple[str, ...]) -> str:
        return "".join(f"<{tag}>{html.escape(value)}</{tag}>" for value in values)

    last = len(table.rows) - 1
    rows = "".join(
        f"<tr{' class=total' if table.total and index == last else ''}>{cells('td', row)}</tr>"
        for index, row in enumerate(table.rows)
    )
    return Markup(
        f'<div class="scroll"><table><thead><tr>{cells("th", table.head)}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )
