"""The fisheye lenses of virtual cameras, by the names that configurations and tables use."""

from ntop.conventions import DataError
from ntop.geometry.guards import require_lens
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt

Fisheye = Equidistant | Equisolid | Stereographic | KannalaBrandt


def fisheye_lens(
    model: str,
    *,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    max_theta: float,
    distortion: tuple[float, ...] = (),
) -> Fisheye:
    """The lens of a model's name; `distortion` (k1..k4) is Kannala-Brandt's alone.

    Raises:
        DataError: no such model, or parameters that it cannot have.
    """
    require_lens(model, focal=(fx, fy), center=(cx, cy), size=(width, height))
    place = {"cx": cx, "cy": cy, "width": width, "height": height, "max_theta": max_theta}
    if model == KannalaBrandt.model:
        return KannalaBrandt(fx, fy, distortion=tuple(distortion) or (0.0,) * 4, **place)
    if any(distortion):
        raise DataError(
            f"{model} lens with distortion {distortion}: only {KannalaBrandt.model} has one"
        )
    match model:
        case Equidistant.model:
            return Equidistant(fx, aspect=fy / fx, **place)
        case Equisolid.model:
            return Equisolid(fx, aspect=fy / fx, **place)
        case Stereographic.model:
            return Stereographic(fx, aspect=fy / fx, **place)
    known = [lens.model for lens in (Equidistant, Equisolid, Stereographic, KannalaBrandt)]
    raise DataError(f"no fisheye model {model!r}, have {known}; was it written by a newer version?")
