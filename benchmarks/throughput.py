"""Views per second of the real stages: render alone, with files written, with labels; and scaling.

A worker is a process that runs the render stage's own code on some sets of nine views (`files`:
and its annotation), after one set that loads the kernels; it is bound to one core, or to two with
two threads. What a job's start costs is not in it, and is given beside. Idle machine, please.

Usage: python -m benchmarks.throughput [RESULTS] (see benchmarks/quadrature.py)
Writes benchmarks/results/throughput.json and .png.
"""

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import torch

from benchmarks.environment import ROOT, write_result
from benchmarks.subjects import Subject, chosen_results, subjects
from benchmarks.throughput_plot import plot
from ntop.annotation.annotate import ViewImages, annotate_view
from ntop.body.skinning import BodyPose, pose_body
from ntop.config.sections import AnnotateConfig, ImageConfig, RenderConfig, RigConfig
from ntop.conventions import VIEWS
from ntop.field.culling import body_pixels
from ntop.field.interface import pose_avatar, render_view
from ntop.field.quality import PRESETS
from ntop.field.rendering import Rendering
from ntop.geometry.cameras import Camera
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.geometry.rotations import axis_angle_from_matrix, matrix_from_axis_angle
from ntop.stages import s5_render, s6_annotate
from ntop.storage.images import encode_depth, encode_parts, encode_rgba
from ntop.storage.keys import SetKey
from ntop.storage.renders import body_columns, render_row

RIG = "benchmark"
TURN_RAD = 0.5  # about the vertical from set to set


@dataclass(frozen=True)
class Case:
    """What a worker does. `work`: render (nothing kept), files, or labels as well."""

    subject: str
    work: str = "labels"
    threads: int = 1
    size_px: int = 1000
    height_m: float = 1.5  # the studio actor of the demo is 200 pixels large on average
    quality: str = "default"
    views: int = len(VIEWS)
    sets: int = 3


@dataclass(frozen=True)
class Speed:
    """What it took, without start and warm-up."""

    views: int
    seconds: float
    cpu_s: float
    start_s: float
    peak_mb: float


WORKS = ("render", "files", "labels")
# the stages render whole sets, so fewer views are rendered without files
WORK_OF = {"size_px": "labels", "height_m": "labels", "views": "render", "sets": "labels"}
PARTS = (
    "pose", "pose, packed", "view", "of it: which pixels", "of it: one ray a pixel", "encode",
    "annotate, without reading",
)  # fmt: skip


def main(results: Path | None) -> None:
    """Measure everything and write it; all but the parts of the last subject alone."""
    names = [subject.name for subject in subjects(results)]
    base = Case(names[-1])
    values = {
        "subjects": names,
        "cores": parallel(base, results),
        "person_px": {
            subject.name: person_px(subject, base.height_m) for subject in subjects(results)
        },
        "parts": [parts_ms(subject, base.height_m) for subject in subjects(results)],
        "axes": {
            axis: [
                run(replace(base, work=WORK_OF[axis], **{axis: value}), results) for value in values
            ]
            for axis, values in {
                "size_px": (250, 500, 1000, 2000),
                "height_m": (1.0, 1.5, 2.0, 3.0),
                "views": (1, 3, 9),
                "sets": (1, 3, 9),
            }.items()
        },
    }
    sys.stdout.write(f"{write_result('throughput', values)}\n")
    plot(values)


def parallel(base: Case, results: Path | None) -> list[dict]:
    """One core, one process with two threads, and two processes on a core each."""
    rows = []
    for work, quality in (*((work, "default") for work in WORKS), ("labels", "draft")):
        for threads, processes in ((1, 1), (2, 1), (1, 2)):
            case = replace(base, work=work, quality=quality, threads=threads)
            row = run(case, results, processes=processes)
            rows.append(row)
            sys.stderr.write(f"{row}\n")
    return rows


def run(case: Case, results: Path | None, *, processes: int = 1) -> dict:
    """Views per second of one or several workers that begin together."""
    words = [sys.executable, "-m", "benchmarks.throughput", "--worker", str(results or "")]
    with tempfile.TemporaryDirectory() as folder:
        workers = [
            subprocess.Popen(
                [*words, json.dumps(asdict(case)), str(core), folder, str(processes)],
                cwd=ROOT, env=os.environ | {"NUMBA_NUM_THREADS": str(case.threads)},
                stdout=subprocess.PIPE, text=True,
            )
            for core in range(processes)
        ]  # fmt: skip
        said = [worker.communicate()[0] for worker in workers]
    if any(worker.returncode for worker in workers):
        raise RuntimeError(f"a worker of {case} failed")
    speeds = [Speed(**json.loads(text.splitlines()[-1])) for text in said]
    return asdict(case) | {
        "processes": processes,
        "views_per_s": round(sum(s.views / s.seconds for s in speeds), 2),
        "cpu_ms_per_view": round(1e3 * sum(s.cpu_s for s in speeds) / sum(s.views for s in speeds)),
        "start_s": round(max(s.start_s for s in speeds), 1),
        "peak_mb": round(max(s.peak_mb for s in speeds)),
    }


def work(case: Case, results: Path | None, *, meeting: Path, processes: int) -> Speed:
    """Be a worker."""
    born = time.monotonic()
    torch.set_num_threads(1)  # as in the stage
    subject = next(s for s in subjects(results) if s.name == case.subject)
    config = RenderConfig(
        rigs={RIG: RigConfig(height_above_pelvis_m=case.height_m, ring_radius_m=1.0)},
        image=ImageConfig(width_px=case.size_px, height_px=case.size_px),
        quality=case.quality,
    )
    studio = s5_render.Studio(
        avatar=subject.avatar,
        model=subject.model,
        rig=s5_render.rig_of(config, RIG),
        avatar_sha256="",
        config=config,
    )
    do = render_only if case.work == "render" else through_the_stages
    with tempfile.TemporaryDirectory() as folder:
        do(replace(case, sets=1), subject, studio, Path(folder) / "warm")
        start_s = time.monotonic() - born
        (meeting / str(os.getpid())).touch()
        while len(list(meeting.iterdir())) < processes:
            time.sleep(0.01)
        started, cpu_s = time.monotonic(), time.process_time()
        do(case, subject, studio, Path(folder) / "timed")
        seconds, cpu_s = time.monotonic() - started, time.process_time() - cpu_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return Speed(case.sets * case.views, seconds, cpu_s, start_s, peak_mb)


def turned(pose: BodyPose, sets: int) -> BodyPose:
    """The pose of a subject in `sets` directions (set first)."""
    up = torch.tensor([0.0, 0.0, TURN_RAD], dtype=torch.float64)
    matrix = matrix_from_axis_angle(pose.global_orient.double())
    turns = [matrix_from_axis_angle(k * up) @ matrix for k in range(sets)]
    return BodyPose(
        betas=pose.betas.expand(sets, -1),
        global_orient=torch.stack([axis_angle_from_matrix(turn) for turn in turns]),
        body_pose=pose.body_pose.expand(sets, -1),
        transl=pose.transl.expand(sets, -1),
    )


def render_only(case: Case, subject: Subject, studio: s5_render.Studio, _: Path) -> None:
    """Pose and render in memory."""
    poses = turned(subject.pose, case.sets)
    settings = PRESETS[studio.config.quality]
    for index in range(case.sets):
        pose = poses.at(index)
        posed = pose_avatar(studio.avatar, studio.model, pose, settings=settings)
        for camera in list(cameras_above(studio, pose).values())[: case.views]:
            render_view(posed, camera, settings=settings)


def through_the_stages(
    case: Case, subject: Subject, studio: s5_render.Studio, folder: Path
) -> None:
    """The render stage's sets, published as a shard; with `labels` the annotate stage's table."""
    keys = [SetKey("benchmark", case.subject, "turn", RIG, k) for k in range(case.sets)]
    content = folder / "work"
    content.mkdir(parents=True)
    s5_render.render_sets(
        keys, turned(subject.pose, case.sets), studio, content=content, terminated=lambda: False
    )
    if case.work == "labels":
        done = [s5_render.set_folder(content, key) for key in keys]
        s5_render.publish(done, [], {}, storage="files", out=folder / "shard")
        s6_annotate.main(AnnotateConfig(), folder / "shard", folder / "keypoints.parquet")


def cameras_above(studio: s5_render.Studio, pose: BodyPose) -> dict[str, Camera]:
    """The nine cameras over a pose."""
    pelvis = pose_body(studio.model, pose.double()).joints[0]
    return top_view_cameras(studio.rig, pelvis)


def seen_from(subject: Subject, height_m: float) -> tuple[Rig, dict[str, Camera]]:
    """The rig of this height, and its cameras over a subject."""
    config = RenderConfig(rigs={RIG: RigConfig(height_above_pelvis_m=height_m, ring_radius_m=1.0)})
    rig = s5_render.rig_of(config, RIG)
    return rig, top_view_cameras(rig, torch.from_numpy(subject.joints_world()[0]))


def person_px(subject: Subject, height_m: float) -> float:
    """The larger side of the person's box, mean over the nine views."""
    posed, sides = subject.posed(PRESETS["draft"]), []
    for camera in seen_from(subject, height_m)[1].values():
        mask = render_view(posed, camera, settings=PRESETS["draft"]).alpha >= 0.5
        sides.append(max(np.ptp(places) + 1 for places in np.nonzero(mask)))
    return round(float(np.mean(sides)), 1)


def parts_ms(subject: Subject, height_m: float) -> dict:
    """Milliseconds of one core per view, by what is done; a pose's are shared by its nine views."""
    rig, cameras = seen_from(subject, height_m)
    body = body_columns(subject.model, subject.pose)
    settings, spent = PRESETS["default"], dict.fromkeys(PARTS, 0.0)

    def timed(name: str, do: Callable[..., Any], *given: Any, **named: Any) -> Any:
        started = time.process_time()
        found = do(*given, **named)
        spent[name] += 1e3 * (time.process_time() - started) / len(cameras)
        return found

    numba.set_num_threads(1)
    for _ in range(2):  # the first loads the kernels
        spent = dict.fromkeys(PARTS, 0.0)
        posed = timed("pose", subject.posed, settings)
        timed("pose, packed", getattr, posed, "scene")
        for view, camera in cameras.items():
            timed("of it: which pixels", body_pixels, posed.warp, camera)
            single = replace(settings, edge_rays=1)
            timed("of it: one ray a pixel", render_view, posed, camera, settings=single)
            seen = timed("view", render_view, posed, camera, settings=settings)
            timed("encode", encoded, seen)
            row = render_row(
                SetKey("", subject.name, "", RIG, 0), view,
                camera=camera, rig=rig, body=body, image_sha256="", avatar_sha256="", seed=0,
            )  # fmt: skip
            images = ViewImages(seen.alpha >= 0.5, seen.depth_m, seen.parts)
            timed("annotate, without reading", annotate_view, row, images, camera=camera)
    return {"subject": subject.name} | {name: round(value, 1) for name, value in spent.items()}


def encoded(seen: Rendering) -> None:
    """The three pictures of a view."""
    encode_rgba(seen.rgb, seen.alpha)
    encode_depth(seen.depth_m)
    encode_parts(seen.parts)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--worker"]:
        where, case, core, folder, processes = sys.argv[2:]
        task = Case(**json.loads(case))
        count = int(processes)
        first = int(core)
        os.sched_setaffinity(0, {first} if task.threads == 1 else set(range(task.threads)))
        speed = work(task, Path(where) if where else None, meeting=Path(folder), processes=count)
        sys.stdout.write(json.dumps(asdict(speed)) + "\n")
    else:
        main(chosen_results())
