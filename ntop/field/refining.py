"""Move cameras and people while their avatar is trained (docs/decisions/0023).

A rigid correction of a camera, or of a person in one frame, moves rays and nothing else. A batch of
rays is walked again with each ray turned and shifted a little about its person, which gives the
slopes of what it sees in six numbers; what a camera or a person does to a ray is a 6 x 6 matrix.
The steps are Gauss-Newton's on the training's own loss, one 6 x 6 system per camera and per frame.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int

from ntop.body.model import BodyModel
from ntop.body.skinning import pose_body
from ntop.field.checkpoints import Twists
from ntop.field.kernels.adjoint import ROBUST_WIDTH
from ntop.field.learners import Learner, StepRule, shown_colours
from ntop.field.schedule import TrainingSettings, decayed, level_at
from ntop.field.views import RayBatch, RaySource, TrainingViews
from ntop.geometry.rotations import cross_matrix, matrix_from_axis_angle

RAYS, VIEWS = 2048, 64  # of one update
EVERY = 2  # steps
RATE = (1.0, 0.3)  # share of the way to the batch's optimum, from the first to the last step
MEMORY = 0.9  # of the curvature, per update
NUDGE_M = (0.03, 0.003)  # how far rays move for their slopes, from the first to the last step
LEVER_M = 0.5  # of a turn: half a person
PRIOR = np.full(6, 30.0)  # per ray, rad^-2 and m^-2; a ray's curvature is near 1000 m^-2
TURN, SHIFT = slice(0, 3), slice(3, 6)  # of a correction's six numbers
RANDOM_COUNTER = 1 << 61  # of this module's random numbers, far from those of the steps


@dataclass(frozen=True)
class Corrections:
    """What was learned, in world axes: rotation (axis-angle, rad), then translation (m).

    A camera turns about its centre, a person about the pelvis.
    """

    cameras: Float[np.ndarray, "camera 6"]
    poses: Float[np.ndarray, "pose 6"]


class Refiner:
    """Moves rays by the twists that were learned so far, and learns.

    Twists are those of the places that cameras stand at (cameras of several actions at the same
    place share one), then those of the poses, which are in axes of the person's pelvis.
    """

    def __init__(
        self,
        views: TrainingViews,
        model: BodyModel,
        origins: Float[np.ndarray, "pose 3"],
        *,
        settings: TrainingSettings,
    ) -> None:
        """`origins`: of the poses' warps, which rays' origins are relative to (world, m)."""
        self._settings = settings
        stands = [
            np.concatenate([c.center_world.double(), c.rotation.double().flatten()])
            for c in views.cameras
        ]
        places, place_of = np.unique(np.stack(stands), axis=0, return_inverse=True)
        self._place_of: Int[np.ndarray, " camera"] = place_of.reshape(-1)
        self._centres: Float[np.ndarray, "place 3"] = places[:, :3]
        posed = [pose_body(model, views.poses.at(p).double()) for p in range(len(origins))]
        self._pelvis = np.stack([body.joints[0].numpy() for body in posed])
        self._turned = np.stack([body.posed_from_rest[0, :3, :3].numpy() for body in posed])
        self._origins = origins
        seen = np.unique(views.pose_of_view[~views.watched])
        learned = np.zeros(len(places) + len(origins), bool)
        learned[: len(places)] = settings.refine_cameras
        learned[len(places) + seen] = settings.refine_poses
        self._learned: Bool[np.ndarray, " twist"] = learned

    @property
    def num_twists(self) -> int:
        """Of places and poses together."""
        return len(self._learned)

    def moved(self, batch: RayBatch, twists: Twists) -> RayBatch:
        """The batch with cameras and people where the twists put them."""
        turns = _rotations(twists.values[:, TURN])
        place, pose = self._twists_of(batch)
        turned = self._turned[batch.poses]
        # the camera moves; then, for the person does, the ray moves back
        back = (turned @ turns[pose] @ turned.transpose(0, 2, 1)).transpose(0, 2, 1)
        shift = np.einsum("rab,rb->ra", turned, twists.values[pose, SHIFT])
        pelvis = (self._pelvis - self._origins)[batch.poses]
        away = batch.origins + twists.values[place, SHIFT] - pelvis - shift
        directions = np.einsum("rab,rb->ra", turns[place], batch.directions)
        return replace(
            batch,
            origins=np.einsum("rab,rb->ra", back, away) + pelvis,
            directions=np.einsum("rab,rb->ra", back, directions),
        )

    def learn(
        self,
        twists: Twists,
        source: RaySource,
        learner: Learner,
        *,
        gain: Float[np.ndarray, "camera 2 3"],
        rule: StepRule,
        step: int,
    ) -> Twists:
        """Twists after the update that is due at this step, if one is."""
        settings = self._settings
        if step % EVERY or level_at(step, settings) == 0:  # the first level is too coarse to tell
            return twists
        nudge_m, rate = (decayed(pair, step / settings.steps) for pair in (NUDGE_M, RATE))
        counter = RANDOM_COUNTER + step
        generator = np.random.Generator(np.random.Philox(key=settings.seed, counter=counter))
        batch = self.moved(source.draw(RAYS, num_views=VIEWS, generator=generator), twists)
        curvature, slopes = self._normal_equations(batch, learner, gain, rule, nudge_m)
        sums = np.zeros((self.num_twists, 6, 6)), np.zeros((self.num_twists, 6))
        counts = np.zeros(self.num_twists)
        effects = self._effects(batch)
        for owner, effect in zip(self._twists_of(batch), effects, strict=True):
            np.add.at(sums[0], owner, effect.transpose(0, 2, 1) @ curvature @ effect)
            np.add.at(sums[1], owner, np.einsum("rba,rb->ra", effect, slopes))
            np.add.at(counts, owner, 1)
        twists = Twists(
            values=twists.values.copy(),
            curvature=MEMORY * twists.curvature + sums[0],
            rays=MEMORY * twists.rays + counts,
        )
        for i in np.flatnonzero(self._learned & (counts > 0)):
            bowl = twists.curvature[i] / twists.rays[i] + np.diag(PRIOR)
            slope = sums[1][i] / counts[i] + PRIOR * twists.values[i]
            twists.values[i] -= rate * np.linalg.solve(bowl, slope)
        self._fix_gauge(twists.values)
        return twists

    def corrections(self, twists: Twists) -> Corrections:
        """What the twists do to each camera and each pose."""
        poses = twists.values[len(self._centres) :].reshape(-1, 2, 3)
        in_world = np.einsum("pab,pkb->pka", self._turned, poses)
        return Corrections(twists.values[self._place_of], in_world.reshape(-1, 6))

    def _twists_of(self, batch: RayBatch) -> tuple[np.ndarray, np.ndarray]:
        """The twists of each ray's camera and of its pose."""
        return self._place_of[batch.cameras], len(self._centres) + batch.poses

    def _effects(self, batch: RayBatch) -> tuple[np.ndarray, np.ndarray]:
        """How a camera's and a pose's twist (6) turn and shift each ray about its pelvis (6)."""
        place, _ = self._twists_of(batch)
        camera = np.tile(np.eye(6), (len(place), 1, 1))
        arms = torch.from_numpy(self._centres[place] - self._pelvis[batch.poses])
        camera[:, SHIFT, TURN] = cross_matrix(arms).numpy()
        person = np.zeros_like(camera)
        person[:, TURN, TURN] = person[:, SHIFT, SHIFT] = -self._turned[batch.poses]
        return camera, person

    def _normal_equations(
        self,
        batch: RayBatch,
        learner: Learner,
        gain: Float[np.ndarray, "camera 2 3"],
        rule: StepRule,
        nudge_m: float,
    ) -> tuple[Float[np.ndarray, "ray 6 6"], Float[np.ndarray, "ray 6"]]:
        """Gauss-Newton's curvature and slope of each ray's loss in its own motion."""

        def shown(rays: RayBatch) -> Float[np.ndarray, "ray 4"]:
            seen = learner.seen(rays, rule)
            return np.concatenate([shown_colours(seen, rays, gain), seen[:, 3:]], axis=1)

        matte = batch.mattes[:, None]
        wanted = matte * batch.targets + (1 - matte) * batch.backgrounds
        errors = shown(batch) - np.concatenate([wanted, matte], axis=1)
        effects = np.empty((len(errors), 4, 6))
        for k in range(6):
            size = nudge_m / LEVER_M if k < 3 else nudge_m
            ends = [shown(self._nudged(batch, side * size * np.eye(6)[k])) for side in (-1, 1)]
            effects[..., k] = (ends[1] - ends[0]) / (2 * size)
        robust = 1 / np.sqrt(errors[:, :3] ** 2 + ROBUST_WIDTH**2)
        weights = np.concatenate(
            [
                batch.colour_weights[:, None] * robust,
                2 * rule.matte_weight * batch.matte_weights[:, None],
            ],
            axis=1,
        )
        weighted = weights[..., None] * effects
        return effects.transpose(0, 2, 1) @ weighted, np.einsum("rca,rc->ra", weighted, errors)

    def _nudged(self, batch: RayBatch, motion: Float[np.ndarray, " 6"]) -> RayBatch:
        """All rays turned about their pelvis, and shifted."""
        turn = _rotations(motion[None, TURN])[0]
        pelvis = (self._pelvis - self._origins)[batch.poses]
        return replace(
            batch,
            origins=np.einsum("ab,rb->ra", turn, batch.origins - pelvis) + pelvis + motion[SHIFT],
            directions=np.einsum("ab,rb->ra", turn, batch.directions),
        )

    def _fix_gauge(self, twists: Float[np.ndarray, "twist 6"]) -> None:
        """Take off what all cameras, or all people, do together: the avatar could follow it."""
        count = len(self._centres)
        arms = self._centres - self._pelvis.mean(0)
        cameras, poses = self._learned[:count], count + np.flatnonzero(self._learned[count:])
        if cameras.any():  # as one body, about the middle of the people
            turn = twists[:count, TURN].mean(0)
            shift = (twists[:count, SHIFT] - np.cross(twists[:count, TURN], arms)).mean(0)
            twists[:count, TURN] -= turn
            twists[:count, SHIFT] -= shift + np.cross(turn, arms)
        if len(poses):
            twists[poses] -= twists[poses].mean(0)


def _rotations(
    axis_angles: Float[np.ndarray, "any 3"],
) -> Float[np.ndarray, "any 3 3"]:
    return matrix_from_axis_angle(torch.from_numpy(axis_angles)).numpy()
