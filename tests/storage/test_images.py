"""Images on disk: fringes, depth steps, broken files. Rounding is cases 38-40 of tests/numerics."""

import numpy as np
import pytest

from ntop.conventions import DataError
from ntop.storage.images import (
    read_depth,
    read_matte,
    read_parts,
    read_rgba,
    write_depth,
    write_matte,
    write_parts,
    write_rgba,
)


def soft_disc(size: int, *, centre: tuple[float, float], radius: float) -> np.ndarray:
    """Coverage of a disc, 16 x 16 samples per pixel."""
    fine = (np.arange(16 * size) + 0.5) / 16
    inside = np.hypot(fine[None] - centre[0], fine[:, None] - centre[1]) <= radius
    return inside.reshape(size, 16, size, 16).mean((1, 3)).astype(np.float32)


def person(size: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """A soft disc of random bright colour; outside the colour is black, as a renderer leaves it."""
    rng = np.random.default_rng(3)
    alpha = soft_disc(size, centre=(size * 0.45, size * 0.55), radius=size * 0.3)
    rgb = (0.4 + 0.6 * rng.random((size, size, 3))).astype(np.float32)
    return rgb * (alpha > 0)[..., None], alpha


def test_colour_reaches_beyond_the_outline_so_that_scaling_has_no_dark_fringe(tmp_path):
    rgb, alpha = person()
    write_rgba(rgb, alpha, path=tmp_path / "a.png")
    stored = read_rgba(tmp_path / "a.png")
    inside = stored[..., 3] > 0
    rows, columns = np.indices(alpha.shape)
    distance = np.hypot(columns + 0.5 - 96 * 0.45, rows + 0.5 - 96 * 0.55) - 96 * 0.3
    near = ~inside & (distance < 3)
    assert near.sum() > 100
    assert stored[..., :3][near].min() > 0.4 * 255
    assert not stored[distance > 8].any()


def test_depth_steps_are_a_tenth_of_a_millimetre_rounded(tmp_path):
    depth = np.random.default_rng(9).uniform(0.3, 6.5, (40, 30)).astype(np.float32)
    depth[:20] = 0
    write_depth(depth, path=tmp_path / "d.png")
    stored = read_depth(tmp_path / "d.png")
    assert np.abs(stored - depth).max() <= 0.5e-4 + 1e-6
    assert not stored[:20].any()


@pytest.mark.parametrize("value", [-0.1, 6.6, np.nan, np.inf])
def test_depth_that_would_wrap_is_refused(tmp_path, value):
    depth = np.ones((4, 4), np.float32)
    depth[1, 2] = value
    with pytest.raises(DataError, match="depth image"):
        write_depth(depth, path=tmp_path / "d.png")
    assert not list(tmp_path.iterdir())


def test_parts_and_mattes_come_back(tmp_path):
    parts = np.random.default_rng(11).integers(0, 25, (33, 21), dtype=np.uint8)
    write_parts(parts, path=tmp_path / "p.png")
    np.testing.assert_array_equal(read_parts(tmp_path / "p.png"), parts)
    matte = soft_disc(50, centre=(20, 30), radius=12)
    write_matte(matte, path=tmp_path / "m.png")
    assert np.abs(read_matte(tmp_path / "m.png") - matte).max() <= 0.5 / 255 + 1e-6


def test_the_same_image_gives_the_same_bytes_and_its_hash(tmp_path):
    rgb, alpha = person()
    first = write_rgba(rgb, alpha, path=tmp_path / "a.png")
    second = write_rgba(rgb.copy(), alpha.copy(), path=tmp_path / "b.png")
    assert first == second
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_broken_missing_and_mistaken_files_name_the_remedy(tmp_path):
    rgb, alpha = person()
    path = tmp_path / "a.png"
    write_rgba(rgb, alpha, path=path)
    with pytest.raises(DataError, match="expected 1 of uint16"):
        read_depth(path)
    content = path.read_bytes()
    for broken in (content[: len(content) // 2], b"", b"not a picture"):
        path.write_bytes(broken)
        with pytest.raises(DataError, match="not a whole PNG"):
            read_rgba(path)
    with pytest.raises(DataError, match=r"--forcerun .*missing\.png"):
        read_rgba(tmp_path / "missing.png")
