"""Large campaigns: pictures in tars instead of files, and memory that does not grow."""

import shutil
import tracemalloc

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ntop.config.sections import AnnotateConfig, AssembleConfig
from ntop.conventions import DataError
from ntop.report.checks import check_masks, coco_self_ap
from ntop.report.inputs import Dataset
from ntop.stages import s6_annotate, s7_assemble
from ntop.storage import files, manifest, schemas
from ntop.storage.archives import read_content
from ntop.storage.files import record_files
from ntop.storage.images import read_depth, read_parts
from ntop.storage.provenance import file_sha256
from ntop.storage.tables import read_table
from ntop.tools import check

from .conftest import ACTION, ACTOR, FRAMES, RIG, SOURCE, UNUSABLE, Shop, shard_name

PICTURES = ("image_path", "depth_path", "parts_path")


@pytest.fixture(scope="module")
def tarred(shop, tmp_path_factory):
    """The first actor's two shards and annotations, with the pictures in tars."""
    folder = tmp_path_factory.mktemp("tarred")
    for name in ("avatar", f"{ACTOR}.parquet"):
        (folder / name).symlink_to(shop.folder / name)
    same = Shop(folder, shop.config.model_copy(update={"storage": "tar"}))
    for frames in ((0, 1), (UNUSABLE, 3)):
        name = shard_name(ACTOR, frames[0])
        shard = same.render(name, frames=frames)
        table = folder / f"{name.replace('5_render', '6_annotate')}.parquet"
        s6_annotate.main(AnnotateConfig(), renders=shard, out=table)
    return folder


def assemble(folder, out, *, actions=(ACTION,), last=FRAMES - 1):
    """The dataset of one actor's shards below `folder`."""
    table = folder / "sequences.tsv"
    lines = [f"{SOURCE}\t{ACTOR}\t{action}\t0\t{last}\t1\trender" for action in actions]
    table.write_text("source\tactor\taction\tfirst\tlast\tstep\tuse\n" + "\n".join(lines) + "\n")
    config = {
        "dataset": "large",
        "rigs": [RIG],
        "sets_per_shard": 2,
        "actors": [{"source": SOURCE, "actor": ACTOR, "split": "train"}],
    }
    config = AssembleConfig.model_validate(config)
    s7_assemble.main(config, table, folder / "5_render", folder / "6_annotate", out)
    return out


@pytest.fixture(scope="module")
def datasets(tarred, shop, annotations, tmp_path_factory):  # noqa: ARG001  makes the tables
    """The same dataset twice: pictures as files, pictures in tars."""
    folder = tmp_path_factory.mktemp("both")
    return assemble(shop.folder, folder / "files"), assemble(tarred, folder / "tar")


def test_both_storages_have_the_same_annotations(shop, annotations, tarred):  # noqa: ARG001
    for first in (0, UNUSABLE):
        name = f"{shard_name(ACTOR, first).replace('5_render', '6_annotate')}.parquet"
        assert (tarred / name).read_bytes() == (shop.folder / name).read_bytes()


def test_a_shard_is_one_tar_with_the_same_pictures(shop, shards, tarred):
    shard = tarred / shard_name(ACTOR, 0)
    names = {"files.parquet", "pictures.tar", "provenance.json", "renders.parquet", "skipped.json"}
    assert {path.name for path in shard.rglob("*")} == names
    plain = read_table(shards["first"] / "renders.parquet", schema=schemas.RENDER)
    for row, known in zip(
        read_table(shard / "renders.parquet", schema=schemas.RENDER), plain, strict=True
    ):
        for column in PICTURES:
            content = (shop.folder / shard_name(ACTOR, 0) / known[column]).read_bytes()
            assert read_content(shard / row[column]) == content
        assert {k: v for k, v in row.items() if k not in PICTURES} == {
            k: v for k, v in known.items() if k not in PICTURES
        }


def test_datasets_differ_in_nothing_but_where_the_pictures_lie(datasets):
    plain, tar = (read_table(d / "manifest.parquet", schema=schemas.MANIFEST) for d in datasets)
    for row, known in zip(tar, plain, strict=True):
        place = f"images/train/{SOURCE}/{ACTOR}/{ACTION}/{RIG}"
        assert row["image_path"].startswith(f"{place}/{2 * (row['frame'] // 2):06d}.tar:")
        assert (read_depth(datasets[1] / row["depth_path"]) == read_depth(
            datasets[0] / known["depth_path"])).all()  # fmt: skip
        assert (read_parts(datasets[1] / row["parts_path"]) == read_parts(
            datasets[0] / known["parts_path"])).all()  # fmt: skip
        assert row | {c: known[c] for c in PICTURES} == known
    pictures = [path for path in (datasets[1] / "images").rglob("*") if path.is_file()]
    assert [path.name for path in sorted(pictures)] == ["000000.tar", "000002.tar"]
    assert all(path.stat().st_nlink >= 2 for path in pictures)
    for path in sorted((datasets[0] / "annotations").iterdir()):
        text = (datasets[1] / "annotations" / path.name).read_text()
        by_name = {r["image_path"]: k["image_path"] for r, k in zip(tar, plain, strict=True)}
        for column in PICTURES:
            by_name |= {r[column]: k[column] for r, k in zip(tar, plain, strict=True)}
        for address, name in by_name.items():
            text = text.replace(f'"{address}"', f'"{name}"')
        assert text == path.read_text()


def test_checks_and_report_read_tars(datasets):
    dataset = Dataset.read(datasets[1])
    found = check_masks(dataset)
    assert found.rle_equals_mask == 1
    assert coco_self_ap(dataset) == pytest.approx(1)
    assert check.main(dataset=datasets[1], processes=1) == 0
    assert "`path:offset:size`" in (datasets[1] / "README.md").read_text()
    assert "`path:offset:size`" not in (datasets[0] / "README.md").read_text()


def test_a_damaged_tar_is_named_before_it_reaches_a_dataset(tarred, tmp_path):
    shutil.copytree(tarred, tmp_path / "copy", symlinks=True)
    path = tmp_path / "copy" / shard_name(ACTOR, UNUSABLE) / "pictures.tar"
    content = bytearray(path.read_bytes())
    content[700] ^= 1
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"000002/pictures.tar holds other bytes"):
        assemble(tmp_path / "copy", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def campaign(tarred, folder, *, num_actions):
    """Copies of one shard under the names of many actions."""
    shard, actions = tarred / shard_name(ACTOR, 0), []
    labels = tarred / f"{shard_name(ACTOR, 0).replace('5_render', '6_annotate')}.parquet"
    for index in range(num_actions):
        actions.append(f"act{index:02d}")
        place = f"{SOURCE}/{ACTOR}/{actions[-1]}/{RIG}"
        copy = folder / "5_render" / place / "000000"
        shutil.copytree(shard, copy, ignore=shutil.ignore_patterns("files.parquet"))
        table = pq.read_table(copy / "renders.parquet")
        column = pa.array([actions[-1]] * table.num_rows)
        index = table.schema.get_field_index("action")
        pq.write_table(table.set_column(index, "action", column), copy / "renders.parquet")
        record_files(copy)
        (folder / "6_annotate" / place).mkdir(parents=True)
        shutil.copy(labels, folder / "6_annotate" / place / "000000.parquet")
    return actions


def test_memory_of_assemble_and_evaluate_does_not_grow_with_images(tarred, tmp_path, monkeypatch):
    """Four times the images: held rows (10 kB each) would be 5 MB more, held text 3 MB."""
    monkeypatch.setattr(manifest, "ROWS_PER_GROUP", 64)
    monkeypatch.setattr(files, "ROWS_PER_GROUP", 64)
    peaks = {}
    for num_actions in (10, 40):
        folder = tmp_path / str(num_actions)
        actions = campaign(tarred, folder, num_actions=num_actions)
        for name in ("warm", "measured"):  # the first call imports and fills caches
            tracemalloc.start()
            out = assemble(folder, folder / name, actions=actions, last=1)
            dataset = Dataset.read(out, max_sets=4)
            coco_self_ap(dataset)
            check_masks(dataset)
            peaks[num_actions] = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        assert (dataset.num_images, dataset.num_sets) == (18 * num_actions, 2 * num_actions)
        assert len(dataset.rows) == 4 * 9
        written = pq.ParquetFile(out / "manifest.parquet")
        assert written.metadata.num_row_groups == -(-18 * num_actions // 64)
        assert file_sha256(out / "manifest.parquet") == file_sha256(
            folder / "warm/manifest.parquet"
        )
    assert peaks[40] - peaks[10] < 1e6, peaks
