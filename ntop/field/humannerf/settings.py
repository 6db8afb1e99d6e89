"""What the twin's training is told."""

from dataclasses import dataclass, field

from ntop.field.humannerf.networks import Architecture


@dataclass(frozen=True)
class HumanNerfSettings:
    """The paper's settings; NToP trains 100,000 steps.

    `non_rigid_steps`: the non-rigid motion joins at the first and has all its bands at the second.
    Patches overlap the person with probability `inside_share`. The curve has a line every
    `record_every` steps, and a watched PSNR every `watch_every`.
    """

    steps: int = 100_000
    patches: int = 6
    patch_px: int = 32
    samples: int = 128
    seed: int = 0
    canonical_rate: float = 5e-4
    other_rate: float = 5e-5
    non_rigid_steps: tuple[int, int] = (10_000, 50_000)
    mse_weight: float = 0.2
    perceptual_weight: float = 1.0
    inside_share: float = 0.8
    weight_floor: float = 1e-4
    record_every: int = 10
    watch_every: int = 250
    architecture: Architecture = field(default_factory=Architecture)
