"""An avatar that needs no training (the body itself, painted by part) and what renders from it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from ntop.body.authored_motions import named_motion
from ntop.body.model import load_body_model
from ntop.body.motions import retarget
from ntop.body.skinning import pose_joints
from ntop.config.sections import AnnotateConfig, AssembleConfig, RenderConfig
from ntop.field.avatar import Avatar, save_avatar
from ntop.field.canonical import CanonicalGrid, canonical_body, initial_grid
from ntop.stages import s5_render, s6_annotate, s7_assemble
from ntop.storage import schemas
from ntop.storage.atomic import write_bytes
from ntop.storage.bodies import body_rows
from ntop.storage.tables import write_table

SOURCE, ACTOR, ACTION, RIG = "lab", "ada", "wave", "h1.2_r1.0"
FRAMES = 4
UNUSABLE = 2  # the frame whose body the fit rejected
SIZE = 160


@dataclass(frozen=True)
class Shop:
    """Where the inputs of the render stage lie, and how to run it."""

    folder: Path
    config: RenderConfig

    def render(
        self,
        name: str,
        *,
        actor: str = ACTOR,
        frames: tuple[int, ...] = (0, 1, 2),
        motion: str = "",
    ) -> Path:
        """Render a shard into `name`; returns its folder."""
        out = self.folder / name
        s5_render.main(
            self.config,
            source=SOURCE,
            actor=actor,
            action=ACTION if not motion else "novel",
            rig=RIG,
            frames=list(frames),
            motion=motion,
            avatar=self.folder / "avatar",
            bodies=self.folder / f"{actor}.parquet",
            packages=self.folder,
            work=self.folder / "work" / name,
            out=out,
        )
        return out


@pytest.fixture(scope="session")
def shop(tmp_path_factory) -> Shop:
    """An avatar, the bodies of two actors and a small rig."""
    folder = tmp_path_factory.mktemp("shop")
    model = load_body_model()
    betas = (0.0,) * 10
    grid = initial_grid(canonical_body(model, betas), voxel_m=0.016, outer_m=0.03, inner_m=0.03)
    values = grid.values.copy()
    values[:, 0] *= 4  # sharper than training starts with: a surface instead of fog
    values[:, 1:] = 1.0
    light = np.zeros((9, 3), np.float32)
    light[0], light[3] = 0.6, 0.3
    sharp = CanonicalGrid(values, grid.bricks, grid.positions, grid.origin, grid.voxel_m)
    save_avatar(Avatar(sharp, light, betas, 0.04, 0), folder / "avatar", write=write_bytes)
    times_s = 0.9 * torch.arange(FRAMES, dtype=torch.float64)
    for actor in (ACTOR, "bob"):
        pose = retarget(
            named_motion("authored:range", folder),
            model,
            torch.tensor(betas, dtype=torch.float64),
            frame_times_s=times_s,
        )
        rows = body_rows(
            pose,
            pose_joints(model, pose),
            source=SOURCE,
            actor=actor,
            frames=[(ACTION, frame) for frame in range(FRAMES)],
            errors_mm=[0.0] * FRAMES,
            reasons=["head outside every view" if i == UNUSABLE else "" for i in range(FRAMES)],
        )
        write_table(rows, schema=schemas.BODY, path=folder / f"{actor}.parquet")
    config = RenderConfig.model_validate(
        {
            "rigs": {RIG: {"height_above_pelvis_m": 1.2, "ring_radius_m": 1.0}},
            "image": {"width_px": SIZE, "height_px": SIZE},
            "seed": 5,
        }
    )
    return Shop(folder, config)


def shard_name(actor: str, first: int) -> str:
    """Where a shard lies below the shop's folder."""
    return f"5_render/{SOURCE}/{actor}/{ACTION}/{RIG}/{first:06d}"


@pytest.fixture(scope="session")
def shards(shop) -> dict[str, Path]:
    """Rendered shards by name: two of the first actor, one of the second."""
    return {
        "first": shop.render(shard_name(ACTOR, 0), frames=(0, 1)),
        "second": shop.render(shard_name(ACTOR, UNUSABLE), frames=(UNUSABLE, 3)),
        "other": shop.render(shard_name("bob", 1), actor="bob", frames=(1,)),
    }


@pytest.fixture(scope="session")
def annotations(shards) -> dict[str, Path]:
    """The tables of annotations of the shards."""
    tables = {}
    for name, folder in shards.items():
        tables[name] = Path(str(folder).replace("5_render", "6_annotate") + ".parquet")
        tables[name].parent.mkdir(parents=True, exist_ok=True)
        s6_annotate.main(AnnotateConfig(), renders=folder, out=tables[name])
    return tables


@pytest.fixture(scope="session")
def assemble(shop, annotations, tmp_path_factory) -> Callable[..., Path]:
    """A function that assembles the shards; `splits` maps actors to splits."""
    lines = [
        f"{SOURCE}\t{ACTOR}\t{ACTION}\t0\t3\t1\trender",
        f"{SOURCE}\tbob\t{ACTION}\t1\t1\t1\trender",
    ]
    tables = tmp_path_factory.mktemp("tables")

    def run(out: Path, *, splits: tuple[tuple[str, str], ...], reverse: bool = False) -> Path:
        header = "source\tactor\taction\tfirst\tlast\tstep\tuse"
        table = tables / "sequences.tsv"
        table.write_text("\n".join([header, *(lines[::-1] if reverse else lines)]) + "\n")
        config = AssembleConfig.model_validate(
            {
                "dataset": "tiny",
                "rigs": [RIG],
                "sets_per_shard": 2,
                "actors": [
                    {"source": SOURCE, "actor": actor, "split": split, "gender": gender}
                    for (actor, split), gender in zip(splits, "fmn", strict=False)
                ],
            }
        )
        s7_assemble.main(
            config,
            sequences=table,
            renders=shop.folder / "5_render",
            annotations=annotations["first"].parents[4],  # above source/actor/action/rig
            out=out,
        )
        return out

    return run


@pytest.fixture(scope="session")
def dataset(assemble, tmp_path_factory) -> Path:
    """The assembled dataset: one actor per split."""
    return assemble(
        tmp_path_factory.mktemp("datasets") / "tiny", splits=((ACTOR, "train"), ("bob", "val"))
    )
