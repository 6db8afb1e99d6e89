"""The real capture's cameras held out in turn: neither poses nor avatar see the one that judges.

For each camera the stages fit and train run without it, configured as the demo is, and the avatar
is compared with that camera's pictures as the report does. Masks checked by hand exist of cam04
only; so that cameras can be compared, all are judged by the mask stage's mattes as well, on the
same frames.

Usage: python -m benchmarks.heldout [--results FOLDER]
Finished pieces stay in --work; the same command goes on where it was stopped.
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.environment import ROOT, write_result
from ntop.body.model import load_body_model
from ntop.config.run import Run, load_files
from ntop.config.sections import CaptureConfig, FitConfig, MaskConfig, TrainConfig
from ntop.config.whole import stage_section
from ntop.conventions import DataError
from ntop.masks.polygons import read_polygon_masks
from ntop.report.capture import Recording
from ntop.report.heldout import ReferenceMasks, score_heldout
from ntop.report.inputs import ActorFolders
from ntop.report.mesh import painted_body
from ntop.report.scores import ImageScores, mean_scores
from ntop.stages import s1_capture, s2_mask, s3_fit, s4_train
from ntop.stages.s8_evaluate import avatar_renderer
from ntop.storage.atomic import write_bytes
from ntop.tools import fetch

SOURCE, ACTOR = "balancing", "p00"
NETWORKS = "mediapipe"
BY_HAND, BY_STAGE = "masks checked by hand", "mattes of the mask stage"


@dataclass(frozen=True)
class Bench:
    """What all cameras share; `capture` and `mattes` are the stages' folders."""

    run: Run
    capture: Path
    mattes: Path
    work: Path

    def without(self, camera: str) -> Recording:
        """Fit and avatar of the other cameras, made where missing."""
        fit, avatar = self.work / camera / "fit", self.work / camera / "avatar"
        masks = self.mattes / "masks.parquet"
        if not fit.exists():
            config = FitConfig.model_validate(self._section("fit", camera))
            s3_fit.main(config, self.capture, self.mattes / "keypoints2d.parquet", masks, fit)
        if not avatar.exists():
            config = TrainConfig.model_validate(self._section("train", camera))
            cameras, bodies = fit / "cameras.parquet", fit / "bodies.parquet"
            work = self.work / camera / "training"
            s4_train.main(config, self.capture, cameras, masks, bodies, work, avatar)
        return Recording(ActorFolders(SOURCE, ACTOR, self.capture, self.mattes, fit, avatar))

    def _section(self, stage: str, camera: str) -> dict[str, Any]:
        extra = {"held_out_views": [camera]}
        return stage_section(self.run.config, stage, source=SOURCE, extra=extra)


def main() -> None:
    """Fit, train and score without each camera, then write heldout.json."""
    options = parsed()
    run = load_files([], directory=ROOT)
    bench = Bench(run, *captured(run, options), options.work)
    section = run.config.sources[SOURCE]
    checked = {
        (item.action, frame, item.view): mask
        for item in section.reference_masks
        for frame, mask in read_polygon_masks(ROOT / item.path).items()
    }
    frames = sorted({key[:2] for key in checked})
    rows = []
    for camera in section.views:
        path = options.work / camera / "scores.json"
        if not path.exists():
            recording = bench.without(camera)
            keys = [(*frame, camera) for frame in frames]
            found = [scored(recording, BY_STAGE, {k: recording.matte(k) >= 0.5 for k in keys})]
            by_hand = {key: checked[key] for key in keys if key in checked}
            found += [scored(recording, BY_HAND, by_hand)] if by_hand else []
            write_bytes(path, json.dumps([{"camera": camera} | f for f in found]).encode())
        rows += json.loads(path.read_text())
        print(*(row for row in rows if row["camera"] == camera), sep="\n", flush=True)
    alike = [ImageScores(**row["scores"]) for row in rows if row["reference"] == BY_STAGE]
    values = {
        "frames": [frame for _, frame in frames],
        "cameras": rows,
        "mean": asdict(mean_scores(alike)),
    }
    print(write_result("heldout", values))


def parsed() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--results",
        type=Path,
        default=ROOT / "results",
        help="of a demo, whose capture and mattes are taken; where there are none, they are made",
    )
    parser.add_argument("--packages", type=Path, default=ROOT / "data/packages")
    parser.add_argument("--work", type=Path, default=ROOT / "benchmarks/work/heldout")
    return parser.parse_args()


def captured(run: Run, options: argparse.Namespace) -> tuple[Path, Path]:
    """Folders of the real capture and of its mattes: a demo's, or made below `--work`."""
    done = [options.results / stage / SOURCE / ACTOR for stage in ("1_capture", "2_mask")]
    if all(folder.exists() for folder in done):
        return done[0], done[1]
    settings = run.config.sources[SOURCE]
    for name in (settings.package, NETWORKS):
        if not (options.packages / name).exists():
            fetch.main(name, options.packages / name)
    capture, mattes = options.work / "capture", options.work / "mattes"
    if not capture.exists():
        rows = [row for row in run.sequences if (row.source, row.use) == (SOURCE, "train")]
        config = CaptureConfig(source_section=settings, sequences=tuple(rows))
        s1_capture.main(config, SOURCE, ACTOR, packages=options.packages, out=capture)
    if not mattes.exists():
        config = MaskConfig.model_validate(stage_section(run.config, "mask", source=SOURCE))
        s2_mask.main(config, capture, packages=options.packages, out=mattes)
    return capture, mattes


def scored(recording: Recording, reference: str, masks: ReferenceMasks) -> dict[str, Any]:
    """Mean scores against one held-out camera's pictures, cut out with these masks."""
    model = load_body_model()
    [camera] = {view for _, _, view in masks}
    others = {view for _, _, view in recording.mattes} - {camera}
    found = score_heldout(
        recording,
        masks,
        render=avatar_renderer(recording.folders, model),
        paint=painted_body(recording, model, views=others).cutout,
    )
    if found is None:
        raise DataError(f"{recording.folders.capture}: no picture and body of {sorted(masks)}")
    scores = asdict(mean_scores(list(found.scores)))
    return {"reference": reference, "pictures": len(found.scores), "scores": scores}


if __name__ == "__main__":
    main()
