"""Stripes: our sampler beside the paper's, on the same avatars, poses and cameras.

Per rig one set is looked at through the dataset's own fisheye cameras, and through a few pinholes
at the same places: the paper blamed the fisheye lens, but its sampler leaves stripes in both.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ntop.body.model import BodyModel
from ntop.conventions import PIXEL_CENTRE
from ntop.field.avatar import FIELD, load_avatar, read_avatar_files
from ntop.field.paper_sampler import SAMPLES, render_paper_view
from ntop.field.posing import PosedAvatar, pose_avatar
from ntop.field.quality import RenderSettings
from ntop.field.rendering import render_view, trace_rays
from ntop.geometry.cameras import Camera, Pinhole
from ntop.metrics.stripes import (
    MAX_AMPLITUDE,
    MAX_PHASE_SHIFT,
    MAX_Z,
    MIN_PIXELS,
    StripeScores,
    high_passed,
    score_pair,
)
from ntop.report.capture import pose_of
from ntop.report.gallery import DIRECTIONS
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.page import Comparison, Table
from ntop.report.pictures import Picture, Square, picture, square_with
from ntop.storage.keys import SetKey
from ntop.storage.renders import fisheye_camera

OPAQUE = 0.99
BORDER_PX = 2  # of the person, where opacity and colour change together
PINHOLE_VIEWS = ("centre", "e", "sw")
CROP_PX = 112  # of a picture: small enough that single pixels are seen
ENLARGED = 3
DETAIL = 2.5  # how much stronger than in the image detail is shown


@dataclass(frozen=True)
class SampledView:
    """A view by one sampler, twice: its samples in place, and half a step further.

    `phase` is the surface's depth in steps; colours are those of `mask`, zero elsewhere.
    """

    first: Float[np.ndarray, "height width 3"]
    second: Float[np.ndarray, "height width 3"]
    phase: Float[np.ndarray, "height width"]
    mask: Bool[np.ndarray, "height width"]

    @property
    def scores(self) -> StripeScores:
        """What both detectors say."""
        return score_pair(self.first, self.second, self.phase, self.mask)


def sampled_views(
    posed: PosedAvatar,
    camera: Camera,
    *,
    joints_world: Float[np.ndarray, "joint 3"],
    settings: RenderSettings,
) -> dict[str, SampledView]:
    """The same view by our sampler (`ours`) and by the paper's (`paper`), well inside the person.

    The phase is that of the depth halfway between two renders, which stripes in depth spare.
    """
    settings = replace(settings, edge_rays=1)
    shifted = replace(settings, phase=(settings.phase + 0.5) % 1)
    first = render_view(posed, camera, settings=settings)
    mask = well_inside(first.alpha >= OPAQUE)
    v, u = np.nonzero(mask)
    directions, _ = camera.rays(torch.from_numpy(np.stack([u, v], 1) + PIXEL_CENTRE))
    second = trace_rays(posed, camera.center_world, directions, settings=shifted)
    depth_m = _scattered((first.depth_m[mask] + second.depth_m) / 2, mask)
    ours = SampledView(
        first=np.where(mask[..., None], first.rgb, 0),
        second=_scattered(second.rgb, mask),
        phase=depth_m / settings.step_m,
        mask=mask,
    )
    papers = [
        render_paper_view(posed, camera, joints_world=joints_world, pixels=mask, shift=shift)
        for shift in (0.0, 0.5)
    ]
    inside = mask & (papers[0].alpha >= OPAQUE) & (papers[1].alpha >= OPAQUE)
    step_m = np.where(inside, papers[0].step_m, 1)
    paper = SampledView(
        first=papers[0].rgb,
        second=papers[1].rgb,
        phase=np.where(inside, (depth_m - papers[0].near_m) / step_m, 0),
        mask=inside,
    )
    return {"ours": ours, "paper": paper}


def well_inside(opaque: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """A mask without its border."""
    size = 2 * BORDER_PX + 1
    return cv2.erode(opaque.astype(np.uint8), np.ones((size, size), np.uint8)).astype(bool)


def pinhole_at(camera: Camera, target_world: Float[Tensor, " 3"]) -> Camera:
    """A pinhole at a camera's place that looks at a point, image up = world +y, same scale.

    Raises:
        DataError: the point is the camera's own place.
    """
    lens = camera.lens
    z = torch.nn.functional.normalize(target_world.double() - camera.center_world, dim=0)
    down = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    x = torch.nn.functional.normalize(torch.linalg.cross(down, z), dim=0)
    focal = min(lens.width, lens.height) / torch.pi
    pinhole = Pinhole(focal, focal, lens.width / 2, lens.height / 2, lens.width, lens.height)
    rotation = torch.stack([x, torch.linalg.cross(z, x), z])
    return Camera(pinhole, camera.center_world, rotation)


@dataclass(frozen=True)
class StripeCheck:
    """What one rig's set gave: scores by (lens, sampler, view), and the picture of one view."""

    key: SetKey
    scores: dict[tuple[str, str, str], StripeScores]
    shown: dict[str, tuple[str, dict[str, SampledView]]]  # by lens: view and its samplings


def check_stripes(
    dataset: Dataset,
    actors: list[ActorFolders],
    *,
    model_of: Callable[[ActorFolders], BodyModel],
    settings: RenderSettings | None = None,
) -> list[StripeCheck]:
    """One set of every rig, actors taking turns; rigs in which nobody is seen are left out.

    Only grids have a sampler to shift: actors with another field are left out.
    """
    settings = settings or RenderSettings()
    actors = [actor for actor in actors if read_avatar_files(actor.avatar).field == FIELD]
    if not actors:
        return []
    checks = []
    for turn, rig in enumerate(sorted({key.rig for key in dataset.sets})):
        for actor in [*actors[turn % len(actors) :], *actors[: turn % len(actors)]]:
            keys = sorted(
                (key for key in dataset.sets if (key.source, key.actor, key.rig)
                 == (actor.source, actor.actor, rig)
                 and any(row["persons"] for row in dataset.sets[key].values())),
                key=str,
            )  # fmt: skip
            if keys:
                key = keys[len(keys) // 2]
                checks.append(_checked_set(dataset, key, actor, model_of(actor), settings))
                break
    return checks


def stripe_values(checks: list[StripeCheck]) -> dict[str, float | None]:
    """The figures `stripes.{rig}.{lens}.{sampler}.*`: the worst of a rig's views."""
    values: dict[str, float | None] = {}
    for check in checks:
        for lens, sampler in sorted({key[:2] for key in check.scores}):
            found = _of(check, lens, sampler)
            for name in ("phase_rms", "amplitude", "z"):
                worst = max(getattr(scores, name) for scores in found.values())
                values[f"stripes.{check.key.rig}.{lens}.{sampler}.{name}"] = worst
    return values


def stripe_comparison(checks: list[StripeCheck]) -> Comparison | None:
    """Pictures of our sampler beside the paper's, and the scores per rig and lens."""
    if not checks:
        return None
    rows = []
    pictures = []
    for check in checks:
        for lens, sampler in sorted({key[:2] for key in check.scores}):
            found = _of(check, lens, sampler)
            rows.append(_row(f"{check.key.rig} · {lens} · {sampler}", found))
        pictures.append(
            tuple(
                shown
                for lens, (view, views) in check.shown.items()
                for shown in compared_samplers(views, view=view, lens=lens)
            )
        )
    head = (
        "rig · lens · sampler", "views", "phase shift, rms", "lock-in amplitude", "lock-in z",
        "views with z ≥ 4",
    )  # fmt: skip
    text = (
        "Errors of a ray marcher follow the surface's depth in steps, which shows as stripes along "
        "its contour lines. Two renders whose samples lie half a step apart measure that error "
        "without a reference; what of it is periodic in the depth is the stripes' amplitude, with "
        "its significance z. All are the worst of a rig's views, in grey levels of 255; limits are "
        f"{MAX_PHASE_SHIFT:g} levels of rms, {MAX_AMPLITUDE:g} of amplitude, z below {MAX_Z:g}. "
        f"The paper's sampler ({SAMPLES} samples across the joints' box, no jitter) renders the "
        "same avatars; its stripes are there with a pinhole as well. Views with fewer than "
        f"{MIN_PIXELS} pixels well inside the person cannot be judged and count as 0."
    )
    return Comparison(text, tuple(pictures), Table(head, tuple(rows)))


def compared_samplers(
    views: dict[str, SampledView], *, view: str, lens: str
) -> tuple[Picture, Picture]:
    """Ours and the paper's image, detail raised, cut to where the paper's differs most."""
    window = _telling_window(views["paper"])
    ours, paper = (
        picture(
            np.repeat(np.repeat(window.of(_raised(views[name])), ENLARGED, 0), ENLARGED, 1),
            alt=f"{words}, {lens}, {DIRECTIONS[view]} camera",
            caption=f"{words}: {lens}, {DIRECTIONS[view]} camera, detail raised {DETAIL:g} times",
        )
        for name, words in (("ours", "Our sampler"), ("paper", "The paper's sampler"))
    )
    return ours, paper


def _telling_window(paper: SampledView) -> Square:
    """The square in which half a step changes the paper's image most."""
    energy = ((paper.first - paper.second) ** 2).sum(-1)
    total = cv2.boxFilter(
        energy, -1, (CROP_PX, CROP_PX), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    v, u = np.unravel_index(total.argmax(), total.shape)
    return square_with(centre=(float(u), float(v)), side=CROP_PX)


def _raised(shown: SampledView) -> UInt8[np.ndarray, "height width 4"]:
    detail = high_passed(shown.first, shown.mask)
    colours = np.clip(shown.first + (DETAIL - 1) * detail, 0, 1)
    return np.rint(255 * np.dstack([colours, shown.mask])).astype(np.uint8)


def _checked_set(
    dataset: Dataset,
    key: SetKey,
    actor: ActorFolders,
    model: BodyModel,
    settings: RenderSettings,
) -> StripeCheck:
    rows = {view: row for view, row in dataset.sets[key].items() if row["persons"]}
    person = next(iter(rows.values()))["persons"][0]
    joints = np.array(person["joints3d_world_m"]).reshape(-1, 3)
    posed = pose_avatar(load_avatar(actor.avatar), model, pose_of(person))
    scores: dict[tuple[str, str, str], StripeScores] = {}
    shown: dict[str, tuple[str, dict[str, SampledView]]] = {}
    for view, row in rows.items():
        camera = fisheye_camera(row)
        cameras = {"fisheye": camera}
        if view in PINHOLE_VIEWS:
            cameras["pinhole"] = pinhole_at(camera, torch.from_numpy(joints[0]))
        for lens, at in cameras.items():
            views = sampled_views(posed, at, joints_world=joints, settings=settings)
            scores |= {(lens, sampler, view): s.scores for sampler, s in views.items()}
            if lens not in shown or view == PINHOLE_VIEWS[1]:
                shown[lens] = view, views
    return StripeCheck(key, scores, shown)


def _of(check: StripeCheck, lens: str, sampler: str) -> dict[str, StripeScores]:
    return {
        view: scores for (a, b, view), scores in check.scores.items() if (a, b) == (lens, sampler)
    }


def _row(name: str, found: dict[str, StripeScores]) -> tuple[str, ...]:
    judged = sum(s.pixels >= MIN_PIXELS for s in found.values())
    return (
        name,
        str(judged) if judged == len(found) else f"{judged} of {len(found)}",
        f"{max(s.phase_rms for s in found.values()):.2f}",
        f"{max(s.amplitude for s in found.values()):.3f}",
        f"{max(s.z for s in found.values()):.1f}",
        str(sum(s.z >= MAX_Z for s in found.values())),
    )


def _scattered(values: np.ndarray, mask: Bool[np.ndarray, "height width"]) -> np.ndarray:
    """Values of the mask's pixels as an image, zero elsewhere."""
    image = np.zeros((*mask.shape, *values.shape[1:]))
    image[mask] = values
    return image
