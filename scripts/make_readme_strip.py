"""Write docs/images/strip.png, the first picture of the README, from a finished dataset.

Usage: python scripts/make_readme_strip.py [DATASET [SOURCE/ACTOR]], after `make demo`.
"""

import io
import sys
from pathlib import Path

import cv2
import matplotlib as mpl
from matplotlib import pyplot as plt

from ntop.body.model import load_body_model
from ntop.report.capture import Recording
from ntop.report.inputs import ActorFolders, Dataset
from ntop.report.making import PANEL_SIDE_PX, Panel, making_panels
from ntop.stages.s8_evaluate import avatar_renderer
from ntop.storage.atomic import write_bytes

PAGE = Path(__file__).parents[1] / "docs/images/strip.png"
RESULTS = Path("results")


def draw(panels: tuple[Panel, ...]) -> bytes:
    """The panels side by side as a PNG; filled dots are visible keypoints, hollow ones occluded."""
    mpl.use("agg")
    figure, axes = plt.subplots(1, len(panels), figsize=(2.2 * len(panels), 2.5), dpi=110)
    for axis, panel in zip(axes, panels, strict=True):
        side = panel.image.shape[0]
        image = cv2.resize(panel.image, (PANEL_SIDE_PX,) * 2, interpolation=cv2.INTER_AREA)
        axis.imshow(image, extent=(0, side, side, 0))
        for skeleton in panel.skeletons:
            points = skeleton.points_px
            for start, end in skeleton.edges:
                axis.plot(*points[[start, end]].T, color="#e08a00", linewidth=1)
            seen = skeleton.visibility == 2
            axis.scatter(*points[seen].T, s=9, color="#e08a00", zorder=3)
            axis.scatter(*points[~seen].T, s=9, facecolor="white", edgecolor="#e08a00", zorder=3)
        axis.set(xlim=(0, side), ylim=(side, 0))
        axis.axis("off")
        axis.set_title(panel.name, fontsize=10)
    figure.tight_layout(pad=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", bbox_inches="tight", metadata={"Software": None})
    return buffer.getvalue()


def main(dataset: str = "demo", name: str = "studio/plain") -> None:
    """Compose the strip of one actor."""
    source, actor = name.split("/")
    capture = RESULTS / "1_capture" / name
    folders = ActorFolders(
        source=source,
        actor=actor,
        capture=capture,
        mattes=capture if (capture / "masks.parquet").exists() else RESULTS / "2_mask" / name,
        bodies=capture if (capture / "bodies.parquet").exists() else RESULTS / "3_fit" / name,
        avatar=RESULTS / "4_train" / name,
    )
    model = load_body_model()
    panels = making_panels(
        Dataset.read(RESULTS / "7_assemble" / dataset),
        Recording(folders),
        model=model,
        render=avatar_renderer(folders, model),
    )
    write_bytes(PAGE, draw(panels))


if __name__ == "__main__":
    main(*sys.argv[1:])
