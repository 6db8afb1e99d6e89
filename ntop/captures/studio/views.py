"""Pictures of a posed actor by any camera: colour, coverage, depth and parts, supersampled.

Light: Lambert's law with the posed smooth normals, one distant light fixed in the world and an
even ambient, no cast shadows. Colours are shaded linearly and averaged as sRGB values, like every
picture this project composites.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numpy import ndarray

from ntop.captures.studio.actors import Actor, PosedActor, albedo
from ntop.captures.studio.raycast import Hits, RayMesh
from ntop.conventions import MASK_ALPHA
from ntop.geometry.cameras import Camera

BOX_MARGIN_PX = 2
RAYS_PER_BLOCK = 1 << 19  # bounds memory; results do not depend on it
INNER_SAMPLES = 2  # per pixel and axis, away from outlines
FLAT_M = 0.03  # a larger step in distance within a pixel is an outline


@dataclass(frozen=True)
class Light:
    """Linear radiance factors of the distant light and of the ambient.

    A surface that faces the light reflects `albedo * (ambient + directional)`.
    """

    towards_light_world: Float[ndarray, " 3"]
    directional: float
    ambient: float


@dataclass(frozen=True)
class View:
    """What one camera sees of the actor; arrays are (H, W[, 3]).

    `rgb` is straight sRGB in 0..1 and zero where nothing is seen, `alpha` the share of the pixel
    that the actor covers. `depth_m` (ray length, 0 = nothing) and `parts` (bone + 1) belong to the
    median sample of a pixel that is at least half covered.
    """

    rgb: Float[ndarray, "height width 3"]
    alpha: Float[ndarray, "height width"]
    depth_m: Float[ndarray, "height width"]
    parts: UInt8[ndarray, "height width"]


@dataclass(frozen=True)
class Scene:
    """A posed actor ready to be seen: search tree built, light set."""

    actor: Actor
    posed: PosedActor
    mesh: RayMesh
    light: Light


def studio_light(light_to_ambient: float) -> Light:
    """The studio's light: from the front left above, scaled so that full light is white."""
    direction = np.array([0.62, -0.42, 0.66])
    ambient = 1 / (1 + light_to_ambient)
    return Light(direction / np.linalg.norm(direction), 1 - ambient, ambient)


def light_actor(actor: Actor, posed: PosedActor, light: Light) -> Scene:
    """A scene with one posed actor."""
    return Scene(actor, posed, RayMesh(posed.vertices_world, actor.faces), light)


def see(scene: Scene, camera: Camera, *, supersampling: int) -> View:
    """The picture of one camera.

    Outlines, seen or occluding, get `supersampling`^2 rays per pixel, inner pixels at most
    `INNER_SAMPLES`^2: textures and shading are smooth at that scale, outlines are not.
    """
    width, height = camera.lens.width, camera.lens.height
    view = View(
        rgb=np.zeros((height, width, 3), np.float32),
        alpha=np.zeros((height, width), np.float32),
        depth_m=np.zeros((height, width), np.float32),
        parts=np.zeros((height, width), np.uint8),
    )
    inner = min(supersampling, INNER_SAMPLES)
    outline = []
    for chosen in _blocks(_candidate_pixels(scene, camera), inner):
        samples = _sample(scene, camera, chosen, inner)
        flat = samples.covered.all(1) & (np.ptp(samples.distance_m, axis=1) < FLAT_M)
        if supersampling == inner:
            flat[:] = True
        outline.append(chosen[~flat])
        _fill(view, chosen[flat], scene=scene, samples=samples.only(flat))
    for chosen in _blocks(np.concatenate(outline) if outline else None, supersampling):
        samples = _sample(scene, camera, chosen, supersampling)
        _fill(view, chosen, scene=scene, samples=samples)
    return view


def over(view: View, background: Float[ndarray, "height width 3"]) -> ndarray:
    """The view composited over a background, sRGB 0..1."""
    alpha = view.alpha[..., None]
    return view.rgb * alpha + background * (1 - alpha)


def hit_parts(actor: Actor, hits: Hits) -> UInt8[ndarray, " hit"]:
    """Part labels (bone + 1) at hit points: that of the nearest corner."""
    first, second, third = hits.weights.T
    nearest = np.where(first >= np.maximum(second, third), 0, np.where(second >= third, 1, 2))
    return (actor.parts[actor.faces[hits.face, nearest]] + 1).astype(np.uint8)


def shade(scene: Scene, hits: Hits, directions_world: Float[ndarray, "hit 3"]) -> ndarray:
    """Colours (sRGB) of hit points, seen along the given unit directions."""
    actor, light = scene.actor, scene.light
    # place and normal in one go: gathering corners is what costs
    values = np.concatenate([actor.texture_points, scene.posed.normals_world], 1, dtype=np.float32)
    at_hits = hits.interpolate(values, actor.faces)
    points, normals = np.ascontiguousarray(at_hits[:, :3]), at_hits[:, 3:]
    surface = actor.surface[hits.face]
    base = srgb_to_linear(albedo(actor, points, surface))
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    lambert = normals @ light.towards_light_world.astype(np.float32) / np.maximum(length, 1e-9)
    # cloth has two sides: light the one that is seen
    inner = (np.einsum("ij,ij->i", normals, directions_world) > 0) & (surface > 0)
    lambert = np.maximum(np.where(inner, -lambert, lambert), 0)
    return linear_to_srgb(base * (light.ambient + light.directional * lambert)[:, None])


def srgb_to_linear(colours: Float[ndarray, "*shape"]) -> ndarray:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(light: Float[ndarray, "*shape"]) -> ndarray:
    """Linear light as sRGB values, clipped to 0..1 (IEC 61966-2-1)."""
    clipped = np.clip(light, 0, 1)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055)


@dataclass(frozen=True)
class _Samples:
    """Hits of a few pixels' rays; arrays are (pixel, sample), zero where nothing is hit."""

    hits: Hits
    directions_world: Float[ndarray, "ray 3"]
    distance_m: Float[ndarray, "pixel sample"]
    covered: Bool[ndarray, "pixel sample"]

    def only(self, pixels: Bool[ndarray, " pixel"]) -> "_Samples":
        """The samples of some of the pixels."""
        per_pixel = self.covered.shape[1]
        kept_rays = np.repeat(pixels, per_pixel)
        kept = kept_rays[self.hits.ray]
        new_index = np.cumsum(kept_rays) - 1
        hits = Hits(
            ray=new_index[self.hits.ray[kept]],
            distance_m=self.hits.distance_m[kept],
            face=self.hits.face[kept],
            weights=self.hits.weights[kept],
        )
        return _Samples(
            hits, self.directions_world[kept_rays], self.distance_m[pixels], self.covered[pixels]
        )


def _sample(
    scene: Scene, camera: Camera, pixels: Int[ndarray, "pixel 2"], supersampling: int
) -> _Samples:
    """Cast a square grid of rays through each pixel (u, v indices)."""
    offsets = (np.arange(supersampling) + 0.5) / supersampling
    grid = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    directions, valid = _rays(camera, (pixels[:, None, :] + grid[None]).reshape(-1, 2))
    hits = scene.mesh.first_hits(camera.center_world.numpy(), directions)
    if not valid.all():
        hits = hits.only(valid[hits.ray])
    distance = np.zeros(len(directions), np.float32)
    covered = np.zeros(len(directions), bool)
    distance[hits.ray] = hits.distance_m
    covered[hits.ray] = True
    shape = (len(pixels), len(grid))
    return _Samples(hits, directions, distance.reshape(shape), covered.reshape(shape))


def _fill(view: View, pixels: Int[ndarray, "pixel 2"], *, scene: Scene, samples: _Samples) -> None:
    """Resolve the samples of the pixels into the view, in place."""
    if not len(pixels):
        return
    v, u = pixels[:, 1], pixels[:, 0]
    hits, covered = samples.hits, samples.covered
    colours = np.zeros((covered.size, 3), np.float32)
    colours[hits.ray] = shade(scene, hits, samples.directions_world[hits.ray])
    labels = np.zeros(covered.size, np.uint8)
    labels[hits.ray] = hit_parts(scene.actor, hits)
    labels = labels.reshape(covered.shape)
    count = covered.sum(1)
    total = np.einsum("psc->pc", colours.reshape(*covered.shape, 3))
    view.rgb[v, u] = total / np.maximum(count, 1)[:, None]
    view.alpha[v, u] = count / covered.shape[1]
    # the lower median is a surface that exists, a mean of two would float between them
    order = np.argsort(np.where(covered, samples.distance_m, np.inf), axis=1, kind="stable")
    middle = np.take_along_axis(order, (np.maximum(count, 1)[:, None] - 1) // 2, 1)
    solid = np.rint(count * 255 / covered.shape[1]) >= MASK_ALPHA
    distance = np.take_along_axis(samples.distance_m, middle, 1)[:, 0]
    view.depth_m[v, u] = np.where(solid, distance, 0)
    view.parts[v, u] = np.where(solid, np.take_along_axis(labels, middle, 1)[:, 0], 0)


def _blocks(pixels: Int[ndarray, "pixel 2"] | None, supersampling: int) -> Iterator[ndarray]:
    """Runs of pixels whose rays fit into memory at once."""
    if pixels is not None:
        size = max(RAYS_PER_BLOCK // supersampling**2, 1)
        for start in range(0, len(pixels), size):
            yield pixels[start : start + size]


def _candidate_pixels(scene: Scene, camera: Camera) -> Int[ndarray, "pixel 2"]:
    """Pixels (u, v indices) whose centre ray meets the actor, and their neighbours."""
    width, height = camera.lens.width, camera.lens.height
    vertices = torch.from_numpy(np.asarray(scene.posed.vertices_world, dtype=np.float64))
    projected, seen = camera.project(vertices)
    projected = projected[seen].numpy()
    if len(projected) == 0:
        return np.empty((0, 2), np.int64)
    low = np.floor(projected.min(0)).astype(int) - BOX_MARGIN_PX
    high = np.ceil(projected.max(0)).astype(int) + BOX_MARGIN_PX
    left, top = np.clip(low, 0, (width, height))
    right, bottom = np.clip(high, 0, (width, height))
    u, v = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    pixels = np.stack([u.ravel(), v.ravel()], -1)
    directions, _ = _rays(camera, pixels + 0.5)
    found = np.zeros(len(pixels), np.uint8)
    found[scene.mesh.first_hits(camera.center_world.numpy(), directions).ray] = 1
    near = _grown(found.reshape(u.shape).astype(bool))
    return pixels[near.ravel()]


def _grown(mask: ndarray) -> ndarray:
    """The mask and its eight neighbours."""
    padded = np.pad(mask, 1)
    grown = np.zeros_like(mask)
    rows, columns = mask.shape
    for row in range(3):
        for column in range(3):
            grown |= padded[row : row + rows, column : column + columns]
    return grown


def _rays(camera: Camera, pixels: Float[ndarray, "pixel 2"]) -> tuple[ndarray, ndarray]:
    directions, valid = camera.rays(torch.from_numpy(pixels.astype(np.float64)))
    return directions.numpy().astype(np.float32), valid.numpy()
