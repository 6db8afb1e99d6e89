"""The words and tables around the pictures: headline, tiles, statistics, provenance."""

import json
import platform
from importlib.metadata import version
from pathlib import Path
from typing import Any

from ntop.conventions import DataError
from ntop.report.charts import bar_chart
from ntop.report.figures import CHECKS, MEANINGS, STAGE_NAMES, Figure, figure
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.page import Table

TILES = (
    "truth.psnr_box_db",
    "truth.mask_iou",
    "heldout.psnr_person_db",
    "heldout.mask_iou",
    "refine_cameras.heldout_px",
    "labels.blob_max_px",
    "truth.visibility_agreement",
    "checks.visible_on_mask",
)
PACKAGES = ("numpy", "torch", "numba", "opencv-contrib-python-headless", "pyarrow", "snakemake")


def read_dataset_record(dataset: Dataset) -> dict[str, Any]:
    """The dataset's own record: versions, hashes, statistics.

    Raises:
        DataError: it is missing or not JSON.
    """
    path = dataset.folder / "dataset.json"
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read {path}: {error}; rerun the assemble stage") from error


def headline(dataset: Dataset) -> str:
    """How many images of how many people."""
    people = len({(row["source"], row["actor"]) for row in dataset.rows})
    noun = "person" if people == 1 else "people"
    return f"{len(dataset.rows):,} images of {people} {noun}, seen from the ceiling"


def lead(dataset: Dataset) -> str:
    """What an image is and comes with."""
    row = dataset.rows[0]
    rigs = sorted({r["rig"] for r in dataset.rows})
    degrees = 2 * row["max_theta_rad"] * 57.29577951308232
    return (
        f"Dataset “{dataset.name}”: {len(dataset.sets):,} sets, one body pose each, seen by nine "
        f"equidistant fisheye cameras ({row['width']} × {row['height']} px, {degrees:.0f}°) in "
        f"{len(rigs)} camera {'setting' if len(rigs) == 1 else 'settings'}, with masks, depth, "
        "body parts, 2D and 3D keypoints and true visibility."
    )


def tiles(values: dict[str, float | None]) -> tuple[Figure, ...]:
    """The figures that a reader wants first; those without a value are left out."""
    meanings = {meaning.key: meaning for meaning in (*MEANINGS, *CHECKS)}
    return tuple(figure(meanings[key], values[key]) for key in TILES if values.get(key) is not None)


def statistics_table(record: dict[str, Any]) -> Table:
    """Contents in the shape of the paper's table 2."""
    rows = []
    for line in record["statistics"]:
        known = [f"{line['male']} M"] * (line["male"] > 0) + [f"{line['female']} F"] * (
            line["female"] > 0
        )
        actors = f"{line['actors']} ({', '.join(known)})" if known else str(line["actors"])
        size = "–"
        if line["mean_width_px"] is not None and line["mean_height_px"] is not None:
            size = f"{line['mean_width_px']:.0f} × {line['mean_height_px']:.0f}"
        rows.append((line["dataset"], actors, f"{line['images']:,}", f"{line['subjects']:,}", size))
    skipped = len(record["skipped"])
    text = (
        "Actors are unique persons, subjects are rendered human instances, and the size is that of "
        "the tight box around the mask, in pixels. Nobody is in both splits."
    )
    if skipped:
        text += f" {skipped} frames were unusable; dataset.json lists them with their reasons."
    head = ("dataset", "actors", "images", "subjects", "average subject size")
    return Table(head, tuple(rows), text=text, total=True)


def cost_charts(costs: dict[str, float | None]) -> tuple[str, ...]:
    """Time and memory per stage."""
    if all(value is None for value in costs.values()):
        return ()
    seconds = {name: costs[f"seconds.{name}"] for name in STAGE_NAMES}
    memory = {name: costs[f"peak_memory_gb.{name}"] for name in STAGE_NAMES}
    total = sum(value for value in seconds.values() if value is not None)
    return (
        bar_chart(seconds, title=f"Time per stage, {total:,.0f} s in all jobs together", unit="s"),
        bar_chart(memory, title="Largest resident memory of a stage's jobs", unit="GB"),
    )


def provenance_rows(
    record: dict[str, Any], actors: list[ActorFolders]
) -> tuple[tuple[str, str], ...]:
    """What made the dataset and this page."""
    versions = ", ".join(f"{name} {number}" for name, number in record["stage_versions"].items())
    return (
        ("ntop", record["ntop_version"]),
        ("stage versions", versions),
        ("code, SHA-256", record["code_sha256"]),
        ("configuration, SHA-256", record["config_sha256"]),
        *((f"avatar of {actor.name}, SHA-256", _avatar_sha256(actor.avatar)) for actor in actors),
        ("Python", platform.python_version()),
        ("libraries", ", ".join(f"{name} {version(name)}" for name in PACKAGES)),
        ("machine", f"{platform.system()} {platform.machine()}"),
    )


def _avatar_sha256(folder: Path) -> str:
    path = folder / "avatar.json"
    try:
        return json.loads(path.read_text())["sha256"]
    except (OSError, ValueError, KeyError) as error:
        raise DataError(f"cannot read {path}: {error!r}; rerun the training") from error
