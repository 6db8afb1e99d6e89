"""The body model: arrays in SMPL's layout, read from the embedded body or from a SMPL file."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ntop.body.smpl_files import read_smpl_arrays

EMBEDDED_BODY_PATH = Path(__file__).parent / "data" / "default_body.npz"


@dataclass(frozen=True)
class BodyModel:
    """A skinned body in SMPL's parametrisation (Loper et al. 2015).

    Rest frame: T-pose, y up, facing +z, metres; the person's left is +x. `joint_regressor` maps
    shaped rest vertices to joints, `coco17_regressor` maps *posed* vertices to COCO keypoints.
    Rows of both and of `lbs_weights` sum to one.
    """

    v_template: Float[Tensor, "vertex 3"]
    shapedirs: Float[Tensor, "vertex 3 beta"]
    posedirs: Float[Tensor, "vertex 3 207"] | None
    joint_regressor: Float[Tensor, "joint vertex"]
    lbs_weights: Float[Tensor, "vertex joint"]
    parents: tuple[int, ...]
    faces: Int[Tensor, "face 3"]
    coco17_regressor: Float[Tensor, "17 vertex"]

    def to(self, like: Tensor) -> "BodyModel":
        """The same body with the dtype and device of `like` (itself, if it already has them)."""
        if self.v_template.dtype == like.dtype and self.v_template.device == like.device:
            return self
        return BodyModel(
            v_template=self.v_template.to(like),
            shapedirs=self.shapedirs.to(like),
            posedirs=None if self.posedirs is None else self.posedirs.to(like),
            joint_regressor=self.joint_regressor.to(like),
            lbs_weights=self.lbs_weights.to(like),
            parents=self.parents,
            faces=self.faces.to(like.device),
            coco17_regressor=self.coco17_regressor.to(like),
        )

    @cached_property
    def offsets_per_beta(self) -> Float[Tensor, "beta vertex 3"]:
        """`shapedirs` with the numbers of one beta side by side in memory, for skinning."""
        return self.shapedirs.movedim(-1, 0).contiguous()

    @cached_property
    def joint_template(self) -> Float[Tensor, "joint 3"]:
        """Rest joints at betas = 0."""
        return self.joint_regressor @ self.v_template

    @cached_property
    def joint_shapedirs(self) -> Float[Tensor, "joint 3 beta"]:
        """How the rest joints follow betas: both maps are linear, so they fold into one."""
        return torch.einsum("jv,vcb->jcb", self.joint_regressor, self.shapedirs)


def load_body_model(path: Path | None = None) -> BodyModel:
    """The embedded default body, or the SMPL model in `path` (official `.pkl` or `.npz`).

    Of more than ten shape directions the first ten are kept. Float32 throughout.

    Raises:
        DataError: The file lacks an array, or an array's shape is wrong.
    """
    arrays = read_smpl_arrays(EMBEDDED_BODY_PATH if path is None else path)
    return BodyModel(
        v_template=torch.from_numpy(arrays.v_template),
        shapedirs=torch.from_numpy(arrays.shapedirs),
        posedirs=None if arrays.posedirs is None else torch.from_numpy(arrays.posedirs),
        joint_regressor=torch.from_numpy(arrays.joint_regressor),
        lbs_weights=torch.from_numpy(arrays.lbs_weights),
        parents=arrays.parents,
        faces=torch.from_numpy(arrays.faces),
        coco17_regressor=torch.from_numpy(arrays.coco17_regressor),
    )


def part_labels(model: BodyModel) -> Int[Tensor, " vertex"]:
    """The bone (0..23) that moves each vertex most; part images hold label + 1."""
    return model.lbs_weights.argmax(-1)
