"""Fields that benchmarks keep: made once, and a training that was stopped goes on."""

from collections.abc import Callable
from pathlib import Path

from ntop.field.avatar import HEADER_NAME, Avatar, load_avatar, save_avatar
from ntop.storage.atomic import write_bytes


def kept_field(folder: Path, make: Callable[[Path], Avatar]) -> Avatar:
    """The field in a folder, or a new one that `make` makes; it is given a checkpoint's path."""
    checkpoint = folder / "checkpoint.safetensors"
    if not (folder / HEADER_NAME).exists():
        save_avatar(make(checkpoint), folder, write=write_bytes)
        checkpoint.unlink(missing_ok=True)
    return load_avatar(folder)
