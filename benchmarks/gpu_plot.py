"""The GPU benchmark's picture: launches of growing size, and what a view costs around the march."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib import pyplot as plt


def plot(values: dict[str, Any], path: Path) -> None:
    """Left: views/s over rays per launch. Right: views/s of each stretch. Missing parts: empty."""
    mpl.use("agg")
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), dpi=110)
    rows = values.get("launches", {}).get("rows", [])
    left.loglog([row["rays"] for row in rows], [row["views_per_s"] for row in rows], "o-")
    left.set_xlabel("rays per launch")
    left.set_ylabel("views/s, march alone")
    left.grid(alpha=0.3)
    bars = {
        "march alone": values.get("launches", {}).get("views_per_s"),
        "+ pixels, edges,\ntransfers": values.get("views", {}).get("views_per_s_render"),
        "+ posing": values.get("views", {}).get("views_per_s"),
        "+ files": values.get("shard", {}).get("views_per_s"),
    }
    known = {name: value for name, value in bars.items() if value is not None}
    right.barh(list(known), list(known.values()), color="#3b6ea5")
    right.set_xscale("log")
    right.invert_yaxis()
    right.set_xlabel("views/s, 1000 x 1000 pixels")
    figure.suptitle(values["gpu"]["name"])
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)
