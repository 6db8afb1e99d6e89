"""The capture stage: a result appears whole and checked, or not at all."""

import json

import pytest

from ntop.cli import main as ntop
from ntop.config.sections import CaptureConfig
from ntop.conventions import DataError
from ntop.stages.s1_capture import main
from ntop.storage import schemas
from ntop.storage.cameras import read_cameras
from ntop.storage.tables import read_table
from tests.captures.recording import make_recording, sequence, settings


@pytest.fixture
def recording(tmp_path, write_video):
    return make_recording(tmp_path / "packages", write_video)


def config(**changes) -> CaptureConfig:
    sequences = (sequence(), sequence("stand", last=4))
    return CaptureConfig(source_section=settings(**changes), sequences=sequences)


def test_the_logged_command_line_writes_the_whole_result(recording, tmp_path):
    out = tmp_path / "results/demo/p00"
    words = ["capture", "--config", config().model_dump_json(), "--source", "demo"]
    words += ["--actor", "p00", "--packages", str(recording), "--out", str(out)]
    assert ntop(words) == 0
    frames = read_table(out / "frames.parquet", schema=schemas.FRAME)
    assert len(frames) == 4 * (12 + 5)
    assert all((out / row["image_path"]).is_file() for row in frames)
    assert len(read_cameras(out / "cameras.parquet")) == 8
    inputs = json.loads((out / "provenance.json").read_text())["inputs"]
    assert set(inputs) == {"Calib.qca.txt"} | {row["image_path"] for row in frames}
    assert [path.name for path in out.parent.iterdir()] == ["p00"]


def test_a_failing_capture_leaves_no_result(recording, tmp_path):
    (recording / "demo/stand/cam04.mp4").unlink()
    out = tmp_path / "results/demo/p00"
    with pytest.raises(DataError, match=r"expected one video cam04\.mp4"):
        main(config(), "demo", "p00", packages=recording, out=out)
    assert list(out.parent.iterdir()) == []


def test_a_recording_that_fails_the_checks_leaves_no_result(recording, tmp_path):
    calibration = recording / "demo/Calib.qca.txt"
    calibration.write_text(calibration.read_text().replace('z="', 'z="-'))
    out = tmp_path / "results/demo/p00"
    with pytest.raises(DataError, match="not above the floor"):
        main(config(), "demo", "p00", packages=recording, out=out)
    assert list(out.parent.iterdir()) == []


def test_an_older_result_and_remains_of_a_killed_run_are_replaced(recording, tmp_path):
    out = tmp_path / "results/demo/p00"
    work = out.with_name(".p00.work")
    for folder in (out, work):
        folder.mkdir(parents=True)
        (folder / "stale.txt").write_text("stale")
    main(config(), "demo", "p00", packages=recording, out=out)
    assert [path.name for path in out.parent.iterdir()] == ["p00"]
    assert not (out / "stale.txt").exists()


def test_an_unwritable_output_folder_is_an_error(recording, tmp_path):
    blocked = tmp_path / "blocked"
    blocked.write_text("a file where a folder is needed")
    with pytest.raises(DataError, match=r"cannot write .*blocked/p00.*permissions"):
        main(config(), "demo", "p00", packages=recording, out=blocked / "p00")
