"""The rows of the actors and sequences tables."""

import csv
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError

from ntop.config.base import Section, explain
from ntop.conventions import ConfigError

Gender = Literal["f", "m", "n"]


class Sequence(Section):
    """One row of the sequences table: a run of frames of one actor, and what it is used for."""

    source: str
    actor: str
    action: str
    first: int = Field(ge=0, description="First frame, 0-based.")
    last: int = Field(ge=0, description="Last frame, included.")
    step: int = Field(default=1, ge=1)
    use: Literal["train", "render"]
    motion: str = Field(
        default="",
        description="Empty: the recorded poses of `action`. Else `authored:<name>` or "
        "`deepmimic:<name>`, sampled at 30 frames per second.",
    )
    truth: bool = Field(
        default=False, description="Studio only: ray-cast the true fisheye views of these sets."
    )

    @property
    def frames(self) -> range:
        """The frames of the sequence."""
        return range(self.first, self.last + 1, self.step)


class Actor(Section):
    """One row of the actors table."""

    source: str
    actor: str
    split: Literal["train", "val"]
    gender: "Gender" = "n"


def read_tsv(path: Path, kind: type[Section]) -> list[Any]:
    """Rows of a tab-separated table as sections; `-` or an empty cell means the default.

    Raises:
        ConfigError: the file is missing, or a row is not usable.
    """
    try:
        with path.open(newline="") as stream:
            rows = list(csv.DictReader(stream, delimiter="\t"))
    except OSError as error:
        raise ConfigError(f"cannot read table {path}: {error.strerror}") from error
    sections = []
    for number, row in enumerate(rows, start=2):
        given = {key: cell for key, cell in row.items() if cell not in {"", "-", None}}
        try:
            sections.append(kind.model_validate(given))
        except ValidationError as error:
            raise ConfigError(explain(error, f"table {path} line {number}")) from error
    return sections
