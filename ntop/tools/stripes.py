"""`ntop stripes`: whether a rendered set has the sampler's stripes."""

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float

from ntop.body.model import BodyModel, load_body_model
from ntop.conventions import PIXEL_CENTRE, ConfigError, DataError
from ntop.field.avatar import ARRAYS_NAME, Avatar, load_avatar
from ntop.field.paper_sampler import paper_steps
from ntop.field.posing import pose_avatar
from ntop.field.quality import RenderSettings
from ntop.metrics.stripes import (
    MAX_AMPLITUDE,
    MAX_PHASE_SHIFT,
    MAX_Z,
    MIN_PIXELS,
    LockIn,
    high_passed,
    lock_in,
)
from ntop.report.capture import pose_of
from ntop.report.stripes import pinhole_at, sampled_views, well_inside
from ntop.storage import schemas
from ntop.storage.images import read_depth, read_rgba
from ntop.storage.keys import SetKey
from ntop.storage.provenance import file_sha256
from ntop.storage.renders import fisheye_camera, set_key
from ntop.storage.tables import Row, read_table

EXIT_STRIPED = 1
TABLES = {"manifest.parquet": schemas.MANIFEST, "renders.parquet": schemas.RENDER}


@dataclass(frozen=True)
class Line:
    """One line of the output; `met` is whether it keeps every limit, `judged` whether any is asked.

    Nothing can be said of fewer than `MIN_PIXELS` pixels well inside the person.
    """

    words: tuple[str, ...]
    met: bool
    judged: bool = True


def main(
    folder: Path,
    avatar: list[Path] | None = None,
    steps_m: list[float] | None = None,
    sets: int = 1,
    body_model: Path | None = None,
) -> int:
    """Look for the sampler's stripes in a rendered shard or an assembled dataset.

    Every image is high-passed and correlated with its own depth in steps: those of `steps_m`
    (default: the renderer's) and those of the paper's sampler, whose length varies with the ray.
    With `avatar` (folders of trained avatars; those that made the images are used) every view is
    also rendered twice, samples half a step apart, through its fisheye and through a pinhole at the
    same place: half the rms difference, and what of it is periodic in the depth.

    `folder` holds a manifest.parquet or a renders.parquet. Looks at `sets` sets of every rig and
    actor, evenly spread (0: all). `body_model`: SMPL file the avatars were trained with, if any.
    Grey levels are of 255. The exit code is 1 where a limit is not kept: image z below 4; phase
    shift at most 0.37 rms, amplitude below 0.1 and z below 4. Views with fewer than 500 pixels
    well inside the person are not judged, which their lines say. Reads only.

    Raises:
        ConfigError: a step that is no positive length, or a negative number of sets.
        DataError: no readable table or images, or none of the avatars made these images.
    """
    if sets < 0:
        raise ConfigError(f"--sets {sets}: expected 1 or more, or 0 for all")
    for step in steps_m or []:
        if not 0 < step < math.inf:
            raise ConfigError(f"--steps-m {step}: expected a positive length in metres")
    rows = rows_of(folder)
    chosen = spread_sets(rows, sets)
    settings = RenderSettings()
    lengths_m = steps_m or [settings.step_m]
    trained = {file_sha256(path / ARRAYS_NAME): load_avatar(path) for path in avatar or []}
    known = {row["avatar_sha256"] for views in chosen.values() for row in views}
    if trained and not known & set(trained):
        raise DataError(
            f"{folder}: rendered from avatars {sorted(sha[:12] for sha in known)}, given are "
            f"{sorted(sha[:12] for sha in trained)}; pass the folders of 4_train that made it"
        )
    model = load_body_model(body_model)
    lines = [Line(("set", "view", "lens", "what", "phase rms", "amplitude", "z", ""), True)]
    for key, views in chosen.items():
        lines += image_lines(key, views, folder=folder, lengths_m=lengths_m)
        found = trained.get(views[0]["avatar_sha256"])
        if found is not None:
            lines += self_test_lines(key, views, avatar=found, model=model, settings=settings)
    show(lines)
    judged = [line for line in lines[1:] if line.judged]
    bad = sum(not line.met for line in judged)
    sys.stdout.write(
        f"{bad} of {len(judged)} measurements exceed a limit: z < {MAX_Z:g}; of the self-test "
        f"also phase rms <= {MAX_PHASE_SHIFT:g} and amplitude < {MAX_AMPLITUDE:g}, of 255\n"
    )
    if len(judged) < len(lines) - 1:
        sys.stdout.write(
            f"{len(lines) - 1 - len(judged)} are not judged: fewer than {MIN_PIXELS} pixels well "
            "inside the person\n"
        )
    return EXIT_STRIPED if bad else 0


def rows_of(folder: Path) -> list[Row]:
    """The rows of a dataset or shard in which somebody is seen.

    Raises:
        DataError: neither table is there, or nobody is seen.
    """
    for name, schema in TABLES.items():
        if (folder / name).is_file():
            rows = read_table(folder / name, schema=schema)
            seen = [row for row in rows if row.get("persons", True)]
            if not seen:
                raise DataError(f"{folder}/{name}: no image shows a person; nothing to look at")
            return seen
    raise DataError(
        f"{folder}: neither of {', '.join(TABLES)}; give a dataset of 7_assemble or a shard of "
        "5_render"
    )


def spread_sets(rows: list[Row], count: int) -> dict[SetKey, list[Row]]:
    """`count` sets of every rig and actor, evenly spread over their order; all for 0."""
    sets: dict[SetKey, list[Row]] = {}
    for row in rows:
        sets.setdefault(set_key(row), []).append(row)
    groups: dict[tuple[str, str, str], list[SetKey]] = {}
    for key in sorted(sets, key=str):
        groups.setdefault((key.source, key.actor, key.rig), []).append(key)
    chosen = []
    for keys in groups.values():
        number = min(count or len(keys), len(keys))
        chosen += [keys[(2 * i + 1) * len(keys) // (2 * number)] for i in range(number)]
    return {key: sets[key] for key in chosen}


def image_lines(
    key: SetKey, views: list[Row], *, folder: Path, lengths_m: list[float]
) -> Iterator[Line]:
    """The stored images, without any reference: only z tells, texture has an amplitude too."""
    for row in views:
        rgba = read_rgba(folder / row["image_path"])
        depth_m = read_depth(folder / row["depth_path"])
        mask = well_inside(rgba[..., 3] >= 255) & (depth_m > 0)
        signal = high_passed(rgba[..., :3] / 255, mask)
        phases = {f"image, {1000 * length:g} mm": depth_m / length for length in lengths_m}
        phases["image, paper's steps"] = paper_phase(row, depth_m, mask)
        for what, phase in phases.items():
            found = lock_in(signal, phase, mask)
            words = _words(key, row["view"], "fisheye", what)
            yield Line((*words, "", *_figures(found)), found.z < MAX_Z, found.judged)


def self_test_lines(
    key: SetKey, views: list[Row], *, avatar: Avatar, model: BodyModel, settings: RenderSettings
) -> Iterator[Line]:
    """Both detectors on the avatar, rendered anew through the row's fisheye and a pinhole."""
    body = body_of(views[0])
    joints = np.array(body["joints3d_world_m"]).reshape(-1, 3)
    posed = pose_avatar(avatar, model, pose_of(body))
    for row in views:
        camera = fisheye_camera(row)
        pinhole = pinhole_at(camera, torch.from_numpy(joints[0]))
        for lens, at in {"fisheye": camera, "pinhole": pinhole}.items():
            views_by = sampled_views(posed, at, joints_world=joints, settings=settings)
            scores = views_by["ours"].scores
            words = _words(key, row["view"], lens, "self-test")
            found = LockIn(scores.amplitude, scores.z, scores.pixels)
            figures = f"{scores.phase_rms:.2f}", *_figures(found)
            yield Line((*words, *figures), scores.met, found.judged)


def body_of(row: Row) -> Row:
    """The columns of the body: of a manifest row's person, or of a render row itself."""
    return row["persons"][0] if "persons" in row else row


def paper_phase(
    row: Row, depth_m: Float[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
) -> Float[np.ndarray, "height width"]:
    """Depth in steps of the paper's sampler; zero outside the mask."""
    camera = fisheye_camera(row)
    joints = np.array(body_of(row)["joints3d_world_m"]).reshape(-1, 3)
    v, u = np.nonzero(mask)
    directions, _ = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    near_m, step_m = paper_steps(camera.center_world.numpy(), directions.numpy(), joints)
    phase = np.zeros(mask.shape)
    phase[mask] = (depth_m[mask] - near_m) / np.where(step_m > 0, step_m, np.inf)
    return phase


def show(lines: list[Line]) -> None:
    """Write an aligned table; a line beyond a limit, or that cannot be judged, says so."""
    columns = zip(*(line.words for line in lines), strict=True)
    widths = [max(map(len, column)) for column in columns]
    for line in lines:
        words = [word.ljust(width) for word, width in zip(line.words, widths, strict=True)]
        words += ["too few"] if not line.judged else [] if line.met else ["STRIPES"]
        sys.stdout.write("  ".join(words).rstrip() + "\n")


def _words(key: SetKey, view: str, lens: str, what: str) -> tuple[str, str, str, str]:
    return f"{key.folder()}/{key.frame}", view, lens, what


def _figures(found: LockIn) -> tuple[str, str, str]:
    return f"{found.amplitude:.3f}", f"{found.z:.1f}", f"{found.pixels} px"
