"""One step of the twin's training: patches, gradients, update; and its state.

On the processor every patch is a piece of work for one thread, and gradients are added in the
patches' order: the result does not depend on the number of threads. A step depends on the seed and
its number only. On a GPU both hold up to the order in which it adds (atomics).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ntop.body.model import BodyModel
from ntop.field.humannerf.avatar import HumanNerfAvatar, TrainingRecord
from ntop.field.humannerf.checkpoints import load_checkpoint, save_checkpoint
from ntop.field.humannerf.device import compute_device, parallel
from ntop.field.humannerf.field import ActorField, on_device
from ntop.field.humannerf.march import Interval, box_interval, trace
from ntop.field.humannerf.networks import (
    hann_windows,
    new_networks,
)
from ntop.field.humannerf.settings import HumanNerfSettings
from ntop.field.humannerf.skeleton import canonical_skeleton, gaussian_bones, posed_skeleton
from ntop.field.patches import Patches, PatchSource, Perceptual
from ntop.field.progress import Progress, psnr_db
from ntop.field.views import TrainingViews

BETAS = (0.9, 0.99)
DECAY_STEPS = 500_000  # after which a rate is a tenth
WATCHED_PATCHES = 8
WATCHED_COUNTER = 1 << 60  # of the random numbers, far from any step's


class _Scored(NamedTuple):
    """One patch: gradients by parameter, its loss, and squared error over the person's pixels."""

    gradients: tuple[Tensor | None, ...]
    loss: float
    person_error: float
    person_pixels: int


class HumanNerfTrainer:
    """The networks, their optimiser and the loop's body. A context: it ends its threads."""

    def __init__(
        self,
        views: TrainingViews,
        model: BodyModel,
        betas: tuple[float, ...],
        *,
        settings: HumanNerfSettings,
        perceptual: Perceptual | None = None,
    ) -> None:
        """Step 0. The networks' first weights depend on the seed alone."""
        self._settings, self._perceptual, self._betas = settings, perceptual, betas
        self._device = compute_device()
        skeleton = canonical_skeleton(model, betas)
        self._box = skeleton.box
        sizes = settings.architecture
        priors = gaussian_bones(skeleton, sizes.volume_side)
        self._log_priors = priors.log().to(self._device)
        self._networks = new_networks(sizes, channels=len(priors), seed=settings.seed)
        self._networks.to(self._device)
        self._parameters = list(self._networks.parameters())
        self._optimiser = _optimiser(self._networks, settings)
        self._views = views
        self._poses = [
            on_device(posed_skeleton(model, views.poses.at(p)), self._device)
            for p in range(len(views.poses.transl))
        ]
        limits = {"side_px": settings.patch_px, "inside_share": settings.inside_share}
        self._source = PatchSource(views, np.flatnonzero(~views.watched), **limits)
        self._watched = _watched_patches(views, settings, limits)
        self._pool = ThreadPoolExecutor(max_workers=parallel(self._device))
        self.step = 0
        self.curve: list[Progress] = []

    def __enter__(self) -> "HumanNerfTrainer":
        return self

    def __exit__(self, *_: object) -> None:
        self._pool.shutdown()

    def advance(self) -> Progress:
        """One step; returns its line, which joins the curve now and then."""
        settings = self._settings
        generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=self.step))
        patches = self._source.draw(settings.patches, generator=generator)
        offsets = generator.random(
            (settings.patches, settings.patch_px**2, settings.samples), np.float32
        )
        volume = self._volume()
        leaf = volume.detach().requires_grad_()
        scored = list(
            self._pool.map(
                lambda p: self._score(patches, p, offsets[p], leaf), range(settings.patches)
            )
        )
        self._learn(scored, volume)
        self.step += 1
        person = max(sum(s.person_pixels for s in scored), 1)
        due = self._watched and self._due(settings.watch_every)
        progress = Progress(
            step=self.step,
            loss=sum(s.loss for s in scored) / settings.patches,
            psnr_person_db=psnr_db(sum(s.person_error for s in scored) / person / 3),
            watched_psnr_db=self._watched_psnr() if due else float("nan"),
        )
        if due or self._due(settings.record_every):
            self.curve.append(progress)
        return progress

    def avatar(self) -> HumanNerfAvatar:
        """What has been learned so far."""
        networks = new_networks(self._settings.architecture, channels=len(self._log_priors), seed=0)
        networks.load_state_dict({k: v.cpu() for k, v in self._networks.state_dict().items()})
        with torch.no_grad():
            volume = self._volume()[:-1].cpu()
        return HumanNerfAvatar(
            architecture=self._settings.architecture,
            canonical=networks["canonical"],
            non_rigid=networks["non_rigid"],
            volume=volume,
            box=self._box,
            betas=self._betas,
            open_bands=self._open_bands(),
            weight_floor=self._settings.weight_floor,
            samples=self._settings.samples,
            training=TrainingRecord(
                iterations=self.step, planned=self._settings.steps, loss=self._loss_name()
            ),
        )

    def save(self, path: Path) -> None:
        """Write the whole state atomically."""
        save_checkpoint(
            path, self._networks, self._optimiser,
            step=self.step, curve=self.curve, recipe=self._recipe(),
        )  # fmt: skip

    def restore(self, path: Path) -> None:
        """Go on where `path` was saved; nothing happens if there is none of these settings.

        Raises:
            DataError: the file is damaged.
        """
        found = load_checkpoint(path, self._networks, self._optimiser, recipe=self._recipe())
        if found is not None:
            self.step, self.curve = found[0], [Progress(*line) for line in found[1]]

    def _recipe(self) -> tuple[HumanNerfSettings, str]:
        # the length of the training changes nothing in a step
        return replace(self._settings, steps=0), self._loss_name()

    def _loss_name(self) -> str:
        weights = self._settings
        if self._perceptual is None:
            return f"{weights.mse_weight:g} MSE"
        return f"{weights.perceptual_weight:g} LPIPS + {weights.mse_weight:g} MSE"

    def _due(self, every: int) -> bool:
        return self.step % every == 0 or self.step == self._settings.steps

    def _volume(self) -> Float[Tensor, "25 x y z"]:
        return self._networks["motion"](self._log_priors)

    def _open_bands(self) -> float | None:
        first, last = self._settings.non_rigid_steps
        if self.step < first:
            return None
        return min((self.step - first) / max(last - first, 1), 1.0)

    def _field(self, volume: Float[Tensor, "25 x y z"]) -> ActorField:
        share, bands = self._open_bands(), self._settings.architecture.non_rigid_bands
        windows = None if share is None else hann_windows(bands, share).to(self._device)
        return ActorField(
            volume[:-1], self._box, self._networks["canonical"], self._networks["non_rigid"],
            windows,
        )  # fmt: skip

    def _score(
        self, patches: Patches, index: int, offsets: np.ndarray, leaf: Float[Tensor, "25 x y z"]
    ) -> _Scored:
        """Loss and gradients of one patch."""
        settings = self._settings
        seen = self._seen(self._field(leaf), patches, index, torch.from_numpy(offsets))
        target = patches.targets[index].to(self._device)
        error = (seen - target) ** 2
        loss = settings.mse_weight * error.mean()
        if self._perceptual is not None:
            distance = self._perceptual(seen[None], target[None])
            loss = loss + settings.perceptual_weight * distance.sum()
        person = patches.mattes[index] > 0.5
        gradients = (None,) * (len(self._parameters) + 1)
        if loss.requires_grad:  # a patch may miss the body
            inputs = [*self._parameters, leaf]
            gradients = torch.autograd.grad(loss, inputs, allow_unused=True)
        person_error = error.detach().cpu()[person].double().sum()
        return _Scored(gradients, float(loss.detach()), float(person_error), int(person.sum()))

    def _seen(
        self, field: ActorField, patches: Patches, index: int, offsets: Float[Tensor, "ray sample"]
    ) -> Float[Tensor, "row column 3"]:
        """A patch as the field shows it, on the patches' background."""
        skeleton = self._poses[self._views.pose_of_view[patches.view]]
        camera = self._views.cameras[self._views.camera_of_view[patches.view]]
        origin = camera.center_world.double() - torch.from_numpy(skeleton.origin_world)
        directions = patches.directions[index].reshape(-1, 3).float().to(self._device)
        origin = origin.float().to(self._device)
        background = patches.background.to(self._device)
        interval = box_interval(origin, directions, skeleton.box)
        rays = torch.nonzero(interval.hit)[:, 0]
        found = trace(
            field,
            skeleton,
            origin=origin,
            directions=directions[rays],
            interval=Interval(*(values[rays] for values in interval)),
            offsets=offsets.to(self._device)[rays],
            num_samples=self._settings.samples,
            weight_floor=self._settings.weight_floor,
        )
        shown = found.colours + background * (1 - found.opacity[:, None])
        everywhere = background.expand(len(directions), 3).index_copy(0, rays, shown)
        return everywhere.view(*patches.directions.shape[1:])

    def _learn(self, scored: list[_Scored], volume: Float[Tensor, "25 x y z"]) -> None:
        """Add the patches' gradients in their order, carry them through the decoder, and step."""
        count = self._settings.patches
        sums: list[Tensor | None] = [None] * (len(self._parameters) + 1)
        for patch in scored:
            for i, gradient in enumerate(patch.gradients):
                if gradient is not None:
                    sums[i] = gradient / count if sums[i] is None else sums[i] + gradient / count
        for parameter, total in zip(self._parameters, sums[:-1], strict=True):
            parameter.grad = total
        if sums[-1] is not None:
            volume.backward(sums[-1])
        decay = 0.1 ** (self.step / DECAY_STEPS)
        for group in self._optimiser.param_groups:
            group["lr"] = group["first_rate"] * decay
        self._optimiser.step()

    def _watched_psnr(self) -> float:
        """PSNR over the person's pixels of fixed patches of the views set aside."""
        field = self._field(self._volume().detach())
        middle = torch.full((1, 1), 0.5)

        @torch.no_grad()  # here and not above: the mode belongs to a thread
        def score(patches: Patches) -> tuple[float, int]:
            seen = self._seen(field, patches, 0, middle.expand(self._settings.patch_px**2, 1))
            person = patches.mattes[0] > 0.5
            error = ((seen.cpu() - patches.targets[0]) ** 2)[person]
            return float(error.double().sum()), int(person.sum())

        scores = list(self._pool.map(score, self._watched))
        pixels = max(sum(count for _, count in scores), 1)
        return psnr_db(sum(error for error, _ in scores) / pixels / 3)


def _optimiser(networks: nn.ModuleDict, settings: HumanNerfSettings) -> torch.optim.Adam:
    rates = {"canonical": settings.canonical_rate}
    groups = [
        {
            "params": list(network.parameters()),
            "lr": rates.get(name, settings.other_rate),
            "first_rate": rates.get(name, settings.other_rate),
        }
        for name, network in networks.items()
    ]
    return torch.optim.Adam(groups, betas=BETAS)


def _watched_patches(
    views: TrainingViews, settings: HumanNerfSettings, limits: dict
) -> list[Patches]:
    """Fixed patches, one each, of the views set aside; none if there are none."""
    chosen: Int[np.ndarray, " any"] = np.flatnonzero(views.watched)
    if not len(chosen):
        return []
    source = PatchSource(views, chosen, **limits)
    generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=WATCHED_COUNTER))
    return [source.draw(1, generator=generator) for _ in range(WATCHED_PATCHES)]
