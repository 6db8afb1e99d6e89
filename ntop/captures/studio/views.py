"""Pictures of a posed actor by any camera: colour, coverage, depth and parts, supersampled.

Light: Lambert's law with the posed smooth normals, one distant light fixed in the world and an
even ambient, no cast shadows. Colours are shaded linearly and averaged as sRGB values, like every
picture this project composites.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from ntop.captures.studio.actors import Actor, PosedActor, albedo
from ntop.captures.studio.raycast import Hits, RayMesh
from ntop.conventions import MASK_ALPHA
from ntop.geometry.cameras import Camera

BOX_MARGIN_PX = 2
RAYS_PER_BLOCK = 1 << 21  # bounds memory; results do not depend on it


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
    """The picture of one camera, `supersampling`^2 rays per covered or neighbouring pixel."""
    width, height = camera.lens.width, camera.lens.height
    rgb = np.zeros((height, width, 3), np.float32)
    alpha = np.zeros((height, width), np.float32)
    depth = np.zeros((height, width), np.float32)
    parts = np.zeros((height, width), np.uint8)
    pixels = _candidate_pixels(scene, camera)
    count = supersampling**2
    block = max(RAYS_PER_BLOCK // count, 1)
    for start in range(0, len(pixels), block):
        chosen = pixels[start : start + block]
        colours, distance, labels, covered = _sample(scene, camera, chosen, supersampling)
        v, u = chosen[:, 1], chosen[:, 0]
        hits = covered.sum(1)
        rgb[v, u] = colours.sum(1) / np.maximum(hits, 1)[:, None]
        alpha[v, u] = hits / count
        # the lower median is a surface that exists, a mean of two would float between them
        order = np.argsort(np.where(covered, distance, np.inf), axis=1, kind="stable")
        middle = np.take_along_axis(order, (np.maximum(hits, 1)[:, None] - 1) // 2, 1)
        solid = np.rint(hits * 255 / count) >= MASK_ALPHA
        depth[v, u] = np.where(solid, np.take_along_axis(distance, middle, 1)[:, 0], 0)
        parts[v, u] = np.where(solid, np.take_along_axis(labels, middle, 1)[:, 0], 0)
    return View(rgb, alpha, depth, parts)


def over(view: View, background: Float[ndarray, "height width 3"]) -> ndarray:
    """The view composited over a background, sRGB 0..1."""
    alpha = view.alpha[..., None]
    return view.rgb * alpha + background * (1 - alpha)


def hit_parts(actor: Actor, hits: Hits) -> UInt8[ndarray, " hit"]:
    """Part labels (bone + 1) at hit points: that of the nearest corner."""
    nearest = hits.weights.argmax(1)
    return (actor.parts[actor.faces[hits.face, nearest]] + 1).astype(np.uint8)


def shade(scene: Scene, hits: Hits, directions_world: Float[ndarray, "hit 3"]) -> ndarray:
    """sRGB colours of hit points, seen along the given unit directions."""
    actor, light = scene.actor, scene.light
    points = hits.interpolate(actor.texture_points, actor.faces)
    base = srgb_to_linear(albedo(actor, points, actor.surface[hits.face]))
    normals = hits.interpolate(scene.posed.normals_world.astype(np.float32), actor.faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    # cloth has two sides: light the one that is seen
    behind = (normals * directions_world).sum(1) > 0
    inner = behind & (actor.surface[hits.face] > 0)
    lambert = normals @ light.towards_light_world.astype(np.float32)
    lambert = np.maximum(np.where(inner, -lambert, lambert), 0)
    return linear_to_srgb(base * (light.ambient + light.directional * lambert)[:, None])


def srgb_to_linear(colours: Float[ndarray, "*shape"]) -> ndarray:
    """Linear light of sRGB values in 0..1 (IEC 61966-2-1)."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(light: Float[ndarray, "*shape"]) -> ndarray:
    """sRGB values of linear light, clipped to 0..1 (IEC 61966-2-1)."""
    clipped = np.clip(light, 0, 1)
    return np.where(clipped <= 0.0031308, clipped * 12.92, 1.055 * clipped ** (1 / 2.4) - 0.055)


def _sample(
    scene: Scene, camera: Camera, pixels: Int[ndarray, "pixel 2"], supersampling: int
) -> tuple[ndarray, ndarray, ndarray, ndarray]:
    """Colour, distance, part and coverage of every sample of the given pixels: (pixel, sample)."""
    offsets = (np.arange(supersampling) + 0.5) / supersampling
    grid = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    places = (pixels[:, None, :] + grid[None]).reshape(-1, 2)
    directions, valid = _rays(camera, places)
    hits = scene.mesh.first_hits(camera.center_world.numpy(), directions)
    shape = (len(pixels), len(grid))
    colours = np.zeros((len(places), 3), np.float32)
    distance = np.zeros(len(places), np.float32)
    labels = np.zeros(len(places), np.uint8)
    covered = np.zeros(len(places), bool)
    colours[hits.ray] = shade(scene, hits, directions[hits.ray])
    distance[hits.ray] = hits.distance_m
    labels[hits.ray] = hit_parts(scene.actor, hits)
    covered[hits.ray] = True
    outside = ~valid
    covered[outside], colours[outside] = False, 0
    return (
        colours.reshape(*shape, 3),
        distance.reshape(shape),
        labels.reshape(shape),
        covered.reshape(shape),
    )


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
