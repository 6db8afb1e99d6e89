"""What to do about a damaged result: Snakemake looks at names and times only, it has to be told."""

from pathlib import Path

FILES_NAME = "files.parquet"  # the record of a finished folder (ntop.storage.files)


def remedy(path: Path) -> str:
    """How to have a damaged result made again; `path` is in it, or is it."""
    return f"run the same command again with `--forcerun {output_of(path)}` added"


def output_of(path: Path) -> Path:
    """A file's output of a rule: the outermost folder with a record, or the file itself."""
    recorded = [folder for folder in (path, *path.parents) if (folder / FILES_NAME).is_file()]
    return recorded[-1] if recorded else path
