"""A campaign's results without running it: those of one executed shard under every shard's name.

For machines on which executing 570 thousand images would take too long: assemble, evaluate and
check then read as many rows and files as after a real run.
"""

import shutil
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from ntop.config.files import read_files
from ntop.config.plan import planned_jobs
from ntop.config.run import BASE, load_run
from ntop.storage.files import FILES_NAME, record_files
from ntop.storage.keys import SetKey


def clone(folder: Path, executed: Path) -> None:
    """Fill the results of the campaign in `folder` from an `executed` one of the same frames."""
    configuration = read_files([folder / BASE]) | {"plan": "plan.json"}
    run = load_run(configuration, directory=folder)
    original = next(iter(sorted((executed / "results/5_render").glob("*/*/*/*/*"))))
    source, actor, action, _rig, _first = original.relative_to(executed / "results/5_render").parts
    for job in planned_jobs(run):
        if job.stage in {"assemble", "evaluate"}:
            continue
        key = job.key.split("/")
        names = {"source": key[0], "actor": key[1]}
        if job.frames:
            names["action"] = key[2]
            place = "/".join((source, actor, action, *key[3:]))
        else:
            place = f"{source}/{actor}"
        old = executed / job.output.replace(job.key, place)
        new = folder / job.output
        if old.is_dir():
            clone_folder(old, new, names)
        else:
            renders = pq.read_table(folder / "results/5_render" / job.key / "renders.parquet")
            table = pq.read_table(old)
            persons = of_person(table["persons"].combine_chunks(), key[1])
            table = table.set_column(table.schema.get_field_index("persons"), "persons", persons)
            write(table.set_column(0, "sample_id", renders["sample_id"]), new)


def of_person(persons: pa.ListArray, name: str) -> pa.ListArray:
    """The persons of some views under another name."""
    fields = list(persons.values.type)
    columns = [
        pa.array([name] * len(persons.values)) if field.name == "person_id" else column
        for field, column in zip(fields, persons.values.flatten(), strict=True)
    ]
    values = pa.StructArray.from_arrays(columns, fields=fields)
    return pa.ListArray.from_arrays(persons.offsets, values, type=persons.type)


def clone_folder(old: Path, new: Path, names: dict[str, str]) -> None:
    """The folder with other names in its tables; other files are the same ones."""
    for path in sorted(old.rglob("*")):
        target = new / path.relative_to(old)
        if path.is_dir() or path.name == FILES_NAME:
            continue
        target.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".parquet":
            write(renamed(pq.read_table(path), names), target)
        elif path.suffix == ".tar":
            shutil.copyfile(path, target)  # a shard's own bytes and inode
        else:
            target.hardlink_to(path)
    record_files(new)


def renamed(table: pa.Table, names: dict[str, str]) -> pa.Table:
    """The table with other values in these columns, and the ids that follow from them."""
    for name, value in names.items():
        if name in table.schema.names:
            if name == "action" and "rig" not in table.schema.names:
                continue  # of a capture: its own actions stay
            index = table.schema.get_field_index(name)
            table = table.set_column(index, name, pa.array([value] * table.num_rows, pa.string()))
    if "sample_id" in table.schema.names:
        columns = ["source", "actor", "action", "rig", "frame", "view"]
        ids = [
            SetKey(*(row[name] for name in columns[:-1])).sample_id(row["view"])
            for row in table.select(columns).to_pylist()
        ]
        table = table.set_column(0, "sample_id", pa.array(ids))
    return table


def write(table: pa.Table, path: Path) -> None:
    """Write a table as the stages do."""
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path, compression="zstd", write_page_checksum=True)
