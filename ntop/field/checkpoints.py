"""The whole state of a training on disk: values, optimiser, step, light, occupancy, curve.

Random numbers depend on the seed and the step's number, so the step stands for the generator.
"""

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Float, Int
from safetensors import SafetensorError

from ntop.conventions import DataError
from ntop.field.canonical import CanonicalGrid, Occupancy


@dataclass(frozen=True)
class Twists:
    """Rigid corrections (rotation in rad, translation in m); the rows are `refining.Refiner`'s.

    `curvature` and `rays` are decayed sums of what the updates saw; nothing is refined: no rows.
    """

    values: Float[np.ndarray, "twist 6"]
    curvature: Float[np.ndarray, "twist 6 6"]
    rays: Float[np.ndarray, " twist"]

    @staticmethod
    def none(count: int) -> "Twists":
        """Nothing moved, nothing seen."""
        return Twists(np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros(count))


@dataclass(frozen=True)
class TrainingState:
    """Everything a step reads and changes. Arrays are changed in place by the optimiser."""

    grid: CanonicalGrid
    first: Float[np.ndarray, "row 4"]
    second: Float[np.ndarray, "row 4"]
    counts: Int[np.ndarray, " slot"]
    occupancy: Occupancy
    light: Float[np.ndarray, "9 3"]
    light_moments: Float[np.ndarray, "2 9 3"]
    gain: Float[np.ndarray, "camera 2 3"]
    gain_moments: Float[np.ndarray, "2 camera 2 3"]
    twists: Twists
    level: int
    step: int
    curve: list[Any]

    @staticmethod
    def fresh(
        *,
        grid: CanonicalGrid,
        occupancy: Occupancy,
        light: np.ndarray,
        gain: np.ndarray,
        num_twists: int = 0,
    ) -> "TrainingState":
        """Step 0, with empty moments."""
        return TrainingState(
            grid=grid,
            first=np.zeros_like(grid.values),
            second=np.zeros_like(grid.values),
            counts=np.zeros(len(grid.positions), np.int64),
            occupancy=occupancy,
            light=light,
            light_moments=np.zeros((2, *light.shape)),
            gain=gain,
            gain_moments=np.zeros((2, *gain.shape)),
            twists=Twists.none(num_twists),
            level=0,
            step=0,
            curve=[],
        )

    def with_grid(self, grid: CanonicalGrid, *, level: int) -> "TrainingState":
        """The same state on another grid; the moments start anew."""
        return replace(
            self,
            grid=grid,
            level=level,
            first=np.zeros_like(grid.values),
            second=np.zeros_like(grid.values),
            counts=np.zeros(len(grid.positions), np.int64),
        )


ARRAYS = ("first", "second", "counts", "light", "light_moments", "gain", "gain_moments")
GRID_ARRAYS = ("values", "bricks", "positions", "origin")
TWIST_ARRAYS = ("values", "curvature", "rays")


def settings_digest(settings: Any) -> str:
    """A name for settings: a checkpoint of other settings must not be continued."""
    text = json.dumps(dataclasses.asdict(settings), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def content_digest(arrays: dict[str, np.ndarray], header: dict[str, Any]) -> str:
    """SHA-256 of all that is saved: the format itself does not notice a changed byte."""
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(arrays[name].data)
    return digest.hexdigest()


def save_checkpoint(state: TrainingState, path: Path, settings: Any) -> None:
    """Write the state (see `write_checkpoint`)."""
    arrays = {name: getattr(state, name) for name in ARRAYS}
    arrays |= {f"grid_{name}": getattr(state.grid, name) for name in GRID_ARRAYS}
    arrays |= {f"twist_{name}": getattr(state.twists, name) for name in TWIST_ARRAYS}
    arrays |= {"occupancy": state.occupancy.cells, "occupancy_origin": state.occupancy.origin}
    # the format stores memory as it lies, whatever the strides
    arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    header = {
        "settings": settings_digest(settings),
        "voxel_m": state.grid.voxel_m,
        "occupancy_spacing_m": state.occupancy.spacing_m,
        "level": state.level,
        "step": state.step,
        "curve": [dataclasses.astuple(line) for line in state.curve],
    }
    write_checkpoint(arrays, header, path)


def write_checkpoint(arrays: dict[str, np.ndarray], header: dict[str, Any], path: Path) -> None:
    """Write arrays and header atomically: a new file beside the old one, then one rename.

    Raises:
        DataError: the folder cannot be written, or the disk is full.
    """
    metadata = {"state": json.dumps(header), "sha256": content_digest(arrays, header)}
    temporary = path.with_name(path.name + ".tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("wb") as stream:
            stream.write(safetensors.numpy.save(arrays, metadata=metadata))
            stream.flush()
            os.fsync(stream.fileno())
        temporary.replace(path)
    except OSError as error:
        if path.parent.is_dir():
            temporary.unlink(missing_ok=True)
        raise DataError(
            f"cannot write checkpoint {path}: {error.strerror or error}; check the folder's "
            "permissions and the free space, then run the same command again"
        ) from error


def load_checkpoint(path: Path, settings: Any, line: type) -> TrainingState | None:
    """The saved state; None where there is none, or it was made with other settings.

    `line` is the type of the curve's entries.

    Raises:
        DataError: the file is damaged.
    """
    found = read_checkpoint(path)
    if found is None or found[1]["settings"] != settings_digest(settings):
        return None
    arrays, header = found
    grid = CanonicalGrid(
        **{name: arrays[f"grid_{name}"] for name in GRID_ARRAYS}, voxel_m=header["voxel_m"]
    )
    return TrainingState(
        grid=grid,
        occupancy=Occupancy(
            arrays["occupancy"], arrays["occupancy_origin"], header["occupancy_spacing_m"]
        ),
        twists=Twists(**{name: arrays[f"twist_{name}"] for name in TWIST_ARRAYS}),
        level=header["level"],
        step=header["step"],
        curve=[line(*values) for values in header["curve"]],
        **{name: arrays[name] for name in ARRAYS},
    )


def read_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]] | None:
    """What `write_checkpoint` wrote; None where there is none.

    Raises:
        DataError: the file is damaged.
    """
    if not path.exists():
        return None
    try:
        with safetensors.safe_open(path, framework="numpy") as stream:
            header = json.loads(stream.metadata()["state"])
            arrays = {name: stream.get_tensor(name) for name in stream.keys()}  # noqa: SIM118
            if content_digest(arrays, header) != stream.metadata()["sha256"]:
                raise ValueError("its content is not what was saved")
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise DataError(
            f"checkpoint {path} is damaged ({error}); delete it, then run the same command again"
        ) from error
    return arrays, header
