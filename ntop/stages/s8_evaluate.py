"""Stage 8, evaluate: dataset, captures, avatars -> metrics.json, report.html and its exhibits."""

import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ntop.body.model import BodyModel, load_body_model
from ntop.body.skinning import BodyPose
from ntop.config.sections import EvaluateConfig
from ntop.config.tables import Actor, read_tsv
from ntop.conventions import ConfigError, DataError
from ntop.field.interface import load_avatar, pose_avatar, render_view
from ntop.geometry.cameras import Camera
from ntop.masks.polygons import read_polygon_masks
from ntop.metrics.images import Cutout
from ntop.report.blobs import blob_max_px
from ntop.report.capture import Recording
from ntop.report.checks import check_masks, coco_self_ap, reprojection_max_px
from ntop.report.costs import cost_charts, cost_table, cost_values, stage_costs, with_own
from ntop.report.exhibits import (
    Exhibit,
    actor_exhibits,
    dataset_exhibits,
    score_exhibits,
    write_exhibits,
)
from ntop.report.figures import complete, figures, write_metrics
from ntop.report.gallery import contact_sheet, representative_sets
from ntop.report.heldout import (
    ReferenceMasks,
    Renderer,
    heldout_comparison,
    heldout_values,
    score_heldout,
)
from ntop.report.inputs import ActorFolders, Dataset, ResultFolders
from ntop.report.making import making_strip
from ntop.report.mesh import painted_body
from ntop.report.page import Comparison, Page, Strip, write_page
from ntop.report.stripes import check_stripes, stripe_comparison, stripe_values
from ntop.report.summary import (
    headline,
    lead,
    left_out_table,
    provenance_rows,
    read_dataset_record,
    statistics_table,
    tiles,
)
from ntop.report.training import training_charts, training_values
from ntop.report.truth import score_truth, truth_comparison, truth_values
from ntop.storage.atomic import atomic_folder
from ntop.storage.files import check_files
from ntop.storage.pace import paced
from ntop.storage.remedies import remedy

Values = dict[str, float | None]


@dataclass(frozen=True)
class ActorReport:
    """What one actor adds to the metrics and the page."""

    values: Values
    strip: Strip
    heldout: Comparison | None
    truth: Comparison | None
    exhibits: tuple[Exhibit, ...]


def main(
    config: EvaluateConfig,
    dataset: Path,
    actors: Path,
    captures: Path,
    masks: Path,
    fits: Path,
    avatars: Path,
    benchmarks: Path,
    out: Path,
) -> None:
    """Write metrics.json, report.html and the folder `exhibits` (for `snakemake --report`).

    `actors` is the table of all actors; `captures`, `masks`, `fits` and `avatars` are the stages'
    folders with `{source}/{actor}` below; `benchmarks` has Snakemake's benchmark tables. Checks and
    pictures are of all sets, or of `config.max_sets` in a larger dataset.

    Raises:
        DataError: a result is missing or damaged.
    """
    started = time.monotonic()
    roots = ResultFolders(captures, masks, fits, avatars)
    folders = [
        roots.of(row, provides=config.provides.get(row.source, ()))
        for row in read_tsv(actors, Actor)
    ]
    check_files(*(p for a in folders for p in (a.capture, a.mattes, a.bodies, a.avatar)))
    assembled = Dataset.read(dataset, max_sets=config.max_sets)
    in_turn = paced(folders, what="evaluate", total=len(folders), unit="actors")
    reports = {actor.name: report_actor(config, assembled, actor) for actor in in_turn}
    record = read_dataset_record(assembled)
    values = mean_values([report.values for report in reports.values()])
    values |= dataset_values(assembled)
    checks = check_stripes(assembled, folders, model_of=lambda actor: body_model_of(config, actor))
    values |= stripe_values(checks)
    exhibits = [item for report in reports.values() for item in report.exhibits]
    measured = stage_costs(benchmarks, actors=set(reports), dataset=assembled.name)
    costs = with_own(measured, started=started)
    table = cost_table(costs, num_images=assembled.num_images)
    exhibits += dataset_exhibits(
        assembled,
        statistics=statistics_table(record),
        left_out=left_out_table(record, folders),
        costs=table,
    )
    values |= cost_values(costs)
    page = compose(assembled, folders, reports=reports, values=complete(values))
    page = replace(
        page,
        costs=cost_charts(costs),
        cost_table=table,
        stripes=stripe_comparison(checks),
    )
    with atomic_folder(out) as folder:
        by_actor = {name: report.values for name, report in reports.items()}
        write_metrics(values, by_actor=by_actor, path=folder / "metrics.json")
        write_page(page, folder / "report.html")
        write_exhibits(exhibits, folder / "exhibits")


def report_actor(config: EvaluateConfig, dataset: Dataset, actor: ActorFolders) -> ActorReport:
    """Scores and pictures of one actor."""
    model = body_model_of(config, actor)
    recording = Recording(actor)
    held_out = set(config.held_out_views.get(actor.source, ()))
    render = avatar_renderer(actor, model)
    seen = {view for _, _, view in recording.mattes} - held_out
    paint = painted_body(recording, model, views=seen).cutout
    values = fit_values(actor) | training_values(actor)
    heldout = truth = None
    exhibits = actor_exhibits(dataset, actor)
    references = reference_masks(config, actor.source)
    found = score_heldout(recording, references, render=render, paint=paint)
    if found is not None:
        values |= heldout_values(found)
        heldout = heldout_comparison(recording, found)
        exhibits += score_exhibits(actor, list(found.scores), against="held out camera")
    true = score_truth(dataset, actor, paint=paint)
    if true is not None:
        values |= truth_values(true)
        truth = truth_comparison(dataset, actor, true, paint=paint)
        exhibits += score_exhibits(actor, list(true.scores), against="truth")
    strip = making_strip(dataset, recording, model=model, render=render)
    return ActorReport(values, strip, heldout, truth, tuple(exhibits))


def body_model_of(config: EvaluateConfig, actor: ActorFolders) -> BodyModel:
    """The body model that the actor was fitted with."""
    file = config.body_models.get(actor.source, {}).get(actor.gender)
    return load_body_model(Path(file) if file else None)


def reference_masks(config: EvaluateConfig, source: str) -> ReferenceMasks:
    """Hand-checked masks of the source's held-out cameras, by (action, frame, view).

    Raises:
        ConfigError: masks of a camera that training saw.
        DataError: a polygon file cannot be read.
    """
    held_out = config.held_out_views.get(source, ())
    masks: ReferenceMasks = {}
    for item in config.reference_masks.get(source, ()):
        if item.view not in held_out:
            raise ConfigError(
                f"reference masks {item.path} are of camera {item.view}, which is not held out of "
                f"{source} (held out: {list(held_out)}): scores on it would flatter"
            )
        for frame, mask in read_polygon_masks(Path(item.path)).items():
            masks[item.action, frame, item.view] = mask
    return masks


def avatar_renderer(actor: ActorFolders, model: BodyModel) -> Renderer:
    """The actor's avatar as a function of pose and camera."""
    avatar = load_avatar(actor.avatar)

    def render(pose: BodyPose, camera: Camera) -> Cutout:
        rendering = render_view(pose_avatar(avatar, model, pose), camera)
        return Cutout(rendering.rgb.astype(np.float64), rendering.alpha.astype(np.float64))

    return render


def fit_values(actor: ActorFolders) -> Values:
    """What the fit stage measured of itself; nothing where the bodies were given."""
    path = actor.bodies / "scores.json"
    if not path.is_file():
        return {}
    try:
        scores = json.loads(path.read_text())
    except ValueError as error:
        raise DataError(f"{path} is not JSON: {error}; {remedy(path)}") from error
    return scores


def dataset_values(dataset: Dataset) -> Values:
    """Figures of the dataset as a whole."""
    checks = check_masks(dataset)
    return {
        "labels.blob_max_px": blob_max_px(dataset),
        "labels.reprojection_max_px": reprojection_max_px(dataset),
        "dataset.images": dataset.num_images,
        "checks.images": len(dataset.rows),
        "checks.coco_self_ap": coco_self_ap(dataset),
        "checks.rle_equals_mask": checks.rle_equals_mask,
        "checks.visible_on_mask": checks.visible_on_mask,
    }


def mean_values(by_actor: list[Values]) -> Values:
    """Each figure's mean over the actors that have it."""
    keys = sorted({key for values in by_actor for key in values})
    means: Values = {}
    for key in keys:
        known = [values[key] for values in by_actor if values.get(key) is not None]
        means[key] = float(np.mean(known)) if known else None
    return means


def compose(
    dataset: Dataset,
    actors: list[ActorFolders],
    *,
    reports: dict[str, ActorReport],
    values: Values,
) -> Page:
    """The page of all actors."""
    record = read_dataset_record(dataset)
    keys = [key for actor in actors for key in representative_sets(dataset, actor).values()]
    return Page(
        title=f"{dataset.name} · ntop report",
        headline=headline(dataset),
        lead=lead(dataset),
        tiles=tiles(values),
        figures=tuple(figures(values)),
        provenance=provenance_rows(record, actors),
        strips=tuple(report.strip for report in reports.values()),
        sheets=tuple(contact_sheet(dataset, key, index=i) for i, key in enumerate(keys)),
        heldout=tuple(r.heldout for r in reports.values() if r.heldout is not None),
        truth=tuple(r.truth for r in reports.values() if r.truth is not None),
        curves=tuple(training_charts(actors).values()),
        statistics=statistics_table(record),
    )
