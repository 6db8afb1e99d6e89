import pytest

from ntop.field.devices import kernel_device, kernel_words


@pytest.mark.parametrize("visible", [None, "", "-1"])
def test_a_job_without_a_gpu_says_so(monkeypatch, visible):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    kernel_device.cache_clear()
    said = kernel_words()
    kernel_device.cache_clear()
    assert said.startswith("CPU kernels on ")
    assert said.endswith("this job has no GPU")


def test_a_gpu_that_cannot_be_used_is_named_with_the_remedy(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "0,3")
    monkeypatch.setattr("numba.cuda.is_available", lambda: False)
    kernel_device.cache_clear()
    said = kernel_words()
    kernel_device.cache_clear()
    assert said.startswith("CPU kernels on ")
    assert "GPU 0,3 stays idle" in said
    assert "ntop[cuda]" in said
