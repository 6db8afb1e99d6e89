"""Case 42 for cameras: any lens with any numbers, and parameters that no lens can have."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from ntop.conventions import DataError
from ntop.geometry.cameras import Camera
from ntop.geometry.fisheyes import fisheye_lens
from ntop.geometry.ideal_fisheyes import Equidistant, Equisolid, Stereographic
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.monotone import monotone_limit
from ntop.geometry.pinhole import Pinhole
from ntop.geometry.rigs import Rig
from ntop.geometry.windows import cropped, resized
from ntop.report.stripes import pinhole_at
from tests.numerics.lenses import PRECISIONS

numbers = st.floats(allow_nan=True, allow_infinity=True, width=32)


@st.composite
def any_lens(draw):
    """A lens that its constructor accepts."""
    focal = draw(st.floats(1.0, 1e4))
    size = draw(st.integers(1, 4000)), draw(st.integers(1, 4000))
    center = draw(st.floats(-1e3, 5e3)), draw(st.floats(-1e3, 5e3))
    max_theta = draw(st.floats(0.01, 3.1))
    kind = draw(
        st.sampled_from(["kannala_brandt", "pinhole", Equidistant, Equisolid, Stereographic])
    )
    small = st.floats(-0.5, 0.5)
    if kind == "pinhole":
        distortion = tuple(draw(small) for _ in range(2)) + tuple(
            draw(st.floats(-0.01, 0.01)) for _ in range(2)
        )
        return Pinhole(focal, 1.1 * focal, *center, *size, (*distortion, draw(small)))
    if kind == "kannala_brandt":
        k = tuple(draw(small) for _ in range(4))
        limit = min(max_theta, monotone_limit(k))
        return KannalaBrandt(focal, 0.9 * focal, *center, *size, limit, k)
    return kind(focal, *center, *size, max_theta, aspect=draw(st.floats(0.5, 2.0)))


@settings(max_examples=500, deadline=None, derandomize=True)
@given(
    any_lens(),
    st.lists(st.tuples(numbers, numbers, numbers), min_size=1, max_size=6),
    st.sampled_from(PRECISIONS),
)
def test_42_cameras_any_lens_with_any_numbers(lens, values, precision):
    points = torch.tensor(values, dtype=precision)
    for at, call in ((points, lens.project), (points[:, :2], lens.unproject)):
        result, good = call(at)
        assert result.isfinite().all()
        assert not good[~at.isfinite().all(-1)].any()
    rays, valid = lens.unproject(points[:, :2])
    length = (rays.double().norm(dim=-1) - 1).abs().max().item()
    assert length < 8 * torch.finfo(precision).eps
    again, seen = lens.project(rays)
    if precision == torch.float64 and bool((valid & seen).any()):
        pixels = points[:, :2]
        error = (again - pixels)[valid & seen].norm(dim=-1)
        # a ray of unit length has 1e-16 to say where it points
        scale = (lens.max_px_per_rad + pixels[valid & seen].abs().amax(-1)).clamp(min=1)
        assert bool((error <= 1e-13 * scale).all())


@pytest.mark.parametrize(
    "bad",
    [
        {"focal": 0.0},
        {"focal": math.nan},
        {"focal": -3.0},
        {"cx": math.inf},
        {"width": 0},
        {"max_theta": 0.0},
        {"max_theta": math.pi},
        {"max_theta": math.nan},
        {"aspect": 0.0},
    ],
    ids=str,
)
def test_42_cameras_bad_parameters_are_refused(bad):
    good = {"focal": 100.0, "cx": 50.0, "cy": 50.0, "width": 100, "height": 100}
    for kind in (Equidistant, Equisolid, Stereographic):
        with pytest.raises(DataError, match="expected"):
            kind(**{**good, **bad})
    fx = bad.get("focal", 100.0)
    rest = {k: v for k, v in {**good, **bad}.items() if k not in ("focal", "aspect")}
    with pytest.raises(DataError, match="expected"):
        KannalaBrandt(fx=fx, fy=100.0 * bad.get("aspect", 1.0), **rest)
    if "max_theta" not in bad:
        with pytest.raises(DataError, match="expected"):
            Pinhole(fx=fx, fy=100.0 * bad.get("aspect", 1.0), **rest)
    if "aspect" not in bad:  # by name, as tables and rigs ask for them
        place = {**good, "max_theta": 1.5, **bad}
        focal = place.pop("focal")
        for model in ("equidistant", "equisolid", "stereographic", "kannala_brandt"):
            with pytest.raises(DataError, match="expected"):
                fisheye_lens(model, fx=focal, fy=100.0, **place)
    with pytest.raises(DataError, match="finite"):
        Camera(Equidistant(**good), torch.tensor([0.0, math.nan, 0.0]), torch.eye(3))


@pytest.mark.parametrize("size", [(0, 60), (60, 0), (-3, 60)])
def test_42_cameras_windows_without_pixels_are_refused(size):
    width, height = size
    for lens in (Equidistant(100.0, 50.0, 50.0, 100, 100), Pinhole(90.0, 91.0, 50, 50, 100, 100)):
        with pytest.raises(DataError, match="at least one pixel"):
            resized(lens, width=width, height=height)
        with pytest.raises(DataError, match="at least one pixel"):
            cropped(lens, left=0, top=0, width=width, height=height)


@pytest.mark.parametrize("focal", [{"focal_px": 0.0}, {"focal_px": 100.0, "focal_y_px": 0.0}])
def test_42_cameras_rigs_without_a_focal_length_are_refused(focal):
    with pytest.raises(DataError, match="focal > 0"):
        Rig(1.2, 1.0, 100, 100, **focal).lens()


@pytest.mark.parametrize("scale", [0.0, 2.0, -1.0, math.inf])
def test_42_cameras_what_is_no_rotation_is_refused(scale):
    lens = Equidistant(100.0, 50.0, 50.0, 100, 100)
    with pytest.raises(DataError, match="expected"):
        Camera(lens, torch.zeros(3), scale * torch.eye(3))


def test_42_cameras_a_pinhole_that_looks_at_itself_is_refused():
    camera = Camera(Equidistant(100.0, 50.0, 50.0, 100, 100), torch.ones(3), torch.eye(3))
    with pytest.raises(DataError, match="no rotation"):
        pinhole_at(camera, torch.ones(3))
