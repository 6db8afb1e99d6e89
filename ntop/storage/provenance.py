"""What made a result: versions, configuration, code and inputs, without any clock."""

import hashlib
import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import ntop
from ntop.conventions import DataError
from ntop.storage.atomic import write_bytes

PROVENANCE_NAME = "provenance.json"


def file_sha256(path: Path) -> str:
    """SHA-256 of a file's content.

    Raises:
        DataError: the file cannot be read.
    """
    try:
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        raise DataError(f"cannot read {path}: {error.strerror or error}") from error


@lru_cache(maxsize=1)
def code_sha256() -> str:
    """SHA-256 over the sources of the installed `ntop` package: names and contents, sorted."""
    root = Path(ntop.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(root).as_posix()} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def json_sha256(values: Any) -> str:
    """SHA-256 of a value's canonical JSON."""
    return hashlib.sha256(canonical_json(values).encode()).hexdigest()


def canonical_json(values: Any) -> str:
    """Compact JSON with sorted keys; floats keep all their digits, NaN is refused.

    Raises:
        ValueError: a value is NaN or infinite, which JSON cannot hold.
    """
    return json.dumps(values, sort_keys=True, separators=(",", ":"), allow_nan=False)


def provenance(*, stage: str, version: int, config: Any, inputs: dict[str, str]) -> dict[str, Any]:
    """The record of one job; `inputs` maps a name to the SHA-256 of what was read."""
    return {
        "ntop_version": ntop.__version__,
        "stage": stage,
        "stage_version": version,
        "config": config,
        "config_sha256": json_sha256(config),
        "code_sha256": code_sha256(),
        "inputs": inputs,
    }


def write_provenance(record: dict[str, Any], *, folder: Path) -> None:
    """Write a record as `provenance.json` into a result folder."""
    text = json.dumps(record, indent=1, sort_keys=True, allow_nan=False) + "\n"
    write_bytes(folder / PROVENANCE_NAME, text.encode())
