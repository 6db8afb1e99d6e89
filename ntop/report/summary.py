"""The words and tables around the pictures: headline, tiles, statistics, provenance."""

import json
import platform
from collections import Counter
from importlib.metadata import version
from typing import Any

from ntop.conventions import DataError
from ntop.report.figures import CHECKS, MEANINGS, Figure, figure
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.page import Table
from ntop.report.training import avatar_header, training_note
from ntop.storage import schemas
from ntop.storage.remedies import remedy
from ntop.storage.tables import read_table

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
MOST_REASONS = 200
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
        raise DataError(f"cannot read {path}: {error}; {remedy(path)}") from error


def headline(dataset: Dataset) -> str:
    """How many images of how many people."""
    people = len({(row["source"], row["actor"]) for row in dataset.rows})
    noun = "person" if people == 1 else "people"
    return f"{dataset.num_images:,} images of {people} {noun}, seen from the ceiling"


def lead(dataset: Dataset) -> str:
    """What an image is and comes with."""
    row = dataset.rows[0]
    rigs = sorted({r["rig"] for r in dataset.rows})
    degrees = 2 * row["max_theta_rad"] * 57.29577951308232
    return (
        f"Dataset “{dataset.name}”: {dataset.num_sets:,} sets, one body pose each, seen by nine "
        f"{row['camera_model'].replace('_', '-')} fisheye cameras "
        f"({row['width']} × {row['height']} px, {degrees:.0f}°) in {len(rigs)} camera "
        f"{'setting' if len(rigs) == 1 else 'settings'}, with masks, depth, "
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


def left_out_table(record: dict[str, Any], actors: list[ActorFolders]) -> Table:
    """What no image was made of, by stage, actor and reason: recorded frames and sets."""
    counts: Counter[tuple[str, str, str]] = Counter()
    for actor in actors:
        for stage, path, schema in (
            ("capture", actor.capture / "frames.parquet", schemas.FRAME),
            ("mask", actor.mattes / "masks.parquet", schemas.MASK),
            ("fit", actor.bodies / "bodies.parquet", schemas.BODY),
        ):
            reasons = read_table(path, schema=schema)
            counts.update((stage, actor.name, row["reason"]) for row in reasons if row["reason"])
    for item in record["skipped"]:
        counts["render", f"{item['source']}/{item['actor']}", item["reason"]] += 1
    rows = [(*key, str(count)) for key, count in counts.most_common(MOST_REASONS)]
    text = "Every planned set became images and every recorded frame was usable."
    if rows:
        text = (
            "Frames that a stage could not use, and planned sets without images, with the stage's "
            "own words."
        )
    if len(counts) > len(rows):
        text += f" The {len(rows)} most frequent of {len(counts)} reasons."
    return Table(("stage", "actor", "reason", "count"), tuple(rows), text=text)


def provenance_rows(
    record: dict[str, Any], actors: list[ActorFolders]
) -> tuple[tuple[str, str], ...]:
    """What made the dataset and this page."""
    notes = [(actor, training_note(actor)) for actor in actors]
    versions = ", ".join(f"{name} {number}" for name, number in record["stage_versions"].items())
    return (
        ("ntop", record["ntop_version"]),
        ("stage versions", versions),
        ("code, SHA-256", record["code_sha256"]),
        ("configuration, SHA-256", record["config_sha256"]),
        *((f"avatar of {actor.name}, SHA-256", _avatar_sha256(actor)) for actor in actors),
        *((f"avatar of {actor.name}, training", note) for actor, note in notes if note),
        ("Python", platform.python_version()),
        ("libraries", ", ".join(f"{name} {version(name)}" for name in PACKAGES)),
        ("machine", f"{platform.system()} {platform.machine()}"),
    )


def _avatar_sha256(actor: ActorFolders) -> str:
    header = avatar_header(actor)
    if "sha256" not in header:
        raise DataError(f"{actor.avatar}/avatar.json names no sha256; {remedy(actor.avatar)}")
    return header["sha256"]
