"""What all points of the field's benchmark share: pictures, truth and finished pieces."""

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.field_points import Point
from benchmarks.studio import Scores, Show, score
from ntop.body.model import BodyModel
from ntop.body.skinning import BodyPose
from ntop.field.interface import AnyAvatar, load_avatar, pose_avatar, render_view, save_avatar
from ntop.field.posing import PosedAvatar
from ntop.field.rendering import Rendering
from ntop.field.views import TrainingViews
from ntop.geometry.cameras import Camera
from ntop.metrics.lpips import Lpips
from ntop.storage.atomic import write_bytes

Correction = Callable[[PosedAvatar, BodyPose, Camera, Rendering], Rendering]


@dataclass(frozen=True)
class Trained:
    """An avatar, what `Point` says of its training, and what corrects its pictures, if anything."""

    avatar: AnyAvatar
    facts: dict[str, Any]
    correction: Correction | None = None


@dataclass(frozen=True)
class Bench:
    """What all points share."""

    work: Path
    capture: Path
    views: TrainingViews
    model: BodyModel
    rows: list[dict[str, Any]]
    lpips: Lpips | None

    @property
    def betas(self) -> tuple[float, ...]:
        """The actor's shape."""
        return tuple(float(value) for value in self.views.poses.betas[0])

    def point(self, name: str, train_it: Callable[[], Trained]) -> Point:
        """A finished piece from disk, or train, score and keep it."""
        folder = self.work / name
        path = folder / "point.json"
        if not path.exists():
            trained = train_it()
            save_avatar(trained.avatar, folder, write=write_bytes)
            seconds: list[float] = []
            show = self._shown(load_avatar(folder), trained.correction, seconds)
            found = score(self.capture, self.rows, show, lpips=self.lpips)
            per_view = sum(seconds) / len(self.rows)
            values = trained.facts | {
                "render_s_per_view": round(per_view, 3),
                "scores": asdict(found),
            }
            write_bytes(path, json.dumps(values, indent=1).encode())
        values = json.loads(path.read_text())
        point = Point(**values | {"scores": Scores(**values["scores"])})
        print(f"{name}: {point}", flush=True)
        return point

    def _shown(
        self, avatar: AnyAvatar, correction: Correction | None, seconds: list[float]
    ) -> Show:
        def show(pose: BodyPose, cameras: list[Camera]) -> list[Rendering]:
            started = time.monotonic()
            posed = pose_avatar(avatar, self.model, pose)
            found = [render_view(posed, camera) for camera in cameras]
            if correction is not None:
                found = [
                    correction(posed, pose, camera, rendering)
                    for camera, rendering in zip(cameras, found, strict=True)
                ]
            seconds.append(time.monotonic() - started)
            return found

        return show
