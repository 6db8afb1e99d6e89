"""The three networks: canonical colour and density, non-rigid offsets, motion weights."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

POSE_NUMBERS = 69  # axis-angles of all joints but the root
DENSITY_SHIFT = -1.0  # of the raw density: nearly empty, but with a gradient, at the start
LEAK = 0.2
LAST_VOLUME_SCALE = 0.1
LAST_LAYER_SCALE = 1e-5  # non-rigid offsets start at a hundredth of a millimetre


@dataclass(frozen=True)
class Architecture:
    """Sizes of the networks; the defaults are the paper's, `decoder_channels` are ours.

    A skip joins the encoded position to the features before layer `depth // 2`, counted from 0. The
    volume's side is two to the number of `decoder_channels`.
    """

    canonical_width: int = 256
    canonical_depth: int = 8
    canonical_bands: int = 10
    non_rigid_width: int = 128
    non_rigid_depth: int = 6
    non_rigid_bands: int = 6
    latent: int = 256
    decoder_channels: tuple[int, ...] = (1024, 128, 128, 64, 64)

    @property
    def volume_side(self) -> int:
        """Nodes of the motion-weight volume along each axis."""
        return 2 ** len(self.decoder_channels)


def encoded(
    points: Float[Tensor, "point 3"], windows: Float[Tensor, " band"]
) -> Float[Tensor, "point coordinate"]:
    """Positions with sines and cosines of doubling frequency (1 rad/m first), band by band.

    Must stay float32: half precision is off by 0.8 rad at the tenth band.
    """
    scales = 2.0 ** torch.arange(len(windows), device=points.device)
    phases = (points[:, None, :] * scales[:, None]).flatten(1)
    weights = windows.repeat_interleave(3)
    return torch.cat([points, weights * torch.sin(phases), weights * torch.cos(phases)], 1)


def hann_windows(bands: int, share: float) -> Float[Tensor, " band"]:
    """Weights of the frequency bands when `share` of them (0..1) are open, the lowest first.

    The truncated Hann window of HumanNeRF's eq. 10: band j rises from 0 to 1 while
    `bands * share` goes from j to j + 1.
    """
    progress = (bands * share - torch.arange(bands, dtype=torch.float32)).clamp(0, 1)
    return (1 - torch.cos(math.pi * progress)) / 2


class Layers(nn.Module):
    """Linear layers with ReLU, the input joined again half-way, and a linear last layer."""

    def __init__(self, *, inputs: int, width: int, depth: int, skip: int, outputs: int) -> None:
        """`inputs` enter layer 0; of those, the first `skip` enter the middle layer again."""
        super().__init__()
        self._skip = skip
        self._middle = depth // 2
        sizes = [inputs] + [width] * (depth - 1)
        sizes[self._middle] += skip
        self.hidden = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.last = nn.Linear(width, outputs)

    def forward(self, values: Float[Tensor, "point input"]) -> Float[Tensor, "point output"]:
        """Raw outputs."""
        found = values
        for index, layer in enumerate(self.hidden):
            if index == self._middle:
                found = torch.cat([found, values[:, : self._skip]], 1)
            found = torch.relu(layer(found))
        return self.last(found)


class CanonicalField(nn.Module):
    """Colour and density of canonical space."""

    def __init__(self, sizes: Architecture) -> None:
        """Random weights."""
        super().__init__()
        inputs = 3 + 6 * sizes.canonical_bands
        self._bands = sizes.canonical_bands
        self.layers = Layers(
            inputs=inputs,
            width=sizes.canonical_width,
            depth=sizes.canonical_depth,
            skip=inputs,
            outputs=4,
        )

    def forward(
        self, points: Float[Tensor, "point 3"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, " point"]]:
        """Colour in [0, 1] and density per metre at canonical positions (metres)."""
        raw = self.layers(encoded(points, points.new_ones(self._bands)))
        return torch.sigmoid(raw[:, :3]), nn.functional.softplus(raw[:, 3] + DENSITY_SHIFT)


class NonRigidMotion(nn.Module):
    """What clothes and flesh add to the bones' motion: an offset in canonical space."""

    def __init__(self, sizes: Architecture) -> None:
        """Random weights, but offsets near zero."""
        super().__init__()
        position = 3 + 6 * sizes.non_rigid_bands
        self.bands = sizes.non_rigid_bands
        self.layers = Layers(
            inputs=position + POSE_NUMBERS,
            width=sizes.non_rigid_width,
            depth=sizes.non_rigid_depth,
            skip=position,
            outputs=3,
        )
        with torch.no_grad():
            self.layers.last.weight.uniform_(-LAST_LAYER_SCALE, LAST_LAYER_SCALE)
            self.layers.last.bias.zero_()

    def forward(
        self,
        points: Float[Tensor, "point 3"],
        pose: Float[Tensor, " 69"],
        windows: Float[Tensor, " band"],
    ) -> Float[Tensor, "point 3"]:
        """Offsets (metres) of canonical positions in a pose."""
        conditions = pose.expand(len(points), -1)
        return self.layers(torch.cat([encoded(points, windows), conditions], 1))


class MotionWeights(nn.Module):
    """A fixed random code, deconvolved to logarithms that correct the Gaussian bones."""

    def __init__(self, sizes: Architecture, channels: int) -> None:
        """`channels`: bones and background."""
        super().__init__()
        first, *_ = widths = sizes.decoder_channels
        self.register_buffer("code", torch.randn(sizes.latent))
        self.spread = nn.Linear(sizes.latent, first)
        pairs = zip(widths, [*widths[1:], channels], strict=True)
        self.up = nn.ModuleList(
            nn.ConvTranspose3d(a, b, kernel_size=4, stride=2, padding=1) for a, b in pairs
        )
        with torch.no_grad():  # the weights start as the priors, nearly
            self.up[-1].weight.mul_(LAST_VOLUME_SCALE)
            self.up[-1].bias.zero_()

    def forward(self, log_priors: Float[Tensor, "channel x y z"]) -> Float[Tensor, "channel x y z"]:
        """Weights of bones and background at the nodes of the canonical box; they sum to one."""
        found = nn.functional.leaky_relu(self.spread(self.code), LEAK)[None, :, None, None, None]
        for index, layer in enumerate(self.up):
            found = layer(found)
            if index + 1 < len(self.up):
                found = nn.functional.leaky_relu(found, LEAK)
        return torch.softmax(log_priors + found[0], 0)


def new_networks(sizes: Architecture, *, channels: int, seed: int) -> nn.ModuleDict:
    """All three with their first weights, which depend on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return nn.ModuleDict(
            {
                "canonical": CanonicalField(sizes),
                "non_rigid": NonRigidMotion(sizes),
                "motion": MotionWeights(sizes, channels),
            }
        )
