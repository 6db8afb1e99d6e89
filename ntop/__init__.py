"""Top-view fisheye pose datasets from multi-view recordings.

stage     | reads                                   | writes
----------|-----------------------------------------|---------------------------------------------
capture   | a source's raw files                    | frames, cameras, given poses
mask      | frames                                  | person mattes, 2D keypoints
fit       | keypoints                               | refined cameras, one body pose per frame
train     | frames, mattes, bodies                  | one avatar per actor
render    | avatar, a pose sequence, a rig          | RGBA, depth, parts per view
annotate  | renders                                 | keypoints, visibility, boxes, RLE
assemble  | renders and annotations of all shards   | manifest, COCO and SMPL files, card
evaluate  | dataset, captures                       | metrics.json, report.html

Packages, upper imports lower: cli > stages, tools > captures, masks, report >
annotation, config, field, metrics, storage > body > geometry > conventions.
"""

__version__ = "0.1.0"
