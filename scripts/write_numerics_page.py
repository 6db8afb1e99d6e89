"""Write docs/numerics.md: case number -> test -> measured margins, from a run of tests/numerics.

pytest tests/numerics --junitxml=FILE && python scripts/write_numerics_page.py FILE
"""

import json
import re
import sys
from pathlib import Path
from xml.etree import ElementTree

PAGE = Path(__file__).parents[1] / "docs/numerics.md"
MARK = "<!-- cases -->"


def main(results: Path) -> None:
    """Replace what follows the mark in the page."""
    rows: dict[tuple[int, str], list[dict]] = {}
    for case in ElementTree.parse(results).iter("testcase"):
        found = re.match(r"test_(\d+)_", case.get("name", ""))
        if found is None:
            continue
        if case.find("failure") is not None or case.find("error") is not None:
            sys.exit(f"{case.get('name')} failed; the page is written from passing runs only")
        where = f"{case.get('classname', '').replace('.', '/')}.py::{case.get('name')}"
        margins = rows.setdefault((int(found[1]), where.split("[")[0]), [])
        for item in case.iter("property"):
            if item.get("name") == "margin":
                margins.append(json.loads(item.get("value", "")))
    lines = ["", "| case | test | quantity | measured | limit |", "|---:|---|---|---:|---:|"]
    for (number, where), margins in sorted(rows.items()):
        for margin in worst(margins) or [None]:
            lines.append(line(number, where, margin))
    head = PAGE.read_text().split(MARK)[0]
    PAGE.write_text(head + MARK + "\n" + "\n".join(lines) + "\n")


def worst(margins: list[dict]) -> list[dict]:
    """Of parametrised repetitions of one quantity, the one nearest to its limit."""
    nearest: dict[tuple[str, str], dict] = {}
    for margin in margins:
        key = (margin["what"], margin["relation"])
        if key not in nearest or closeness(margin) > closeness(nearest[key]):
            nearest[key] = margin
    return list(nearest.values())


def closeness(margin: dict) -> float:
    """How near a quantity is to its limit, growing towards it."""
    ratio = margin["measured"] / margin["limit"] if margin["limit"] else margin["measured"]
    return ratio if margin["relation"] == "at most" else -ratio


def line(number: int, where: str, margin: dict | None) -> str:
    """A row of the page's table."""
    file, test = where.removeprefix("tests/numerics/").split("::")
    if margin is None:
        return f"| {number} | `{file}` `{test}` | exact or raises | | |"
    unit = f" {margin['unit']}" if margin["unit"] else ""
    measured, limit = f"{margin['measured']:.2g}{unit}", f"{margin['limit']:.2g}{unit}"
    what = margin["what"].replace("|", "\\|")
    return f"| {number} | `{file}` `{test}` | {what} | {measured} | {margin['relation']} {limit} |"


if __name__ == "__main__":
    main(Path(sys.argv[1]))
