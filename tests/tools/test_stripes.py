"""`ntop stripes` on shards whose sampler is known: ours, and the paper's."""

import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ntop.body.model import load_body_model
from ntop.body.skinning import pose_body
from ntop.cli import main
from ntop.field.avatar import Avatar, load_avatar, save_avatar
from ntop.field.paper_sampler import render_paper_view
from ntop.field.rendering import render_view
from ntop.geometry.rigs import Rig, top_view_cameras
from ntop.storage import schemas
from ntop.storage.atomic import write_bytes
from ntop.storage.images import read_rgba, write_depth, write_parts, write_rgba
from ntop.storage.keys import SetKey
from ntop.storage.renders import body_columns, image_paths, render_row
from ntop.storage.tables import write_table
from ntop.tools.stripes import spread_sets
from tests.numerics.avatars import analytic_avatar, posed_at, standing

RIG = Rig(1.0, 0.5, 400, 400, 400 / math.pi)
VIEWS = ("centre", "e")


def plain(avatar: Avatar) -> Avatar:
    """The avatar in one colour: no sampler can make stripes of it."""
    values = avatar.grid.values.copy()
    values[:, 1:] = 0.5
    return replace(avatar, grid=replace(avatar.grid, values=values))


def write_shard(folder: Path, avatar: Avatar, *, paper: bool) -> None:
    """Two views of one set, by the paper's sampler or by ours, and the avatar beside them."""
    (folder / "avatar").mkdir(parents=True)
    sha256 = save_avatar(avatar, folder / "avatar", write=write_bytes)
    posed = posed_at(load_avatar(folder / "avatar"), standing())
    joints = pose_body(load_body_model(), standing()).joints
    body = body_columns(load_body_model(), standing())
    key = SetKey("lab", "ada", "stand", "h1.0_r0.5", 0)
    rows = []
    for view, camera in top_view_cameras(RIG, joints[0]).items():
        if view not in VIEWS:
            continue
        ours = render_view(posed, camera)
        seen = render_paper_view(posed, camera, joints_world=joints.numpy()) if paper else ours
        paths = image_paths(key, view)
        image = write_rgba(seen.rgb, seen.alpha, path=folder / paths["image_path"])
        write_depth(ours.depth_m, path=folder / paths["depth_path"])
        write_parts(ours.parts, path=folder / paths["parts_path"])
        rows.append(
            render_row(
                key, view, camera=camera, rig=RIG, body=body, image_sha256=image,
                avatar_sha256=sha256, seed=0,
            )
        )  # fmt: skip
    write_table(rows, schema=schemas.RENDER, path=folder / "renders.parquet")


@pytest.fixture(scope="module")
def shards(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("stripes")
    write_shard(root / "plain", plain(analytic_avatar()), paper=False)
    write_shard(root / "paper", analytic_avatar(), paper=True)
    return root


def test_a_set_without_stripes_passes_with_and_without_its_avatar(shards, capsys):
    assert main(["stripes", "--folder", str(shards / "plain")]) == 0
    alone = capsys.readouterr().out
    assert alone.count("paper's steps") == len(VIEWS) and "pinhole" not in alone
    avatar = str(shards / "plain/avatar")
    assert main(["stripes", "--folder", str(shards / "plain"), "--avatar", avatar]) == 0
    tested = capsys.readouterr().out
    assert tested.count("self-test") == 2 * len(VIEWS) + 1  # two lenses, and the last line
    assert "pinhole" in tested and "STRIPES" not in tested
    assert "0 of 8 measurements" in tested


def test_the_papers_stripes_are_found_in_the_files_alone(shards, capsys):
    assert main(["stripes", "--folder", str(shards / "paper")]) == 1
    lines = capsys.readouterr().out.splitlines()
    marked = [line for line in lines if line.endswith("STRIPES")]
    assert marked and all("paper's steps" in line for line in marked)
    assert {line.split()[1] for line in marked} == set(VIEWS)


def test_a_wrong_step_is_not_found(shards, capsys):
    words = ["stripes", "--folder", str(shards / "paper"), "--steps-m", "0.0071", "0.0123"]
    main(words)
    lines = [line for line in capsys.readouterr().out.splitlines() if " mm " in line]
    assert len(lines) == 2 * len(VIEWS)
    assert not any(line.endswith("STRIPES") for line in lines)


def test_wrong_folders_and_avatars_are_errors(shards, tmp_path, capsys):
    assert main(["stripes", "--folder", str(tmp_path)]) == 2
    assert "neither of manifest.parquet, renders.parquet" in capsys.readouterr().err
    other = str(shards / "paper/avatar")
    assert main(["stripes", "--folder", str(shards / "plain"), "--avatar", other]) == 2
    assert "pass the folders of 4_train" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--steps-m", "0"], ["--steps-m", "nan"], ["--sets", "-1"]])
def test_steps_and_numbers_that_are_none_are_refused(shards, words, capsys):
    assert main(["stripes", "--folder", str(shards / "paper"), *words]) == 2
    assert f"{words[0]} " in capsys.readouterr().err


def test_a_view_with_too_few_pixels_is_not_said_to_be_free_of_stripes(shards, tmp_path, capsys):
    """The paper's stripes, but of a person cut down to 20 x 20 pixels."""
    folder = tmp_path / "small"
    shutil.copytree(shards / "paper", folder)
    for path in (folder / "images").rglob("*.png"):
        rgba = read_rgba(path)
        v, u = (int(x.mean()) for x in np.nonzero(rgba[..., 3] >= 255))
        alpha = np.zeros(rgba.shape[:2])
        alpha[v - 10 : v + 10, u - 10 : u + 10] = 1
        write_rgba(rgba[..., :3] / 255, alpha, path=path)
    assert main(["stripes", "--folder", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "0 of 0 measurements" in said and "4 are not judged" in said
    assert said.count("too few") == 4


def test_sets_are_spread_evenly():
    rows = [
        {"source": "s", "actor": "a", "action": "x", "rig": rig, "frame": frame, "view": "e"}
        for rig in ("r1", "r2")
        for frame in range(10)
    ]
    assert sorted(key.frame for key in spread_sets(rows, 2) if key.rig == "r1") == [2, 7]
    assert len(spread_sets(rows, 0)) == 20
    assert np.all([key.frame == 5 for key in spread_sets(rows, 1)])
