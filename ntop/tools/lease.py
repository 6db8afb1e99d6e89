"""`ntop lease -n N -- command ...`: run a command on N GPUs that no other lease holds.

Snakemake counts `--resources gpu=N` but assigns nothing: without a lease all jobs of a workstation
start on GPU 0. A lease is a file lock per GPU that the command inherits, so the kernel frees it
however the command ends, SIGKILL included: there are no pid files and no stale locks. (What the
command leaves running in the background keeps its GPU.) Locks are each user's own: several users
of one machine give themselves pools that do not overlap.

| variable | meaning |
|---|---|
| NTOP_GPU_IDS | the pool, `0,1,3`; else CUDA_VISIBLE_DEVICES, else all that nvidia-smi lists |
| NTOP_JOBS_PER_GPU | leases that may share a GPU, for small jobs; default 1 |
| NTOP_GPU_LOCKS | folder of the locks, local to the machine; default below the temporary folder |
"""

import fcntl
import os
import random
import shutil
import stat
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from ntop.conventions import ConfigError, DataError

IDS_VARIABLE, VISIBLE_VARIABLE = "NTOP_GPU_IDS", "CUDA_VISIBLE_DEVICES"
SHARING_VARIABLE, LOCKS_VARIABLE = "NTOP_JOBS_PER_GPU", "NTOP_GPU_LOCKS"
SLURM_VARIABLE = "SLURM_JOB_ID"
NVIDIA_SMI = ("nvidia-smi", "--query-gpu=index", "--format=csv,noheader")
PAUSE_S = (0.2, 0.5)  # random, so that two leases do not try in step for ever


def main(*command: str, n: int, timeout_s: float | None = None) -> None:
    """Become `command` while holding `n` GPUs; their ids are its CUDA_VISIBLE_DEVICES.

    With `n` = 0 it is empty, which hides all GPUs, and inside a SLURM job (whose GPUs are already
    its own) it stays as it is. Otherwise waits for free GPUs, at most `timeout_s` seconds; without
    it, as long as it takes. Does not return: the command takes this process's place, signals and
    exit code.

    Raises:
        ConfigError: `n` is negative, larger than the pool, or a variable makes no sense.
        DataError: the GPUs stayed busy, the locks cannot be used, or there is no such command.
    """
    if n < 0:
        raise ConfigError(f"-n {n}: expected the number of GPUs, 0 or more")
    if n == 0:
        hide_gpus()
    elif SLURM_VARIABLE not in os.environ:
        pool, sharing = gpu_pool(), jobs_per_gpu()
        if len(pool.ids) < n:
            raise ConfigError(
                f"-n {n}: {n} GPUs wanted, but the pool has {len(pool.ids)} "
                f"({pool.origin}: {','.join(pool.ids) or 'none'}); set {IDS_VARIABLE}=0,1,... to "
                "the GPUs of this machine, or ask for fewer (gpu=0 runs on the CPU)"
            )
        lease = wait_for_gpus(n, pool.ids, sharing=sharing, locks=lock_folder(), limit_s=timeout_s)
        os.environ[VISIBLE_VARIABLE] = ",".join(lease.ids)
        # nvidia-smi numbers GPUs by bus, CUDA by speed unless it is told otherwise
        os.environ["CUDA_DEVICE_ORDER"] = "PCI_BUS_ID"
        for descriptor in lease.descriptors:
            os.set_inheritable(descriptor, True)
        _say(f"leased GPU {','.join(lease.ids)}")
    try:
        os.execvp(command[0], command)
    except OSError as error:
        raise DataError(
            f"cannot run {command[0]!r}: {error.strerror}; check its name and PATH"
        ) from error


def hide_gpus() -> None:
    """Let this process's programs see no GPU, and say so where the environment gave it one.

    Empty, not `-1`, which is an index that CUDA merely does not find: "If the variable is set to an
    empty string, no GPU devices are visible" (CUDA Programming Guide, Environment Variables).
    """
    inherited = os.environ.get(VISIBLE_VARIABLE, "")
    os.environ[VISIBLE_VARIABLE] = ""
    if inherited and not inherited.startswith("-"):
        _say(f"GPU {inherited} hidden: this job asked for none")


def _say(words: str) -> None:
    """A line for the job's log, out before another program takes this process's place."""
    sys.stderr.write(f"{words}\n")
    sys.stderr.flush()


@dataclass(frozen=True)
class Pool:
    """The GPUs to choose from, by physical id, and what named them."""

    ids: tuple[str, ...]
    origin: str


@dataclass(frozen=True)
class Lease:
    """GPUs held, by physical id; they are free again when the descriptors are closed."""

    ids: tuple[str, ...]
    descriptors: tuple[int, ...]


def gpu_pool() -> Pool:
    """The GPUs this user may use on this machine.

    Raises:
        ConfigError: an id cannot be part of a file name.
    """
    for name in (IDS_VARIABLE, VISIBLE_VARIABLE):
        given = os.environ.get(name)
        # an empty CUDA_VISIBLE_DEVICES hides all GPUs, an empty variable of ours says nothing
        if given or (given is not None and name == VISIBLE_VARIABLE):
            return Pool(read_ids(given, name=name), name)
    if shutil.which(NVIDIA_SMI[0]) is None:
        return Pool((), "nvidia-smi is not installed")
    done = subprocess.run(NVIDIA_SMI, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        words = (done.stderr or done.stdout).strip().splitlines() or ["no message"]
        return Pool((), f"nvidia-smi failed with {words[-1]!r}")
    return Pool(read_ids(",".join(done.stdout.split()), name=NVIDIA_SMI[0]), NVIDIA_SMI[0])


def read_ids(text: str, *, name: str) -> tuple[str, ...]:
    """The ids in a comma-separated list, each once; as for CUDA, `-1` ends the list."""
    ids: list[str] = []
    for word in (part.strip() for part in text.split(",")):
        if word.startswith("-"):
            break
        if "/" in word or "\0" in word:
            raise ConfigError(f"{name}={text}: {word!r} is no GPU index or UUID; expected 0,1,...")
        if word and word not in ids:
            ids.append(word)
    return tuple(ids)


def jobs_per_gpu() -> int:
    """How many leases may share one GPU."""
    text = os.environ.get(SHARING_VARIABLE) or "1"
    if not text.isdecimal() or int(text) < 1:
        raise ConfigError(f"{SHARING_VARIABLE}={text}: expected a whole number, 1 or more")
    return int(text)


def lock_folder() -> Path:
    """The folder of the lock files, which nobody else may enter.

    Raises:
        DataError: it cannot be made, or the name in the temporary folder is another user's.
    """
    given = os.environ.get(LOCKS_VARIABLE)
    folder = Path(given or Path(tempfile.gettempdir()) / f"ntop-gpu-{os.getuid()}")
    try:
        folder.mkdir(mode=0o700, parents=bool(given), exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise DataError(
            f"cannot use the lock folder {folder}: {error.strerror}; set {LOCKS_VARIABLE} to a "
            "folder on a local disk"
        ) from error
    # anybody can take our name in the temporary folder: then their locks would steer our jobs
    if not given and (not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid()):
        raise DataError(
            f"the lock folder {folder} is not a folder of user {os.getuid()}; have it removed, or "
            f"set {LOCKS_VARIABLE} to a folder on a local disk"
        )
    return folder


def wait_for_gpus(
    n: int, ids: tuple[str, ...], *, sharing: int, locks: Path, limit_s: float | None
) -> Lease:
    """`n` GPUs of `ids`, as soon as so many are free at once.

    Raises:
        DataError: not within `limit_s` seconds, or a lock file cannot be opened.
    """
    started = time.monotonic()
    told = False
    while True:
        lease = try_gpus(n, ids, sharing=sharing, locks=locks)
        if lease is not None:
            return lease
        waited_s = time.monotonic() - started
        if limit_s is not None and waited_s >= limit_s:
            raise DataError(
                f"waited {waited_s:.0f} s for {n} free GPUs of {','.join(ids)}: others hold them "
                f"(`fuser -v {locks}/*` names the processes); end them, or wait longer with "
                "--timeout-s"
            )
        if not told:
            _say(f"waiting for {n} free GPUs of {','.join(ids)}")
            told = True
        time.sleep(random.uniform(*PAUSE_S))


def try_gpus(n: int, ids: tuple[str, ...], *, sharing: int, locks: Path) -> Lease | None:
    """Hold `n` GPUs, or none: who kept a part while waiting for more could wait for ever."""
    held: dict[str, list[int]] = {}
    # first slots of all GPUs before any second slot: jobs spread before they share
    for slot in range(sharing):
        for gpu in ids:
            if len(held) < n and gpu not in held:
                descriptors = _try_slot(gpu, slot, sharing=sharing, locks=locks)
                if descriptors:
                    held[gpu] = descriptors
    everything = tuple(descriptor for some in held.values() for descriptor in some)
    if len(held) == n:
        return Lease(tuple(gpu for gpu in ids if gpu in held), everything)
    for descriptor in everything:
        os.close(descriptor)
    return None


def _try_slot(gpu: str, slot: int, *, sharing: int, locks: Path) -> list[int]:
    """Descriptors that hold one slot of a GPU; empty if it is taken.

    Whoever shares holds the GPU's own lock as well, shared, so that a lease that does not share
    (another run, without the variable) never joins them.
    """
    if sharing == 1:
        wanted = [(f"gpu{gpu}.lock", fcntl.LOCK_EX)]
    else:
        wanted = [(f"gpu{gpu}.lock", fcntl.LOCK_SH), (f"gpu{gpu}.{slot}.lock", fcntl.LOCK_EX)]
    held: list[int] = []
    for name, kind in wanted:
        try:
            descriptor = os.open(locks / name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise DataError(
                f"cannot open the lock {locks / name}: {error.strerror}; check the folder's "
                f"permissions, or set {LOCKS_VARIABLE} to a folder on a local disk"
            ) from error
        held.append(descriptor)
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            for mine in held:
                os.close(mine)
            return []
    return held
