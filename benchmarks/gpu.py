"""Training and rendering on an NVIDIA GPU, part by part: `make bench-gpu` where there is one.

| part | what |
|---|---|
| `differences` | nine views of a body, GPU against CPU, in grey levels of 255 |
| `launches` | the march alone, rays already on the GPU: rays/s and views/s over rays per launch |
| `views` | from a pose to finished pixels in memory, in one process, before encoding: views/s |
| `shard` | the same written as files, as the stage render does: views/s |
| `training` | the studio actor, twice: seconds, PSNR from above in novel poses, same bytes |

A part's result is in benchmarks/results/gpu.json as soon as it is there; one that fails is written
down with its error, the others go on, and the exit code says so. Usage: python -m benchmarks.gpu
[PART ...] (all).
"""

import argparse
import hashlib
import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks import gpu_page
from benchmarks.environment import RESULTS, ROOT, write_result
from benchmarks.gpu_plot import plot
from benchmarks.studio import capture_views, chosen_rows, score, studio_capture
from benchmarks.subjects import painted
from ntop.body.model import load_body_model
from ntop.config.sections import TrainConfig
from ntop.conventions import PIXEL_CENTRE
from ntop.field.culling import body_pixels
from ntop.field.devices import VISIBLE_VARIABLE, kernel_device
from ntop.field.marching import MarchRule, Rays, Scene, march_on_cpu, march_rays
from ntop.field.posing import PosedAvatar, pose_avatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view
from ntop.field.training import train
from ntop.geometry.cameras import Camera
from ntop.stages.s4_train import training_settings
from ntop.stages.s5_render import write_view

RIG = "h1.0_r0.5"
LAUNCHES = tuple(1 << n for n in range(14, 23))  # rays
REPEATS = 7
SETS = 20
WORK = ROOT / "benchmarks/work/gpu"
DATA = ROOT / "data/packages"


def main() -> None:
    """Measure the parts and write them down one by one."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("parts", nargs="*", help=f"of {', '.join(PARTS)}; default: all")
    chosen = parser.parse_args().parts or list(PARTS)
    if unknown := set(chosen) - set(PARTS):
        parser.error(f"no part {sorted(unknown)}, have {list(PARTS)}")
    os.environ.setdefault(VISIBLE_VARIABLE, "0")
    if missing := missing_gpu():
        sys.exit(f"bench-gpu: {missing}")
    torch.set_num_threads(1)
    values: dict[str, Any] = {"gpu": gpu_facts()}
    failed = []
    for name in chosen:
        started = time.monotonic()
        try:
            values[name] = PARTS[name]()
        except Exception as error:  # whatever a new machine brings: the other parts still count
            traceback.print_exc()
            values[name] = {"failed": f"{type(error).__name__}: {error}"}
            failed.append(name)
        values[name]["part_s"] = round(time.monotonic() - started, 2)
        print(f"{name}: {values[name]}", flush=True)
        print(write_result("gpu", values), flush=True)
    plot(values, RESULTS / "gpu.png")
    gpu_page.main()
    if failed:
        sys.exit(
            f"bench-gpu: {', '.join(failed)} failed; run: python -m benchmarks.gpu "
            f"{' '.join(failed)}"
        )


def missing_gpu() -> str:
    """What keeps this machine from running the benchmark, in words; empty if nothing does."""
    device = kernel_device()
    if device.gpu and device.name != "the simulator":
        return ""
    if device.gpu:
        return "this is numba's simulator; unset NUMBA_ENABLE_CUDASIM"
    return (
        f"{device.reason}. Needed: an NVIDIA GPU, its driver (nvidia-smi shows both) and the "
        "package numba-cuda"
    )


def gpu_facts() -> dict[str, Any]:
    """The GPU, its memory, driver and compiler."""
    from numba import cuda  # only where a GPU is

    context = cuda.current_context()
    free, total = context.get_memory_info()
    try:
        package = version("numba-cuda")
    except PackageNotFoundError:
        package = "numba's own"
    return {
        "name": kernel_device().name,
        "memory_gb": round(total / 1e9, 1),
        "free_gb": round(free / 1e9, 1),
        "compute_capability": ".".join(map(str, context.device.compute_capability)),
        "cuda": ".".join(map(str, cuda.runtime.get_version())),
        "numba_cuda": package,
        "python": platform.python_version(),
    }


def differences() -> dict[str, Any]:
    """One ray per pixel on both targets."""
    subject = painted()
    posed, cameras = subject.posed(RenderSettings()), subject.cameras(RIG)
    largest, off_parts, pixels = 0.0, 0, 0
    for camera in cameras.values():
        scene, rays, rule = view_rays(posed, camera)
        one, other = march_rays(scene, rays, rule), march_on_cpu(scene, rays, rule)
        for name in ("colours", "opacity"):
            gap = np.abs(getattr(one, name) - getattr(other, name)).max()
            largest = max(largest, 255 * float(gap))
        seen = other.opacity >= 0.5
        off_parts += int((one.parts != other.parts)[seen].sum())
        pixels += int(seen.sum())
    return {"largest_levels": largest, "parts_that_differ": off_parts, "pixels": pixels,
            "met": largest < 1}  # fmt: skip


def launches() -> dict[str, Any]:
    """Views of `painted` repeated to fill a launch; nothing but the kernel is timed."""
    from numba import cuda  # only where a GPU is

    from ntop.field.gpu import ReadyMarch

    subject = painted()
    posed = subject.posed(RenderSettings())
    rays = [view_rays(posed, camera)[1] for camera in subject.cameras(RIG).values()]
    scene, _, rule = view_rays(posed, next(iter(subject.cameras(RIG).values())))
    origins = np.concatenate([np.repeat(r.origins, len(r.directions), 0) for r in rays])
    directions = np.concatenate([r.directions for r in rays])
    per_view = len(directions) / len(rays)
    rows = []
    for count in LAUNCHES:
        index = np.arange(count) % len(directions)
        batch = Rays(np.zeros(1, np.int64), origins[index], directions[index], np.full(count, 0.5))
        march = ReadyMarch(scene, batch, rule)
        march.launch()  # the first compiles
        cuda.synchronize()
        seconds = []
        for _ in range(REPEATS):
            started = time.perf_counter()
            march.launch()
            cuda.synchronize()
            seconds.append(time.perf_counter() - started)
        median_s = float(np.median(seconds))
        rows.append({"rays": count, "median_s": median_s, "all_s": seconds,
                     "rays_per_s": count / median_s,
                     "views_per_s": count / median_s / per_view})  # fmt: skip
    best = max(row["views_per_s"] for row in rows)
    return {"rays_per_view": per_view, "rows": rows, "views_per_s": best}


def views() -> dict[str, Any]:
    """Poses, nine views each; transfers and what the CPU does for a view are counted."""
    subject = painted()
    cameras = subject.cameras(RIG).values()
    posing, rendering = [], []
    for _ in range(SETS + 1):
        started = time.perf_counter()
        posed = subject.posed(RenderSettings())
        posing.append(time.perf_counter() - started)
        started = time.perf_counter()
        for camera in cameras:
            render_view(posed, camera)
        rendering.append(time.perf_counter() - started)
    posing_s, rendering_s = float(np.median(posing[1:])), float(np.median(rendering[1:]))
    return {
        "posing_s_per_set": posing_s,
        "rendering_s_per_set": rendering_s,
        "views_per_s_render": len(cameras) / rendering_s,
        "views_per_s": len(cameras) / (posing_s + rendering_s),
    }


def shard() -> dict[str, Any]:
    """As `views`, with the pictures written while the next ones are rendered."""
    subject = painted()
    cameras = subject.cameras(RIG)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor() as encoder:
        started = time.perf_counter()
        jobs = [
            encoder.submit(write_view, render_view(posed, camera), _paths(Path(folder), s, view))
            for s in range(SETS)
            for posed in [subject.posed(RenderSettings())]
            for view, camera in cameras.items()
        ]
        for job in jobs:
            job.result()
        seconds = time.perf_counter() - started
    return {"views": len(jobs), "seconds": seconds, "views_per_s": len(jobs) / seconds}


def _paths(folder: Path, number: int, view: str) -> dict[str, Path]:
    names = ("image_path", "depth_path", "parts_path")
    return {name: folder / f"{number}_{view}_{name}.png" for name in names}


def training() -> dict[str, Any]:
    """Train the studio actor twice; the first time includes compilation."""
    model = load_body_model()
    capture = studio_capture(WORK / "capture", actor="plain", packages=DATA)
    photographs = capture_views(capture, model)
    betas = tuple(float(value) for value in photographs.poses.betas[0])
    settings = training_settings(TrainConfig())
    seconds, digests, steps_s = [], [], []
    for _ in range(2):
        times: list[float] = []
        started = time.perf_counter()
        avatar, curve = train(
            photographs, model, betas, settings=settings,
            on_step=lambda _, times=times: times.append(time.perf_counter()),
        )  # fmt: skip
        seconds.append(time.perf_counter() - started)
        steps_s.append(times[-1] - times[0])
        content = avatar.grid.values.tobytes() + avatar.light.tobytes()
        digests.append(hashlib.sha256(content).hexdigest())
    rows = chosen_rows(capture, actions=[], views=["centre", "e"], rigs=1, sets=1)
    found = score(
        capture, rows, lambda pose, cameras: show(pose_avatar(avatar, model, pose), cameras),
        lpips=None,
    )  # fmt: skip
    return {
        "seconds": seconds,
        "steps_s": steps_s,
        "steps": len(curve),
        "pictures": len(photographs.crops),
        "scores": asdict(found),
        "same_bytes": digests[0] == digests[1],
        "sha256": digests[0],
        "met": seconds[1] <= 15,
    }


def show(posed: PosedAvatar, cameras: list[Camera]) -> list[Any]:
    return [render_view(posed, camera) for camera in cameras]


def view_rays(posed: PosedAvatar, camera: Camera) -> tuple[Scene, Rays, MarchRule]:
    """One ray through the centre of each pixel that may see the body, as `render_view` sends."""
    v, u = np.nonzero(body_pixels(posed.warp, camera))
    directions, valid = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    settings = RenderSettings()
    origin = camera.center_world.double().numpy() - posed.warp.origin_world
    chosen = np.ascontiguousarray(directions[valid].double().numpy())
    rays = Rays(np.zeros(1, np.int64), origin[None], chosen, np.full(len(chosen), settings.phase))
    return posed.scene, rays, settings.rule


PARTS: dict[str, Callable[[], dict[str, Any]]] = {
    "differences": differences, "launches": launches, "views": views, "shard": shard,
    "training": training,
}  # fmt: skip

if __name__ == "__main__":
    main()
