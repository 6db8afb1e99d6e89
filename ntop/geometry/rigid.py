"""Rigid transforms, named by what they map: `points_camera = camera_from_world.apply(points)`."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class RigidTransform:
    """x -> R x + t, with R a proper rotation; leading dimensions are free."""

    rotation: Float[Tensor, "*batch 3 3"]
    translation: Float[Tensor, "*batch 3"]

    def apply(self, points: Float[Tensor, "*points 3"]) -> Float[Tensor, "*points 3"]:
        """Map points; the transform's batch must broadcast against the points' leading axes."""
        return (self.rotation @ points[..., None]).squeeze(-1) + self.translation

    def inverse(self) -> "RigidTransform":
        """The transform that undoes this one."""
        transposed = self.rotation.transpose(-1, -2)
        return RigidTransform(transposed, -(transposed @ self.translation[..., None]).squeeze(-1))

    def compose(self, other: "RigidTransform") -> "RigidTransform":
        """`self o other`: first `other`, then `self`."""
        return RigidTransform(self.rotation @ other.rotation, self.apply(other.translation))
