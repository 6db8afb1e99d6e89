"""Assemble: all shards -> one dataset folder: manifest, COCO and SMPL files, sets, card."""

import json
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path

import ntop
from ntop.config.plan import shard_frames
from ntop.config.sections import AssembleConfig
from ntop.config.tables import Actor, Sequence, read_tsv
from ntop.conventions import VIEWS, ConfigError, DataError
from ntop.metrics.statistics import Tally, statistics_rows, statistics_table
from ntop.stages import VERSIONS
from ntop.storage import schemas
from ntop.storage.archives import member_at
from ntop.storage.atomic import atomic_folder, write_bytes
from ntop.storage.card import dataset_card
from ntop.storage.coco import COCO17, SMPL24, CocoWriter, coco_writer
from ntop.storage.files import (
    check_files,
    file_row,
    files_writer,
    find_damage,
    raise_damage,
    read_records,
)
from ntop.storage.links import link_or_copy
from ntop.storage.manifest import manifest_writer
from ntop.storage.pace import paced
from ntop.storage.provenance import code_sha256, json_sha256
from ntop.storage.remedies import FILES_NAME, remedy
from ntop.storage.renders import set_key
from ntop.storage.sets import set_record, write_set
from ntop.storage.shards import PicturePlaces, picture_places
from ntop.storage.tables import Row, RowWriter, read_table

SPLITS = ("train", "val")
COCO_NAMES = {COCO17: "person_keypoints", SMPL24: "person_smpl24"}
NOT_IN_MANIFEST = ("coco17_world_m", "joints3d_world_m", *(n for n, _ in schemas.BODY_COLUMNS))


@dataclass(frozen=True)
class Shard:
    """One shard's folder of renders and its table of annotations."""

    renders: Path
    annotations: Path


@dataclass
class Totals:
    """What grows while shards are added; none of it with the number of images."""

    tallies: dict[tuple[str, str], Tally] = field(default_factory=dict)
    num_sets: int = 0
    archives: bool = False  # whether pictures are in tars


def main(
    config: AssembleConfig, sequences: Path, renders: Path, annotations: Path, out: Path
) -> None:
    """Build the dataset of all shards that the table `sequences` asks for.

    `renders` and `annotations` are the folders below which the shards lie. Their names come from
    the table: thousands of them would not fit on a command line.

    Raises:
        ConfigError: an actor is in two splits, or has none.
        DataError: a shard is missing, a shard and its annotations disagree, or the folder cannot be
            written.
    """
    actors = actors_by_key(config)
    keys = shard_frames(
        read_tsv(sequences, Sequence), rigs=config.rigs, sets_per_shard=config.sets_per_shard
    )
    # by source, actor, action, rig and first frame: the manifest is sorted without reading ahead
    shards = [
        Shard(renders / key, annotations / f"{key}.parquet")
        for key in sorted(keys, key=lambda key: key.split("/"))
    ]
    totals = Totals()
    with atomic_folder(out) as folder, files_writer(folder) as files:
        with ExitStack() as stack:
            manifest = stack.enter_context(manifest_writer(folder))
            coco = {
                (skeleton.name, split): stack.enter_context(
                    coco_writer(
                        folder / "annotations" / f"{name}_{split}.json",
                        skeleton=skeleton,
                        info={"description": f"{config.dataset} {split}", "version": "1.0"},
                    )
                )
                for skeleton, name in COCO_NAMES.items()
                for split in SPLITS
            }
            for shard in paced(shards, what="assemble", total=len(shards), unit="shards"):
                rows = add_shard(
                    shard, actors=actors, folder=folder, manifest=manifest, coco=coco, totals=totals
                )
                files.add(rows)
        write_summary(config, shards, totals=totals, folder=folder)
        once = [*folder.glob("*"), *(folder / "annotations").glob("*")]
        named = sorted(path for path in once if path.is_file() and path.name != FILES_NAME)
        files.add(file_row(path, folder=folder) for path in named)


def actors_by_key(config: AssembleConfig) -> dict[tuple[str, str], Actor]:
    """The declared actors by (source, actor).

    Raises:
        ConfigError: an actor is in two splits.
    """
    actors: dict[tuple[str, str], Actor] = {}
    for actor in config.actors:
        known = actors.setdefault((actor.source, actor.actor), actor)
        if known.split != actor.split:
            raise ConfigError(
                f"actor {actor.source}/{actor.actor} is in splits {known.split!r} and "
                f"{actor.split!r}; an actor belongs to one: keep one line of the actors table"
            )
    return actors


def add_shard(
    shard: Shard,
    *,
    actors: dict[tuple[str, str], Actor],
    folder: Path,
    manifest: RowWriter,
    coco: dict[tuple[str, str], CocoWriter],
    totals: Totals,
) -> list[Row]:
    """Add a shard's sets to every file of the dataset; returns the record of the files it brings.

    Raises:
        DataError: a file of the shard is not what was rendered.
    """
    check_files(shard.renders, only={"renders.parquet", "skipped.json"})
    records = read_records(shard.renders)
    files: dict[str, Row] = {}
    for pairs in sets_of(shard):
        body = pairs[0][0]
        actor = actors.get((body["source"], body["actor"]))
        if actor is None:
            raise ConfigError(
                f"{shard.renders}: actor {body['source']}/{body['actor']} has no split; "
                "add a line to the actors table"
            )
        rows = []
        for render, annotated in pairs:
            places = picture_places(render, split=actor.split, shard=shard.renders.name)
            for source, target in places.links.items():
                if target in files:
                    continue  # a tar, linked with its first picture
                record = records.get(source)
                if record is None:
                    raise DataError(
                        f"{shard.renders} has no record of {source}: another version of ntop "
                        f"rendered it; {remedy(shard.renders)}"
                    )
                # the last look: whatever damages a picture later is the dataset's, not the run's
                raise_damage(find_damage(shard.renders, record), shard.renders)
                link_or_copy(shard.renders / source, folder / target)
                files[target] = record | {"path": target}
            row = manifest_row(render, places, persons=annotated["persons"], split=actor.split)
            manifest.add([row])
            rows.append(row)
            for skeleton, points in (
                (COCO17, render["coco17_world_m"]),
                (SMPL24, render["joints3d_world_m"]),
            ):
                coco[skeleton.name, actor.split].add(
                    row, rle=annotated["rle"], keypoints3d_world_m=points
                )
            key = (actor.source, actor.split)
            totals.tallies[key] = totals.tallies.get(key, Tally()).with_image(
                (actor.source, actor.actor, actor.gender),
                sizes_px=[tuple(person["bbox_xywh_px"][2:]) for person in row["persons"]],
            )
        written = write_set(set_record(rows, body=body), folder=folder)
        files[written["path"]] = written
        totals.num_sets += 1
        totals.archives = totals.archives or member_at(rows[0]["image_path"]) is not None
    return list(files.values())


def sets_of(shard: Shard) -> Iterator[list[tuple[Row, Row]]]:
    """The sets of a shard: (render row, annotation row) of each view, in the rig's order.

    Raises:
        DataError: the two tables hold different samples.
    """
    renders = read_table(shard.renders / "renders.parquet", schema=schemas.RENDER)
    annotated = {
        row["sample_id"]: row for row in read_table(shard.annotations, schema=schemas.KEYPOINTS)
    }
    if set(annotated) != {row["sample_id"] for row in renders}:
        raise DataError(
            f"{shard.annotations} annotates other samples than {shard.renders} holds; "
            + remedy(shard.annotations)
        )
    for _, group in groupby(renders, key=set_key):
        views = sorted(group, key=lambda row: VIEWS.index(row["view"]))
        yield [(row, annotated[row["sample_id"]]) for row in views]


def manifest_row(render: Row, places: PicturePlaces, *, persons: list[Row], split: str) -> Row:
    """The manifest's row of one view; paths become relative to the dataset's folder."""
    kept = {name: value for name, value in render.items() if name not in NOT_IN_MANIFEST}
    return kept | places.paths | {"split": split, "persons": persons}


def write_summary(
    config: AssembleConfig, shards: list[Shard], *, totals: Totals, folder: Path
) -> None:
    """Write `dataset.json` and the dataset card."""
    lines = statistics_rows(totals.tallies, dataset=config.dataset)
    num_images = lines[-1].images
    skipped = [
        frame
        for shard in shards
        for frame in json.loads((shard.renders / "skipped.json").read_text())
    ]
    values = config.model_dump(mode="json")
    summary = {
        "dataset": config.dataset,
        "ntop_version": ntop.__version__,
        "stage_versions": VERSIONS,
        "config": values,
        "config_sha256": json_sha256(values),
        "code_sha256": code_sha256(),
        "num_images": num_images,
        "num_sets": totals.num_sets,
        "statistics": [asdict(line) for line in lines],
        "skipped": sorted(skipped, key=lambda item: json.dumps(item, sort_keys=True)),
    }
    text = json.dumps(summary, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_bytes(folder / "dataset.json", text.encode())
    card = dataset_card(
        dataset=config.dataset,
        version=ntop.__version__,
        num_images=num_images,
        num_sets=totals.num_sets,
        statistics=statistics_table(lines),
        archives=totals.archives,
    )
    write_bytes(folder / "README.md", card.encode())
