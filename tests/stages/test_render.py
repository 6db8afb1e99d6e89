"""Rendering shards: what is written, resuming, refusing to work twice, and dying politely."""

import fcntl
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from ntop.config.sections import RenderConfig
from ntop.conventions import MASK_ALPHA, VIEWS, ConfigError, DataError
from ntop.stages import s5_render
from ntop.storage import schemas
from ntop.storage.images import read_depth, read_parts, read_rgba
from ntop.storage.keys import SetKey
from ntop.storage.provenance import file_sha256
from ntop.storage.renders import fisheye_camera
from ntop.storage.tables import read_table

from .conftest import ACTION, ACTOR, RIG, SIZE, SOURCE, UNUSABLE


def digest(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below a folder."""
    paths = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): file_sha256(path) for path in paths}


def test_a_shard_holds_nine_views_per_usable_set_and_names_the_others(shards):
    rows = read_table(shards["second"] / "renders.parquet", schema=schemas.RENDER)
    assert [(row["frame"], row["view"]) for row in rows] == [(3, view) for view in sorted(VIEWS)]
    skipped = json.loads((shards["second"] / "skipped.json").read_text())
    assert [(item["frame"], item["reason"]) for item in skipped] == [
        (UNUSABLE, "head outside every view")
    ]
    row = rows[0]
    key = SetKey(SOURCE, ACTOR, ACTION, RIG, 3)
    assert row["sample_id"] == key.sample_id(row["view"])
    assert len({row["sample_id"] for row in rows}) == 9
    assert row["image_sha256"] == file_sha256(shards["second"] / row["image_path"])
    assert (row["seed"], row["width"]) == (5, SIZE)
    assert row["focal_px"] == pytest.approx(SIZE / np.pi)


def test_images_show_the_body_where_its_joints_project(shards):
    rows = read_table(shards["first"] / "renders.parquet", schema=schemas.RENDER)
    for row in rows[::4]:
        rgba = read_rgba(shards["first"] / row["image_path"])
        depth_m = read_depth(shards["first"] / row["depth_path"])
        parts = read_parts(shards["first"] / row["parts_path"])
        mask = rgba[..., 3] >= MASK_ALPHA
        assert 0.01 < mask.mean() < 0.2
        camera = fisheye_camera(row)
        joints = torch.tensor(row["joints3d_world_m"], dtype=torch.float64).reshape(24, 3)
        pixels, seen = camera.project(joints)
        assert seen.all()
        u, v = pixels.numpy().astype(int).T
        assert mask[v, u].mean() > 0.95
        distance = (joints - camera.center_world).norm(dim=-1).numpy()
        on = mask[v, u] & (depth_m[v, u] > 0)
        assert (depth_m[v, u][on] < distance[on] + 0.05).all()  # metres: thin limbs at grazing rays
        assert set(np.unique(parts)) <= set(range(25))
        assert (parts[mask] > 0).mean() > 0.97


def test_rendering_again_gives_the_same_bytes_and_leaves_no_work(shop, shards):
    again = shop.render("again", frames=(0, 1))
    assert digest(again) == digest(shards["first"])
    assert [p.name for p in (shop.folder / "work/again").iterdir()] == ["lock"]


def test_a_stopped_shard_goes_on_at_its_first_unfinished_set(shop, shards, monkeypatch):
    rendered = []
    original = s5_render.render_set

    def stop_at_the_second(key, *arguments, **others):
        rendered.append(key.frame)
        if len(rendered) == 2:
            raise KeyboardInterrupt
        return original(key, *arguments, **others)

    monkeypatch.setattr(s5_render, "render_set", stop_at_the_second)
    with pytest.raises(KeyboardInterrupt):
        shop.render("stopped", frames=(0, 1))
    assert not (shop.folder / "stopped").exists()
    out = shop.render("stopped", frames=(0, 1))
    assert rendered == [0, 1, 1]
    assert digest(out) == digest(shards["first"])


def test_sets_of_another_recipe_are_not_reused(shop, shards):
    stale = shop.folder / "work/changed/content/000000"
    stale.mkdir(parents=True)
    (stale / "renders.parquet").write_bytes(b"from another avatar")
    (shop.folder / "work/changed/recipe.json").write_text('{"avatar":"another"}')
    assert digest(shop.render("changed", frames=(0, 1))) == digest(shards["first"])


def test_a_duplicate_of_a_running_job_is_refused(shop):
    (shop.folder / "work/twice").mkdir(parents=True)
    with (shop.folder / "work/twice/lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(DataError, match="already runs"):
            shop.render("twice")
    assert not (shop.folder / "twice").exists()


def test_sigterm_ends_at_a_set_border_with_143_and_the_next_run_goes_on(shop):
    frames = tuple(range(0, 120, 10))  # enough sets for the signal to arrive among them
    command = [
        sys.executable, "-m", "ntop.cli", "render", "--config", shop.config.model_dump_json(),
        "--source", SOURCE, "--actor", ACTOR, "--action", "novel", "--rig", RIG,
        "--frames", *map(str, frames), "--motion", "authored:range",
        "--avatar", str(shop.folder / "avatar"), "--bodies", str(shop.folder / f"{ACTOR}.parquet"),
        "--packages", str(shop.folder), "--work", str(shop.folder / "work/terminated"),
        "--out", str(shop.folder / "terminated"),
    ]  # fmt: skip
    root = str(Path(s5_render.__file__).parents[2])
    environment = os.environ | {"PYTHONPATH": root}
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment)
    assert process.stderr.readline().startswith("render: CPU kernels on ")  # once
    assert "set 1/12" in process.stderr.readline()
    process.send_signal(signal.SIGTERM)
    rest = process.stderr.read()
    assert process.wait() == 143, rest
    assert "of 12 sets" in rest
    assert not (shop.folder / "terminated").exists()
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    assert "set 1/12" not in done.stderr  # what was finished is not rendered again
    undisturbed = shop.render("undisturbed", frames=frames, motion="authored:range")
    assert digest(shop.folder / "terminated") == digest(undisturbed)


def test_novel_motion_stands_on_the_floor_below_the_rig(shop):
    out = shop.render("novel", frames=(30,), motion="authored:sit")
    rows = read_table(out / "renders.parquet", schema=schemas.RENDER)
    assert len(rows) == 9
    joints = np.array(rows[0]["joints3d_world_m"]).reshape(24, 3)
    assert 0 < joints[:, 2].min() < 0.15
    centre = next(row for row in rows if row["view"] == "centre")
    assert centre["center_world_m"] == pytest.approx([*joints[0, :2], joints[0, 2] + 1.2], abs=1e-9)


def test_unknown_rig_frame_actor_and_motion_say_what_there_is(shop):
    with pytest.raises(DataError, match="frames 0 to 3"):
        shop.render("a", frames=(0, 77))
    with pytest.raises(ConfigError, match="authored"):
        shop.render("b", motion="mime:box")
    other = RenderConfig.model_validate(
        {"rigs": {"low": {"height_above_pelvis_m": 1.0, "ring_radius_m": 0.5}}}
    )
    with pytest.raises(ConfigError, match="low"):
        s5_render.rig_of(other, RIG)


def test_an_unwritable_output_folder_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    with pytest.raises(DataError, match="check"):
        s5_render.publish([], [], {}, storage="files", out=tmp_path / "file" / "shard")
