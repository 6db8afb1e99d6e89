"""Checks of a finished dataset against itself: cameras, masks, COCO files."""

import contextlib
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from ntop.body.skeletons import COCO17_SIGMAS, SMPL24_SIGMAS
from ntop.conventions import MASK_ALPHA, DataError
from ntop.report.inputs import Dataset
from ntop.storage.coco import read_coco
from ntop.storage.images import read_rgba
from ntop.storage.remedies import remedy
from ntop.storage.renders import fisheye_camera
from ntop.storage.sets import read_set

ANNOTATION_SIGMAS = {"person_keypoints": COCO17_SIGMAS, "person_smpl24": SMPL24_SIGMAS}


@dataclass(frozen=True)
class MaskChecks:
    """How the files' masks, codes and keypoints agree."""

    rle_equals_mask: float  # share of annotations
    visible_on_mask: float | None  # share of keypoints marked visible


def reprojection_max_px(dataset: Dataset) -> float:
    """Largest distance of stored 2D keypoints from the 3D points through the stored camera.

    From the manifest: the joints in the world and in the camera's frame. From the set files: joints
    and COCO points through the cameras that the JSON holds. All in float64; points outside the
    image circle count as well, because unclipped coordinates are kept.

    Raises:
        DataError: a set file is missing or damaged.
    """
    worst = 0.0
    for row in dataset.rows:
        camera = fisheye_camera(row)
        for person in row["persons"]:
            stored = _points(person["keypoints2d_smpl24_px"], 2)
            from_world, _ = camera.project(_points(person["joints3d_world_m"], 3))
            from_camera, _ = camera.lens.project(_points(person["joints3d_camera_m"], 3))
            worst = max(worst, _farthest(from_world, stored), _farthest(from_camera, stored))
    for views in dataset.sets.values():
        record = read_set(next(iter(views.values())), folder=dataset.folder)
        bodies = {body["person_id"]: body for body in record["bodies"]}
        for view in record["views"].values():
            camera = fisheye_camera(view["camera"])
            for person in view["persons"]:
                body = bodies[person["person_id"]]
                for points, pixels in (
                    ("joints3d_world_m", "keypoints2d_smpl24_px"),
                    ("coco17_world_m", "keypoints2d_coco17_px"),
                ):
                    projected, _ = camera.project(_points(body[points], 3))
                    worst = max(worst, _farthest(projected, _points(person[pixels], 2)))
    return worst


def annotation_files(dataset: Dataset) -> list[Path]:
    """The dataset's COCO files, all kinds and splits.

    Raises:
        DataError: a kind is missing altogether.
    """
    files = []
    for kind in ANNOTATION_SIGMAS:
        found = sorted((dataset.folder / "annotations").glob(f"{kind}_*.json"))
        if not found:
            folder = dataset.folder / "annotations"
            raise DataError(f"{folder}: no {kind}_*.json; {remedy(folder)}")
        files += found
    return files


def file_names(dataset: Dataset) -> set[str]:
    """What the COCO files call the images that are looked at."""
    return {row["image_path"] for row in dataset.rows}


def coco_self_ap(dataset: Dataset) -> float | None:
    """Lowest average precision of an annotation file against itself (pycocotools).

    None if no file has an annotation.
    """
    scores, names = [], file_names(dataset)
    for path in annotation_files(dataset):
        sigmas = ANNOTATION_SIGMAS[path.stem.rsplit("_", 1)[0]]
        with contextlib.redirect_stdout(io.StringIO()):  # pycocotools prints its progress
            truth = COCO()
            truth.dataset = read_coco(path, file_names=names)
            truth.createIndex()
            if not truth.anns:
                continue
            answers = [
                {key: a[key] for key in ("image_id", "category_id", "keypoints")} | {"score": 1.0}
                for a in truth.anns.values()
            ]
            evaluation = COCOeval(truth, truth.loadRes(answers), "keypoints")
            evaluation.params.kpt_oks_sigmas = np.array(sigmas)
            evaluation.evaluate()
            evaluation.accumulate()
            evaluation.summarize()
        scores.append(float(evaluation.stats[0]))
    return min(scores, default=None)


def check_masks(dataset: Dataset) -> MaskChecks:
    """Compare every image's mask with its run-length codes and its visible keypoints."""
    codes: dict[str, list[dict]] = {}
    for path in annotation_files(dataset):
        document = read_coco(path, file_names=file_names(dataset))
        names = {image["id"]: image["file_name"] for image in document["images"]}
        for annotation in document["annotations"]:
            name = names[annotation["image_id"]]
            codes.setdefault(name, []).append(annotation["segmentation"])
    equal = total = on_mask = visible = 0
    for row in dataset.rows:
        mask = read_rgba(dataset.image_path(row))[..., 3] >= MASK_ALPHA
        # run lengths are canonical: equal codes and sizes are equal masks
        expected = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
        for code in codes.get(row["image_path"], []):
            total += 1
            same_size = list(code["size"]) == list(expected["size"])
            equal += same_size and code["counts"].encode("ascii") == expected["counts"]
        for person in row["persons"]:
            for points, flags in (
                (person["keypoints2d_coco17_px"], person["visibility_coco17"]),
                (person["keypoints2d_smpl24_px"], person["visibility_smpl24"]),
            ):
                seen = np.array(flags) == 2
                columns, lines = np.floor(_points(points, 2).numpy()[seen]).astype(int).T
                on_mask += int(mask[lines, columns].sum())
                visible += int(seen.sum())
    return MaskChecks(
        rle_equals_mask=equal / total if total else 0.0,
        visible_on_mask=on_mask / visible if visible else None,
    )


def _farthest(a: torch.Tensor, b: torch.Tensor) -> float:
    return float((a - b).norm(dim=-1).max())


def _points(values: list[float], width: int) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64).reshape(-1, width)
