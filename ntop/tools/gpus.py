"""How many GPUs each job will ask for: read where Snakemake reads it, so that it is said once.

The rules `train` and `render` ask for none. `set-resources` changes that, in a profile or on the
command line; as in Snakemake the command line replaces a profile's lines altogether, and the
profile `profiles/default`, which is always read, wins over the one that is named.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from ntop.conventions import ConfigError

GPU_RULES = ("train", "render")
KEY = "set-resources"
DEFAULT_PROFILE = "profiles/default"


@dataclass(frozen=True)
class Gpus:
    """GPUs that one job of each rule asks for, and where that is said."""

    train: float = 0.0
    render: float = 0.0
    origin: str = "the rules"


def asked_gpus(directory: Path, *, profile: Path | None, words: list[str] | None) -> Gpus:
    """What jobs in `directory` ask for with this `--profile` and these `--set-resources` words.

    Raises:
        ConfigError: a profile cannot be read, or an amount is not a plain number.
    """
    if words:
        return _gpus(words, "--set-resources")
    default = directory / DEFAULT_PROFILE
    for folder in (default if default.is_dir() else None, profile):
        settings = _read(folder) if folder else {}
        if KEY in settings:
            return _gpus(settings[KEY], str(folder))
    return Gpus()


def _read(folder: Path) -> dict[str, Any]:
    path = folder / "config.yaml"
    try:
        return yaml.safe_load(path.read_text()) or {}
    except OSError as error:
        raise ConfigError(
            f"cannot read profile {path}: {error.strerror}; expected a folder such as "
            "profiles/slurm with config.yaml in it"
        ) from error
    except yaml.YAMLError as error:
        raise ConfigError(f"profile {path} is not YAML: {error}") from error


def _gpus(settings: Any, origin: str) -> Gpus:
    asked: dict[str, float] = {}
    for rule, amount in _amounts(settings, origin):
        try:
            asked[rule] = float(amount)
        except (TypeError, ValueError):
            raise ConfigError(
                f"{origin}: {rule} asks for gpu={amount!r}; expected a number here: say "
                f"--set-resources {rule}:gpu=1"
            ) from None
    return Gpus(**{rule: asked.get(rule, 0.0) for rule in GPU_RULES}, origin=origin)


def _amounts(settings: Any, origin: str) -> Iterator[tuple[str, Any]]:
    """Rule and amount of every line about GPUs: `{rule: {gpu: 1}}`, or words `rule:gpu=1`."""
    if isinstance(settings, dict):
        for rule, resources in settings.items():
            if rule in GPU_RULES and isinstance(resources, dict) and "gpu" in resources:
                yield rule, resources["gpu"]
        return
    for word in [settings] if isinstance(settings, str) else settings:
        rule, colon, setting = str(word).partition(":")
        name, equals, amount = setting.partition("=")
        if not (colon and equals):
            raise ConfigError(f"{origin}: {word!r} is no resource; expected render:gpu=1")
        if rule in GPU_RULES and name == "gpu":
            yield rule, amount
