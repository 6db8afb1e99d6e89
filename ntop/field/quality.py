"""How exactly rays are marched: every shortcut with its switch, and the presets."""

import math
from dataclasses import dataclass

from ntop.conventions import ConfigError
from ntop.field.marching import MarchRule


@dataclass(frozen=True)
class RenderSettings:
    """How exactly to march; every shortcut can be switched off, and costs at most its bound.

    Args:
        step_m: Largest length of a piece of a ray; faces of voxels cut it as well.
        piece_depth: Largest optical depth of a piece, by its denser end (infinity: any); the less
            light is left on the ray, the deeper it may be.
        stop_transmittance: Light left at which a ray ends (0: never); bounds the colour's error.
        colour_floor: Light up to which pieces of a ray share one colour (0: each has its own).
        intervals: Jump over space that no warp cell covers.
        cells: Jump over octants of cells in which the field is empty.
        extent: How much of an octant is asked whether it is empty; less than 1 may miss density.
        crop: March only pixels that may see the body.
        edge_rays: 4: so many rays more on outlines, half as many on contrasts; 1: one ray through
            every pixel's centre.
        phase: Offset of all pieces, in steps, for the phase-shift self-test.
    """

    step_m: float = 0.003
    piece_depth: float = 1.0
    stop_transmittance: float = 1e-3
    colour_floor: float = 1e-3
    intervals: bool = True
    cells: bool = True
    extent: float = 1.0
    crop: bool = True
    edge_rays: int = 4
    phase: float = 0.5

    def __post_init__(self) -> None:
        """Refuse steps that never reach the end of a ray, and lights that cannot be left.

        Raises:
            ConfigError: a number is out of its range.
        """
        if not 0 < self.step_m < math.inf:
            raise ConfigError(f"render step_m is {self.step_m} m, expected a positive length")
        if not self.piece_depth > 0:
            raise ConfigError(f"render piece_depth is {self.piece_depth}, expected more than 0")
        for name in ("stop_transmittance", "colour_floor", "phase"):
            if not 0 <= getattr(self, name) < 1:
                raise ConfigError(f"render {name} is {getattr(self, name)}, expected 0 <= it < 1")
        if not 0 <= self.extent <= 1:
            raise ConfigError(f"render extent is {self.extent}, expected 0 <= it <= 1")
        if self.edge_rays not in (1, 4):
            raise ConfigError(f"render edge_rays is {self.edge_rays}, expected 1 or 4")

    @property
    def rule(self) -> MarchRule:
        """What of this a march asks for."""
        return MarchRule(
            step_m=self.step_m,
            piece_depth=self.piece_depth,
            stop=self.stop_transmittance,
            colour_floor=self.colour_floor,
            skipping=self.intervals,
        )


# chosen and measured by `make bench`: benchmarks/quadrature.py, docs/benchmarks.md
PRESETS = {
    "draft": RenderSettings(
        step_m=0.008,
        piece_depth=4.0,
        stop_transmittance=1e-2,
        colour_floor=2e-2,
        extent=0.5,
        edge_rays=1,
    ),
    "default": RenderSettings(),
    "reference": RenderSettings(
        step_m=0.0005, piece_depth=0.25, stop_transmittance=1e-5, colour_floor=0.0
    ),
}
