"""The twin's whole state on disk: networks, both Adam moments, step and curve.

Random numbers depend on the seed and the step's number, so the step stands for the generator.
"""

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ntop.field.checkpoints import read_checkpoint, settings_digest, write_checkpoint

MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def save_checkpoint(
    path: Path,
    networks: nn.ModuleDict,
    optimiser: torch.optim.Adam,
    *,
    step: int,
    curve: list[Any],
    recipe: tuple[Any, str],
) -> None:
    """Write the state.

    `recipe`: settings and the loss's name; another recipe's checkpoint is not continued.
    """
    tensors = {f"network.{name}": value for name, value in networks.state_dict().items()}
    for index, values in optimiser.state_dict()["state"].items():
        tensors |= {f"adam.{index}.{name}": values[name] for name in MOMENTS}
    header = {
        "recipe": _digest(recipe),
        "step": step,
        "curve": [dataclasses.astuple(line) for line in curve],
    }
    arrays = {name: value.detach().cpu().contiguous().numpy() for name, value in tensors.items()}
    write_checkpoint(arrays, header, path)


def load_checkpoint(
    path: Path, networks: nn.ModuleDict, optimiser: torch.optim.Adam, *, recipe: tuple[Any, str]
) -> tuple[int, list[Any]] | None:
    """Fill networks and optimiser; returns step and curve, None where there is nothing to go on.

    Raises:
        DataError: the file is damaged.
    """
    found = read_checkpoint(path)
    if found is None or found[1]["recipe"] != _digest(recipe):
        return None
    tensors = {name: torch.from_numpy(array) for name, array in found[0].items()}
    prefix = "network."
    networks.load_state_dict(
        {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    )
    moments: dict[int, dict[str, torch.Tensor]] = {}
    for key, value in tensors.items():
        kind, index, *name = key.split(".")
        if kind == "adam":
            moments.setdefault(int(index), {})[name[0]] = value
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": moments, "param_groups": groups})
    return found[1]["step"], found[1]["curve"]


def _digest(recipe: tuple[Any, str]) -> str:
    settings, loss = recipe
    return f"{settings_digest(settings)} {loss}"
