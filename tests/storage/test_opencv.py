import math

import cv2
import numpy as np
import pytest
import torch

from ntop.conventions import DataError
from ntop.geometry.kannala_brandt import KannalaBrandt
from ntop.geometry.opencv import fisheye_from_opencv, opencv_parameters, pinhole_from_opencv
from ntop.geometry.pinhole import Pinhole
from ntop.storage.opencv import read_opencv_lens, write_opencv_lens

FISHEYE = KannalaBrandt(
    330.7, 331.2, 319.9, 241.1, 640, 480, math.radians(100), (0.05, 0.08, -0.03, 0.004)
)
PINHOLE = Pinhole(1681.24, 1681.08, 533.1, 948.6, 1088, 1920, (-0.05, 0.14, 1e-3, -2e-3, 0.01))


@pytest.mark.parametrize("suffix", [".yaml", ".yml", ".xml", ".json"])
@pytest.mark.parametrize("lens", [FISHEYE, PINHOLE], ids=lambda lens: lens.model)
def test_a_written_lens_reads_back_bit_for_bit(lens, suffix, tmp_path):
    path = tmp_path / f"camera{suffix}"
    write_opencv_lens(lens, path=path)
    assert read_opencv_lens(path, max_theta=math.radians(100)) == lens


@pytest.mark.parametrize("lens", [FISHEYE, PINHOLE], ids=lambda lens: lens.model)
def test_opencv_projects_with_the_written_file_as_we_do(lens, tmp_path):
    path = tmp_path / "camera.yaml"
    write_opencv_lens(lens, path=path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode("camera_matrix").mat()
    distortion = storage.getNode("distortion_coefficients").mat()
    points = np.random.default_rng(0).uniform((-0.4, -0.4, 1), (0.4, 0.4, 3), (50, 1, 3))
    project = cv2.fisheye.projectPoints if lens is FISHEYE else cv2.projectPoints
    theirs, _ = project(points, np.zeros(3), np.zeros(3), matrix, distortion)
    ours, _ = lens.project(torch.from_numpy(points[:, 0]))
    assert np.abs(ours.numpy() - 0.5 - theirs[:, 0]).max() < 1e-9


def test_a_file_of_opencvs_calibration_program(tmp_path):
    path = tmp_path / "out_camera_data.xml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Mon")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("fisheye_model", 1)
    storage.write("camera_matrix", np.array([[300.0, 0, 319.5], [0, 301.0, 239.5], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array([[-0.12], [0.0], [0.0], [0.0]]))
    storage.release()
    lens = read_opencv_lens(path)
    assert (lens.cx, lens.cy) == (320.0, 240.0)
    assert math.degrees(lens.max_theta) == pytest.approx(95.49, abs=0.01)  # where it folds


def test_what_our_models_do_not_have_is_refused(tmp_path):
    matrix, distortion = opencv_parameters(PINHOLE)
    size = {"width": 1088, "height": 1920}
    padded = (*distortion, 0.0, 0.0, 0.0)
    assert pinhole_from_opencv(matrix, padded, **size) == PINHOLE
    assert pinhole_from_opencv(matrix, distortion[:4], **size).distortion[4] == 0
    with pytest.raises(DataError, match="CALIB_RATIONAL_MODEL"):
        pinhole_from_opencv(matrix, (*distortion, 0.1, 0.0, 0.0), **size)
    with pytest.raises(DataError, match="k1, k2, k3, k4"):
        fisheye_from_opencv(matrix, distortion, **size)
    skewed = ((1000.0, 0.3, 500.0), *matrix[1:])
    with pytest.raises(DataError, match="skew"):
        pinhole_from_opencv(skewed, distortion, **size)
    with pytest.raises(DataError, match="no such"):
        read_opencv_lens(tmp_path / "absent.yaml")
    (tmp_path / "bad.yaml").write_text("%YAML:1.0\n---\nimage_width: 3\n")
    with pytest.raises(DataError, match="camera_matrix"):
        read_opencv_lens(tmp_path / "bad.yaml")
    (tmp_path / "worse.yaml").write_text("not a camera: [")
    with pytest.raises(DataError, match="worse"):
        read_opencv_lens(tmp_path / "worse.yaml")
    with pytest.raises(DataError, match="which OpenCV can read"):
        write_opencv_lens(FISHEYE, path=tmp_path / "camera.txt")
