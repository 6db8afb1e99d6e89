"""Annotate: rendered views -> keypoints with visibility, boxes, areas and run-length masks."""

from pathlib import Path

from ntop.annotation.annotate import ViewImages, annotate_view
from ntop.config.sections import AnnotateConfig
from ntop.conventions import MASK_ALPHA, DataError
from ntop.storage import schemas
from ntop.storage.files import check_files
from ntop.storage.images import read_depth, read_parts, read_rgba
from ntop.storage.pace import paced
from ntop.storage.remedies import remedy
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import Row, read_table, write_table


def main(config: AnnotateConfig, renders: Path, out: Path) -> None:  # noqa: ARG001
    """Annotate one shard: `renders` is the shard's folder, `out` the table (schema KEYPOINTS)."""
    check_files(renders)
    rows = read_table(renders / "renders.parquet", schema=schemas.RENDER)
    annotated = [
        annotate_view(row, read_view(row, folder=renders), camera=fisheye_camera(row))
        for row in paced(rows, what="annotate", total=len(rows), unit="images")
    ]
    write_table(annotated, schema=schemas.KEYPOINTS, path=out)


def read_view(row: Row, *, folder: Path) -> ViewImages:
    """The images of a row, checked against its size.

    Raises:
        DataError: a file is missing or broken, or has another size than the row says.
    """
    rgba = read_rgba(folder / row["image_path"])
    depth_m = read_depth(folder / row["depth_path"])
    parts = read_parts(folder / row["parts_path"])
    for column, shape in (
        ("image_path", rgba.shape[:2]),
        ("depth_path", depth_m.shape),
        ("parts_path", parts.shape),
    ):
        if shape != (row["height"], row["width"]):
            raise DataError(
                f"{folder / row[column]}: {shape[1]}x{shape[0]} px, the table says "
                f"{row['width']}x{row['height']}; {remedy(folder)}"
            )
    return ViewImages(mask=rgba[..., 3] >= MASK_ALPHA, depth_m=depth_m, parts=parts)
