"""What a warp grid says of world points, as the renderer looks it up."""

import numpy as np
from jaxtyping import Float

from ntop.field.kernels.tables import canonical_point
from ntop.field.warp import PoseWarp


def ways_back(
    warp: PoseWarp, points_world: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "point 2 3"]:
    """Canonical places of world points by sheet of their cell, NaN where there is none."""
    tables = warp.tables
    found = np.full((len(points_world), 2, 3), np.nan)
    for n, point in enumerate((points_world - warp.origin_world) / warp.cell_m):
        index = np.floor(point).astype(int)
        cell = tables.cells[np.ravel_multi_index(index, tables.dims[0])]
        for sheet in range(2):
            if cell >= 0 and tables.sheets[cell, sheet, 0] >= 0:
                found[n, sheet] = canonical_point(tables, cell, sheet, *(point - index))
    return found
