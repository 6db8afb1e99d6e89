"""Write the page and the JSON schema of all configuration keys from the models themselves.

Run it after changing `ntop/config/`; a test fails while they differ from the models. Editors read
the schema through the first line of the YAML files.
"""

import json
import types
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from ntop.config.tables import Actor, Sequence
from ntop.config.whole import Config

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "config/README.md"
SCHEMA = ROOT / "workflow/schemas/config.schema.json"

INTRODUCTION = """# Configuration

`config/config.yaml` is the demo; `--configfile config/other.yaml` is merged over it. Facts of the
experiment stand here; threads, memory and folders belong to `profiles/`. Unknown keys are errors.
This page is written by `scripts/write_config_reference.py` from the models in `ntop/config/`.

A source may change any value of the sections `mask`, `fit`, `train` and `render` for itself below
`sources.<name>.overrides`, for example `overrides: {mask: {method: background}}`.
"""


def reference() -> str:
    """The whole page."""
    parts = [INTRODUCTION, _tables(Config, "", "Keys of the YAML files")]
    parts.append(_tables(Sequence, "", "Columns of the sequences table (TSV, `-` = default)"))
    parts.append(_tables(Actor, "", "Columns of the actors table (TSV)"))
    return "\n".join(parts)


def schema() -> str:
    """The JSON schema; no key is required, as a configuration file may be merged over another."""
    values = Config.model_json_schema()
    for section in (values, *values["$defs"].values()):
        section.pop("required", None)
    return json.dumps(values, indent=1) + "\n"


def _tables(model: type[BaseModel], prefix: str, title: str) -> str:
    lines = [f"## {title}", "", "| key | type | default | meaning |", "|---|---|---|---|"]
    lines += _rows(model, prefix)
    return "\n".join(lines) + "\n"


def _rows(model: type[BaseModel], prefix: str) -> list[str]:
    rows = []
    for name, field in model.model_fields.items():
        key = f"{prefix}{name}"
        sections = _sections(field.annotation)
        if sections:
            for section, suffix in sections:
                rows += _rows(section, f"{key}{suffix}.")
            continue
        cells = [f"`{key}`", _type(field.annotation), _default(field), field.description or ""]
        rows.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return rows


def _sections(annotation: Any) -> list[tuple[type[BaseModel], str]]:
    """The sections below a key, each with what stands between the key and its own keys."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [(annotation, "")]
    origin = get_origin(annotation)
    if origin is Annotated:
        return _sections(get_args(annotation)[0])
    if origin in {Union, types.UnionType}:
        found = [pair for member in get_args(annotation) for pair in _sections(member)]
        return [(kind, f" ({_reader_of(kind)})") for kind, _ in found]
    if origin is dict:
        return [(kind, f".<name>{suffix}") for kind, suffix in _sections(get_args(annotation)[1])]
    return []


def _reader_of(kind: type[BaseModel]) -> str:
    return get_args(kind.model_fields["reader"].annotation)[0]


def _type(annotation: Any) -> str:
    origin = get_origin(annotation)
    if origin is Literal:
        return " or ".join(f"`{value}`" for value in get_args(annotation))
    if origin is tuple:
        return f"list of {_type(get_args(annotation)[0])}"
    if origin in {Union, types.UnionType}:
        return " or ".join(_type(a) for a in get_args(annotation) if a is not type(None))
    return "mapping" if origin is dict else getattr(annotation, "__name__", str(annotation))


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.get_default(call_default_factory=True)
    return "" if value in (None, "", (), {}) else f"`{value}`"


if __name__ == "__main__":
    PAGE.write_text(reference())
    SCHEMA.parent.mkdir(exist_ok=True)
    SCHEMA.write_text(schema())
