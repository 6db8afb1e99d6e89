"""How a grid is trained, coarse to fine, and what is due at a step: level, rates, march step."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrainingSettings:
    """How an avatar is trained. Lengths in metres; weights are per ray, a prior's per node.

    `voxels_m`, `level_starts` (share of all steps) and `sharpness` are the coarse-to-fine
    schedule: in a level, raw density is `sharpness` times as steep as the body's was at first, and
    the surface that much harder. A rate falls exponentially from the first to the second value.
    `light`: learn light that depends on the surface's direction in the world. `camera_colour`:
    learn a gain and bias per camera. `refine_cameras`, `refine_poses`: learn where cameras and
    people stand (`refining`). `lpips_weight`: of a patch's perceptual distance, beside a ray's mean
    loss (`perceptual`).
    """

    steps: int = 800
    rays_per_batch: int = 8192
    views_per_batch: int = 32
    seed: int = 0
    voxels_m: tuple[float, ...] = (0.016, 0.008, 0.005)
    level_starts: tuple[float, ...] = (0.0, 0.12, 0.4)
    sharpness: tuple[float, ...] = (1.0, 4.0, 16.0)
    outer_m: float = 0.05
    inner_m: float = 0.03
    cell_m: float = 0.012
    min_step_m: float = 0.003
    density_rate: tuple[float, float] = (0.3, 0.03)
    colour_rate: tuple[float, float] = (0.15, 0.015)
    light_rate: tuple[float, float] = (0.01, 0.001)
    light: bool = True
    camera_colour: bool = False
    refine_cameras: bool = False
    refine_poses: bool = False
    lpips_weight: float = 0.0
    matte_weight: float = 1.0
    band_weights: tuple[float, float] = (0.2, 0.5)
    band_px: int = 2
    shares: tuple[float, float] = (0.6, 0.25)
    entropy_weight: float = 0.02
    density_smoothness: float = 3e-5
    colour_smoothness: float = 2e-4
    smooth_all_every: int = 25
    body_weight: float = 0.0
    occupancy_every: int = 100
    occupied_raw: float = -4.0
    watch_every: int = 250
    patience: int = 3
    ray_blocks: int = 4
    checkpoint_every: int = 50


def level_at(step: int, settings: TrainingSettings) -> int:
    """Which of the grid levels a step belongs to."""
    starts = [round(share * settings.steps) for share in settings.level_starts]
    return max(level for level, start in enumerate(starts) if step >= start)


def march_step_m(voxel_m: float, settings: TrainingSettings) -> float:
    """Distance of samples along rays through a grid of this cell size."""
    return max(settings.min_step_m, 0.5 * voxel_m)


def decayed(rate: tuple[float, float], share: float) -> float:
    """A rate after a share of all steps, on its exponential way from the first to the second."""
    return rate[0] * (rate[1] / rate[0]) ** share
