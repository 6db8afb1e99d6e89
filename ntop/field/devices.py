"""What the field's kernels run on, in words for a job's log."""

import os

import numba

VISIBLE_VARIABLE = "CUDA_VISIBLE_DEVICES"


def kernel_words() -> str:
    """Which kernels compute and on what; names GPUs that this job sees and will not use.

    `ntop lease` and SLURM tell a job its GPUs by CUDA_VISIBLE_DEVICES.
    """
    count = numba.get_num_threads()
    words = f"CPU kernels on {count} thread{'s' * (count > 1)}"
    gpus = os.environ.get(VISIBLE_VARIABLE, "")
    if not gpus or gpus.startswith("-"):
        return f"{words}: this job has no GPU"
    return f"{words}: there are no GPU kernels yet, GPU {gpus} stays idle"
