"""Where the field's kernels run: chosen once per process, and said in a job's log.

A job has a GPU where CUDA_VISIBLE_DEVICES names one: `ntop lease` and SLURM set it for jobs that
ask for GPUs. Without it the kernels run on CPU cores, whatever the machine has.
"""

import functools
import os
from dataclasses import dataclass

import numba

VISIBLE_VARIABLE = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class KernelDevice:
    """Whether kernels run on the GPU; `reason` is why not, `name` what the GPU is called."""

    gpu: bool
    name: str = ""
    reason: str = ""


@functools.cache
def kernel_device() -> KernelDevice:
    """The first GPU that this job may use, else the CPU."""
    visible = os.environ.get(VISIBLE_VARIABLE, "")
    if not visible or visible.startswith("-"):
        return KernelDevice(gpu=False, reason="this job has no GPU")
    try:
        from numba import cuda
    except ImportError:
        return KernelDevice(gpu=False, reason=_idle(visible, "numba has no CUDA here"))
    if not cuda.is_available():
        return KernelDevice(gpu=False, reason=_idle(visible, "CUDA finds no driver or no GPU"))
    name = getattr(cuda.current_context().device, "name", "the simulator")
    return KernelDevice(gpu=True, name=name.decode() if isinstance(name, bytes) else name)


def kernel_words() -> str:
    """Which kernels compute and on what; names GPUs that this job sees and will not use."""
    device = kernel_device()
    if device.gpu:
        return f"GPU kernels on {device.name}"
    count = numba.get_num_threads()
    return f"CPU kernels on {count} thread{'s' * (count > 1)}: {device.reason}"


def _idle(visible: str, cause: str) -> str:
    return f"GPU {visible} stays idle, as {cause}; install its package: pip install 'ntop[cuda]'"
