"""A small world in the layout of the workflow: a posed body, ray-cast, captured, assembled.

Everything is written by the stages' own code or by `ntop.storage`; only the pictures come from a
plain ray caster, so that the right answers are known.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import torch

from ntop.body.model import load_body_model, part_labels
from ntop.body.skinning import BodyPose, pose_body
from ntop.captures.studio.raycast import RayMesh
from ntop.config.sections import AnnotateConfig, AssembleConfig
from ntop.config.tables import Actor
from ntop.field.avatar import Avatar, save_avatar
from ntop.field.canonical import canonical_body, initial_grid
from ntop.geometry.cameras import Camera, Pinhole, pixel_grid
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.metrics.images import Cutout
from ntop.report.inputs import ActorFolders
from ntop.stages import s6_annotate, s7_assemble
from ntop.storage import schemas
from ntop.storage.atomic import write_bytes
from ntop.storage.cameras import write_cameras
from ntop.storage.files import record_files
from ntop.storage.images import write_depth, write_matte, write_parts, write_rgba
from ntop.storage.keys import SetKey
from ntop.storage.png import encode_png
from ntop.storage.renders import body_columns, image_paths, render_row
from ntop.storage.tables import write_table

SIZE = 96
FRAMES = (0, 4)
SPLITS = {("studio", "plain"): "val", ("real", "p00"): "train"}


@dataclass(frozen=True)
class World:
    """Folders of the small world and the means to look at its people."""

    root: Path
    actors: tuple[ActorFolders, ...]
    dataset: Path
    benchmarks: Path

    def actors_table(self) -> Path:
        """The table of the two actors, as a configuration names it."""
        path = self.root / "actors.tsv"
        lines = [f"{actor.source}\t{actor.actor}\tval\n" for actor in self.actors]
        path.write_text("source\tactor\tsplit\n" + "".join(lines))
        return path

    @property
    def studio(self) -> ActorFolders:
        return next(actor for actor in self.actors if actor.source == "studio")

    @property
    def real(self) -> ActorFolders:
        return next(actor for actor in self.actors if actor.source == "real")


def pose(frame: int) -> BodyPose:
    """Standing upright in the world (z up), arms lowered, the knee bent more with every frame."""
    body_pose = torch.zeros(69, dtype=torch.float64)
    body_pose[15 * 3 + 2], body_pose[16 * 3 + 2] = -1.1, 1.1  # shoulders, about body z
    body_pose[3 * 3] = 0.15 * frame  # left knee
    return BodyPose(
        betas=torch.zeros(10, dtype=torch.float64),
        global_orient=torch.tensor([np.pi / 2, 0.0, 0.0], dtype=torch.float64),
        body_pose=body_pose,
        transl=torch.tensor([0.0, 0.0, 1.3], dtype=torch.float64),
    )


def cast(body_pose: BodyPose, camera: Camera):
    """Colour by part and height, alpha, depth and parts of the body, one ray per pixel."""
    model = load_body_model()
    vertices = pose_body(model, body_pose).vertices.numpy()
    faces = model.faces.numpy()
    pixels = pixel_grid(camera.lens.width, camera.lens.height, torch.float64).reshape(-1, 2)
    directions, valid = camera.rays(pixels)
    hits = RayMesh(vertices, faces).first_hits(camera.center_world.numpy(), directions.numpy())
    count = len(pixels)
    rgb, alpha = np.zeros((count, 3)), np.zeros(count)
    depth, parts = np.zeros(count, np.float32), np.zeros(count, np.uint8)
    labels = part_labels(model).numpy()[faces[hits.face, 0]]
    alpha[hits.ray] = valid.numpy()[hits.ray]
    heights = vertices[faces[hits.face, 0], 2]
    rgb[hits.ray] = np.stack([labels / 30 + 0.1, heights / 3 + 0.1, 0.4 + 0 * heights], -1)
    depth[hits.ray], parts[hits.ray] = hits.distance_m, labels + 1
    seen = alpha > 0
    shape = (camera.lens.height, camera.lens.width)
    return (
        (rgb * seen[:, None]).reshape(*shape, 3).clip(0, 1),
        alpha.reshape(shape),
        (depth * seen).reshape(shape),
        (parts * seen).reshape(shape).astype(np.uint8),
    )


def cutout(body_pose: BodyPose, camera: Camera) -> Cutout:
    """A renderer for the evaluation: exact."""
    rgb, alpha, _, _ = cast(body_pose, camera)
    return Cutout(rgb, alpha)


def painted(body_pose: BodyPose, camera: Camera) -> Cutout:
    """A painter for the evaluation: one colour for the whole body."""
    rgb, alpha, _, _ = cast(body_pose, camera)
    return Cutout(np.full_like(rgb, 0.5), alpha)


def side_cameras() -> dict[str, Camera]:
    """Two perspective cameras at the person's height."""
    lens = Pinhole(fx=110.0, fy=110.0, cx=48.0, cy=64.0, width=96, height=128)
    rotations = {
        "cam01": [[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]],
        "cam02": [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
    }
    centres = {"cam01": [2.2, 0.0, 1.0], "cam02": [0.0, -2.2, 1.0]}
    return {
        view: Camera(
            lens,
            torch.tensor(centres[view], dtype=torch.float64),
            torch.tensor(rotation, dtype=torch.float64),
        )
        for view, rotation in rotations.items()
    }


def write_renders(folder: Path, key: tuple[str, str], *, error: float) -> list[dict]:
    """A shard of exact views whose colours are off by `error`; returns the rows."""
    model = load_body_model()
    rig = Rig(1.2, 1.0, SIZE, SIZE, SIZE / np.pi)
    rows = []
    for frame in FRAMES:
        body = body_columns(model, pose(frame))
        pelvis = torch.tensor(body["joints3d_world_m"][:3], dtype=torch.float64)
        name = SetKey(*key, "stand", "h1.2_r1.0", frame)
        for view, camera in top_view_cameras(rig, pelvis).items():
            rgb, alpha, depth, parts = cast(pose(frame), camera)
            paths = image_paths(name, view)
            sha = write_rgba(np.clip(rgb + error, 0, 1), alpha, path=folder / paths["image_path"])
            write_depth(depth, path=folder / paths["depth_path"])
            write_parts(parts, path=folder / paths["parts_path"])
            rows.append(
                render_row(
                    name, view, camera=camera, rig=rig, body=body, image_sha256=sha,
                    avatar_sha256="", seed=0,
                )
            )  # fmt: skip
    write_table(rows, schema=schemas.RENDER, path=folder / "renders.parquet")
    (folder / "skipped.json").write_text("[]")
    record_files(folder)
    return rows


def write_capture(folder: Path, key: tuple[str, str]) -> None:
    """Two side cameras, stills, exact mattes and bodies."""
    source, actor = key
    frames, masks, bodies = [], [], []
    model = load_body_model()
    for frame in FRAMES:
        columns = body_columns(model, pose(frame))
        columns.pop("coco17_world_m")
        base = {"source": source, "actor": actor, "action": "stand", "frame": frame}
        bodies.append(base | columns | {"error_mm": 0.0, "reason": ""})
        for view, camera in side_cameras().items():
            rgb, alpha, _, _ = cast(pose(frame), camera)
            photo = np.where(alpha[..., None] > 0, rgb, 0.8)
            path = folder / "images" / f"{view}_{frame:06d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(encode_png(np.rint(photo * 255).astype(np.uint8)))
            write_matte(alpha, path=folder / "masks" / path.name)
            frames.append(
                base
                | {"view": view, "image_path": f"images/{path.name}", "image_index": -1}
                | {"width": 96, "height": 128, "reason": ""}
            )
            masks.append(
                base
                | {"view": view, "mask_path": f"masks/{path.name}", "confidence": 1.0}
                | {"method": "exact", "reason": ""}
            )
    write_table(frames, schema=schemas.FRAME, path=folder / "frames.parquet")
    write_table(masks, schema=schemas.MASK, path=folder / "masks.parquet")
    write_table(bodies, schema=schemas.BODY, path=folder / "bodies.parquet")
    cameras = {("stand", view): camera for view, camera in side_cameras().items()}
    write_cameras(cameras, source=source, actor=actor, path=folder / "cameras.parquet")


def write_avatar(folder: Path) -> None:
    """An untrained avatar: the body's own density, one grey."""
    betas = (0.0,) * 10
    body = canonical_body(load_body_model(), betas)
    grid = initial_grid(body, voxel_m=0.012, outer_m=0.04, inner_m=0.04)
    light = np.zeros((9, 3), np.float32)
    light[0] = 1
    save_avatar(Avatar(grid, light, betas, 0.04, 0), folder, write=write_bytes)


def write_truth(folder: Path, key: tuple[str, str]) -> None:
    """The studio's truth: the same views without the colour error, and their visibility."""
    rows = write_renders(folder, key, error=0.0)
    s6_annotate.main(AnnotateConfig(), folder, folder / "labels.parquet")
    labels = {row["sample_id"]: row for row in pq.read_table(folder / "labels.parquet").to_pylist()}
    columns = ("visibility_coco17", "visibility_smpl24")
    keys = ("source", "actor", "action", "rig", "frame", "view")
    table = [
        {name: row[name] for name in keys}
        | {name: labels[row["sample_id"]]["persons"][0][name] for name in columns}
        for row in rows
    ]
    pq.write_table(pa.Table.from_pylist(table), folder / "visibility.parquet")


def write_benchmark(path: Path, **cells: str) -> None:
    """A table as Snakemake writes it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\t".join(cells) + "\n" + "\t".join(cells.values()) + "\n")


def build_world(root: Path) -> World:
    """Write everything below `root`."""
    actors = []
    for key in SPLITS:
        place = "/".join(key)
        capture = root / "1_capture" / place
        write_capture(capture, key)
        if key[0] == "studio":
            write_truth(capture / "truth", key)
        shard = root / "5_render" / place / "stand/h1.2_r1.0/000000"
        write_renders(shard, key, error=0.1)
        annotations = root / "6_annotate" / place / "stand/h1.2_r1.0/000000.parquet"
        s6_annotate.main(AnnotateConfig(), shard, annotations)
        avatar = root / "4_train" / place
        avatar.mkdir(parents=True)
        write_avatar(avatar)
        curve = {
            "step": [1, 2, 3],
            "loss": [0.5, 0.3, 0.2],
            "watched_psnr_db": [float("nan"), 20.0, 22.0],
        }
        pq.write_table(pa.table(curve), avatar / "curve.parquet")
        actors.append(ActorFolders(*key, capture, capture, capture, avatar))
    declared = tuple(
        Actor(source=source, actor=actor, split=split, gender="m")
        for (source, actor), split in SPLITS.items()
    )
    dataset = root / "7_assemble" / "tiny"
    config = AssembleConfig(dataset="tiny", actors=declared, rigs=("h1.2_r1.0",), sets_per_shard=1)
    lines = [f"{source}\t{actor}\tstand\t0\t0\trender" for source, actor in SPLITS]
    table = root / "sequences.tsv"
    table.write_text("\n".join(["source\tactor\taction\tfirst\tlast\tuse", *lines]) + "\n")
    s7_assemble.main(config, table, root / "5_render", root / "6_annotate", dataset)
    benchmarks = root / "benchmarks"
    for index, (source, actor) in enumerate(SPLITS):
        write_benchmark(
            benchmarks / f"4_train/{source}/{actor}.tsv",
            s=f"{10 + index}.5", max_rss=f"{1024 * (index + 1)}.0", cpu_time="21.0",
        )  # fmt: skip
    write_benchmark(
        benchmarks / "6_annotate/real/p00/stand.tsv", s="0.1", max_rss="NA", cpu_time="NA"
    )
    # another dataset's, in the same results folder
    write_benchmark(benchmarks / "4_train/studio/other.tsv", s="999", max_rss="99999", cpu_time="9")
    write_benchmark(benchmarks / "7_assemble/other.tsv", s="999", max_rss="99999", cpu_time="9")
    scores = {"fit.joint_error_mm": 21.5, "fit.mask_iou": 0.9, "refine_cameras.heldout_px": None}
    (actors[1].bodies / "scores.json").write_text(json.dumps(scores))
    return World(root, tuple(actors), dataset, benchmarks)
