"""Things many tests need: small real videos, and one undisturbed tiny campaign."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.workflow.project import Project

VideoWriter = Callable[..., Path]


@pytest.fixture(scope="session")
def campaign(tmp_path_factory):
    """The tiny campaign, run once without any disturbance."""
    project = Project(tmp_path_factory.mktemp("campaign"))
    done = project.run()
    assert done.returncode == 0, done.stdout + done.stderr
    return project


@pytest.fixture
def write_video() -> VideoWriter:
    """A function that writes an mp4 whose frame i is the grey 40 + 10 i; returns its path."""

    def write(path: Path, *, num_frames: int, width: int = 64, height: int = 48) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        codec = cv2.VideoWriter.fourcc(*"mp4v")
        video = cv2.VideoWriter(str(path), codec, 60.0, (width, height))
        assert video.isOpened()
        for index in range(num_frames):
            video.write(np.full((height, width, 3), 40 + 10 * index, np.uint8))
        video.release()
        return path

    return write


@pytest.fixture
def truncate_video() -> Callable[[Path], None]:
    """A function that cuts the last 40 % of a video's pictures off, its index staying whole.

    The index (`moov`) is moved before the pictures (`mdat`), as in a file meant for streaming;
    otherwise a cut file has no index and cannot be opened at all.
    """

    def truncate(path: Path) -> None:
        content = path.read_bytes()
        data, index = content.index(b"mdat") - 4, content.index(b"moov") - 4
        moov = bytearray(content[index:])
        table = moov.index(b"stco") + 8  # past the name, version and flags
        for entry in range(int.from_bytes(moov[table : table + 4], "big")):
            at = table + 4 + 4 * entry
            offset = int.from_bytes(moov[at : at + 4], "big") + len(moov)
            moov[at : at + 4] = offset.to_bytes(4, "big")
        pictures = content[data:index]
        path.write_bytes(content[:data] + moov + pictures[: int(0.6 * len(pictures))])

    return truncate
