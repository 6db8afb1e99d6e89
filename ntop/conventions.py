"""The conventions every module shares: frames, axes, units, pixel centres, array order.

World
    Right-handed, metres, +z up.
Camera
    OpenCV axes: x right, y down, z along the optical axis. `camera_from_world` maps a world point
    into it: `X_c = R X_w + t`. What is stored is `center_world = -R^T t`; t is derived.
Pixel
    (u, v) = (right, down), continuous. The first pixel's centre lies at (0.5, 0.5) and the image
    spans [0, W] x [0, H]. Arrays are indexed [v, u]. Integer centres exist only at the edge.
Fisheye
    Equidistant: rho = focal * theta, focal in pixels per radian, up to a declared `max_theta`.
Body
    SMPL: `betas` (10), `global_orient` (3), `body_pose` (23 x 3 axis-angle, radians), `transl` (3),
    24 joints. The body frame has y up and faces +z; `global_orient` and `transl` lead to the world.
Depth images
    16-bit, `DEPTH_STEP_M` metres of *ray length* per step, 0 where there is nothing.
Masks
    A pixel belongs to the person where alpha >= `MASK_ALPHA`.
"""

PIXEL_CENTRE = 0.5  # add to an integer-centre coordinate (OpenCV, COCO) to get ours
NUM_JOINTS = 24
NUM_BETAS = 10
DEPTH_STEP_M = 1e-4
MASK_ALPHA = 128  # of 255; thresholding at one half is unbiased in area

VIEWS = ("centre", "e", "ne", "n", "nw", "w", "sw", "s", "se")  # counter-clockwise from +x


class NtopError(Exception):
    """Base of every error that `ntop` raises on purpose; its text is meant for people."""


class ConfigError(NtopError):
    """The configuration is not usable: unknown key, retired key, impossible value."""


class DataError(NtopError):
    """A file or table does not hold what it must: what, where, got, expected, remedy."""
