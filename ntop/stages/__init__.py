"""The eight stages: number, name, version. Imports nothing heavy, the Snakefile reads it.

`version` is bumped when the *meaning* of a stage's output changes; the workflow then reruns that
stage and what follows from it, and the command line refuses a mismatch.
"""

STAGES = (
    (1, "capture", 1),
    (2, "mask", 1),
    (3, "fit", 2),
    (4, "train", 5),
    (5, "render", 8),
    (6, "annotate", 1),
    (7, "assemble", 1),
    (8, "evaluate", 3),
)

VERSIONS = {name: version for _, name, version in STAGES}
