"""The truth from above: what perfect rendering and annotation would give for each set."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from ntop.body.skinning import BodyPose
from ntop.captures.studio.actors import Actor, pose_actor
from ntop.captures.studio.views import Light, light_actor, see
from ntop.captures.studio.visibility import VISIBILITY, measure_limbs, true_visibility
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.storage import schemas
from ntop.storage.images import write_depth, write_parts, write_rgba
from ntop.storage.keys import SetKey
from ntop.storage.pace import paced
from ntop.storage.renders import body_columns, render_row
from ntop.storage.tables import write_table


@dataclass(frozen=True)
class TruePose:
    """One body pose whose views are wanted (no leading dimensions)."""

    action: str
    frame: int
    pose: BodyPose


def write_truth(
    poses: Sequence[TruePose],
    actor: Actor,
    *,
    source: str,
    rigs: dict[str, Rig],
    light: Light,
    supersampling: int,
    seed: int,
    out: Path,
) -> None:
    """Write renders.parquet, visibility.parquet and the images of all sets into `out`.

    Files lie in `{action}/{rig}/{images,depth,parts}/`, so that one table holds all sets.
    """
    radii = measure_limbs(actor)
    renders, visibilities = [], []
    for item in paced(poses, what="capture: truth", total=len(poses), unit="sets"):
        posed = pose_actor(actor, item.pose)
        scene = light_actor(actor, posed, light)
        body = body_columns(actor.model, item.pose)
        pelvis = torch.tensor(body["joints3d_world_m"][:3], dtype=torch.float64)
        for name, rig in rigs.items():
            key = SetKey(source, actor.name, item.action, name, item.frame)
            for view, camera in top_view_cameras(rig, pelvis).items():
                picture = see(scene, camera, supersampling=supersampling)
                row = render_row(
                    key, view, camera=camera, rig=rig, body=body,
                    image_sha256="", avatar_sha256="", seed=seed,
                )  # fmt: skip
                for column in ("image_path", "depth_path", "parts_path"):
                    row[column] = f"{item.action}/{name}/{row[column]}"
                row["image_sha256"] = write_rgba(
                    picture.rgb, picture.alpha, path=out / row["image_path"]
                )
                write_depth(picture.depth_m, path=out / row["depth_path"])
                write_parts(picture.parts, path=out / row["parts_path"])
                renders.append(row)
                coco17, smpl24 = true_visibility(scene, radii, camera)
                keys = {k: row[k] for k in ("source", "actor", "action", "rig", "frame", "view")}
                visibilities.append(
                    keys
                    | {
                        "visibility_coco17": coco17.tolist(),
                        "visibility_smpl24": smpl24.tolist(),
                    }
                )
    write_table(renders, schema=schemas.RENDER, path=out / "renders.parquet")
    write_table(visibilities, schema=VISIBILITY, path=out / "visibility.parquet")
