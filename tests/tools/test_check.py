"""`ntop check` on a small real run: every kind of damage is named, with its remedy."""

import json
import os
import shutil
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from ntop.conventions import ConfigError, DataError
from ntop.storage import schemas
from ntop.storage.files import record_files
from ntop.tools import check
from tests.report.small_world import build_world

IMAGE = "images/train/real/p00/stand/h1.2_r1.0/000000_centre.png"
SHARD = "5_render/real/p00/stand/h1.2_r1.0/000000"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    return build_world(tmp_path_factory.mktemp("made")).root


@pytest.fixture
def results(made, tmp_path) -> Path:
    """A copy of the run, in which pictures of the dataset are links to those of the shards."""
    folder = tmp_path / "results"
    shutil.copytree(made, folder, ignore=shutil.ignore_patterns("7_assemble"))
    shutil.copytree(made / "7_assemble", folder / "7_assemble", copy_function=os.link)
    for kind in ("images", "depth", "parts"):
        for path in (folder / "5_render").rglob(f"{kind}/*.png"):
            source, actor, action, rig = path.relative_to(folder / "5_render").parts[:4]
            places = (folder / "7_assemble/tiny" / kind).glob(
                f"*/{source}/{actor}/{action}/{rig}/{path.name}"
            )
            for place in places:
                place.unlink()
                os.link(path, place)
    for path in (folder / "7_assemble/tiny").rglob("*"):
        if path.is_file() and path.suffix != ".png":  # not the module's own files
            content = path.read_bytes()
            path.unlink()
            path.write_bytes(content)
    return folder


def rewritten(path: Path, old: bytes, new: bytes) -> None:
    content = path.read_bytes()
    assert old in content
    path.write_bytes(content.replace(old, new, 1))


def test_what_is_whole_passes(results, capsys):
    assert check.main(dataset=results / "7_assemble/tiny") == 0
    assert "all as they were written" in capsys.readouterr().out
    shutil.move(results / "7_assemble/tiny", results.parent / "copied")
    assert check.main(dataset=results.parent / "copied", processes=1) == 0


def test_a_truncated_picture_is_its_shards(results, capsys):
    dataset = results / "7_assemble/tiny"
    os.truncate(dataset / IMAGE, 100)
    assert check.main(dataset=dataset) == check.EXIT_DAMAGED
    said = capsys.readouterr().out
    assert f"{dataset / IMAGE} has 100 bytes" in said
    assert f"  --forcerun {results / SHARD}\n" in said
    assert check.main(results=results) == check.EXIT_DAMAGED
    assert "1 damaged" not in capsys.readouterr().out  # the shard's file and the dataset's


def test_a_picture_that_is_damaged_in_a_copy_alone_is_not_rendered_again(results, capsys):
    path = results / "7_assemble/tiny" / IMAGE
    path.unlink()
    assert check.main(dataset=results / "7_assemble/tiny") == check.EXIT_DAMAGED
    assert f"  --forcerun {results / '7_assemble/tiny'}\n" in capsys.readouterr().out


def test_a_flipped_bit_of_an_annotation_is_found(results, capsys):
    [path] = (results / "6_annotate/real").rglob("*.parquet")
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 16
    path.write_bytes(content)
    assert check.main(results=results) == check.EXIT_DAMAGED
    assert f"  --forcerun {path}\n" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["files.parquet", "manifest.parquet", "dataset.json"])
def test_a_truncated_table_of_the_dataset_is_found(results, capsys, name):
    path = results / "7_assemble/tiny" / name
    os.truncate(path, path.stat().st_size // 2)
    assert check.main(dataset=path.parent) == check.EXIT_DAMAGED
    said = capsys.readouterr().out
    assert name in said
    assert f"  --forcerun {path.parent}\n" in said


def test_numbers_that_disagree_are_found_even_where_all_files_are_as_written(results):
    dataset = results / "7_assemble/tiny"
    images = json.loads((dataset / "dataset.json").read_text())["num_images"]
    rewritten(dataset / "dataset.json", b'"num_images": %d' % images, b'"num_images": 7')
    coco = dataset / "annotations/person_keypoints_train.json"
    lines = coco.read_bytes().splitlines(keepends=True)
    coco.write_bytes(b"".join(line for i, line in enumerate(lines) if i != 4))
    findings = check.Findings()
    check.check_counts(dataset, findings)
    assert len(findings.problems) == 2
    assert f"has {images} images, dataset.json says 7" in findings.problems[0]
    assert (
        "person_keypoints_train.json has 17 images with 18 persons, the manifest 18 with 18"
        in (findings.problems[1])
    )


def test_a_dataset_of_before_the_lens_columns_is_whole(results):
    dataset = results / "7_assemble/tiny"
    table = pq.read_table(dataset / "manifest.parquet")
    later = [name for name, _ in schemas.LENS_COLUMNS]
    pq.write_table(table.drop_columns(later), dataset / "manifest.parquet")
    record_files(dataset)  # as its own version of ntop wrote it
    assert check.main(dataset=dataset) == 0


def test_many_problems_are_counted_not_listed(results, capsys):
    for path in (results / "7_assemble/tiny/images").rglob("*.png"):
        path.unlink()
    assert check.main(dataset=results / "7_assemble/tiny") == check.EXIT_DAMAGED
    said = capsys.readouterr().out
    assert said.count("cannot be read") == check.SHOWN
    assert "more" in said


def test_nothing_to_check_is_an_error(tmp_path):
    with pytest.raises(ConfigError, match="--dataset"):
        check.main()
    with pytest.raises(DataError, match="no finished folder"):
        check.main(results=tmp_path)
    with pytest.raises(DataError, match="not a folder"):
        check.main(dataset=tmp_path / "none")
