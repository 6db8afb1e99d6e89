"""Errors of the renderer's quadrature against the same avatar in float64, and what they cost.

The reference: pieces of at most 0.1 mm, nothing skipped, no early stop.
"""

import math
import sys
import time
import tracemalloc
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from benchmarks.subjects import Subject
from ntop.annotation.keypoints import project_keypoints
from ntop.annotation.visibility import NEIGHBOURS, OUTSIDE, SMPL24_LIMBS, keypoint_visibility
from ntop.conventions import PIXEL_CENTRE
from ntop.field.culling import body_pixels
from ntop.field.paper_sampler import paper_steps, trace_paper_rays
from ntop.field.posing import PosedAvatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import RayRendering, trace_rays
from ntop.geometry.cameras import Camera
from ntop.metrics.stripes import MAX_AMPLITUDE, MAX_Z, lock_in

Precision = Literal["fp64", "fp32", "fp16 values"]
RAYS_PER_VIEW = 1000
REPEATS = 16  # of few milliseconds each, which alone would be noise
MAX_RMS, MAX_P999 = 0.5, 1.0  # grey levels
SEEN_ALPHA = 0.02
BASE = RenderSettings(edge_rays=1)
REFERENCE = RenderSettings(
    step_m=1e-4,
    piece_depth=math.inf,
    stop_transmittance=0.0,
    colour_floor=0.0,
    cells=False,
    edge_rays=1,
)


@dataclass(frozen=True)
class Way:
    """A way to look along rays: our march, or the paper's samples (`samples` > 0) in our field.

    `shift` of the paper's samples, in steps: 0 is its left rule, 1/2 the midpoint rule.
    """

    settings: RenderSettings = BASE
    precision: Precision = "fp32"
    samples: int = 0
    shift: float = 0.0


@dataclass(frozen=True)
class Scene:
    """Rays of one view, what the reference sees along them, and the avatar as BASE wants it."""

    subject: Subject
    posed: PosedAvatar
    camera: Camera
    directions: torch.Tensor
    truth: np.ndarray  # (rays, 4) premultiplied colour and alpha
    depth_m: np.ndarray
    visibility: np.ndarray  # of the joints


@dataclass(frozen=True)
class Errors:
    """Over all rays that meet the body, in grey levels of 255; depth in mm where both are solid.

    `visibility_flips` of the joints that are in view; None: the paper's sampler has no depth.
    """

    rms: float
    p99: float
    p999: float
    max: float
    depth_median_mm: float | None
    depth_p99_mm: float | None
    mask_iou: float
    visibility_flips: int | None
    joints_in_view: int
    stripe_z: float
    stripe_amplitude: float
    evaluations_per_ray: float
    peak_mb: float

    @property
    def meets(self) -> bool:
        """The bars: rms, p99.9 and no stripes."""
        striped = self.stripe_z >= MAX_Z or self.stripe_amplitude >= MAX_AMPLITUDE
        return self.rms <= MAX_RMS and self.p999 <= MAX_P999 and not striped


def scene(person: Subject, rig: str, view: str) -> Scene:
    """Random pixels of one view, and their reference."""
    camera = person.cameras(rig)[view]
    posed = person.posed(BASE)
    v, u = np.nonzero(body_pixels(posed.warp, camera))
    chosen = np.random.default_rng(0).permutation(len(v))[:RAYS_PER_VIEW]
    chosen.sort()
    pixels = np.stack([u, v], 1)[chosen] + PIXEL_CENTRE
    directions, valid = camera.rays(torch.from_numpy(pixels))
    directions = directions[valid]
    exact = doubled(person.posed(REFERENCE))
    rays = trace_rays(exact, camera.center_world, directions, settings=REFERENCE)
    sys.stderr.write(f"{person.name} {rig} {view}: reference of {len(directions)} rays\n")
    return Scene(
        subject=person,
        posed=posed,
        camera=camera,
        directions=directions,
        truth=_four(rays.rgb, rays.alpha),
        depth_m=rays.depth_m,
        visibility=joint_visibility(person, exact, camera, REFERENCE),
    )


def doubled(posed: PosedAvatar) -> PosedAvatar:
    """The same weights in float64, and all that is packed of them."""
    grid = replace(posed.grid, values=posed.grid.values.astype(np.float64))
    return replace(posed, grid=grid, light=posed.light.astype(np.float64), density=None)


def halved(posed: PosedAvatar) -> PosedAvatar:
    """The field's values rounded to half precision."""
    values = posed.grid.values.astype(np.float16).astype(np.float32)
    return replace(posed, grid=replace(posed.grid, values=values), density=None)


def prepared(s: Scene, way: Way) -> PosedAvatar:
    """The avatar as a way of looking wants it posed."""
    posed, settings = s.posed, way.settings
    if (settings.cells, settings.extent) != (BASE.cells, BASE.extent):
        posed = s.subject.posed(settings)
    return {"fp64": doubled, "fp32": lambda p: p, "fp16 values": halved}[way.precision](posed)


def joint_visibility(
    person: Subject, posed: PosedAvatar, camera: Camera, settings: RenderSettings
) -> np.ndarray:
    """Visibility of the joints, from rays through their own pixels and the eight around each."""
    projected = project_keypoints(torch.from_numpy(person.joints_world()), camera)
    height, width = camera.lens.height, camera.lens.width
    own = np.floor(projected.pixels.numpy()[projected.in_view.numpy()]).astype(int)
    pixels = np.unique((own[:, None] + NEIGHBOURS).reshape(-1, 2), axis=0)
    u, v = np.clip(pixels, 0, (width - 1, height - 1)).T
    directions, valid = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    seen = trace_rays(posed, camera.center_world, directions[valid], settings=settings)
    depth_m, parts = np.zeros((height, width), np.float32), np.zeros((height, width), np.uint8)
    solid = seen.alpha >= 0.5
    u, v = u[valid.numpy()][solid], v[valid.numpy()][solid]
    depth_m[v, u], parts[v, u] = seen.depth_m[solid], seen.parts[solid]
    return keypoint_visibility(projected, SMPL24_LIMBS, depth_m=depth_m, parts=parts)


def look(s: Scene, way: Way, posed: PosedAvatar) -> tuple[np.ndarray, RayRendering | None, int]:
    """Colour and alpha (rays, 4), what else our march knows of the rays, and evaluations."""
    origin = s.camera.center_world
    if way.samples:
        seen = trace_paper_rays(
            posed, origin, s.directions,
            joints_world=s.subject.joints_world(), samples=way.samples, shift=way.shift,
        )  # fmt: skip
        evaluations = way.samples * int((seen.step_m > 0).sum())
        return _four(seen.rgb, seen.alpha), None, evaluations
    rays = trace_rays(posed, origin, s.directions, settings=way.settings)
    return _four(rays.rgb, rays.alpha), rays, rays.evaluations


def errors(scenes: list[Scene], way: Way) -> Errors:
    """Errors over the rays of some scenes, those that meet the body."""
    differences, depths_mm, evaluations, stripes, peak = [], [], 0, [], 0
    both = either = flips = in_view = 0
    for s in scenes:
        posed = prepared(s, way)
        tracemalloc.start()
        seen, rays, count = look(s, way, posed)
        peak = max(peak, tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        difference = 255 * (seen - s.truth)
        differences.append(difference[s.truth[:, 3] > SEEN_ALPHA])
        evaluations += count
        solid, truly = seen[:, 3] >= 0.5, s.truth[:, 3] >= 0.5
        both, either = both + (solid & truly).sum(), either + (solid | truly).sum()
        in_view += int((s.visibility != OUTSIDE).sum())
        if rays is not None:
            depths_mm.append(1e3 * np.abs(rays.depth_m - s.depth_m)[solid & truly])
            mine = joint_visibility(s.subject, posed, s.camera, way.settings)
            flips += int((mine != s.visibility).sum())
        stripes.append(striped(s, way, seen))
    every = np.concatenate(differences)
    largest = np.abs(every).max(-1)
    depth_mm = np.concatenate(depths_mm) if depths_mm else None
    return Errors(
        rms=float(np.sqrt((every**2).mean())),
        p99=float(np.percentile(largest, 99)),
        p999=float(np.percentile(largest, 99.9)),
        max=float(largest.max()),
        depth_median_mm=None if depth_mm is None else float(np.median(depth_mm)),
        depth_p99_mm=None if depth_mm is None else float(np.percentile(depth_mm, 99)),
        mask_iou=float(both / either),
        visibility_flips=None if depth_mm is None else flips,
        joints_in_view=in_view,
        stripe_z=max(found.z for found in stripes),
        stripe_amplitude=max(found.amplitude for found in stripes),
        evaluations_per_ray=evaluations / len(every),
        peak_mb=peak / 1e6,
    )


def striped(s: Scene, way: Way, seen: np.ndarray):
    """What of the error is periodic in the phase of the samples on the surface.

    Raises:
        RuntimeError: too few rays meet the body to tell.
    """
    phase = s.depth_m / way.settings.step_m
    if way.samples:
        origin, directions = s.camera.center_world.numpy(), s.directions.numpy()
        near, step = paper_steps(origin, directions, s.subject.joints_world(), samples=way.samples)
        phase = (s.depth_m - near) / np.where(step > 0, step, np.inf)
    solid = s.truth[:, 3] > 0.99
    found = lock_in((seen - s.truth)[None, :, :3], phase[None], solid[None])
    if not found.judged:
        raise RuntimeError(f"{found.pixels} rays cannot tell stripes: raise RAYS_PER_VIEW")
    return found


def seconds(scenes: list[Scene], way: Way, posed: list[PosedAvatar]) -> float:
    """Processor time to look along all rays of some scenes."""
    started = time.process_time()
    for _ in range(REPEATS):
        for s, one in zip(scenes, posed, strict=True):
            look(s, way, one)
    return time.process_time() - started


def _four(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.concatenate([rgb, alpha[:, None]], 1)
