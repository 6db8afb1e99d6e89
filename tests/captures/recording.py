"""A small Qualisys recording: the published calibration at 1/16, with videos of plain grey."""

from pathlib import Path
from typing import NamedTuple

from ntop.config.sources import QualisysSource
from ntop.config.tables import Sequence

VIEWS = ("cam01", "cam02", "cam03", "cam04")
WIDTH, HEIGHT = 68, 120  # the calibrated image at 1/16
BOXED_WIDTH = 64  # of the letter-boxed trial


class Calibrated(NamedTuple):
    """One camera as published: in the file's own terms, and as others read it from that file."""

    axes: tuple[float, ...]  # rows: right, up, backward
    centre_mm: tuple[float, float, float]
    focal_subpixels: tuple[float, float]
    centre_subpixels: tuple[float, float]
    distortion: tuple[float, float, float, float]  # k1, k2, p1, p2
    translation_m: tuple[float, float, float]
    rotation_vector_rad: tuple[float, float, float]


# the Pose2Sim demo's calibration; translation and rotation vector as its users report them
PUBLISHED = {
    "cam_01": Calibrated(
        (0.5536380477336265, 0.8046719867383512, 0.2144479094331626, -0.4345300743838753,
         0.05946489349975602, 0.8986921279821063, 0.7104002579937896, -0.5907342212870501,
         0.3825762057979294),
        (1460.2323709212087, -1909.1590482454608, 1896.5058524092062),
        (107599.671875, 107588.828125), (34110.316406, 60680.792969),
        (-0.046183, 0.139983, 0.000608, 0.00069),
        (0.32110, 0.95633, 2.89071), (1.68828, 1.04832, -0.41956),
    ),
    "cam_02": Calibrated(
        (-0.1966832217091926, 0.979523227309506, -0.043011131806342306, -0.31478107085300017,
         -0.02153908797812718, 0.9489198834051846, 0.9285626460991909, 0.20017570994064315,
         0.3125717476340885),
        (2582.0136248568124, 706.5662881637625, 1690.9818366061595),
        (107118.695313, 107123.023438), (34207.652344, 61646.457031),
        (-0.047847, 0.136786, 0.000972, 0.000291),
        (-0.11153, 0.77662, 3.06755), (1.34976, 1.59638, -1.19833),
    ),
    "cam_03": Calibrated(
        (-0.740641130147863, -0.6704153360235378, -0.044654154988568895, 0.25251118212268814,
         -0.3393170985114385, 0.9061467925015139, -0.6226466246887545, 0.6598539110153292,
         0.4205995683324882),
        (-3216.86586729648, 2231.1786368869416, 2088.19103027083),
        (107622.296875, 107616.632813), (32845.335938, 61120.328125),
        (-0.046705, 0.137622, -0.000542, -0.000517),
        (-0.79348, 0.32284, 4.35351), (0.81097, -2.19721, 1.37603),
    ),
    "cam_04": Calibrated(
        (0.2586331447643361, -0.875095795920923, -0.40904308378315923, 0.49590579729377593,
         -0.24310718522469382, 0.8336524076031634, -0.8289670298870364, -0.4184569804097585,
         0.3710895025551282),
        (-3758.720480260634, -1415.6654017496533, 1881.7941041388026),
        (107215.039063, 107213.070313), (34566.796875, 61697.9375),
        (-0.047633, 0.134667, 0.000277, 0.000199),
        (0.50302, 0.04895, 4.40656), (1.40456, -1.38874, 0.42536),
    ),
}  # fmt: skip


def qca_text(*, width: int = 1088, height: int = 1920, scale: float = 1.0) -> str:
    """A .qca.txt file with the published cameras; `scale` multiplies their focals and centres."""
    cameras = []
    for serial, camera in PUBLISHED.items():
        names = [f"r{row}{column}" for row in (1, 2, 3) for column in (1, 2, 3)] + ["x", "y", "z"]
        values = (*camera.axes, *camera.centre_mm)
        transform = " ".join(f'{n}="{v!r}"' for n, v in zip(names, values, strict=True))
        k1, k2, p1, p2 = camera.distortion
        focal_u, focal_v = (value * scale for value in camera.focal_subpixels)
        centre_u, centre_v = (value * scale for value in camera.centre_subpixels)
        cameras.append(f"""
    <camera active="1" serial="{serial}" viewrotation="0">
      <fov_video bottom="{height - 1}" left="0" right="{width - 1}" top="0"/>
      <transform {transform}/>
      <intrinsic centerPointU="{centre_u!r}" centerPointV="{centre_v!r}"
        focalLengthU="{focal_u!r}" focalLengthV="{focal_v!r}" skew="0.000000"
        radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="0.000000"
        tangentalDistortion1="{p1}" tangentalDistortion2="{p2}"/>
    </camera>""")
    return f"<calibration><cameras>{''.join(cameras)}</cameras></calibration>"


def make_recording(packages: Path, write_video) -> Path:
    """Write a package folder with two trials of four views: 12 frames, and 5 letter-boxed ones."""
    folder = packages / "demo"
    folder.mkdir(parents=True)
    (folder / "Calib.qca.txt").write_text(qca_text(width=WIDTH, height=HEIGHT, scale=1 / 16))
    for view in VIEWS:
        write_video(folder / f"walk/{view}.mp4", num_frames=12, width=WIDTH, height=HEIGHT)
        write_video(folder / f"stand/{view}.mp4", num_frames=5, width=BOXED_WIDTH, height=HEIGHT)
    return packages


def settings(**changes) -> QualisysSource:
    values = {
        "reader": "qualisys",
        "package": "demo",
        "calibration": "Calib.qca.txt",
        "views": VIEWS,
        "trials": {"walk": {"videos": "walk"}, "stand": {"videos": "stand"}},
        "letterbox_sizes_px": [(64, HEIGHT)],
    }
    return QualisysSource.model_validate(values | changes)


def sequence(action: str = "walk", *, last: int = 11, step: int = 1, first: int = 0) -> Sequence:
    return Sequence(
        source="demo", actor="p00", action=action, first=first, last=last, step=step, use="train"
    )
