"""An avatar on disk: one person's canonical field, loadable without the training code.

`avatar.safetensors` holds the bricks (float16 values: rounding stays below 1/16 grey level) and
the light; `avatar.json` says what they mean, and the hash of the former.
"""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy
from jaxtyping import Float
from safetensors import SafetensorError

from ntop import __version__
from ntop.conventions import NUM_BETAS, DataError
from ntop.field.canonical import CanonicalGrid
from ntop.field.kernels.tables import VOID_RAW

FORMAT = 1
FIELD = "grid"
ARRAYS_NAME = "avatar.safetensors"
HEADER_NAME = "avatar.json"


@dataclass(frozen=True)
class Avatar:
    """One person's canonical field.

    `light` (9, 3): quadratic in the world normal per colour (see `kernels.tables.shade`).
    `reach_m`: how far beyond the body's surface the field may hold density.
    """

    grid: CanonicalGrid
    light: Float[np.ndarray, "9 3"]
    betas: tuple[float, ...]
    reach_m: float
    step: int


@dataclass(frozen=True)
class AvatarFiles:
    """An avatar's two files, of whatever field: the header, and arrays whose hash it names."""

    folder: Path
    header: dict[str, Any]
    content: bytes

    @property
    def field(self) -> str:
        """Which kind of field; headers without one are older than the second kind."""
        return self.header.get("field", FIELD)


def read_avatar_files(folder: Path) -> AvatarFiles:
    """Read and check both files.

    Raises:
        DataError: a file is missing or broken, of another format, or not the one its header names.
    """
    try:
        header = json.loads((folder / HEADER_NAME).read_text())
        content = (folder / ARRAYS_NAME).read_bytes()
    except (OSError, ValueError) as error:
        raise DataError(f"cannot read avatar {folder}: {error}; train it again") from error
    digest = hashlib.sha256(content).hexdigest()
    if header.get("format") != FORMAT or header.get("sha256") != digest:
        raise DataError(
            f"avatar {folder}: format {header.get('format')}, arrays' sha256 {digest[:12]}; "
            f"expected format {FORMAT} and {str(header.get('sha256'))[:12]}; train it again"
        )
    return AvatarFiles(folder, header, content)


def write_avatar_files(header: dict[str, Any], content: bytes, folder: Path, *, write: Any) -> str:
    """Write both files through `write(path, bytes)` and return the arrays' sha256."""
    digest = hashlib.sha256(content).hexdigest()
    full = {"format": FORMAT, "ntop": __version__, "sha256": digest, **header}
    write(folder / ARRAYS_NAME, content)
    write(folder / HEADER_NAME, (json.dumps(full, indent=1) + "\n").encode())
    return digest


def save_avatar(avatar: Avatar, folder: Path, *, write: Any) -> str:
    """Write both files through `write(path, bytes)` and return the arrays' sha256.

    The void brick is left out; values of all others are kept, as training left them.
    """
    grid = avatar.grid
    content = safetensors.numpy.save(
        {
            "values": grid.values[64:].astype(np.float16),
            # safetensors stores memory order
            "positions": np.ascontiguousarray(grid.positions[1:]),
            "light": avatar.light.astype(np.float32),
        }
    )
    header = {
        "field": FIELD,
        "step": avatar.step,
        "betas": list(avatar.betas),
        "reach_m": avatar.reach_m,
        "voxel_m": grid.voxel_m,
        "origin_m": [float(x) for x in grid.origin],
        "bricks": list(grid.bricks.shape),
        "void_raw": VOID_RAW,
    }
    return write_avatar_files(header, content, folder, write=write)


def load_avatar(folder: Path) -> Avatar:
    """Read a grid's avatar; `ntop.field.interface` reads any.

    Raises:
        DataError: a file is missing or broken, of another format or field, or not the one its
            header names.
    """
    files = read_avatar_files(folder)
    if files.field != FIELD:
        raise DataError(
            f"avatar {folder}: field {files.field!r}, expected {FIELD!r}; this needs a grid"
        )
    return grid_from_files(files)


def grid_from_files(files: AvatarFiles) -> Avatar:
    """The avatar of files whose header says that they are a grid's.

    Raises:
        DataError: arrays or header do not fit together, or a number in them is not finite, or a
            length not positive.
    """
    folder, header = files.folder, files.header
    try:
        arrays = safetensors.numpy.load(files.content)
        betas = tuple(float(x) for x in header["betas"])
        positions, stored = arrays["positions"], arrays["values"]
        bricks = np.zeros(header["bricks"], np.int32)
        bricks[tuple(positions.T)] = np.arange(1, len(positions) + 1)
    except (SafetensorError, KeyError, IndexError, ValueError) as error:
        raise DataError(f"avatar {folder} is damaged: {error!r}; train it again") from error
    if len(betas) != NUM_BETAS or stored.shape != (64 * len(positions), 4):
        raise DataError(
            f"avatar {folder}: {len(betas)} betas and values {stored.shape}; expected {NUM_BETAS} "
            f"and {(64 * len(positions), 4)}; train it again"
        )
    _require_finite(folder, header, stored=stored, light=arrays["light"], betas=betas)
    void = np.zeros((64, 4), np.float32)
    void[:, 0] = header["void_raw"]
    grid = CanonicalGrid(
        values=np.concatenate([void, stored.astype(np.float32)]),
        bricks=bricks,
        positions=np.concatenate([np.full((1, 3), -1, np.int32), positions]),
        origin=np.array(header["origin_m"]),
        voxel_m=float(header["voxel_m"]),
    )
    return Avatar(grid, arrays["light"], betas, float(header["reach_m"]), int(header["step"]))


def _require_finite(
    folder: Path,
    header: dict[str, Any],
    *,
    stored: Float[np.ndarray, "row 4"],
    light: Float[np.ndarray, "9 3"],
    betas: tuple[float, ...],
) -> None:
    lengths = np.array([header["voxel_m"], header["reach_m"]], float)
    refuse_diverged(
        folder,
        {
            "values": not_finite(stored),
            "light": not_finite(light),
            "betas": not_finite(betas),
            "origin_m": not_finite(np.array(header["origin_m"], float)),
            "lengths": not_positive(lengths),
        },
    )


def not_finite(values: Any) -> int:
    """How many of some numbers are NaN or infinite."""
    return int((~np.isfinite(np.asarray(values))).sum())


def not_positive(values: Float[np.ndarray, "..."]) -> int:
    """How many of some numbers are not positive, NaN or infinite."""
    return int((~(np.isfinite(values) & (values > 0))).sum())


def refuse_diverged(folder: Path, bad: dict[str, int]) -> None:
    """Refuse an avatar that a diverged training left: one NaN would spread over whole pixels.

    `bad` counts what `not_finite` and `not_positive` found, by the name of what was searched.

    Raises:
        DataError: they found anything.
    """
    if any(bad.values()):
        found = ", ".join(f"{count} in {name}" for name, count in bad.items() if count)
        raise DataError(
            f"avatar {folder}: numbers that are not finite, or lengths that are not positive: "
            f"{found}; its training diverged, train it again"
        )
