"""Configuration files as Snakemake reads them: YAML, later files merged over earlier ones."""

from pathlib import Path
from typing import Any

import yaml

from ntop.conventions import ConfigError


def read_files(paths: list[Path]) -> dict[str, Any]:
    """The files' values, each file merged over those before it.

    Raises:
        ConfigError: a file is missing, is not YAML, or holds no keys.
    """
    merged: dict[str, Any] = {}
    for path in paths:
        try:
            values = yaml.safe_load(path.read_text())
        except OSError as error:
            raise ConfigError(f"cannot read configuration {path}: {error.strerror}") from error
        except yaml.YAMLError as error:
            raise ConfigError(f"configuration {path} is not YAML: {error}") from error
        if not isinstance(values, dict):
            raise ConfigError(f"configuration {path}: expected keys and values, got {values!r}")
        merged = merge(merged, values)
    return merged


def merge(base: dict[str, Any], over: dict[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`; mappings merge key by key, all else is replaced."""
    merged = dict(base)
    for key, value in over.items():
        before = merged.get(key)
        if isinstance(value, dict):
            value = merge(before if isinstance(before, dict) else {}, value)
        merged[key] = value
    return merged
