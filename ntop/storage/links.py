"""Hard links between results: a dataset costs no second copy of its images."""

import errno
import os
import shutil
from pathlib import Path

from ntop.conventions import DataError

# other device, too many links, links not permitted or not known to the file system
NEEDS_COPY = {errno.EXDEV, errno.EMLINK, errno.EPERM, errno.ENOTSUP, errno.EACCES}


def link_or_copy(source: Path, target: Path) -> None:
    """Make `target` the same file as `source`, or its copy where links are impossible.

    Raises:
        DataError: the source is missing, or the target cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(source, target)
        except OSError as error:
            if error.errno not in NEEDS_COPY:
                raise
            shutil.copyfile(source, target)
    except OSError as error:
        raise DataError(
            f"cannot link or copy {source} to {target}: {error.strerror or error}; "
            "rerun the stage that writes the first, check the free space for the second"
        ) from error
