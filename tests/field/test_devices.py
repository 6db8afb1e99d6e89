import pytest

from ntop.field.devices import kernel_words


@pytest.mark.parametrize(
    ("visible", "words"),
    [
        (None, "this job has no GPU"),
        ("", "this job has no GPU"),
        ("-1", "this job has no GPU"),
        ("0,3", "there are no GPU kernels yet, GPU 0,3 stays idle"),
    ],
)
def test_what_computes_and_what_stays_idle_is_said(monkeypatch, visible, words):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    said = kernel_words()
    assert said.startswith("CPU kernels on ")
    assert said.endswith(words)
