"""`ntop lens`: what a lens sees; OpenCV's camera files to and from configuration and datasets."""

import math
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import yaml
from pydantic import ValidationError

from ntop.config.base import explain
from ntop.config.rigs import configured_rig
from ntop.config.run import load_files
from ntop.config.sections import ImageConfig, RigConfig
from ntop.conventions import ConfigError, DataError
from ntop.geometry.cameras import Lens
from ntop.geometry.fields_of_view import field_of_view, pixels_per_radian
from ntop.geometry.fisheyes import Fisheye
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.monotone import monotone_limit
from ntop.geometry.opencv import fisheye_polynomial
from ntop.geometry.pinhole import Pinhole
from ntop.storage import schemas
from ntop.storage.cameras import read_cameras
from ntop.storage.opencv import read_opencv_lens, write_opencv_lens
from ntop.storage.renders import LENS_KEYS, row_lens
from ntop.storage.tables import read_columns

TABLES = {"manifest.parquet": schemas.MANIFEST, "renders.parquet": schemas.RENDER}
CAMERAS_NAME = "cameras.parquet"
ANYWHERE = RigConfig(height_above_pelvis_m=1.0, ring_radius_m=0.0)  # a lens has no place
LAST_DIGIT_DEG = 1e-6


def main(
    configfile: list[Path] | None = None,
    directory: Path = Path(),
    opencv: Path | None = None,
    max_theta_deg: float | None = None,
    folder: Path | None = None,
    view: str = "",
    out: Path | None = None,
) -> None:
    """Show a lens as a fragment of configuration, and write it as OpenCV's camera file `out`.

    The lens is the configuration's own (`configfile` and `directory` as for Snakemake), that of
    `opencv` (a file of OpenCV's calibration: YAML, XML or JSON), or those of `folder`: a dataset
    (7_assemble), a rendered shard (5_render), or an actor's real cameras (1_capture, 3_fit);
    `view` picks one, as `e` or `ACTION/VIEW`. A calibration does not say how far off the axis it
    holds: give `max_theta_deg`; without it the lens reaches to 170 degrees or to where its
    polynomial folds.

    What is printed may follow another `--configfile` as it is: only the section `render.image`
    is no comment. `out` ends in .yaml, .yml, .xml or .json; fisheyes become k1..k4 of cv2.fisheye,
    exactly if they are equidistant or kannala_brandt, else within 0.1 px.

    Raises:
        ConfigError: two lenses are asked for at once, or the configuration cannot be used.
        DataError: the file or folder holds no lens that can be used, or several for one `out`.
    """
    if opencv is not None and folder is not None:
        raise ConfigError("--opencv FILE and --folder FOLDER: give one of them")
    if opencv is None and max_theta_deg is not None:
        raise ConfigError("--max-theta-deg belongs to --opencv FILE; other lenses say how far")
    if folder is None and view:
        raise ConfigError("--view NAME belongs to --folder FOLDER")
    if opencv is not None:
        found = {calibrated(opencv, max_theta_deg): str(opencv)}
    elif folder is not None:
        found = lenses_of(folder, view=view)
    else:
        run = load_files(configfile or [], directory=directory)
        found = {configured_rig(ANYWHERE, run.config.render.image).lens(): "the configuration"}
    for lens, where in found.items():
        sys.stdout.write(described(lens, where))
    if len(found) == 1 and not isinstance(lens, Pinhole):
        if opencv is not None and max_theta_deg is None:
            sys.stdout.write(
                "# a calibration does not say how far it holds: --max-theta-deg does\n"
            )
        fragment = {"render": {"image": section(lens)}}
        sys.stdout.write(yaml.safe_dump(fragment, sort_keys=False, default_flow_style=None))
    if out is not None:
        if len(found) > 1:
            raise DataError(
                f"{folder}: {len(found)} lenses, {out} can hold one; pick it with --view NAME"
            )
        sys.stdout.write(written(lens, out))


def calibrated(path: Path, max_theta_deg: float | None) -> Lens:
    """The lens of OpenCV's file, up to an angle in degrees where one is given.

    Raises:
        ConfigError: the angle is outside 0 to 180 degrees, or the lens is a pinhole.
        DataError: the file holds no lens that we have.
    """
    if max_theta_deg is None:
        return read_opencv_lens(path)
    if not 0 < max_theta_deg < 180:
        raise ConfigError(f"--max-theta-deg {max_theta_deg:g}: expected more than 0, less than 180")
    lens = read_opencv_lens(path, max_theta=math.radians(max_theta_deg))
    if isinstance(lens, Pinhole):
        raise ConfigError(
            f"{path} is a pinhole: its image says how far it sees, no --max-theta-deg"
        )
    return lens


def lenses_of(folder: Path, *, view: str) -> dict[Lens, str]:
    """The different lenses of a folder's cameras, and how many images or cameras have them.

    Raises:
        DataError: none of the tables is there, it is damaged, empty, or has no such view.
    """
    names = [name for name in (*TABLES, CAMERAS_NAME) if (folder / name).is_file()]
    if not names:
        raise DataError(
            f"{folder}: none of {', '.join(TABLES)}, {CAMERAS_NAME}; give a dataset of 7_assemble, "
            "a shard of 5_render, or an actor's folder of 1_capture or 3_fit"
        )
    path = folder / names[0]
    lenses: dict[str, Counter[Lens]] = {}  # of each view
    if path.name == CAMERAS_NAME:
        for (action, name), camera in read_cameras(path).items():
            lenses[f"{action}/{name}"] = Counter([camera.lens])
    else:
        known: dict[tuple[Any, ...], Lens] = {}  # thousands of rows have one lens
        for row in read_columns(path, [*LENS_KEYS, "view"], schema=TABLES[path.name]):
            numbers = tuple(str(row.get(key)) for key in LENS_KEYS)
            if numbers not in known:
                known[numbers] = row_lens(row)
            lenses.setdefault(row["view"], Counter())[known[numbers]] += 1
    if not lenses or (view and view not in lenses):
        raise DataError(f"{path}: no view {view!r}; it has {', '.join(lenses) or 'none at all'}")
    what = "cameras" if path.name == CAMERAS_NAME else "images"
    found: dict[Lens, str] = {}
    chosen = [view] if view else list(lenses)
    for lens in dict.fromkeys(lens for name in chosen for lens in lenses[name]):
        having = [name for name in chosen if lens in lenses[name]]
        count = sum(lenses[name][lens] for name in having)
        found[lens] = f"{path}: {count} {what}, views {', '.join(having)}"
    return found


def described(lens: Lens, where: str) -> str:
    """What people want to know of a lens, as comments."""
    focal = f"{lens.fx:.2f}" if lens.fx == lens.fy else f"{lens.fx:.2f} x {lens.fy:.2f}"
    view = field_of_view(lens)
    degrees = [math.degrees(angle) for angle in (view.horizontal, view.vertical, view.diagonal)]
    outwards, around = pixels_per_radian(lens, lens.max_theta)
    lines = [
        f"{where}",
        f"  model               {lens.model}",
        f"  image               {lens.width} x {lens.height} px, principal point "
        f"({lens.cx:.2f}, {lens.cy:.2f}), the first pixel's centre at (0.5, 0.5)",
        f"  sees                {math.degrees(lens.max_theta):.2f} degrees off the axis",
        f"  field of view       {degrees[0]:.2f} x {degrees[1]:.2f} degrees, "
        f"{degrees[2]:.2f} across corners",
        f"  pixels per radian   {focal} on the axis; at the rim {outwards:.2f} outwards, "
        f"{around:.2f} around",
    ]
    if isinstance(lens, Pinhole | KannalaBrandt) and any(lens.distortion):
        lines.append(f"  distortion          {', '.join(f'{k:.6g}' for k in lens.distortion)}")
    if isinstance(lens, Pinhole):
        lines.append("  no section follows: virtual cameras are fisheyes")
    return "".join(f"# {line}\n" for line in lines)


def section(lens: Fisheye) -> dict[str, Any]:
    """All values of `render.image` for this lens, checked as the workflow checks them.

    Raises:
        ConfigError: a lens that the configuration refuses.
    """
    values: dict[str, Any] = {
        "width_px": lens.width,
        "height_px": lens.height,
        "lens": lens.model,
        "focal_px": lens.fx,
        "focal_y_px": lens.fy,
        "center_px": [lens.cx, lens.cy],
        "max_theta_deg": _degrees_within(lens),
        "distortion": list(lens.distortion) if isinstance(lens, KannalaBrandt) else [0.0] * 4,
    }
    try:
        ImageConfig.model_validate(values)
    except ValidationError as error:
        raise ConfigError(explain(error, "section render.image")) from error
    return values


def _degrees_within(lens: Fisheye) -> float:
    """`max_theta` in degrees, rounded, but not beyond the fold of a polynomial."""
    degrees = round(math.degrees(lens.max_theta), 6)
    if isinstance(lens, KannalaBrandt) and math.radians(degrees) > monotone_limit(lens.distortion):
        degrees = round(degrees - LAST_DIGIT_DEG, 6)
    return degrees


def written(lens: Lens, path: Path) -> str:
    """Write OpenCV's file; returns what to know of it, as comments.

    Raises:
        DataError: OpenCV has no such lens, or cannot read files of that suffix.
    """
    if isinstance(lens, Pinhole):
        write_opencv_lens(lens, path=path)
        return f"# wrote {path} for cv2.projectPoints\n"
    polynomial, misfit_px = fisheye_polynomial(lens)
    write_opencv_lens(polynomial, path=path)
    within = f"off by at most {misfit_px:.1g} px" if misfit_px else "exact"
    return (
        f"# wrote {path} for cv2.fisheye.projectPoints, right below 90 degrees only: {within}\n"
        f"# it cannot hold how far the lens sees: --max-theta-deg {_degrees_within(lens):g}\n"
    )
