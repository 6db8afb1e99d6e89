"""Snakemake's benchmark tables: what the attempt that succeeded took."""

import ast
import math
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Usage:
    """Time and memory of one job; None where it was too short to be sampled, or not recorded."""

    wall_s: float
    cpu_s: float | None = None
    peak_mib: float | None = None  # largest resident memory of the job's processes together
    gpus: float | None = None  # asked for; only where Snakemake ran with `benchmark-extended`


def read_usage(path: Path) -> Usage | None:
    """The last line of a benchmark table; None without a usable one (the stages complain, not we).

    Read by hand: an extended table lists all inputs in one cell, more than `csv` takes.
    """
    try:
        head, *lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError, ValueError):
        return None
    if not lines:
        return None
    cells = dict(zip(head.split("\t"), lines[-1].split("\t"), strict=False))
    wall_s = _number(cells.get("s"))
    if wall_s is None:
        return None
    return Usage(
        wall_s, _number(cells.get("cpu_time")), _number(cells.get("max_rss")), _gpus(cells)
    )


def _number(text: str | None) -> float | None:
    """A cell; `-` and `NA` mean that the job was too short to be sampled."""
    try:
        value = float(text) if text is not None else math.nan
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _gpus(cells: dict[str, str]) -> float | None:
    try:
        resources = ast.literal_eval(cells["resources"])
        return float(resources.get("gpu", 0))
    except (KeyError, SyntaxError, ValueError, TypeError, AttributeError):
        return None
