"""Where the networks run: chosen once per process."""

import functools

import numba
import torch


@functools.cache
def compute_device() -> torch.device:
    """The first CUDA GPU that the job may use, else the processor."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def device_words() -> str:
    """The same for a job's log."""
    device = compute_device()
    if device.type == "cuda":
        return f"HumanNeRF's networks on GPU {torch.cuda.get_device_name(device)}"
    count = workers()
    return f"HumanNeRF's networks on {count} CPU thread{'s' * (count > 1)}: this job has no GPU"


def workers() -> int:
    """Pieces of work at a time on the processor: the threads that the kernels would get."""
    return numba.get_num_threads()


def parallel(device: torch.device) -> int:
    """Pieces of work at a time on a device; a GPU takes them one after the other."""
    return 1 if device.type == "cuda" else workers()
