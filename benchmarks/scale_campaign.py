"""A synthetic campaign: the workflow's own rules and stages, rendering without pixels.

43 actors (22 sources of two studio actors each), six actions of 246 frames, nine views: 63,468 sets
or 571,212 images; smaller campaigns have fewer actors, the smallest fewer frames.
"""

import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

from ntop.conventions import VIEWS

ROOT = Path(__file__).parents[1]
ACTORS, ACTIONS, FRAMES = 43, 6, 246
NAMES = ("plain", "loose")  # the studio's actors
MOTION = "authored:range"
RIG = "h1.2_r1.0"
SOCKET = "stages.socket"

SOURCE = """  {name}:
    reader: studio
    provides: [masks, keypoints2d, bodies]
    num_cameras: 2
    image_size_px: 64
    supersampling: 1
    seed: {seed}
"""
CONFIG = """dataset: scale
actors: config/actors.tsv
sequences: config/sequences.tsv
sources:
{sources}train: {{steps: 3, rays_per_batch: 256, finest_voxel_mm: 20.0, warp_cell_mm: 40.0}}
render:
  rigs: {{{rig}: {{height_above_pelvis_m: 1.2, ring_radius_m: 1.0}}}}
  image: {{width_px: {size}, height_px: {size}}}
  storage: {storage}
"""


@dataclass(frozen=True)
class Campaign:
    """A folder in which the workflow runs, and how large its campaign is."""

    folder: Path
    images: int

    @classmethod
    def make(cls, folder: Path, *, actors: int, actions: int, frames: int, storage: str):
        """Write configuration and tables, copy the workflow, put the fast `render` on PATH."""
        for name in ("workflow", "profiles"):
            shutil.copytree(ROOT / name, folder / name)
        (folder / "config").mkdir()
        for name in ("Snakefile", "environment.yml"):
            shutil.copy(ROOT / name, folder)
        keys = [(f"studio{i // len(NAMES):02d}", NAMES[i % len(NAMES)]) for i in range(actors)]
        sources = sorted({source for source, _ in keys})
        text = "".join(SOURCE.format(name=name, seed=i) for i, name in enumerate(sources))
        config = CONFIG.format(sources=text, rig=RIG, size=64, storage=storage)
        (folder / "config/config.yaml").write_text(config)
        lines = ["source\tactor\tsplit\tgender"]
        lines += [f"{s}\t{a}\t{'val' if i % 5 else 'train'}\tn" for i, (s, a) in enumerate(keys)]
        (folder / "config/actors.tsv").write_text("\n".join(lines) + "\n")
        lines = ["source\tactor\taction\tfirst\tlast\tstep\tuse\tmotion"]
        for source, actor in keys:
            lines.append(f"{source}\t{actor}\trange\t0\t60\t60\ttrain\t{MOTION}")
            lines += [
                f"{source}\t{actor}\tdance{k}\t0\t{frames - 1}\t1\trender\t{MOTION}"
                for k in range(actions)
            ]
        (folder / "config/sequences.tsv").write_text("\n".join(lines) + "\n")
        shim = folder / "bin/ntop"
        shim.parent.mkdir()
        client = f'"{sys.executable}" -ISs "{ROOT}/benchmarks/fast_client.py" {folder}/{SOCKET}'
        real = Path(sys.executable).parent / "ntop"
        shim.write_text(
            "#!/bin/sh\n"
            f'case $1 in capture|train|lease|annotate) exec {client} "$@" ;; esac\n'
            f'exec "{real}" "$@"\n'
        )
        shim.chmod(0o755)
        return cls(folder, cls.images_of(actors, actions, frames))

    @staticmethod
    def images_of(actors: int, actions: int, frames: int) -> int:
        """Images of a campaign."""
        return actors * actions * frames * len(VIEWS)

    def environment(self) -> dict[str, str]:
        """Variables with which the campaign's own `ntop` is found first."""
        path = f"{self.folder / 'bin'}{os.pathsep}{Path(sys.executable).parent}"
        return os.environ | {
            "PATH": f"{path}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": str(ROOT),
        }
