"""First surface along rays through a triangle mesh, by embree, and the mesh's smooth normals."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Bool, Float, Int
from numpy import ndarray


@dataclass(frozen=True)
class Hits:
    """First surfaces of the rays that hit something, in the order of the rays.

    `ray` indexes the rays given, `distance_m` is the ray's length up to the surface, `weights` are
    the barycentric weights of the three corners of `face`.
    """

    ray: Int[ndarray, " hit"]
    distance_m: Float[ndarray, " hit"]
    face: Int[ndarray, " hit"]
    weights: Float[ndarray, "hit 3"]

    def only(self, kept: Bool[ndarray, " hit"]) -> "Hits":
        """Some of the hits; `ray` still indexes the rays given."""
        return Hits(self.ray[kept], self.distance_m[kept], self.face[kept], self.weights[kept])

    def interpolate(
        self, values: Float[ndarray, "vertex channel"], faces: Int[ndarray, "face 3"]
    ) -> Float[ndarray, "hit channel"]:
        """Values given at the vertices, at the hit points."""
        corners = faces[self.face]
        result = values[corners[:, 0]] * self.weights[:, :1]
        result += values[corners[:, 1]] * self.weights[:, 1:2]
        result += values[corners[:, 2]] * self.weights[:, 2:]
        return result


class RayMesh:
    """A mesh prepared for ray queries (owns embree's search tree).

    Coordinates are kept relative to the mesh's centre: embree works in float32, and a person far
    from the world's origin must not lose precision.
    """

    def __init__(
        self, vertices_world: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
    ) -> None:
        """Build the search tree of a mesh given in world coordinates (metres)."""
        self._origin = vertices_world.mean(axis=0, dtype=np.float64)
        local = (vertices_world - self._origin).astype(np.float32)
        self._scene = EmbreeScene()
        # the scene keeps no reference to the geometry's arrays
        self._mesh = TriangleMesh(self._scene, local, np.ascontiguousarray(faces, dtype=np.int32))

    def first_hits(
        self, center_world: Float[ndarray, " 3"], directions_world: Float[ndarray, "ray 3"]
    ) -> Hits:
        """First surface on each ray from one point; directions must have unit length."""
        origin = (np.asarray(center_world, dtype=np.float64) - self._origin).astype(np.float32)
        directions = np.ascontiguousarray(directions_world, dtype=np.float32)
        origins = np.ascontiguousarray(np.broadcast_to(origin, directions.shape))
        found = self._scene.run(origins, directions, output=True)
        ray = np.flatnonzero(found["primID"] >= 0)
        second, third = found["u"][ray], found["v"][ray]
        return Hits(
            ray=ray,
            distance_m=found["tfar"][ray],
            face=found["primID"][ray],
            weights=np.stack([1 - second - third, second, third], axis=-1),
        )


def vertex_normals(
    vertices: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"]
) -> Float[ndarray, "vertex 3"]:
    """Unit normals at the vertices, the area-weighted mean of the faces around each."""
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    count = len(vertices)
    sums = np.stack(
        [
            sum(np.bincount(faces[:, k], face_normals[:, axis], count) for k in range(3))
            for axis in range(3)
        ],
        axis=-1,
    )
    length = np.linalg.norm(sums, axis=-1, keepdims=True)
    return (sums / np.where(length > 0, length, 1)).astype(vertices.dtype)
