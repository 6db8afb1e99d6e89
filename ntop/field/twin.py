"""Plain torch twins of the hot loops: their specification, slow and obvious, any float type.

A twin walks every sample of every ray, asks nothing about occupancy, and leaves gradients to
autograd; tests compare values and gradients with the kernels'.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ntop.field.kernels.adjoint import MIN_SHADE, ROBUST_WIDTH
from ntop.field.kernels.tables import DENSITY_SCALE, VOID_RAW, GridTables, WarpTables


@dataclass(frozen=True)
class Composite:
    """What a ray sees: premultiplied colour, opacity, and the light that passes."""

    rgb: Float[Tensor, "ray 3"]
    opacity: Float[Tensor, " ray"]
    transmittance: Float[Tensor, " ray"]


def composite(
    optical_depth: Float[Tensor, "ray sample"], colour: Float[Tensor, "ray sample 3"]
) -> Composite:
    """Emission and absorption along rays (Max 1995; NToP eq. 1-2).

    w_i = T_i (1 - exp(-tau_i)) with T_i = exp(-sum of earlier tau): weights and the light that
    passes sum to one. The exclusive sum is a shift, not a difference, which would cancel.
    """
    earlier = torch.cumsum(optical_depth, -1).roll(1, -1).clone()
    earlier[..., 0] = 0
    weights = torch.exp(-earlier) * -torch.expm1(-optical_depth)
    total = optical_depth.sum(-1)
    return Composite((weights[..., None] * colour).sum(-2), -torch.expm1(-total), torch.exp(-total))


@dataclass(frozen=True)
class Samples:
    """Where samples lie: cell number (-1: none) and fractions in it."""

    cells: Int[Tensor, "ray sample"]
    fractions: Float[Tensor, "ray sample 3"]
    usable: Bool[Tensor, "ray sample"]


def place_samples(
    warp: WarpTables,
    origins: Float[Tensor, "ray 3"],
    directions: Float[Tensor, "ray 3"],
    offsets: Float[Tensor, " ray"],
    *,
    step_m: float,
    count: int,
) -> Samples:
    """Samples t = (k + offset) * step of rays through the warp grid of pose 0.

    A sample is usable where the grid has a cell and the cell's octant may hold density.
    """
    t = (torch.arange(count, dtype=origins.dtype) + offsets[:, None]) * step_m
    points = (origins[:, None] + t[..., None] * directions[:, None]) * warp.inverse_cell
    dims = torch.from_numpy(warp.dims[0].astype("int64"))
    index = points.floor().long()
    inside = ((points >= 0) & (index < dims)).all(-1)
    clamped = torch.minimum(index.clamp(min=0), dims - 1)
    flat = (clamped[..., 0] * dims[1] + clamped[..., 1]) * dims[2] + clamped[..., 2]
    cells = torch.from_numpy(warp.cells.astype("int64"))[flat]
    fractions = points - index
    octant = ((fractions >= 0.5).long() * torch.tensor([4, 2, 1])).sum(-1)
    occupancy = torch.from_numpy(warp.occupancy.astype("int64"))[cells.clamp(min=0)]
    usable = inside & (cells >= 0) & (((occupancy >> octant) & 1) == 1)
    return Samples(cells, fractions, usable)


def field_at(
    grid: GridTables,
    values: Float[Tensor, "row 4"],
    warp: WarpTables,
    samples: Samples,
) -> tuple[Float[Tensor, "ray sample 4"], Float[Tensor, "ray sample 3"]]:
    """Raw values of the denser sheet and its unit normal; the void where there is nothing."""
    best = torch.full((*samples.cells.shape, 4), VOID_RAW, dtype=values.dtype)
    normals = torch.zeros(*samples.cells.shape, 3, dtype=values.dtype)
    corners = torch.tensor([[c >> 2, (c >> 1) & 1, c & 1] for c in range(8)])
    nodes = torch.from_numpy(warp.nodes).to(values.dtype)
    sheets = torch.from_numpy(warp.sheets.astype("int64"))[samples.cells.clamp(min=0)]
    weights = _trilinear(samples.fractions, corners)
    for sheet in range(2):
        index = sheets[..., sheet, :]
        exists = samples.usable & (index[..., 0] >= 0)
        record = (weights[..., None] * nodes[index.clamp(min=0)]).sum(-2)
        raw, found = _interpolated(grid, values, record[..., :3], corners)
        better = exists & found & (raw[..., 0] > best[..., 0])
        normal = record[..., 3:] / torch.sqrt((record[..., 3:] ** 2).sum(-1, True) + 1e-12)
        best = torch.where(better[..., None], raw, best)
        normals = torch.where(better[..., None], normal, normals)
    return best, normals


def shade(
    light: Float[Tensor, "9 3"], normals: Float[Tensor, "*batch 3"]
) -> Float[Tensor, "*batch 3"]:
    """Light on a surface: a quadratic in its normal (Ramamoorthi and Hanrahan 2001)."""
    x, y, z = normals.unbind(-1)
    one = torch.ones_like(x)
    basis = [one, x, y, z, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y]
    return (torch.stack(basis, -1) @ light).clamp(min=MIN_SHADE)


def seen_rays(
    raw: Float[Tensor, "ray sample 4"],
    normals: Float[Tensor, "ray sample 3"],
    light: Float[Tensor, "9 3"],
    *,
    step_m: float,
    empty_density: float = 0.0,
) -> Composite:
    """Rays through a field: activate after interpolation, shade, composite.

    Training sees all density; rendering takes off `empty_density` (EMPTY_DENSITY), below which
    space is empty. The rendering kernel's specification is this sum for steps that go to zero.
    """
    occupied = raw[..., 0] > VOID_RAW
    activated = torch.nn.functional.softplus(raw[..., 0]) - empty_density
    density = DENSITY_SCALE * activated.clamp(min=0)
    optical_depth = torch.where(occupied, density * step_m, torch.zeros_like(density))
    return composite(optical_depth, torch.sigmoid(raw[..., 1:]) * shade(light, normals))


@dataclass(frozen=True)
class Photograph:
    """What the photograph says of each ray, and how much it counts."""

    targets: Float[Tensor, "ray 3"]
    mattes: Float[Tensor, " ray"]
    backgrounds: Float[Tensor, "ray 3"]
    colour_weights: Float[Tensor, " ray"]
    matte_weights: Float[Tensor, " ray"]


def ray_losses(
    seen: Composite,
    photograph: Photograph,
    gain: Float[Tensor, "2 3"],
    *,
    entropy_weight: float,
) -> Float[Tensor, " ray"]:
    """Loss of each ray: robust colour over a random background, matte, opacity away from 1/2."""
    mattes = photograph.mattes[:, None]
    colour = seen.rgb * gain[0].exp() + gain[1] * seen.opacity[:, None]
    over = colour + seen.transmittance[:, None] * photograph.backgrounds
    wanted = mattes * photograph.targets + (1 - mattes) * photograph.backgrounds
    robust = torch.sqrt((over - wanted) ** 2 + ROBUST_WIDTH**2) - ROBUST_WIDTH
    matte = (seen.opacity - photograph.mattes) ** 2
    entropy = seen.opacity * (1 - seen.opacity)
    return (
        photograph.colour_weights * robust.sum(-1)
        + photograph.matte_weights * matte
        + entropy_weight * entropy
    )


def _trilinear(
    fractions: Float[Tensor, "*batch 3"], corners: Int[Tensor, "8 3"]
) -> Float[Tensor, "*batch 8"]:
    near = fractions[..., None, :]
    return torch.where(corners == 1, near, 1 - near).prod(-1)


def _interpolated(
    grid: GridTables,
    values: Float[Tensor, "row 4"],
    points: Float[Tensor, "*batch 3"],
    corners: Int[Tensor, "8 3"],
) -> tuple[Float[Tensor, "*batch 4"], Bool[Tensor, "*batch"]]:
    bricks = torch.from_numpy(grid.bricks.astype("int64"))
    nodes = 4 * torch.tensor(bricks.shape)
    position = (points - torch.from_numpy(grid.origin).to(points.dtype)) * grid.inverse_voxel
    index = position.floor().long()
    found = ((position >= 0) & (index + 1 < nodes)).all(-1)
    corner = torch.minimum(index.clamp(min=0)[..., None, :] + corners, nodes - 1)
    slot = bricks[tuple((corner >> 2).unbind(-1))]
    inner = corner & 3
    rows = slot * 64 + (inner[..., 0] << 4) + (inner[..., 1] << 2) + inner[..., 2]
    weights = _trilinear(position - index, corners)
    return (weights[..., None] * values[rows]).sum(-2), found
