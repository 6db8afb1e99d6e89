"""Leases of GPUs: real processes, real locks; only the GPUs are names."""

import os
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import pytest

from ntop.conventions import ConfigError
from ntop.tools import lease

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60
SHOW = ["sh", "-c", "echo ${CUDA_VISIBLE_DEVICES-unset} ${CUDA_DEVICE_ORDER-unset}"]


class Machine:
    """A machine with GPUs named by the environment, on which leases are started."""

    def __init__(self, folder: Path) -> None:
        self.locks = folder / "locks"
        ours = {"NTOP_GPU_IDS", "NTOP_JOBS_PER_GPU", "CUDA_VISIBLE_DEVICES", "SLURM_JOB_ID"}
        self.environment = {k: v for k, v in os.environ.items() if k not in ours}
        self.environment |= {"PYTHONPATH": str(ROOT), "NTOP_GPU_LOCKS": str(self.locks)}
        self.environment.pop("CUDA_DEVICE_ORDER", None)
        self.started: list[subprocess.Popen[str]] = []

    def start(self, *words: str, **environment: str) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-m", "ntop.cli", "lease", *words],
            env=self.environment | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.started.append(process)
        return process

    def run(self, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
        process = self.start(*words, **environment)
        out, err = process.communicate(timeout=PATIENCE_S)
        return subprocess.CompletedProcess(process.args, process.returncode, out, err)

    def hold(self, *flags: str, **environment: str) -> subprocess.Popen[str]:
        """A lease that is held until the process is ended."""
        process = self.start(*flags, "--", "sleep", "600", **environment)
        assert process.stderr is not None
        assert process.stderr.readline().startswith("leased GPU ")
        return process


@pytest.fixture
def machine(tmp_path):
    machine = Machine(tmp_path)
    yield machine
    for process in machine.started:
        process.kill()
        process.wait()
        process.stdout.close()
        process.stderr.close()


def test_eight_jobs_on_three_gpus_never_overlap_and_keep_all_three_busy(machine, tmp_path):
    events = tmp_path / "events"
    # nobody ends before three have started: they can only do so side by side
    job = f"""
        echo "start $CUDA_VISIBLE_DEVICES" >> {events}
        while [ "$(grep -c start {events})" -lt 3 ]; do sleep 0.02; done
        sleep 0.1
        echo "end $CUDA_VISIBLE_DEVICES" >> {events}"""
    jobs = [machine.start("-n", "1", "--", "sh", "-c", job, NTOP_GPU_IDS="0,1,3") for _ in range(8)]
    assert [process.wait(timeout=PATIENCE_S) for process in jobs] == [0] * 8
    lines = [line.split() for line in events.read_text().splitlines()]
    assert Counter(what for what, _ in lines) == {"start": 8, "end": 8}
    running: set[str] = set()
    most = 0
    for what, gpu in lines:
        assert gpu in {"0", "1", "3"}
        if what == "start":
            assert gpu not in running, lines
            running.add(gpu)
        else:
            running.remove(gpu)
        most = max(most, len(running))
    assert most == 3


def test_kill_9_frees_the_gpu_and_leaves_nothing_to_clean(machine):
    machine.environment["NTOP_GPU_IDS"] = "5"
    holder = machine.hold("-n", "1")
    busy = machine.run("-n", "1", "--timeout-s", "0.3", "--", *SHOW)
    assert busy.returncode == 2
    assert "for 1 free GPUs of 5: others hold them" in busy.stderr
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    free = machine.run("-n", "1", "--timeout-s", "0", "--", *SHOW)
    assert free.stdout.split() == ["5", "PCI_BUS_ID"]
    assert [path.name for path in machine.locks.iterdir()] == ["gpu5.lock"]


def test_who_waits_gets_the_gpu_when_it_is_free(machine):
    machine.environment["NTOP_GPU_IDS"] = "0"
    holder = machine.hold("-n", "1")
    waiting = machine.start("-n", "1", "--", *SHOW)
    assert waiting.stderr.readline() == "waiting for 1 free GPUs of 0\n"
    holder.terminate()
    out, _ = waiting.communicate(timeout=PATIENCE_S)
    assert out.split()[0] == "0"


def test_leases_of_two_cannot_deadlock(machine):
    # each would take its first GPU and wait for the other's for ever
    jobs = [
        machine.start("-n", "2", "--", "sh", "-c", "sleep 0.1; echo $CUDA_VISIBLE_DEVICES",
                      NTOP_GPU_IDS=ids)
        for ids in ("0,1", "1,0", "0,1", "1,0")
    ]  # fmt: skip
    given = [process.communicate(timeout=PATIENCE_S)[0].strip() for process in jobs]
    assert given == ["0,1", "1,0", "0,1", "1,0"]


def test_a_part_is_given_back_while_waiting_for_more(machine):
    machine.environment["NTOP_GPU_IDS"] = "0,1"
    machine.hold("-n", "1")  # GPU 0
    waiting = machine.start("-n", "2", "--", *SHOW)
    assert waiting.stderr.readline().startswith("waiting for 2")
    time.sleep(0.3)
    other = machine.run("-n", "1", "--timeout-s", "5", "--", *SHOW)
    assert other.stdout.split()[0] == "1"


def test_a_pool_that_is_too_small_names_both_numbers(machine):
    done = machine.run("-n", "3", "--", *SHOW, NTOP_GPU_IDS="0,1")
    assert done.returncode == 2
    assert done.stdout == ""
    assert "3 GPUs wanted, but the pool has 2 (NTOP_GPU_IDS: 0,1)" in done.stderr


def test_slurms_gpus_stay_as_they_are(machine):
    environment = {"SLURM_JOB_ID": "17", "CUDA_VISIBLE_DEVICES": "2"}
    done = machine.run("-n", "1", "--", *SHOW, NTOP_GPU_IDS="0,1", **environment)
    assert (done.returncode, done.stdout, done.stderr) == (0, "2 unset\n", "")
    assert not machine.locks.exists()


@pytest.mark.parametrize(
    ("inherited", "said"),
    [
        ({}, ""),
        ({"CUDA_VISIBLE_DEVICES": ""}, ""),
        ({"CUDA_VISIBLE_DEVICES": "-1"}, ""),
        ({"CUDA_VISIBLE_DEVICES": "2,5"}, "GPU 2,5 hidden: this job asked for none\n"),
        (
            {"CUDA_VISIBLE_DEVICES": "2", "SLURM_JOB_ID": "17"},
            "GPU 2 hidden: this job asked for none\n",
        ),
    ],
)
def test_who_asks_for_no_gpu_sees_none(machine, inherited, said):
    see = [sys.executable, "-c", "import os; print(repr(os.environ['CUDA_VISIBLE_DEVICES']))"]
    done = machine.run("-n", "0", "--", *see, NTOP_GPU_IDS="0,1", **inherited)
    assert (done.returncode, done.stdout, done.stderr) == (0, "''\n", said)
    assert not machine.locks.exists()


def test_torch_and_the_kernels_find_no_gpu_where_all_are_hidden(machine):
    see = (
        "import torch; from ntop.field.devices import kernel_words;"
        "print(torch.cuda.device_count(), kernel_words())"
    )
    done = machine.run("-n", "0", "--", sys.executable, "-c", see, CUDA_VISIBLE_DEVICES="0")
    assert done.stdout.startswith("0 CPU kernels on "), done.stderr
    assert done.stdout.endswith("this job has no GPU\n")


def test_no_gpu_is_needed_for_none(machine, tmp_path):
    done = machine.run("-n", "0", "--", "/bin/sh", "-c", "echo ran", PATH=str(tmp_path))
    assert done.stdout == "ran\n"


def test_the_command_takes_the_process_its_signals_and_its_exit_code(machine):
    words = ["-n", "1", "--", "sh", "-c", "echo $$ $1 $2; exit 7", "sh", "-n", "--"]
    process = machine.start(*words, NTOP_GPU_IDS="0")
    out, _ = process.communicate(timeout=PATIENCE_S)
    assert out.split() == [str(process.pid), "-n", "--"]  # its own flags arrive as they are
    assert process.returncode == 7
    holder = machine.hold("-n", "1", NTOP_GPU_IDS="0")
    holder.terminate()
    assert holder.wait(timeout=PATIENCE_S) == -signal.SIGTERM


def test_small_jobs_spread_first_then_share_but_never_with_a_lease_that_does_not(machine):
    machine.environment |= {"NTOP_GPU_IDS": "0,1", "NTOP_JOBS_PER_GPU": "2"}
    now = ["-n", "1", "--timeout-s", "0"]
    held = []
    for _ in range(4):
        process = machine.start(*now, "--", "sleep", "600")
        held.append(process.stderr.readline().strip())
    assert held == [f"leased GPU {gpu}" for gpu in (0, 1, 0, 1)]
    assert machine.run(*now, "--", *SHOW).returncode == 2
    for process in machine.started[:2]:  # one job is left on either GPU
        process.kill()
        process.wait()
    assert machine.run(*now, "--", *SHOW, NTOP_JOBS_PER_GPU="1").returncode == 2
    assert machine.run(*now, "--", *SHOW).stdout.split()[0] == "0"


@pytest.mark.parametrize(
    ("environment", "seen"),
    [
        ({"NTOP_GPU_IDS": "0,1", "NTOP_JOBS_PER_GPU": "2"}, {"0": 2, "1": 2}),
        # the same command inside a SLURM job, whose GPU is its own
        ({"SLURM_JOB_ID": "17", "CUDA_VISIBLE_DEVICES": "7"}, {"7": 4}),
    ],
)
def test_snakemakes_jobs_share_gpus_as_told(machine, tmp_path, environment, seen):
    # nobody ends before all four have begun
    job = (
        "echo $CUDA_VISIBLE_DEVICES > $0; until [ $(ls *.begun | wc -l) -eq 4 ]; do sleep 0.1; done"
    )
    (tmp_path / "Snakefile").write_text(f"""
rule all:
    input: expand("{{n}}.txt", n=range(4))

rule job:
    output: "{{n}}.txt"
    resources: gpu=1
    params: job={job!r}
    shell: "{sys.executable} -m ntop.cli lease -n {{resources.gpu}} --"
           " sh -c {{params.job:q}} {{wildcards.n}}.begun && cp {{wildcards.n}}.begun {{output}}"
""")
    done = subprocess.run(
        [sys.executable, "-m", "snakemake", "--cores", "4", "--resources", "gpu=4"],
        cwd=tmp_path,
        env=machine.environment | environment,
        capture_output=True,
        text=True,
        timeout=4 * PATIENCE_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert Counter((tmp_path / f"{n}.txt").read_text().strip() for n in range(4)) == seen


def test_the_pool_comes_from_the_nearest_source(machine, tmp_path):
    smi = tmp_path / "bin/nvidia-smi"
    smi.parent.mkdir()
    smi.write_text("#!/bin/sh\nprintf '4\\n5\\n'\n")
    smi.chmod(0o755)
    machine.environment["PATH"] = f"{smi.parent}{os.pathsep}{machine.environment['PATH']}"
    words = ["-n", "1", "--", *SHOW]
    assert machine.run(*words).stdout.split()[0] == "4"
    assert machine.run(*words, CUDA_VISIBLE_DEVICES="3,1").stdout.split()[0] == "3"
    both = {"CUDA_VISIBLE_DEVICES": "3,1", "NTOP_GPU_IDS": "1"}
    assert machine.run(*words, **both).stdout.split()[0] == "1"
    hidden = machine.run(*words, CUDA_VISIBLE_DEVICES="")
    assert "the pool has 0 (CUDA_VISIBLE_DEVICES: none)" in hidden.stderr
    smi.write_text("#!/bin/sh\necho 'no driver' >&2\nexit 9\n")
    assert "nvidia-smi failed with 'no driver'" in machine.run(*words).stderr


def test_only_the_user_may_enter_the_locks(machine):
    machine.run("-n", "1", "--", *SHOW, NTOP_GPU_IDS="0")
    assert stat.S_IMODE(machine.locks.stat().st_mode) == 0o700
    assert stat.S_IMODE((machine.locks / "gpu0.lock").stat().st_mode) == 0o600


def test_a_name_that_somebody_else_took_is_refused(machine, tmp_path):
    (tmp_path / "tmp").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / f"tmp/ntop-gpu-{os.getuid()}").symlink_to(tmp_path / "elsewhere")
    environment = {"TMPDIR": str(tmp_path / "tmp"), "NTOP_GPU_LOCKS": "", "NTOP_GPU_IDS": "0"}
    done = machine.run("-n", "1", "--", *SHOW, **environment)
    assert done.returncode == 2
    assert "is not a folder of user" in done.stderr


def test_the_default_folder_is_the_users_own(tmp_path, monkeypatch):
    monkeypatch.delenv("NTOP_GPU_LOCKS", raising=False)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert lease.lock_folder() == tmp_path / f"ntop-gpu-{os.getuid()}"


@pytest.mark.parametrize(
    ("words", "environment", "message"),
    [
        (["-n", "-1", "--", "true"], {}, "expected the number of GPUs"),
        (["-n", "1", "--", "true"], {"NTOP_GPU_IDS": "a/b"}, "'a/b' is no GPU index"),
        (["-n", "1", "--", "true"], {"NTOP_JOBS_PER_GPU": "none"}, "NTOP_JOBS_PER_GPU=none"),
        (["-n", "1", "--", "no-such-command"], {}, "cannot run 'no-such-command'"),
        (["-n", "1", "--"], {}, "expected `-- command ...`"),
        (["-n", "1"], {}, "expected `-- command ...`"),
    ],
)
def test_what_makes_no_sense_is_said_in_words(machine, words, environment, message):
    done = machine.run(*words, **({"NTOP_GPU_IDS": "0"} | environment))
    assert done.returncode == 2
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_ids_are_read_as_cuda_reads_them():
    assert lease.read_ids(" 0, 1,1,3,", name="X") == ("0", "1", "3")
    assert lease.read_ids("0,-1,2", name="X") == ("0",)
    assert lease.read_ids("GPU-8932f937-d72c", name="X") == ("GPU-8932f937-d72c",)
    with pytest.raises(ConfigError, match="expected 0,1"):
        lease.read_ids("../0", name="X")
