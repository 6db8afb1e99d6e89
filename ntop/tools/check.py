"""`ntop check`: whether a finished dataset, or a run's results, still is what was written.

Everything is read once, in pieces: the memory does not depend on the number of images.
"""

import json
import sys
from collections import Counter, deque
from collections.abc import Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ntop.conventions import ConfigError, DataError
from ntop.storage import schemas
from ntop.storage.files import Damage, find_damage, read_records
from ntop.storage.manifest import MANIFEST_NAME
from ntop.storage.remedies import FILES_NAME, output_of
from ntop.storage.renders import IMAGE_FOLDERS
from ntop.storage.shards import ARCHIVE_NAME
from ntop.storage.tables import Row, completed, read_table

EXIT_DAMAGED = 1
FILES_PER_TASK = 512
TASKS_AHEAD = 4  # per process: enough that none waits, few enough to be held in memory
SHOWN = 20  # problems that are named one by one
SHARDS, DATASETS = "5_render", "7_assemble"  # folders of stages in a run's results
COCO_NAMES = ("person_keypoints", "person_smpl24")
IMAGE_COLUMNS = ["split", "persons.list.element.person_id"]


@dataclass
class Findings:
    """What was looked at and what was wrong with it."""

    num_files: int = 0
    num_bytes: int = 0
    problems: list[str] = field(default_factory=list)  # the first SHOWN of them
    num_problems: int = 0
    again: dict[Path, None] = field(default_factory=dict)  # outputs to make again, in order

    def add(self, problem: str, *, output: Path) -> None:
        """Note a problem and the output that has to be made again because of it."""
        self.num_problems += 1
        if len(self.problems) < SHOWN:
            self.problems.append(problem)
        self.again[output] = None


def main(dataset: Path | None = None, results: Path | None = None, processes: int = 2) -> int:
    """Compare every file with the size and SHA-256 that were recorded when it was written.

    Give a `dataset` folder (`results/7_assemble/NAME`, or a copy of it anywhere), the `results`
    folder of a run (all stages and datasets in it), or both. Of a dataset the COCO files and the
    manifest must also agree in their numbers of images and persons. The exit code is 1 if anything
    is damaged or missing; what it is and how to have it made again is printed. Reads only.

    Raises:
        ConfigError: neither is given, or fewer than one process.
        DataError: the folder is no dataset, or holds no results.
    """
    if (dataset is None and results is None) or processes < 1:
        raise ConfigError("give --dataset FOLDER or --results FOLDER, and --processes 1 or more")
    folders = [] if dataset is None else [dataset]
    if results is not None:
        folders += [path for path in recorded_folders(results) if path not in folders]
    findings = Findings()
    # fresh interpreters: a fork would copy the threads' locks of Arrow, perhaps while they are held
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for folder in folders:
            check_folder(folder, pool, ahead=TASKS_AHEAD * processes, findings=findings)
    for folder in folders:
        if folder == dataset or (folder / MANIFEST_NAME).exists():
            check_counts(folder, findings)
    if results is not None:
        check_annotations(results, findings)
    sys.stdout.write("\n".join(describe(findings)) + "\n")
    return EXIT_DAMAGED if findings.num_problems else 0


def recorded_folders(results: Path) -> list[Path]:
    """All finished folders below a run's results, by stage.

    Raises:
        DataError: there is none.
    """
    found = sorted(path.parent for path in results.glob(f"[0-9]_*/**/{FILES_NAME}"))
    whole = [folder for folder in found if output_of(folder) == folder]
    if not whole:
        raise DataError(f"{results}: no finished folder of a stage; expected a run's results")
    return whole


def check_folder(
    folder: Path, pool: ProcessPoolExecutor, *, ahead: int, findings: Findings
) -> None:
    """Compare the files of one folder with their record, a few thousand at a time.

    Raises:
        DataError: the folder has no record.
    """
    if not folder.is_dir():
        raise DataError(f"{folder} is not a folder; expected a dataset")
    waiting: deque[Future[list[Damage]]] = deque()
    try:
        for rows in record_batches(folder):
            findings.num_files += len(rows)
            findings.num_bytes += sum(row["num_bytes"] for row in rows)
            waiting.append(pool.submit(find_damages, folder, rows))
            if len(waiting) > ahead:
                note(waiting.popleft().result(), folder, findings)
    except (OSError, pa.ArrowException) as error:
        problem = f"{folder / FILES_NAME} cannot be read: {error}"
        findings.add(problem, output=folder)
    while waiting:
        note(waiting.popleft().result(), folder, findings)


def record_batches(folder: Path) -> Iterator[list[Row]]:
    """The record of a folder in pieces."""
    with pq.ParquetFile(folder / FILES_NAME, page_checksum_verification=True) as table:
        for batch in table.iter_batches(FILES_PER_TASK):
            yield batch.to_pylist()


def find_damages(folder: Path, rows: list[Row]) -> list[Damage]:
    """What is wrong with some files; runs in a process of its own."""
    found = (find_damage(folder, row) for row in rows)
    return [damage for damage in found if damage is not None]


def note(damages: list[Damage], folder: Path, findings: Findings) -> None:
    """Add damaged files of a folder to the findings."""
    for damage in damages:
        findings.add(f"{damage.path} {damage.what}", output=origin(damage.path, folder))


def origin(path: Path, folder: Path) -> Path:
    """The output to make again for a damaged file: in a run, a dataset's pictures are its shards'.

    They are links to the same files, so that assembling again would take the damage along.
    """
    kind, *place = path.relative_to(folder).parts
    if folder.parent.name != DATASETS or kind not in IMAGE_FOLDERS.values():
        return folder
    _split, *sequence, name = place
    renders = (folder.parent.parent / SHARDS).joinpath(*sequence)
    if path.suffix == ".tar":  # all pictures of a shard, and named after it
        shards, source = [renders / path.stem], ARCHIVE_NAME
    else:
        source = f"{kind}/{name}"
        shards = sorted(shard for shard in renders.glob("*") if (shard / source).exists())
    for shard in shards:
        record = read_records(shard).get(source)
        if record is not None and find_damage(shard, record) is not None:
            return shard
    return folder


def check_counts(folder: Path, findings: Findings) -> None:
    """Compare the numbers of images and persons in manifest, COCO files and summary."""
    try:
        images, persons = count_manifest(folder / MANIFEST_NAME)
        told = json.loads((folder / "dataset.json").read_text())["num_images"]
        coco = {
            (name, split): count_coco(folder / "annotations" / f"{name}_{split}.json")
            for name in COCO_NAMES
            for split in sorted(images)
        }
    except (OSError, pa.ArrowException, ValueError, KeyError) as error:
        findings.add(f"{folder}: {error}", output=folder)
        return
    if told != sum(images.values()):
        problem = f"has {sum(images.values())} images, dataset.json says {told}"
        findings.add(f"{folder / MANIFEST_NAME} {problem}", output=folder)
    for (name, split), counted in coco.items():
        expected = (images[split], persons[split])
        if counted != expected:
            problem = (
                f"has {counted[0]} images with {counted[1]} persons, "
                f"the manifest {expected[0]} with {expected[1]}"
            )
            findings.add(f"{folder}/annotations/{name}_{split}.json {problem}", output=folder)


def count_manifest(path: Path) -> tuple[Counter[str], Counter[str]]:
    """Images and persons of each split."""
    images, persons = Counter[str](), Counter[str]()
    with pq.ParquetFile(path, page_checksum_verification=True) as table:
        found = completed(table.schema_arrow.empty_table(), schemas.MANIFEST)
        if found.schema.names != schemas.MANIFEST.names:
            raise ValueError(f"{path.name} has other columns than a manifest")
        for batch in table.iter_batches(columns=IMAGE_COLUMNS):
            for row in batch.to_pylist():
                images[row["split"]] += 1
                persons[row["split"]] += len(row["persons"])
    return images, persons


def count_coco(path: Path) -> tuple[int, int]:
    """Images and annotations of a COCO file of ours: one record per line."""
    counts = [0, 0]
    section = 0
    with path.open("rb") as stream:
        for line in stream:
            if line.startswith(b'"annotations":'):
                section = 1
            counts[section] += line.startswith(b'{"id":')
    return counts[0], counts[1]


def check_annotations(results: Path, findings: Findings) -> None:
    """Read the tables of the annotate stage, which are no folders: their pages have checksums."""
    for path in sorted((results / "6_annotate").rglob("*.parquet")):
        findings.num_files += 1
        findings.num_bytes += path.stat().st_size
        try:
            read_table(path, schema=schemas.KEYPOINTS)
        except DataError as error:
            findings.add(str(error).split(";")[0], output=path)


def describe(findings: Findings) -> list[str]:
    """The findings in words, with the way to mend each."""
    size = f"{findings.num_files} files, {findings.num_bytes / 1e9:.2f} GB"
    if not findings.num_problems:
        return [f"{size}: all as they were written"]
    more = findings.num_problems - len(findings.problems)
    again = " ".join(map(str, findings.again))
    return [
        f"{size}: {findings.num_problems} damaged",
        *(f"  {problem}" for problem in findings.problems),
        *([f"  and {more} more"] if more else []),
        "A copy: copy these files again. Where it was made: run the same command again with",
        f"  --forcerun {again}",
        "added; what else was made from them follows by itself.",
    ]
