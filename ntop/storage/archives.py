"""Tar shards: the many small files of a shard as one, each read by its place without a scan.

The address of a member is `{tar}:{offset}:{size}`, in bytes of the uncompressed tar, so that three
lines of any language read it. The tar itself is plain POSIX (`tar xf` unpacks it), and its members
`{key}.{kind}.png` are in WebDataset's order: those of one image follow each other.
"""

import re
import tarfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from ntop.conventions import DataError
from ntop.storage.atomic import atomic_path
from ntop.storage.remedies import remedy

ADDRESS = re.compile(r"(?P<archive>.+\.tar):(?P<offset>\d+):(?P<size>\d+)", re.DOTALL)
MODE = 0o644


class Member(NamedTuple):
    """Where a member's bytes lie; `archive` is as written in the address."""

    archive: str
    offset: int
    size: int

    @property
    def address(self) -> str:
        """The member as a path that `read_content` understands."""
        return f"{self.archive}:{self.offset}:{self.size}"


def member_at(path: str) -> Member | None:
    """The member that a path names, None if it names a file of its own."""
    match = ADDRESS.fullmatch(path)
    return Member(match["archive"], int(match["offset"]), int(match["size"])) if match else None


def write_archive(files: Mapping[str, Path], *, path: Path) -> dict[str, Member]:
    """Write files, sorted by member name, as one uncompressed tar; returns their places.

    The same files give the same bytes: no times, owners or permissions of this machine. The
    members' `archive` is the bare file name.

    Raises:
        DataError: a file cannot be read, or the archive not written.
    """
    members = {}
    with (
        atomic_path(path) as temporary,
        tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as archive,
    ):
        for name, source in sorted(files.items()):
            header = tarfile.TarInfo(name)  # time, user and group are 0
            header.size, header.mode = source.stat().st_size, MODE
            members[name] = Member(path.name, archive.offset + tarfile.BLOCKSIZE, header.size)
            with source.open("rb") as stream:
                archive.addfile(header, stream)
    return members


def read_content(path: Path) -> bytes:
    """The bytes of a file, or of a tar's member if `path` is an address.

    Raises:
        OSError: the file cannot be read.
        DataError: the archive ends before its member does.
    """
    member = member_at(str(path))
    if member is None:
        return path.read_bytes()
    with Path(member.archive).open("rb") as stream:
        stream.seek(member.offset)
        content = stream.read(member.size)
    if len(content) != member.size:
        raise DataError(
            f"{member.archive} is cut off: member at byte {member.offset} has {len(content)} of "
            f"{member.size} bytes; {remedy(Path(member.archive))}"
        )
    return content
