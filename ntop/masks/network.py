"""A TensorFlow Lite network run by ai-edge-litert, as a plain function of one image."""

from pathlib import Path

import numpy as np
from ai_edge_litert.interpreter import Interpreter
from jaxtyping import Float32

from ntop.conventions import DataError


class Network:
    """One loaded `.tflite` file. Owns the interpreter and its buffers; not thread-safe."""

    def __init__(self, path: Path) -> None:
        """Load `path`.

        Raises:
            DataError: the file is missing or is no network.
        """
        try:
            # One thread: the stage parallelises over views, and sums keep one order.
            self._interpreter = Interpreter(model_path=str(path), num_threads=1)
        except (ValueError, OSError) as error:
            raise DataError(
                f"cannot load the network {path}: {error}; fetch the packages again"
            ) from error
        self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        self._outputs = [
            (tuple(int(n) for n in detail["shape"]), detail["index"])
            for detail in self._interpreter.get_output_details()
        ]

    def __call__(
        self, image: Float32[np.ndarray, "height width 3"]
    ) -> dict[tuple[int, ...], Float32[np.ndarray, "..."]]:
        """All outputs for one image, keyed by their shape (unique in the networks used here)."""
        self._interpreter.set_tensor(self._input, image[None])
        self._interpreter.invoke()
        return {shape: self._interpreter.get_tensor(index) for shape, index in self._outputs}
