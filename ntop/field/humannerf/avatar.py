"""The twin's avatar: networks and motion weights of one person, and how far they were trained."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from jaxtyping import Float
from safetensors import SafetensorError

from ntop.conventions import NUM_BETAS, DataError
from ntop.field.avatar import (
    AvatarFiles,
    not_finite,
    not_positive,
    refuse_diverged,
    write_avatar_files,
)
from ntop.field.humannerf.field import ActorField
from ntop.field.humannerf.networks import Architecture, CanonicalField, NonRigidMotion, hann_windows
from ntop.field.humannerf.skeleton import Box

FIELD = "humannerf"
CONVERGED_STEPS = 30_000  # below, a result says more about the time than about the method


@dataclass(frozen=True)
class TrainingRecord:
    """How far the training went, and on what. `loss` names its terms."""

    iterations: int
    planned: int
    loss: str

    @property
    def converged(self) -> bool:
        """Whether results may be taken for the method's."""
        return self.iterations >= CONVERGED_STEPS


@dataclass(frozen=True)
class HumanNerfAvatar:
    """One person as HumanNeRF keeps them.

    `open_bands` is the share of the non-rigid motion's bands in use, None: bones alone.
    """

    architecture: Architecture
    canonical: CanonicalField
    non_rigid: NonRigidMotion
    volume: Float[torch.Tensor, "24 x y z"]
    box: Box
    betas: tuple[float, ...]
    open_bands: float | None
    weight_floor: float
    samples: int
    training: TrainingRecord

    @property
    def step(self) -> int:
        """Iterations done."""
        return self.training.iterations

    def field(self, device: torch.device) -> ActorField:
        """What rays meet, on a device."""
        windows = None
        if self.open_bands is not None:
            windows = hann_windows(self.architecture.non_rigid_bands, self.open_bands).to(device)
        return ActorField(
            volume=self.volume.to(device),
            box=self.box,
            canonical=self.canonical.to(device),
            non_rigid=self.non_rigid.to(device),
            windows=windows,
        )


def save_humannerf(avatar: HumanNerfAvatar, folder: Path, *, write: Any) -> str:
    """Write both files through `write(path, bytes)` and return the arrays' sha256."""
    tensors = {"volume": avatar.volume}
    for name in ("canonical", "non_rigid"):
        network = getattr(avatar, name)
        tensors |= {f"{name}.{key}": value for key, value in network.state_dict().items()}
    content = safetensors.torch.save({k: v.cpu().contiguous() for k, v in tensors.items()})
    header = {
        "field": FIELD,
        "betas": list(avatar.betas),
        "architecture": asdict(avatar.architecture),
        "box_low_m": avatar.box.low.tolist(),
        "box_high_m": avatar.box.high.tolist(),
        "open_bands": avatar.open_bands,
        "weight_floor": avatar.weight_floor,
        "samples": avatar.samples,
        "training": asdict(avatar.training) | {"converged": avatar.training.converged},
    }
    return write_avatar_files(header, content, folder, write=write)


def humannerf_from_files(files: AvatarFiles) -> HumanNerfAvatar:
    """The avatar of files whose header says that they are the twin's.

    Raises:
        DataError: arrays are missing or have the wrong shape, a number is not finite, or the box
            is empty.
    """
    header = files.header
    try:
        tensors = safetensors.torch.load(files.content)
        sizes = dict(header["architecture"])
        sizes["decoder_channels"] = tuple(sizes["decoder_channels"])
        architecture = Architecture(**sizes)
        networks = {}
        for name, kind in (("canonical", CanonicalField), ("non_rigid", NonRigidMotion)):
            networks[name] = kind(architecture)
            prefix = f"{name}."
            networks[name].load_state_dict(
                {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
            )
        record = {k: v for k, v in header["training"].items() if k != "converged"}
        betas = tuple(float(x) for x in header["betas"])
        avatar = HumanNerfAvatar(
            architecture=architecture,
            volume=tensors["volume"],
            box=Box(np.array(header["box_low_m"]), np.array(header["box_high_m"])),
            betas=betas,
            open_bands=header["open_bands"],
            weight_floor=float(header["weight_floor"]),
            samples=int(header["samples"]),
            training=TrainingRecord(**record),
            **networks,
        )
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DataError(f"avatar {files.folder} is damaged: {error}; train it again") from error
    if len(betas) != NUM_BETAS:
        raise DataError(
            f"avatar {files.folder}: {len(betas)} betas, expected {NUM_BETAS}; train it again"
        )
    weights = {name: network.state_dict().values() for name, network in networks.items()}
    weights["volume"] = [avatar.volume]
    bad = {name: sum(map(not_finite, tensors)) for name, tensors in weights.items()}
    bad |= {
        "betas": not_finite(betas),
        "box": not_finite(avatar.box.low) + not_positive(avatar.box.high - avatar.box.low),
        "open_bands": not_finite(avatar.open_bands or 0.0),
        "weight_floor": not_finite(avatar.weight_floor),
    }
    refuse_diverged(files.folder, bad)
    return avatar
