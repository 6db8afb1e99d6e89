"""Write a file or a folder so that it is either whole or absent, whatever happens meanwhile."""

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ntop.conventions import DataError


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary name beside `path`; it becomes `path` when the block ends without an error.

    Raises:
        DataError: the folder cannot be made or written to, or the disk is full.
    """
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        raise DataError(
            f"cannot write {path}: {error.strerror or error}; "
            "check the folder's permissions and the free space, then run the same command again"
        ) from error
    finally:
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)


def write_bytes(path: Path, content: bytes) -> None:
    """Write `content` atomically."""
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


@contextmanager
def atomic_folder(target: Path) -> Iterator[Path]:
    """A work folder beside `target`; it becomes `target` when the block ends without an error.

    What a killed run left in the work folder is removed first.

    Raises:
        DataError: the folder cannot be made or published, or the disk is full.
    """
    work = target.with_name(f".{target.name}.partial")
    try:
        if work.exists():
            shutil.rmtree(work)
        work.mkdir(parents=True)
    except OSError as error:
        raise DataError(
            f"cannot make folder {work}: {error.strerror or error}; "
            "check the permissions and the free space"
        ) from error
    try:
        yield work
    except OSError as error:
        raise DataError(
            f"cannot make {target}: {error.filename or work}: {error.strerror or error}; "
            "check the folder's permissions and the free space, then run the same command again"
        ) from error
    publish_folder(work, target)


def publish_folder(work: Path, target: Path) -> None:
    """Make the finished folder `work` become `target` in one rename.

    An older `target` is moved aside first and removed last, so that no moment leaves a mixture.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        old = None
        if target.exists():
            old = target.with_name(f".{target.name}.old")
            if old.exists():  # left by a run that was killed between the two renames
                shutil.rmtree(old)
            target.rename(old)
        work.rename(target)
        if old is not None:
            shutil.rmtree(old)
    except OSError as error:
        raise DataError(
            f"cannot publish {work} as {target}: {error.strerror or error}; "
            "check the folder's permissions, then run the same command again"
        ) from error
