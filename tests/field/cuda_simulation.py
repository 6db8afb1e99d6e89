"""Run in its own process by `test_cuda`: numba decides what `numba.cuda` is when it is imported."""

import os
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from ntop.conventions import DataError
from ntop.field.devices import kernel_device, kernel_words
from ntop.field.gpu import GpuLearner
from ntop.field.kernels.cuda import UNITS
from ntop.field.marching import march_rays
from ntop.field.rendering import render_view


def main(given: Path, found: Path) -> None:
    """Compute on the (simulated) GPU what the pickled cases ask for."""
    cases = pickle.loads(given.read_bytes())
    assert kernel_device().gpu
    results = {"words": kernel_words(), "march": march_rays(*cases["march"])}
    posed, camera, settings = cases["view"]
    results["view"] = render_view(posed, camera, settings=settings)
    state, tables, anchors, batches, rule = cases["learn"]
    learner = GpuLearner(state, tables, anchors)
    results["sums"] = [learner.accumulate(batch, rule) for batch in batches]
    results["gradients"] = learner._sums.copy_to_host()
    results["touched"] = learner.touched()
    results["seen"] = learner.seen(batches[0], rule)
    extra = GpuLearner(state, tables, anchors)
    results["extra_gain"] = extra.accumulate(batches[0], rule, cases["slopes"]).gain
    results["extra_gradients"] = extra._sums.copy_to_host()
    results["broken"] = refusal(GpuLearner(state, tables, anchors), batches[0], rule)
    shuffled = GpuLearner(state, tables, anchors)
    order = np.random.default_rng(0).permutation(len(batches[0].poses))
    for batch in reversed(batches):
        shuffled.accumulate(reordered(batch, order[: len(batch.poses)]), rule)
    results["shuffled_gradients"] = shuffled._sums.copy_to_host()
    learner.learn(results["touched"], rule)
    learner.accumulate(batches[0], rule)
    learner.learn(learner.touched(), rule)
    learner.settle()
    results["state"], results["left"] = state, np.abs(learner._sums.copy_to_host()).max()
    results["units"] = UNITS
    found.write_bytes(pickle.dumps(results))


def reordered(batch, order):
    return replace(batch, **{name: values[order] for name, values in vars(batch).items()})


def refusal(learner, batch, rule) -> str:
    targets = batch.targets.copy()
    targets[0] = np.nan
    try:
        learner.accumulate(replace(batch, targets=targets), rule)
    except DataError as error:
        return str(error)
    return ""


if __name__ == "__main__":
    if os.environ.get("NUMBA_ENABLE_CUDASIM") == "1":
        # a thread per ray, all of one interpreter: on two cores they take 15 times as long, passing
        # its lock to and fro
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    main(Path(sys.argv[1]), Path(sys.argv[2]))
