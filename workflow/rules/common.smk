# Parse-time data and small functions: configuration, tables, what each job reads and is told.
import json
import sys
from pathlib import Path

from ntop.config.plan import shard_frames
from ntop.config.run import load_run
from ntop.config.sections import TrainConfig
from ntop.config.whole import body_model_of, stage_section
from ntop.conventions import ConfigError
from ntop.stages import VERSIONS

try:
    RUN = load_run(config)
except ConfigError as error:
    sys.exit(f"ntop: {error}")
CONFIG, ACTORS, SEQUENCES = RUN.config, RUN.actors, RUN.sequences

PACKAGES = "data/packages"
# what a source says to later stages must not rerun its capture
NOT_FOR_CAPTURE = {"overrides", "reference_masks", "held_out_views", "body_models"}
KEY = "{source}/{actor}"


wildcard_constraints:
    source="[a-z0-9_]+",
    actor="[a-z0-9_]+",
    action="[a-z0-9_]+",
    rig="[a-z0-9_.]+",
    shard="[0-9]{6}",


def params_json(stage, source=None, extra=None):
    """A stage's section and version as sorted JSON: a changed value reruns that stage."""
    values = stage_section(CONFIG, stage, source=source, extra=extra)
    return json.dumps(values | {"version": VERSIONS[stage]}, sort_keys=True)


def stage_params(stage):
    """A params function for a stage whose section depends on the source only."""

    def section_of(wildcards):
        return params_json(stage, getattr(wildcards, "source", None))

    return section_of


def memory_mb(first):
    """A resource function: twice as much once an attempt has failed, in case it lacked memory.

    Not more: under SLURM a training that needs several time slices has as many attempts.
    """

    def of_attempt(wildcards, attempt):
        return first * min(attempt, 2)

    return of_attempt


def body_model(wildcards):
    """The actor's SMPL file as a list of inputs, empty for the embedded body."""
    key = (wildcards.source, wildcards.actor)
    found = next(row for row in ACTORS if (row.source, row.actor) == key)
    return [path for path in [body_model_of(CONFIG, found)] if path]


def body_stage_params(stage):
    """A params function for a stage that poses the actor's body."""

    def section_of(wildcards):
        extra = {"body_model": path for path in body_model(wildcards)}
        return params_json(stage, wildcards.source, extra)

    return section_of


def sequences_of(wildcards, use):
    """The actor's sequences of one use."""
    key = (wildcards.source, wildcards.actor, use)
    return [row for row in SEQUENCES if (row.source, row.actor, row.use) == key]


def given(wildcards, what):
    """Whether the source brings `what` along, so that no stage computes it."""
    return what in CONFIG.sources[wildcards.source].provides


def capture_folder(wildcards):
    return f"results/1_capture/{wildcards.source}/{wildcards.actor}"


def given_or_masked(what):
    """An input function: where `what` lies, with the capture or with the mask stage."""

    def folder(wildcards):
        if given(wildcards, what):
            return capture_folder(wildcards)
        return f"results/2_mask/{wildcards.source}/{wildcards.actor}"

    return folder


matte_folder = given_or_masked("masks")
keypoint_folder = given_or_masked("keypoints2d")


def body_folder(wildcards):
    """Where bodies and cameras lie: given ones come with the capture."""
    if given(wildcards, "bodies"):
        return capture_folder(wildcards)
    return f"results/3_fit/{wildcards.source}/{wildcards.actor}"


def package_folders(names):
    return [f"{PACKAGES}/{name}" for name in names]


def motion_packages(rows):
    """The packages that the motions of these sequences come from."""
    return (
        ["pybullet"] if any(row.motion.startswith("deepmimic:") for row in rows) else []
    )


def render_row(wildcards):
    """The render sequence that a shard belongs to."""
    return next(
        row
        for row in sequences_of(wildcards, "render")
        if row.action == wildcards.action
    )


def sets_of_shard(wildcards):
    """The frames (sets) of one shard."""
    key = "{0.source}/{0.actor}/{0.action}/{0.rig}/{0.shard}".format(wildcards)
    return SHARDS[key]


def capture_packages(wildcards):
    section = CONFIG.sources[wildcards.source]
    rows = sequences_of(wildcards, "train") + sequences_of(wildcards, "render")
    if section.reader == "qualisys":
        return package_folders([section.package])
    rows = [row for row in rows if row.use == "train" or row.truth]
    return package_folders(motion_packages(rows))


def capture_params(wildcards):
    section = CONFIG.sources[wildcards.source]
    rows = sequences_of(wildcards, "train")
    rows += [row for row in sequences_of(wildcards, "render") if row.truth]
    extra = {
        "source_section": section.model_dump(
            mode="json", exclude_defaults=True, exclude=NOT_FOR_CAPTURE
        )
        | {"reader": section.reader},
        "sequences": [
            row.model_dump(mode="json", exclude_defaults=True) for row in rows
        ],
    }
    if any(row.truth for row in rows):
        rigs = CONFIG.render.rigs
        extra["rigs"] = {
            name: rig.model_dump(mode="json") for name, rig in rigs.items()
        }
        extra["image"] = CONFIG.render.image.model_dump(mode="json")
    return params_json("capture", None, extra)


def mask_packages(wildcards):
    section = stage_section(CONFIG, "mask", source=wildcards.source)
    needs_network = section.get("method", "mediapipe") == "mediapipe" or not given(
        wildcards, "keypoints2d"
    )
    return package_folders(["mediapipe"] if needs_network else [])


def perceptual_package(wildcards):
    """The package with the perceptual loss's weights, where the actor's avatar asks for them."""
    section = TrainConfig(**stage_section(CONFIG, "train", source=wildcards.source))
    path = section.perceptual_path
    return [str(path.parent)] if path and path.is_relative_to(PACKAGES) else []


def render_packages(wildcards):
    return package_folders(motion_packages([render_row(wildcards)]))


def render_motion(wildcards):
    return render_row(wildcards).motion


def assemble_params(wildcards):
    extra = {
        "dataset": wildcards.dataset,
        "actors": [row.model_dump(mode="json") for row in ACTORS],
        "rigs": list(CONFIG.render.rigs),
        "sets_per_shard": CONFIG.render.sets_per_shard,
    }
    return params_json("assemble", None, extra)


def actor_folders(folder_of):
    """One folder per actor, in the order of the actors table, each once."""

    def folders(wildcards):
        return [folder_of(actor) for actor in ACTORS]

    return folders


def evaluate_params(wildcards):
    names = sorted({actor.source for actor in ACTORS})
    sections = {name: CONFIG.sources[name] for name in names}
    extra = {
        "held_out_views": {
            name: list(section.held_out_views)
            for name, section in sections.items()
            if section.held_out_views
        },
        "reference_masks": {
            name: [item.model_dump(mode="json") for item in section.reference_masks]
            for name, section in sections.items()
            if section.reference_masks
        },
    }
    provides = {name: section.provides for name, section in sections.items()}
    extra["provides"] = {name: list(given) for name, given in provides.items() if given}
    files = {
        name: getattr(section, "body_models", {}) for name, section in sections.items()
    }
    extra["body_models"] = {
        name: by_gender for name, by_gender in files.items() if by_gender
    }
    return params_json("evaluate", None, extra)


def reference_mask_files(wildcards):
    sections = {actor.source: CONFIG.sources[actor.source] for actor in ACTORS}
    return [
        item.path for section in sections.values() for item in section.reference_masks
    ]


SHARDS = shard_frames(
    SEQUENCES,
    rigs=list(CONFIG.render.rigs),
    sets_per_shard=CONFIG.render.sets_per_shard,
)


def actor_shards(wildcards):
    """The annotations of everything that is rendered of one actor."""
    actor = f"{wildcards.source}/{wildcards.actor}"
    shards = [shard for shard in SHARDS if shard.startswith(f"{actor}/")]
    if not shards:
        raise ValueError(f"{CONFIG.sequences} has no render line of {actor}")
    return [f"results/6_annotate/{shard}.parquet" for shard in shards]


# topic of a file in the report's folder `exhibits` -> category, and what its last word is
EXHIBITS = {
    "views": ("Nine views", "rig"),
    "training": ("Training", "curve"),
    "scores": ("Scores", "score"),
    "contents": ("Dataset", "figure"),
    "run": ("Run", "table"),
}


def exhibit_category(wildcards):
    category, _ = EXHIBITS[wildcards.topic]
    return category


def exhibit_subcategory(wildcards):
    """The source, so that a campaign of many actors stays readable; the dataset for the rest."""
    words = wildcards.words.split("-")
    return words[0] if len(words) > 1 else wildcards.dataset


def exhibit_labels(wildcards):
    """What the report's table shows of a file."""
    *actor, last = wildcards.words.split("-")
    _, label = EXHIBITS[wildcards.topic]
    shown = last if label == "rig" else last.replace("_", " ")
    return {"actor": "/".join(actor), label: shown} if actor else {label: shown}
