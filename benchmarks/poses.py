"""Error of novel poses over their distance from the training poses, on the pinned studio actor.

Every true view from above is scored, and a few of the training poses from above as well: they are
at distance 0, and what they miss is not the pose's doing. The distance of two poses is the mean
over the joints of the distance between them (mm) when the pelvises coincide, place and orientation;
that of a view is its pose's to the nearest pose that was trained on.

Usage: python -m benchmarks.poses [--capture FOLDER --avatar FOLDER] [--actor plain]
Finished pieces stay in --work; the same command goes on where it was stopped.
"""

import argparse
import json
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch
from jaxtyping import Float
from matplotlib import pyplot as plt
from scipy.stats import spearmanr

from benchmarks.environment import RESULTS, ROOT, write_result
from benchmarks.studio import capture_views, studio_capture
from ntop.body.model import BodyModel, load_body_model
from ntop.body.skinning import BodyPose, pose_body
from ntop.captures.studio.actors import dress_actor
from ntop.captures.studio.truth import TruePose, write_truth
from ntop.captures.studio.views import studio_light
from ntop.config.rigs import configured_rig
from ntop.config.run import Run, load_files
from ntop.config.sections import TrainConfig
from ntop.config.whole import stage_section
from ntop.field.interface import AnyAvatar, load_avatar, pose_avatar, render_view
from ntop.metrics.images import Cutout, mask_iou, psnr_person_db
from ntop.stages import s4_train
from ntop.storage import schemas
from ntop.storage.atomic import atomic_folder, write_bytes
from ntop.storage.bodies import body_pose_from_rows
from ntop.storage.images import read_depth, read_rgba
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import Row, read_table

TRAINING_POSES = 4  # of those, evenly spread, that are looked at from above
METRICS = {
    "psnr_person_db": "PSNR, person (dB)",
    "mask_iou": "mask IoU",
    "depth_error_mm": "depth error, median (mm)",
}
TRAINED = "training"  # the action that training poses are shown as


def main() -> None:
    """Score all views, then write poses.json and poses.png."""
    options = parsed()
    torch.set_num_threads(1)
    model = load_body_model()
    run = load_files([ROOT / "config/studio.yaml"], directory=ROOT)
    capture = options.capture or studio_capture(
        options.work / "capture", actor=options.actor, packages=options.packages
    )
    avatar = load_avatar(options.avatar or trained(run, capture, options.work))
    views = capture_views(capture, model)
    numbers = sorted(set(views.pose_of_view[~views.watched].tolist()))
    seen = [views.poses.at(p) for p in numbers]
    truths = [capture / "truth", training_truth(run, capture, seen, options.work / "truth")]
    known = relative_joints(model, seen)
    scored = []
    for truth in truths:
        for group in sets(truth):
            name = "{action}_{rig}_{frame:06d}.json".format(**group[0])
            path = options.work / "scores" / truth.parent.name / name
            if not path.exists():
                found = score_set(truth, group, avatar, model, known)
                path.parent.mkdir(parents=True, exist_ok=True)
                write_bytes(path, json.dumps(found, indent=1).encode())
            scored += json.loads(path.read_text())
    values = {
        "training_poses": len(seen),
        "steps": avatar.step,
        "views": len(scored),
        "summary": summary(scored),
        "scores": scored,
    }
    print(write_result("poses", values))
    plot(scored, RESULTS / "poses.png")


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--actor", default="plain", help="of the pinned capture")
    parser.add_argument("--capture", type=Path, help="a finished capture; default: made in --work")
    parser.add_argument("--avatar", type=Path, help="trained on it; default: trained in --work")
    parser.add_argument("--packages", type=Path, default=ROOT / "data/packages")
    parser.add_argument("--work", type=Path, default=ROOT / "benchmarks/work/poses")
    return parser.parse_args()


def trained(run: Run, capture: Path, work: Path) -> Path:
    """The avatar of a studio capture, trained as the workflow would."""
    out = work / "avatar"
    if not out.exists():
        [source] = {row["source"] for row in sets(capture / "truth")[0]}
        config = TrainConfig.model_validate(stage_section(run.config, "train", source=source))
        tables = [capture / f"{name}.parquet" for name in ("cameras", "masks", "bodies")]
        s4_train.main(config, capture, *tables, work=work / "training", out=out)
    return out


def training_truth(run: Run, capture: Path, seen: list[BodyPose], out: Path) -> Path:
    """The truth of a few training poses from above, by the studio that made the capture."""
    folder = out / "truth"
    if not folder.exists():
        [first, *_] = read_table(capture / "truth/renders.parquet", schema=schemas.RENDER)
        settings = run.config.sources[first["source"]]
        image = run.config.render.image
        chosen = np.linspace(0, len(seen) - 1, TRAINING_POSES).round().astype(int)
        with atomic_folder(folder) as part:
            write_truth(
                [TruePose(TRAINED, n, seen[n]) for n in chosen.tolist()],
                dress_actor(first["actor"], load_body_model()),
                source=first["source"],
                rigs={
                    name: configured_rig(place, image)
                    for name, place in run.config.render.rigs.items()
                },
                light=studio_light(settings.light_to_ambient),
                supersampling=settings.truth_supersampling,
                seed=settings.seed,
                out=part,
            )
    return folder


def sets(truth: Path) -> list[list[Row]]:
    """The rows of each set: one pose in one rig."""
    found: dict[tuple, list[Row]] = {}
    for row in read_table(truth / "renders.parquet", schema=schemas.RENDER):
        found.setdefault((row["action"], row["rig"], row["frame"]), []).append(row)
    return [found[key] for key in sorted(found)]


def relative_joints(model: BodyModel, poses: list[BodyPose]) -> Float[np.ndarray, "pose 23 3"]:
    """Joints but the pelvis relative to it (metres), the body frame's axes."""
    zero = torch.zeros(3, dtype=torch.float64)
    joints = [
        pose_body(model, BodyPose(pose.betas, zero, pose.body_pose, zero)).joints for pose in poses
    ]
    joints = torch.stack(joints)
    return (joints[:, 1:] - joints[:, :1]).numpy()


def score_set(
    truth: Path,
    rows: list[Row],
    avatar: AnyAvatar,
    model: BodyModel,
    known: Float[np.ndarray, "pose 23 3"],
) -> list[dict[str, Any]]:
    """Scores of one pose's views in one rig."""
    pose = body_pose_from_rows(rows[:1]).at(0)
    away = np.linalg.norm(relative_joints(model, [pose]) - known, axis=-1).mean(-1).min()
    posed = pose_avatar(avatar, model, pose)
    scores = []
    for row in rows:
        seen = render_view(posed, fisheye_camera(row))
        image = Cutout(seen.rgb.astype(np.float64), seen.alpha.astype(np.float64))
        reference = Cutout.from_rgba(read_rgba(truth / row["image_path"]))
        depth_m = read_depth(truth / row["depth_path"])
        both = (depth_m > 0) & (seen.depth_m > 0)
        key = {name: row[name] for name in ("action", "frame", "rig", "view")}
        found = {
            "distance_mm": 1000 * float(away),
            "psnr_person_db": psnr_person_db(image, reference),
            "mask_iou": float(mask_iou(image.mask, reference.mask)),
            "depth_error_mm": 1000 * float(np.median(np.abs(depth_m - seen.depth_m)[both])),
        }
        scores.append(key | {name: round(value, 5) for name, value in found.items()})
    print(f"{rows[0]['action']} {rows[0]['frame']} {rows[0]['rig']}: {scores[0]}", flush=True)
    return scores


def summary(scored: list[dict[str, Any]]) -> dict[str, Any]:
    """Means of training and novel poses, and how the latter's scores go with distance."""
    groups = {
        "trained": [s for s in scored if s["action"] == TRAINED],
        "novel": [s for s in scored if s["action"] != TRAINED],
    }
    novel = groups["novel"]
    poses = sorted({(s["action"], s["frame"]) for s in novel})
    of_pose = [[s for s in novel if (s["action"], s["frame"]) == pose] for pose in poses]
    distances = [group[0]["distance_mm"] for group in of_pose]
    found: dict[str, Any] = {"novel_poses": len(poses)}
    found["distance_mm"] = [min(distances), max(distances)]
    for metric in METRICS:
        means = [float(np.mean([s[metric] for s in group])) for group in of_pose]
        slope = float(np.polyfit(distances, means, 1)[0])
        found[metric] = {
            name: float(np.mean([s[metric] for s in group])) for name, group in groups.items()
        } | {
            "per_100_mm": 100 * slope,
            "rank_correlation": float(spearmanr(distances, means).statistic),
        }
    return found


def plot(scored: list[dict[str, Any]], path: Path) -> None:
    """Every view a dot, every pose's mean a ring, over the pose's distance."""
    mpl.use("agg")
    figure, axes = plt.subplots(1, len(METRICS), figsize=(12, 3.4), dpi=110)
    actions = sorted({s["action"] for s in scored}, key=lambda a: (a != TRAINED, a))
    for axis, (metric, label) in zip(axes, METRICS.items(), strict=True):
        for number, action in enumerate(actions):
            colour = "#222222" if action == TRAINED else f"C{number - 1}"
            mine = [s for s in scored if s["action"] == action]
            distances = [s["distance_mm"] for s in mine]
            axis.plot(distances, [s[metric] for s in mine], ".", ms=2.5, color=colour, alpha=0.35)
            places = sorted(set(distances))
            means = [np.mean([s[metric] for s in mine if s["distance_mm"] == d]) for d in places]
            axis.plot(places, means, "o", color=colour, markerfacecolor="none", label=action)
        axis.set_xlabel("distance from the nearest training pose (mm)")
        axis.set_title(label, fontsize=9)
        axis.spines[["top", "right"]].set_visible(False)
    axes[2].set_ylim(0, 1.3 * np.percentile([s["depth_error_mm"] for s in scored], 99))
    axes[0].legend(fontsize=7, frameon=False)
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    main()
