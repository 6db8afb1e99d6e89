"""Reading pictures: the right frame, in order, decoded once; damage is named, never guessed."""

import cv2
import numpy as np
import pytest

from ntop.conventions import DataError
from ntop.storage.frames import count_frames, iterate_frames, read_frame, video_size_px

# the codec is lossy and stores colour in limited range: grey levels move by a few steps at most
GREY_TOLERANCE = 4


def row(image_path: str, *, index: int, width: int = 64, height: int = 48) -> dict:
    return {"image_path": image_path, "image_index": index, "width": width, "height": height}


def test_each_row_gets_its_own_frame_in_sorted_order(tmp_path, write_video):
    write_video(tmp_path / "b.mp4", num_frames=12)
    write_video(tmp_path / "a.mp4", num_frames=12)
    wanted = [("b.mp4", 7), ("a.mp4", 11), ("b.mp4", 0), ("a.mp4", 3), ("a.mp4", 4)]
    rows = [row(name, index=index) for name, index in wanted]
    seen = []
    for got, picture in iterate_frames(tmp_path / "frames.parquet", rows):
        assert picture.shape == (48, 64, 3)
        assert picture.dtype == np.uint8
        assert abs(picture.mean() - (40 + 10 * got["image_index"])) < GREY_TOLERANCE
        seen.append((got["image_path"], got["image_index"]))
    assert seen == sorted(wanted)


def test_one_frame_wanted_twice_is_given_twice(tmp_path, write_video):
    write_video(tmp_path / "a.mp4", num_frames=4)
    rows = [row("a.mp4", index=2), row("a.mp4", index=2)]
    first, second = (picture for _, picture in iterate_frames(tmp_path / "frames.parquet", rows))
    assert np.array_equal(first, second)


def test_each_video_is_opened_once(tmp_path, write_video, monkeypatch):
    write_video(tmp_path / "a.mp4", num_frames=6)
    opened = []
    original = cv2.VideoCapture

    def counting(name: str) -> cv2.VideoCapture:
        opened.append(name)
        return original(name)

    monkeypatch.setattr(cv2, "VideoCapture", counting)
    rows = [row("a.mp4", index=index) for index in range(6)]
    assert len(list(iterate_frames(tmp_path / "frames.parquet", rows))) == 6
    assert len(opened) == 1


def test_a_still_is_read_as_rgb(tmp_path):
    red = np.zeros((48, 64, 3), np.uint8)
    red[..., 2] = 200  # OpenCV writes BGR
    cv2.imwrite(str(tmp_path / "still.png"), red)
    picture = read_frame(tmp_path / "frames.parquet", row("still.png", index=-1))
    assert picture[5, 5].tolist() == [200, 0, 0]


def test_sizes_and_decodable_frames_are_counted(tmp_path, write_video):
    path = write_video(tmp_path / "a.mp4", num_frames=9, width=80, height=32)
    assert count_frames(path) == 9
    assert video_size_px(path) == (80, 32)


def test_a_truncated_video_is_named_with_both_counts(tmp_path, write_video, truncate_video):
    path = write_video(tmp_path / "a.mp4", num_frames=20)
    truncate_video(path)
    with pytest.raises(DataError, match=r"a\.mp4: truncated .* says 20"):
        count_frames(path)
    with pytest.raises(DataError, match=r"cannot read frame 19: decoding ends after frame \d+"):
        read_frame(tmp_path / "frames.parquet", row("a.mp4", index=19))


def test_a_video_cut_before_its_index_cannot_be_opened(tmp_path, write_video):
    path = write_video(tmp_path / "a.mp4", num_frames=20)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(DataError, match="cannot be opened: it is truncated"):
        count_frames(path)


def test_a_frame_beyond_the_end_is_an_error(tmp_path, write_video):
    write_video(tmp_path / "a.mp4", num_frames=5)
    with pytest.raises(DataError, match="cannot read frame 5: decoding ends after frame 4"):
        read_frame(tmp_path / "frames.parquet", row("a.mp4", index=5))


@pytest.mark.parametrize(("name", "index"), [("no.mp4", 0), ("no.png", -1)])
def test_a_missing_file_is_an_error(tmp_path, name, index):
    with pytest.raises(DataError, match="does not exist"):
        read_frame(tmp_path / "frames.parquet", row(name, index=index))


def test_a_damaged_still_is_an_error(tmp_path):
    (tmp_path / "still.png").write_bytes(b"\x89PNG\r\n\x1a\n broken")
    with pytest.raises(DataError, match="cannot be decoded"):
        read_frame(tmp_path / "frames.parquet", row("still.png", index=-1))


def test_a_picture_of_another_size_than_its_row_is_an_error(tmp_path, write_video):
    write_video(tmp_path / "a.mp4", num_frames=2)
    with pytest.raises(DataError, match="64x48 px, its table says 32x48 px"):
        read_frame(tmp_path / "frames.parquet", row("a.mp4", index=0, width=32))
