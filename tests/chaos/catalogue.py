"""All disturbances: the few of `make test`, and the weighted deck of `make chaos`."""

import random
import signal

from tests.chaos.damage import (
    CAPTURED,
    IMAGES,
    damaged_result,
    damaged_work,
    lost_metadata,
    mangle,
    missing_file,
    moved_in_time,
    truncate,
    truncated_metadata,
)
from tests.chaos.signals import (
    kill_group,
    kill_head,
    kill_worker,
    press_ctrl_c,
    pull_the_plug,
    terminate_cleanly,
)
from tests.chaos.surroundings import (
    FAKETIME,
    duplicate_worker,
    full_disk,
    read_only,
    stale_plan_of_work,
    two_heads,
    wrong_clock,
)
from tests.chaos.trial import Kind
from tests.chaos.workspace import ACTOR, DATASET, OUTPUTS, can_mount

SHARDS = f"results/5_render/{ACTOR}/sit"

# quick ones: none repeats a training
QUICK = [
    Kind("kill -9 the worker", "render", kill_worker(signal.SIGKILL, "render")),
    Kind("kill -9 the worker", "annotate", kill_worker(signal.SIGKILL, "annotate")),
    Kind("kill -9 the worker", "assemble", kill_worker(signal.SIGKILL, "assemble")),
    Kind("kill -9 the process groups", "render", kill_group("render")),
    Kind("kill -9 the process groups", "assemble", kill_group("assemble")),
    Kind("kill -9 everything", "render", pull_the_plug("render")),
    Kind("kill -9 everything", "assemble", pull_the_plug("assemble")),
    Kind("kill -9 the head", "render", kill_head(signal.SIGKILL, "render")),
    Kind("kill -9 the head", "assemble", kill_head(signal.SIGKILL, "assemble")),
    Kind("SIGTERM to the worker", "render", terminate_cleanly("render")),
    Kind("SIGTERM to the worker", "assemble", kill_worker(signal.SIGTERM, "assemble")),
    Kind("SIGTERM to the head", "render", kill_head(signal.SIGTERM, "render")),
    Kind("SIGINT to the head", "render", kill_head(signal.SIGINT, "render")),
    Kind("SIGINT to the worker", "render", kill_worker(signal.SIGINT, "render")),
    Kind("Ctrl-C", "render", press_ctrl_c("render")),
    Kind("Ctrl-C", "assemble", press_ctrl_c("assemble")),
    Kind("truncate a PNG", "annotate", damaged_result(truncate, OUTPUTS["render"], "*.png",
                                                      rerun="annotate")),
    Kind("truncate a PNG", "assemble", damaged_result(truncate, OUTPUTS["render"], "*.png",
                                                      rerun="assemble")),
    Kind("truncate a PNG", "finished", damaged_result(truncate, IMAGES, "*.png")),
    Kind("overwrite bytes of a PNG", "assemble", damaged_result(mangle, OUTPUTS["render"], "*.png",
                                                                rerun="assemble")),
    Kind("overwrite bytes of a PNG", "finished", damaged_result(mangle, f"{DATASET}/depth",
                                                                "*.png")),
    Kind("remove a PNG", "annotate", missing_file(OUTPUTS["render"], "*.png", rerun="annotate")),
    Kind("truncate a Parquet", "annotate", damaged_result(truncate, OUTPUTS["render"], "*.parquet",
                                                          rerun="annotate")),
    Kind("truncate a Parquet", "assemble", damaged_result(truncate, "results/6_annotate",
                                                          "*.parquet", rerun="assemble")),
    Kind("truncate a Parquet", "finished", damaged_result(truncate, DATASET, "*.parquet")),
    Kind("overwrite bytes of a Parquet", "assemble", damaged_result(
        mangle, "results/6_annotate", "*.parquet", rerun="assemble")),
    Kind("truncate a set in the work folder", "render", damaged_work("render", "*.png")),
    Kind("truncate a table in the work folder", "render", damaged_work("render", "*.parquet")),
    Kind("truncate a COCO file", "finished", damaged_result(truncate, f"{DATASET}/annotations",
                                                            "*.json")),
    Kind("fill the disk", "render", full_disk("render", "results/work/5_render", (16, 500)),
         "mount"),
    Kind("fill the disk of the results", "render", full_disk("render", SHARDS, (16, 400)), "mount"),
    Kind("fill the disk", "assemble", full_disk("assemble", "results/7_assemble", (16, 3000)),
         "mount"),
    Kind("read-only output", "render", read_only("render", SHARDS), "mount"),
    Kind("read-only work folder", "render", read_only("render", "results/work/5_render"), "mount"),
    Kind("read-only output", "annotate", read_only("annotate", "results/6_annotate"), "mount"),
    Kind("read-only output", "assemble", read_only("assemble", "results/7_assemble"), "mount"),
    Kind("change the clock", "render", wrong_clock("render"), "faketime"),
    Kind("change the clock", "assemble", wrong_clock("assemble"), "faketime"),
    Kind("two heads on one folder", "render", two_heads),
    Kind("a second worker on one shard", "render", duplicate_worker("render")),
    Kind("another recipe's work folder", "render", stale_plan_of_work),
    Kind("lose Snakemake's records", "any", lost_metadata),
    Kind("empty Snakemake's records", "any", truncated_metadata),
]  # fmt: skip

# each repeats a training and what follows
SLOW = [
    Kind("kill -9 the worker", "capture", kill_worker(signal.SIGKILL, "capture")),
    Kind("kill -9 the worker", "mask", kill_worker(signal.SIGKILL, "mask")),
    Kind("kill -9 the worker", "fit", kill_worker(signal.SIGKILL, "fit")),
    Kind("kill -9 the worker", "train", kill_worker(signal.SIGKILL, "train")),
    Kind("kill -9 the worker", "evaluate", kill_worker(signal.SIGKILL, "evaluate")),
    Kind("kill -9 everything", "train", pull_the_plug("train")),
    Kind("kill -9 the head", "train", kill_head(signal.SIGKILL, "train")),
    Kind("SIGTERM to the worker", "train", terminate_cleanly("train")),
    Kind("Ctrl-C", "train", press_ctrl_c("train")),
    Kind("truncate a checkpoint", "train", damaged_work("train", "*.safetensors")),
    Kind("overwrite bytes of a checkpoint", "train", damaged_work("train", "*.safetensors",
                                                                  mangle)),
    Kind("truncate an avatar", "render", damaged_result(truncate, OUTPUTS["train"],
                                                        "*.safetensors", rerun="render")),
    Kind("corrupt a source frame", "train", damaged_result(mangle, f"{CAPTURED}/images", "*.png",
                                                           rerun="train")),
    Kind("truncate a source frame", "train", damaged_result(truncate, f"{CAPTURED}/images",
                                                            "*.png", rerun="train")),
    Kind("truncate a matte", "train", damaged_result(truncate, f"{CAPTURED}/masks", "*.png",
                                                     rerun="train")),
    Kind("truncate a Parquet", "train", damaged_result(truncate, CAPTURED, "*.parquet",
                                                       rerun="train")),
    Kind("fill the disk", "train", full_disk("train", "results/work/4_train", (16, 900)), "mount"),
    Kind("restore with old times", "annotate", moved_in_time(-400)),
    Kind("restore with future times", "annotate", moved_in_time(2)),
    Kind("a second worker on one actor", "train", duplicate_worker("train")),
]  # fmt: skip

# of QUICK and SLOW, for `make test`
IN_TESTS = [
    ("kill -9 the worker", "render"),
    ("kill -9 the process groups", "assemble"),
    ("kill -9 the head", "render"),
    ("SIGTERM to the worker", "render"),
    ("Ctrl-C", "render"),
    ("truncate a PNG", "finished"),
    ("truncate a Parquet", "assemble"),
    ("truncate a set in the work folder", "render"),
    ("fill the disk", "render"),
    ("read-only output", "assemble"),
    ("change the clock", "assemble"),
    ("a second worker on one shard", "render"),
]


def lacking(kind: Kind) -> str:
    """Why this machine cannot run a disturbance; empty if it can."""
    if kind.needs == "mount" and not can_mount():
        return "may not mount a small disk here; root may"
    if kind.needs == "faketime" and FAKETIME is None:
        return "no libfaketime here; on Debian: apt install faketime"
    return ""


def find(name: str, stage: str) -> Kind:
    """The disturbance of that name and stage."""
    return next(kind for kind in [*QUICK, *SLOW] if (kind.name, kind.stage) == (name, stage))


def deal(trials: int, seed: int) -> list[tuple[Kind, int]]:
    """Disturbances for so many trials, each with a seed.

    First each name once, at one of its stages, then the other stages, then quick ones again: a
    short deck leaves out stages sooner than a kind of disturbance.
    """
    chance = random.Random(seed)
    kinds = [kind for kind in [*QUICK, *SLOW] if not lacking(kind)]
    chance.shuffle(kinds)
    first = list({kind.name: kind for kind in kinds}.values())
    deck = [*first, *(kind for kind in kinds if kind not in first)]
    again = [kind for kind in QUICK if not lacking(kind)]
    while len(deck) < trials:
        deck.append(chance.choice(again))
    return [(kind, chance.randrange(2**31)) for kind in deck[:trials]]
