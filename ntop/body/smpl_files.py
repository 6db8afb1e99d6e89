"""SMPL's file format, read without chumpy and without running foreign code.

Official files are Python 2 pickles holding chumpy arrays and a scipy sparse matrix, or `.npz` of
the same keys. Both pass through an unpickler that knows array constructors and nothing else: a
chumpy or scipy object becomes a plain holder of its attributes.
"""

import pickle
import zipfile
from dataclasses import dataclass
from io import BufferedIOBase
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ntop.body.skeletons import COCO17_NAMES, SMPL24_NAMES
from ntop.conventions import NUM_BETAS, NUM_JOINTS, DataError

SMPL_VERTICES = 6890
# Nose, eyes and ears on SMPL's own mesh; the limbs' COCO keypoints are SMPL joints.
SMPL_FACE_VERTICES = {
    "nose": 332, "left_eye": 2800, "right_eye": 6260, "left_ear": 583, "right_ear": 4071,
}  # fmt: skip

_REMEDY = "give an official SMPL .pkl or .npz (24 joints), or leave the path out"


@dataclass(frozen=True)
class SmplArrays:
    """The arrays of one SMPL file, float32 and checked; `parents[0]` is -1."""

    v_template: NDArray[np.float32]  # (V, 3)
    shapedirs: NDArray[np.float32]  # (V, 3, 10)
    posedirs: NDArray[np.float32] | None  # (V, 3, 207)
    joint_regressor: NDArray[np.float32]  # (24, V)
    lbs_weights: NDArray[np.float32]  # (V, 24)
    parents: tuple[int, ...]
    faces: NDArray[np.int64]  # (F, 3)
    coco17_regressor: NDArray[np.float32]  # (17, V)


def read_smpl_arrays(path: Path) -> SmplArrays:
    """Read and check the arrays of a SMPL file; shape directions past the tenth are dropped.

    Raises:
        DataError: Unreadable file, missing array or wrong shape.
    """
    try:
        match path.suffix:
            case ".npz":
                content = _read_npz(path)
            case ".pkl":
                content = _read_pickle(path)
            case other:
                raise DataError(f"{path}: body model files end in .pkl or .npz, got {other!r}")
    except OSError as error:
        raise DataError(f"cannot read body model {path}: {error.strerror}; {_REMEDY}") from error

    template = _array(content, "v_template", path)
    vertices = template.shape[0]
    _check("v_template", template, (vertices, 3), path)
    shapedirs = _array(content, "shapedirs", path)
    if shapedirs.ndim == 3:
        shapedirs = shapedirs[..., :NUM_BETAS]
    _check("shapedirs", shapedirs, (vertices, 3, NUM_BETAS), path)
    posedirs = _array(content, "posedirs", path) if "posedirs" in content else None
    if posedirs is not None:
        _check("posedirs", posedirs, (vertices, 3, 9 * (NUM_JOINTS - 1)), path)
    regressor = _array(content, "J_regressor", path)
    _check("J_regressor", regressor, (NUM_JOINTS, vertices), path)
    weights = _array(content, "weights", path)
    _check("weights", weights, (vertices, NUM_JOINTS), path)
    tree = _array(content, "kintree_table", path)
    _check("kintree_table", tree, (2, NUM_JOINTS), path)
    faces = _array(content, "f", path)
    _check("f", faces, (faces.shape[0], 3), path)
    if faces.min() < 0 or faces.max() >= vertices:
        raise DataError(
            f"{path}: array 'f' names vertices {faces.min()}..{faces.max()}, expected "
            f"0..{vertices - 1}; {_REMEDY}"
        )
    if "coco17_regressor" in content:
        coco17 = _array(content, "coco17_regressor", path)
        _check("coco17_regressor", coco17, (len(COCO17_NAMES), vertices), path)
    elif vertices == SMPL_VERTICES:
        coco17 = _smpl_coco17_regressor(regressor)
    else:
        raise DataError(
            f"{path}: array 'coco17_regressor' is missing and the mesh is not SMPL's: got "
            f"{vertices} vertices, expected {SMPL_VERTICES}; {_REMEDY}"
        )
    return SmplArrays(
        v_template=template.astype(np.float32),
        shapedirs=shapedirs.astype(np.float32),
        posedirs=None if posedirs is None else posedirs.astype(np.float32),
        joint_regressor=regressor.astype(np.float32),
        lbs_weights=weights.astype(np.float32),
        parents=_parents(tree, path),
        faces=faces.astype(np.int64),
        coco17_regressor=coco17.astype(np.float32),
    )


def _smpl_coco17_regressor(joint_regressor: NDArray) -> NDArray:
    """COCO keypoints on SMPL's mesh: face vertices and, for the limbs, the joint regressor."""
    rows = []
    for name in COCO17_NAMES:
        if name in SMPL_FACE_VERTICES:
            row = np.zeros(SMPL_VERTICES)
            row[SMPL_FACE_VERTICES[name]] = 1.0
        else:
            row = joint_regressor[SMPL24_NAMES.index(name)]
        rows.append(row)
    return np.stack(rows)


def _parents(tree: NDArray, path: Path) -> tuple[int, ...]:
    """Parents from `kintree_table`, whose root entry is 2^32 - 1 in official files."""
    parents = (-1, *(int(parent) for parent in tree[0, 1:]))
    for joint, parent in enumerate(parents[1:], start=1):
        if not 0 <= parent < joint:
            raise DataError(
                f"{path}: array 'kintree_table' gives joint {joint} the parent {parent}, "
                f"expected 0..{joint - 1}; {_REMEDY}"
            )
    return parents


def _check(name: str, array: NDArray, expected: tuple[int, ...], path: Path) -> None:
    if array.shape != expected:
        raise DataError(
            f"{path}: array {name!r} has shape {array.shape}, expected {expected}; {_REMEDY}"
        )


def _array(content: dict, name: str, path: Path) -> NDArray:
    if name not in content:
        raise DataError(f"{path}: array {name!r} is missing, have {sorted(content)}; {_REMEDY}")
    value = content[name]
    if isinstance(value, _Attributes):
        value = _dense(value, name, path)
    array = np.asarray(value)
    if array.dtype.kind not in "fiu" or array.ndim < 2:
        raise DataError(
            f"{path}: array {name!r} holds {array.dtype} of shape {array.shape}, expected numbers "
            f"on at least two axes; {_REMEDY}"
        )
    return array


def _dense(value: "_Attributes", name: str, path: Path) -> NDArray:
    """The numbers inside a chumpy array (`x`) or a compressed sparse column matrix."""
    attributes = vars(value)
    if "x" in attributes:
        return np.asarray(attributes["x"])
    if {"data", "indices", "indptr", "_shape"} <= attributes.keys():
        rows, columns = attributes["_shape"]
        dense = np.zeros((rows, columns))
        column_of_entry = np.repeat(np.arange(columns), np.diff(attributes["indptr"]))
        np.add.at(dense, (attributes["indices"], column_of_entry), attributes["data"])
        return dense
    raise DataError(
        f"{path}: array {name!r} is an object with {sorted(attributes)}, expected chumpy's 'x' or "
        f"a scipy csc matrix; {_REMEDY}"
    )


class _Attributes:
    """Stands in for a foreign object; unpickling fills in its attributes."""

    def __init__(self, *_arguments: object) -> None:
        pass

    def __setstate__(self, state: dict) -> None:
        self.__dict__.update(state)


# numpy's own constructors, whatever numpy wrote the file
_NUMPY_GLOBALS = {
    ("multiarray", "_reconstruct"): np.empty(0).__reduce__()[0],
    ("multiarray", "scalar"): np.float64(0).__reduce__()[0],
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class _ArrayUnpickler(pickle.Unpickler):
    """Builds arrays and plain holders; any other global in the file is refused."""

    def find_class(self, module: str, name: str) -> object:
        package, _, last = module.rpartition(".")
        if module.split(".")[0] == "chumpy" or name in ("csc_matrix", "csc_array"):
            return _Attributes
        if package in ("", "numpy.core", "numpy._core") and (last, name) in _NUMPY_GLOBALS:
            return _NUMPY_GLOBALS[last, name]
        if (module, name) == ("_codecs", "encode"):  # how protocol 2 spells bytes
            return super().find_class(module, name)
        raise DataError(f"refused to load {module}.{name}: not an array constructor; {_REMEDY}")


def _unpickle(file: BufferedIOBase, path: Path) -> object:
    try:
        return _ArrayUnpickler(file, encoding="latin1").load()
    except (pickle.UnpicklingError, EOFError, AttributeError, TypeError, ValueError) as error:
        raise DataError(f"{path}: not a readable pickle ({error}); {_REMEDY}") from error
    except DataError as error:
        raise DataError(f"{path}: {error}") from error


def _read_pickle(path: Path) -> dict:
    with path.open("rb") as file:
        content = _unpickle(file, path)
    if not isinstance(content, dict):
        raise DataError(f"{path}: holds a {type(content).__name__}, expected a dict; {_REMEDY}")
    return content


def _read_npz(path: Path) -> dict:
    """The arrays of an `.npz`; object arrays are unpickled by our unpickler, not numpy's."""
    content = {}
    try:
        with zipfile.ZipFile(path) as archive:
            for member in archive.namelist():
                with archive.open(member) as file:
                    content[member.removesuffix(".npy")] = _read_npy(file, path)
    except zipfile.BadZipFile as error:
        raise DataError(f"{path}: not a readable .npz ({error}); {_REMEDY}") from error
    return content


def _read_npy(file: BufferedIOBase, path: Path) -> object:
    version = np.lib.format.read_magic(file)
    read_header = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }[version]
    shape, fortran_order, dtype = read_header(file)
    if dtype.hasobject:
        value = _unpickle(file, path)
        return value.item() if isinstance(value, np.ndarray) and value.shape == () else value
    numbers = np.frombuffer(file.read(), dtype=dtype)
    return numbers.reshape(shape, order="F" if fortran_order else "C")
