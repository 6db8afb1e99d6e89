"""What all sections share: frozen, no unknown keys, errors in words."""

from pydantic import BaseModel, ConfigDict, ValidationError

# keys of earlier versions -> what to write instead
RETIRED_KEYS = {
    "heights_above_pelvis_m": "use render.rigs.<name>.height_above_pelvis_m",
    "frame_step": "use the column `step` of the sequences table",
    "splits": "use the column `split` of the actors table",
}


class Section(BaseModel):
    """Base of all sections: frozen, and a misspelt key is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


def explain(error: ValidationError, what: str) -> str:
    """A validation error in words: where, got, expected, remedy."""
    lines = [f"the {what} is not usable:"]
    for item in error.errors():
        place = ".".join(str(part) for part in item["loc"])
        key = str(item["loc"][-1]) if item["loc"] else ""
        if item["type"] == "extra_forbidden":
            hint = RETIRED_KEYS.get(key, "check the spelling; config/README.md lists all keys")
            lines.append(f"  {place}: unknown key; {hint}")
        else:
            lines.append(f"  {place}: {item['msg']}, got {item.get('input')!r}")
    return "\n".join(lines)
