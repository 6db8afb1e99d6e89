"""What a dataset holds, in the shape of the paper's table 2: actors, subjects, subject size."""

from collections.abc import Iterable
from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Tally:
    """Running sums over the images of one group: memory does not grow with their number.

    `actors` are (source, actor, gender); a subject is one rendered human instance.
    """

    actors: frozenset[tuple[str, str, str]] = frozenset()
    images: int = 0
    subjects: int = 0
    width_sum_px: float = 0.0
    height_sum_px: float = 0.0

    def with_image(
        self, actor: tuple[str, str, str], *, sizes_px: Iterable[tuple[float, float]]
    ) -> "Tally":
        """The tally after one more image, in which subjects have these box sizes."""
        sizes = list(sizes_px)
        return replace(
            self,
            actors=self.actors | {actor},
            images=self.images + 1,
            subjects=self.subjects + len(sizes),
            width_sum_px=self.width_sum_px + sum(width for width, _ in sizes),
            height_sum_px=self.height_sum_px + sum(height for _, height in sizes),
        )

    def merged(self, other: "Tally") -> "Tally":
        """The tally of both groups together."""
        return Tally(
            actors=self.actors | other.actors,
            images=self.images + other.images,
            subjects=self.subjects + other.subjects,
            width_sum_px=self.width_sum_px + other.width_sum_px,
            height_sum_px=self.height_sum_px + other.height_sum_px,
        )


@dataclass(frozen=True)
class StatisticsRow:
    """One line of the statistics table; sizes are None where there is no subject."""

    dataset: str
    actors: int
    male: int
    female: int
    images: int
    subjects: int
    mean_width_px: float | None
    mean_height_px: float | None


def statistics_rows(
    tallies: dict[tuple[str, str], Tally], *, dataset: str
) -> tuple[StatisticsRow, ...]:
    """Lines per source and split, then per split, then the total, as the paper orders them.

    `tallies` is keyed by (source, split).
    """
    splits = [split for split in ("train", "val") if any(key[1] == split for key in tallies)]
    lines = [
        _row(f"{source}-{split}", [tallies[source, split]])
        for source in sorted({key[0] for key in tallies})
        for split in splits
        if (source, split) in tallies
    ]
    lines += [
        _row(f"{dataset}-{split}", [tally for key, tally in tallies.items() if key[1] == split])
        for split in splits
    ]
    return (*lines, _row(f"{dataset} total", list(tallies.values())))


def statistics_table(rows: Iterable[StatisticsRow]) -> str:
    """The lines as a Markdown table with the paper's columns."""
    lines = ["| Dataset | Actors | Subjects | Avg. subject size |", "|:--|:--|--:|:-:|"]
    for row in rows:
        known = [f"{row.male}M"] * (row.male > 0) + [f"{row.female}F"] * (row.female > 0)
        actors = f"{row.actors} ({', '.join(known)})" if known else f"{row.actors}"
        size = "-"
        if row.mean_width_px is not None and row.mean_height_px is not None:
            size = f"{row.mean_width_px:.0f}×{row.mean_height_px:.0f}"
        lines.append(f"| {row.dataset} | {actors} | {row.subjects:,} | {size} |")
    return "\n".join(lines)


def _row(name: str, tallies: list[Tally]) -> StatisticsRow:
    total = Tally()
    for tally in tallies:
        total = total.merged(tally)
    genders = [gender for _, _, gender in total.actors]
    some = total.subjects > 0
    return StatisticsRow(
        dataset=name,
        actors=len(total.actors),
        male=genders.count("m"),
        female=genders.count("f"),
        images=total.images,
        subjects=total.subjects,
        mean_width_px=total.width_sum_px / total.subjects if some else None,
        mean_height_px=total.height_sum_px / total.subjects if some else None,
    )
