"""A shard's folder: the pictures of its finished sets, as files or as one tar."""

from dataclasses import dataclass
from pathlib import Path

from ntop.storage import schemas
from ntop.storage.archives import member_at, write_archive
from ntop.storage.files import check_files, read_records
from ntop.storage.links import link_or_copy
from ntop.storage.renders import IMAGE_FOLDERS, set_key
from ntop.storage.tables import Row, read_table

RENDERS_NAME = "renders.parquet"
ARCHIVE_NAME = "pictures.tar"


def archive_members(row: Row) -> dict[str, str]:
    """Column -> name in a tar of a row's three files: WebDataset's `{key}.{kind}.png`."""
    name = set_key(row).image_name(row["view"]).removesuffix(".png")
    return {column: f"{name}.{column.removesuffix('_path')}.png" for column in IMAGE_FOLDERS}


def store_files(done: list[Path], *, folder: Path) -> tuple[list[Row], list[Row]]:
    """Link the sets' pictures into the shard's folder; returns the rows of its table and files.

    The files' records are those made when they were rendered: what has become of them since must
    not be believed.
    """
    rows, files = [], []
    for place in done:
        files += [row for name, row in read_records(place).items() if name != RENDERS_NAME]
        for row in set_rows(place):
            for column in IMAGE_FOLDERS:
                link_or_copy(place / row[column], folder / row[column])
            rows.append(row)
    return rows, files


def store_archive(done: list[Path], *, folder: Path) -> tuple[list[Row], list[Row]]:
    """Put the sets' pictures into one tar; returns the rows of the table, with their places.

    No file has a record yet: the tar was made here.

    Raises:
        DataError: a set is not what was rendered.
    """
    rows, files = [], {}
    check_files(*done)
    for place in done:
        for row in set_rows(place):
            names = archive_members(row)
            files |= {name: place / row[column] for column, name in names.items()}
            rows.append(row)
    members = write_archive(files, path=folder / ARCHIVE_NAME)
    placed = [
        row | {column: members[name].address for column, name in archive_members(row).items()}
        for row in rows
    ]
    return placed, []


def set_rows(place: Path) -> list[Row]:
    """The rows of a finished set."""
    return read_table(place / RENDERS_NAME, schema=schemas.RENDER)


@dataclass(frozen=True)
class PicturePlaces:
    """Where a view's pictures lie in a dataset."""

    paths: dict[str, str]  # column -> file, or address in a tar; relative to the dataset's folder
    links: dict[str, str]  # file in the shard's folder -> file in the dataset's


def picture_places(render: Row, *, split: str, shard: str) -> PicturePlaces:
    """The places of one render row's pictures; `shard` is the name of the shard's folder."""
    key = set_key(render)
    paths, links = {}, {}
    for column, kind in IMAGE_FOLDERS.items():
        member = member_at(render[column])
        if member is None:
            paths[column] = f"{kind}/{split}/{key.folder()}/{key.image_name(render['view'])}"
            links[render[column]] = paths[column]
        else:
            archive = f"{IMAGE_FOLDERS['image_path']}/{split}/{key.folder()}/{shard}.tar"
            paths[column] = member._replace(archive=archive).address
            links[member.archive] = archive
    return PicturePlaces(paths, links)
