"""The GPU's section of docs/benchmarks.md; a line whose part was not measured says `pending`.

Usage: python -m benchmarks.gpu_page (also at the end of `make bench-gpu`).
"""

import json
from collections.abc import Callable
from typing import Any

from benchmarks.environment import RESULTS, ROOT

PAGE = ROOT / "docs/benchmarks.md"
START, NEXT = "<!-- gpu -->\n", "<!-- "

# what is claimed, its bar, the part of gpu.json and how it is shown
Show = Callable[[dict[str, Any]], str]
LINES: tuple[tuple[str, str, str, Show], ...] = (
    ("largest difference of CPU and GPU pixels, levels of 255", "< 1", "differences",
     lambda v: f"{v['largest_levels']:.3g}"),
    ("views/s before encoding, march alone (rays on the GPU)", ">= 1000", "launches",
     lambda v: f"{v['views_per_s']:.0f}"),
    ("views/s before encoding, one process, with pixels, edges and transfers", ">= 1000", "views",
     lambda v: f"{v['views_per_s_render']:.1f}"),
    ("the same with posing", "", "views", lambda v: f"{v['views_per_s']:.1f}"),
    ("views/s with files written", "", "shard", lambda v: f"{v['views_per_s']:.1f}"),
    ("s to train the studio actor (compiled)", "<= 15", "training",
     lambda v: f"{v['seconds'][1]:.1f}"),
    ("its PSNR in the box from above, novel poses, dB", "", "training",
     lambda v: f"{v['scores']['psnr_box_db']:.2f}"),
    ("two trainings give the same bytes", "yes", "training",
     lambda v: "yes" if v["same_bytes"] else "no"),
)  # fmt: skip


def main() -> None:
    """Write the section from benchmarks/results/gpu.json, or as pending without it."""
    path = RESULTS / "gpu.json"
    values = json.loads(path.read_text()) if path.exists() else {}
    head, rest = PAGE.read_text().split(START)
    PAGE.write_text(head + START + section(values) + NEXT + rest.partition(NEXT)[2])


def section(values: dict[str, Any]) -> str:
    """The table, one line per claim."""
    lines = [
        "",
        "## GPU",
        "",
        "`make bench-gpu` on a machine with an NVIDIA GPU measures these lines and writes them",
        "here; 1000 x 1000 pixels, nine views per pose.",
        ran_on(values),
        "",
        "| what | bar (H200) | measured |",
        "|---|---|---:|",
    ]
    for claim, bar, part, show in LINES:
        found = values.get(part)
        measured = "`pending`" if found is None else found.get("failed") or show(found)
        lines.append(f"| {claim} | {bar} | {measured} |")
    return "\n".join([*lines, "", ""])


def ran_on(values: dict[str, Any]) -> str:
    """The machine."""
    if not values:
        return "Not measured on a GPU yet; the simulator tests the kernels."
    gpu, ran = values["gpu"], values["environment"]
    return (
        f"On {gpu['name']}, {ran['cores']} cores of {ran['cpu']}, numba-cuda {gpu['numba_cuda']}, "
        f"commit {ran['commit']}."
    )


if __name__ == "__main__":
    main()
