"""SMPL files of our own making, byte for byte in the layout of the official ones."""

import io
import pickle
import struct
import sys
import types
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import torch

from ntop.body.model import load_body_model
from ntop.body.skeletons import COCO17_NAMES, SMPL24_PARENTS
from ntop.body.skinning import BodyPose, pose_body
from ntop.body.smpl_files import SMPL_FACE_VERTICES, SMPL_VERTICES
from ntop.conventions import DataError


class _Python2Pickler(pickle._Pickler):
    """Writes bytes as Python 2's protocol 2 did: as a raw string, not through a codec."""

    dispatch: ClassVar[dict] = dict(pickle._Pickler.dispatch)

    def _save_bytes(self, data: bytes) -> None:
        self.write(b"T" + struct.pack("<i", len(data)) + data)
        self.memoize(data)

    dispatch[bytes] = _save_bytes


def foreign_class(monkeypatch: pytest.MonkeyPatch, module_name: str, name: str) -> type:
    """A class that pickles under a foreign module's name, as chumpy's and old scipy's do."""
    module = types.ModuleType(module_name)
    cls = type(name, (), {"__module__": module_name})
    setattr(module, name, cls)
    for depth in range(1, module_name.count(".") + 1):
        package = module_name.rsplit(".", depth)[0]
        monkeypatch.setitem(
            sys.modules, package, sys.modules.get(package, types.ModuleType(package))
        )
    monkeypatch.setitem(sys.modules, module_name, module)
    return cls


def smpl_arrays(vertices: int) -> dict:
    """Random numbers in the official keys, shapes and types (v1.0: ten shape directions)."""
    random = np.random.default_rng(1)
    regressor = np.zeros((24, vertices))
    regressor[np.arange(24), random.permutation(vertices)[:24]] = 1.0
    weights = random.uniform(size=(vertices, 24))
    parents = np.array(SMPL24_PARENTS).astype(np.uint32)  # -1 becomes 4294967295
    return {
        "v_template": random.normal(size=(vertices, 3)),
        "shapedirs": random.normal(size=(vertices, 3, 10)),
        "posedirs": random.normal(size=(vertices, 3, 207)),
        "J_regressor": regressor,
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.stack([parents, np.arange(24, dtype=np.uint32)]),
        "f": random.integers(0, vertices, (2 * vertices - 4, 3)).astype(np.uint32),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def coco17_row_sum(vertices: int) -> np.ndarray:
    return np.full((len(COCO17_NAMES), vertices), 1 / vertices)


def csc_attributes(dense: np.ndarray) -> dict:
    """The attributes of scipy's compressed sparse column matrix."""
    columns, rows = np.nonzero(dense.T)
    counts = np.bincount(columns, minlength=dense.shape[1])
    return {
        "_shape": dense.shape,
        "data": dense[rows, columns],
        "indices": rows.astype(np.int32),
        "indptr": np.concatenate([[0], counts.cumsum()]).astype(np.int32),
    }


def write_official_pickle(path: Path, arrays: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """shapedirs as chumpy, J_regressor as scipy csc, the rest numpy; Python 2's protocol 2."""
    chumpy = foreign_class(monkeypatch, "chumpy.ch", "Ch")()
    chumpy.__dict__.update(x=arrays["shapedirs"], _dirty_vars=None)
    sparse = foreign_class(monkeypatch, "scipy.sparse.csc", "csc_matrix")()
    sparse.__dict__.update(csc_attributes(arrays["J_regressor"]), maxprint=50)
    buffer = io.BytesIO()
    _Python2Pickler(buffer, protocol=2).dump(arrays | {"shapedirs": chumpy, "J_regressor": sparse})
    content = buffer.getvalue()
    path.write_bytes(content.replace(b"cnumpy._core.multiarray\n", b"cnumpy.core.multiarray\n"))


def test_official_pickle_loads_without_chumpy(tmp_path, monkeypatch):
    arrays = smpl_arrays(SMPL_VERTICES)
    path = tmp_path / "basicModel_neutral_lbs_10_207_0_v1.0.0.pkl"
    with monkeypatch.context() as patch:
        write_official_pickle(path, arrays, patch)
    assert b"cchumpy.ch\nCh\n" in path.read_bytes()
    model = load_body_model(path)
    assert "chumpy" not in sys.modules
    for name, value in {
        "v_template": model.v_template,
        "shapedirs": model.shapedirs,
        "posedirs": model.posedirs,
        "J_regressor": model.joint_regressor,
        "weights": model.lbs_weights,
    }.items():
        assert value.dtype == torch.float32
        np.testing.assert_array_equal(value, arrays[name].astype(np.float32), err_msg=name)
    np.testing.assert_array_equal(model.faces, arrays["f"])
    assert model.parents == SMPL24_PARENTS
    rows = dict(zip(COCO17_NAMES, model.coco17_regressor, strict=True))
    assert rows["nose"].argmax() == SMPL_FACE_VERTICES["nose"]
    torch.testing.assert_close(rows["left_knee"], model.joint_regressor[4])


def test_loaded_pickle_poses(tmp_path, monkeypatch):
    arrays = smpl_arrays(50) | {"coco17_regressor": coco17_row_sum(50)}
    write_official_pickle(tmp_path / "small.pkl", arrays, monkeypatch)
    model = load_body_model(tmp_path / "small.pkl")
    zero = BodyPose(torch.zeros(10), torch.zeros(3), torch.zeros(69), torch.ones(3))
    torch.testing.assert_close(pose_body(model, zero).vertices, model.v_template + 1)


@pytest.mark.parametrize("shape_directions", [10, 300])
def test_npz_loads_and_keeps_ten_shape_directions(tmp_path, shape_directions):
    arrays = smpl_arrays(50) | {"coco17_regressor": coco17_row_sum(50)}
    arrays["shapedirs"] = np.random.default_rng(0).normal(size=(50, 3, shape_directions))
    np.savez(tmp_path / "SMPL_NEUTRAL.npz", **arrays)
    model = load_body_model(tmp_path / "SMPL_NEUTRAL.npz")
    np.testing.assert_array_equal(model.shapedirs, arrays["shapedirs"][..., :10].astype("float32"))
    np.testing.assert_array_equal(model.joint_regressor, arrays["J_regressor"])


def test_npz_with_a_sparse_regressor_object_loads(tmp_path, monkeypatch):
    arrays = smpl_arrays(50) | {"coco17_regressor": coco17_row_sum(50)}
    sparse = foreign_class(monkeypatch, "scipy.sparse._csc", "csc_matrix")()
    sparse.__dict__.update(csc_attributes(arrays["J_regressor"]))
    stored = arrays | {"J_regressor": np.array(sparse, dtype=object)}
    np.savez(tmp_path / "model.npz", **stored)
    model = load_body_model(tmp_path / "model.npz")
    np.testing.assert_array_equal(model.joint_regressor, arrays["J_regressor"])


@pytest.mark.parametrize(
    ("name", "wrong", "expected"),
    [
        ("v_template", (50, 2), "(50, 3)"),
        ("shapedirs", (50, 3, 4), "(50, 3, 10)"),
        ("shapedirs", (49, 3, 10), "(50, 3, 10)"),
        ("posedirs", (50, 3, 486), "(50, 3, 207)"),  # SMPL-X
        ("J_regressor", (55, 50), "(24, 50)"),
        ("weights", (50, 52), "(50, 24)"),
        ("kintree_table", (2, 55), "(2, 24)"),
        ("f", (96, 4), "(96, 3)"),
        ("coco17_regressor", (17, 49), "(17, 50)"),
    ],
)
def test_wrong_shapes_are_named(tmp_path, name, wrong, expected):
    arrays = smpl_arrays(50) | {"coco17_regressor": coco17_row_sum(50), name: np.ones(wrong)}
    np.savez(tmp_path / "wrong.npz", **arrays)
    with pytest.raises(DataError) as error:
        load_body_model(tmp_path / "wrong.npz")
    for word in (name, str(wrong), expected, "wrong.npz"):
        assert word in str(error.value)


@pytest.mark.parametrize("name", ["v_template", "J_regressor", "kintree_table", "f"])
def test_missing_arrays_are_named(tmp_path, name):
    arrays = smpl_arrays(50) | {"coco17_regressor": coco17_row_sum(50)}
    del arrays[name]
    np.savez(tmp_path / "model.npz", **arrays)
    with pytest.raises(DataError, match=f"{name}.*missing"):
        load_body_model(tmp_path / "model.npz")


def test_a_foreign_mesh_needs_its_own_coco_regressor(tmp_path):
    np.savez(tmp_path / "model.npz", **smpl_arrays(50))
    with pytest.raises(DataError, match=r"coco17_regressor.*50 vertices"):
        load_body_model(tmp_path / "model.npz")


def test_faces_and_parents_outside_the_model_are_refused(tmp_path):
    arrays = smpl_arrays(50) | {"coco17_regressor": coco17_row_sum(50)}
    np.savez(tmp_path / "faces.npz", **(arrays | {"f": np.array([[0, 1, 50]])}))
    with pytest.raises(DataError, match=r"'f' names vertices 0\.\.50"):
        load_body_model(tmp_path / "faces.npz")
    tree = arrays["kintree_table"].copy()
    tree[0, 5] = 7
    np.savez(tmp_path / "tree.npz", **(arrays | {"kintree_table": tree}))
    with pytest.raises(DataError, match="joint 5 the parent 7"):
        load_body_model(tmp_path / "tree.npz")


class _Opens:
    def __reduce__(self):
        return (open, ("/dev/null",))


def test_code_in_a_pickle_is_refused(tmp_path):
    path = tmp_path / "model.pkl"
    path.write_bytes(pickle.dumps({"v_template": _Opens()}))
    with pytest.raises(DataError, match=r"model\.pkl: refused to load .*open"):
        load_body_model(path)
    np.savez(tmp_path / "model.npz", v_template=np.array(_Opens(), dtype=object))
    with pytest.raises(DataError, match="refused to load"):
        load_body_model(tmp_path / "model.npz")


@pytest.mark.parametrize("name", ["model.pkl", "model.npz", "model.obj"])
def test_other_content_is_refused(tmp_path, name):
    (tmp_path / name).write_bytes(b"not a model")
    with pytest.raises(DataError, match=name.replace(".", r"\.")):
        load_body_model(tmp_path / name)
