"""Write the novel poses and held-out cameras of docs/benchmarks.md from their results."""

import json
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs/benchmarks.md"
RESULTS = ROOT / "benchmarks/results"
MARK, NEXT = "<!-- poses -->", "<!-- "
POSE_METRICS = {
    "psnr_person_db": ("PSNR, person (dB)", ".2f"),
    "mask_iou": ("mask IoU", ".4f"),
    "depth_error_mm": ("depth error, median (mm)", ".2f"),
}


def main() -> None:
    """Replace what lies between the mark and the next one."""
    lines = []
    for name, write in {"poses": pose_lines, "heldout": heldout_lines}.items():
        path = RESULTS / f"{name}.json"
        if path.exists():  # each is hours on its own
            lines += write(json.loads(path.read_text()))
    head, rest = PAGE.read_text().split(MARK)
    tail = rest.partition(NEXT)[2]
    PAGE.write_text(head + "\n".join([MARK, *lines, "", NEXT]) + tail)


def pose_lines(values: dict) -> list[str]:
    """How scores go with the distance from the training poses."""
    found = values["summary"]
    low, high = found["distance_mm"]
    lines = [
        "",
        "## Novel poses",
        "",
        "`python -m benchmarks.poses` (in `make bench-field`): the pinned studio actor from above,",
        f"{found['novel_poses']} poses that were not trained on, {low:.0f} to {high:.0f} mm from "
        "the nearest of the",
        f"{values['training_poses']} that were (mean over the joints, pelvises laid upon each "
        "other), and some",
        f"of those, from above as well; {values['views']} views. {where(values)}",
        "",
        "| score | training poses | novel poses | change per 100 mm | rank correlation |",
        "|---|---:|---:|---:|---:|",
    ]
    for name, (label, digits) in POSE_METRICS.items():
        row = found[name]
        lines.append(
            f"| {label} | {row['trained']:{digits}} | {row['novel']:{digits}} | "
            f"{row['per_100_mm']:+{digits}} | {row['rank_correlation']:+.2f} |"
        )
    return [*lines, "", "![Error over distance](../benchmarks/results/poses.png)"]


def heldout_lines(values: dict) -> list[str]:
    """One line per real camera, and their mean."""
    lines = [
        "",
        "## Real cameras held out in turn",
        "",
        "`python -m benchmarks.heldout` (in `make bench-field`): of the recording `balancing`, the "
        "stages",
        f"fit and train run without one camera, and its {len(values['frames'])} pictures of the "
        "reference frames judge the",
        "avatar, each cut out with the mask stage's matte. Only cam04 has masks checked by hand. "
        "The",
        f"painted body is the same body in one colour per part. {where(values)}",
        "",
        "| camera | PSNR, person (dB) | PSNR, box (dB) | mask IoU | painted body, person (dB) |",
        "|---|---:|---:|---:|---:|",
    ]
    rows = [(row["camera"], row["reference"], row["scores"]) for row in values["cameras"]]
    for camera, reference, scores in [*rows, ("mean", "", values["mean"])]:
        name = f"{camera}, {reference}" if "hand" in reference else camera
        lines.append(
            f"| {name} | {scores['psnr_person_db']:.2f} | {scores['psnr_box_db']:.2f} | "
            f"{scores['mask_iou']:.3f} | {scores['baseline_psnr_person_db']:.2f} |"
        )
    return lines


def where(values: dict) -> str:
    """The machine."""
    ran = values["environment"]
    return f"On {ran['cores']} cores of {ran['cpu']}, commit {ran['commit']}."


if __name__ == "__main__":
    main()
