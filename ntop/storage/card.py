"""The dataset card: a README with Hugging Face's YAML header."""

SIZE_CATEGORIES = (
    (1_000, "n<1K"),
    (10_000, "1K<n<10K"),
    (100_000, "10K<n<100K"),
    (1_000_000, "100K<n<1M"),
)

TEMPLATE = """---
pretty_name: {dataset}
license: other
task_categories:
- keypoint-detection
- image-segmentation
- depth-estimation
tags:
- synthetic
- fisheye
- top-view
- human-pose-estimation
- smpl
size_categories:
- {size_category}
---

# {dataset}

Virtual top-view fisheye images of people with masks, depth, part labels, 2D and 3D keypoints with
occlusion-true visibility, SMPL parameters and cameras. {num_images} images in {num_sets} sets of
nine views (`centre` and eight on a circle around it); made by ntop {version}.

{statistics}

Actors are unique persons, subjects are rendered human instances; the size is that of the tight box
around the mask, in pixels (width×height). Splits are by actor: nobody is in both.

## Files

| path | content |
|:--|:--|
| `manifest.parquet` | one row per image: camera, files, persons with keypoints and SMPL |
| `images/`, `depth/`, `parts/` | RGBA; 16-bit ray length; 8-bit part labels |
| `annotations/person_keypoints_{{train,val}}.json` | COCO-17 keypoints, boxes, RLE masks |
| `annotations/person_smpl24_{{train,val}}.json` | the 24 SMPL joints in COCO's format |
| `sets/` | one JSON per body pose: SMPL parameters, 3D keypoints, its virtual cameras and views |
| `dataset.json` | versions, hashes, these statistics, unusable frames with their reasons |

## Conventions

- World: right-handed, metres, +z up. Camera: x right, y down, z forward,
  `X_camera = R (X_world - center_world_m)`, `rotation_camera_from_world` row by row.
- Lens: `camera_model` says how the radius in the image follows the angle from the axis, up to
  `max_theta_rad`. equidistant: `focal_px * theta`; equisolid: `2 focal_px sin(theta / 2)`;
  stereographic: `2 focal_px tan(theta / 2)`; kannala_brandt: `focal_px * (theta + k1 theta^3 +
  k2 theta^5 + k3 theta^7 + k4 theta^9)` with `distortion` k1..k4. `focal_y_px` serves the vertical.
- Pixels are continuous: the first pixel's centre is (0.5, 0.5). The `keypoints` of the COCO files
  alone follow COCO (first centre at 0): ours minus 0.5.
- Images: sRGB, straight alpha; the person's mask is alpha >= 128.
- Depth: 0.1 mm of *ray length* per step, 0 where there is nothing. Parts: SMPL bone + 1.
- Visibility: 0 outside the image circle, 1 occluded, 2 visible; 2D coordinates are kept unclipped,
  except in COCO's `keypoints`, where v = 0 comes with x = y = 0.
- SMPL-24 has no standard OKS sigmas: those used are in each file's category record.
"""


TAR_PAGE = """
## Pictures in tars

The pictures of a shard are one plain tar, for file systems that would refuse millions of files. The
paths of manifest, COCO files and sets are addresses `path:offset:size`, in bytes: nothing has to
be unpacked or scanned, also from several workers at once.

```python
def read_picture(dataset: str, address: str) -> bytes:
    path, offset, size = address.rsplit(":", 2)
    with open(f"{dataset}/{path}", "rb") as stream:
        stream.seek(int(offset))
        return stream.read(int(size))
```

`ntop.storage.archives.read_content` does the same and names a tar that is cut off. `tar xf` unpacks
a shard to `{frame}_{view}.image.png`, `.depth.png` and `.parts.png`; with this order and these
names a shard is a WebDataset shard as well.
"""


def dataset_card(
    *,
    dataset: str,
    version: str,
    num_images: int,
    num_sets: int,
    statistics: str,
    archives: bool,
) -> str:
    """The text of a dataset's README.md; `statistics` is a Markdown table.

    `archives` says whether the pictures are in tars.
    """
    size_category = next((name for limit, name in SIZE_CATEGORIES if num_images < limit), "n>1M")
    text = TEMPLATE.format(
        dataset=dataset,
        version=version,
        num_images=f"{num_images:,}",
        num_sets=f"{num_sets:,}",
        statistics=statistics,
        size_category=size_category,
    )
    return text + TAR_PAGE if archives else text
