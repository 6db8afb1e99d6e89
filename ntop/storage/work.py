"""Work folders: what a stopped job leaves behind and its successor continues from.

A work folder belongs to one job at a time (a lock that dies with its holder) and to one recipe:
what another recipe left there is removed, so that old and new results never mix.
"""

import fcntl
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

from ntop.conventions import DataError
from ntop.storage.atomic import write_bytes
from ntop.storage.provenance import canonical_json

EXIT_TERMINATED = 143  # 128 + SIGTERM: what a shell reports for a terminated process
LOCK_NAME, RECIPE_NAME, CONTENT_NAME = "lock", "recipe.json", "content"


@contextmanager
def work_folder(work: Path, *, recipe: dict[str, Any]) -> Iterator[Path]:
    """The folder in `work` to keep finished pieces in; what the same recipe left is still there.

    `recipe` is all that determines the pieces. The caller removes the pieces once its result is
    published (`clear_work`).

    Raises:
        DataError: another process holds the folder, or it cannot be written or locked.
    """
    try:
        work.mkdir(parents=True, exist_ok=True)
        (work / CONTENT_NAME).mkdir(exist_ok=True)
        lock = (work / LOCK_NAME).open("w")
    except OSError as error:
        raise DataError(
            f"cannot use work folder {work}: {error.strerror or error}; "
            "check its permissions and the free space, then run the same command again"
        ) from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise DataError(
                f"{work} is in use: the same job already runs; wait for it or end it, then run the "
                "same command again"
            ) from error
        except OSError as error:
            raise DataError(
                f"cannot lock {work / LOCK_NAME}: {error.strerror or error}; without locks two "
                "jobs could write here at once: mount the file system with them (Lustre: -o flock) "
                "or make results/work a link to a folder that has them"
            ) from error
        content, recipe_path = work / CONTENT_NAME, work / RECIPE_NAME
        text = canonical_json(recipe).encode()
        if not recipe_path.exists() or recipe_path.read_bytes() != text:
            if content.exists():
                shutil.rmtree(content)
            write_bytes(recipe_path, text)
        content.mkdir(exist_ok=True)
        yield content


def clear_work(work: Path) -> None:
    """Remove the pieces of a published result; the lock stays until the job ends."""
    shutil.rmtree(work / CONTENT_NAME)
    (work / RECIPE_NAME).unlink()


@contextmanager
def termination_flag() -> Iterator[Callable[[], bool]]:
    """A function that says whether SIGTERM has come: the caller stops where it can continue.

    The handler only sets a flag: work is cut at a border, never in the middle of a file.
    """
    came = False

    def note(_number: int, _frame: FrameType | None) -> None:
        nonlocal came
        came = True

    before = signal.signal(signal.SIGTERM, note)
    try:
        yield lambda: came
    finally:
        signal.signal(signal.SIGTERM, before)
