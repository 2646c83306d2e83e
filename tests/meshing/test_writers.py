"""Files of meshes, read back by others, and glTF by its rules."""

import json
import struct

import numpy as np
import pytest
import torch
from exact_shapes import BOX, ExactSurface, InvertibleRigid, torus

from dnerf.data.normalization import Similarity
from dnerf.meshing import animate, extract_surface, write_gltf, write_meshes

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("pygltflib")

TYPES = {5126: np.float32, 5123: np.uint16, 5125: np.uint32}
COLUMNS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
UP = (0.0, -0.6, 0.8)  # in the data set's axes
OWN = Similarity.of_box([[3.0, -2.0, 1.0], [7.0, 3.0, 2.5]], UP)


@pytest.fixture(scope="module")
def animation():
    return animate(
        extract_surface(ExactSurface(torus), 0.0, box=BOX, resolution=16), InvertibleRigid(), torch.linspace(0, 1, 6)
    )


def read_by_the_rules(path):
    """JSON and accessors of a GLB file, whose layout is checked against glTF 2.0 (Khronos), chapters 3 to 5."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    gltf = json.loads(data[20 : 20 + size])
    binary_size, kind = struct.unpack_from("<I4s", data, 20 + size)
    assert kind == b"BIN\0"
    assert binary_size % 4 == 0
    binary = data[28 + size :]
    assert len(binary) == binary_size
    assert 0 <= binary_size - gltf["buffers"][0]["byteLength"] < 4
    arrays = []
    for accessor in gltf["accessors"]:
        view, dtype = gltf["bufferViews"][accessor["bufferView"]], np.dtype(TYPES[accessor["componentType"]])
        columns = COLUMNS[accessor["type"]]
        assert view.get("byteOffset", 0) % 4 == accessor.get("byteOffset", 0) == 0
        assert view.get("byteOffset", 0) + view["byteLength"] <= binary_size
        assert view["byteLength"] == accessor["count"] * columns * dtype.itemsize
        values = np.frombuffer(binary, dtype, accessor["count"] * columns, view.get("byteOffset", 0))
        values = values.reshape(-1, columns)
        assert np.isfinite(values).all()
        for name, bound in (("min", values.min(0)), ("max", values.max(0))):
            assert name not in accessor or np.array_equal(np.array(accessor[name], dtype), bound)
        arrays.append(values)
    (primitive,) = gltf["meshes"][0]["primitives"]
    places = [primitive["attributes"]["POSITION"], *(target["POSITION"] for target in primitive.get("targets", []))]
    assert all({"min", "max"} <= gltf["accessors"][i].keys() for i in places)  # required of positions
    assert {len(arrays[i]) for i in (*primitive["attributes"].values(), *places)} == {len(arrays[places[0]])}
    assert arrays[primitive["indices"]].max() < len(arrays[places[0]])
    assert np.abs(np.linalg.norm(arrays[primitive["attributes"]["NORMAL"]], axis=1) - 1).max() < 1e-4
    is_lit = "NORMAL" in (primitive.get("targets") or [{}])[0]
    assert set(gltf.get("extensionsUsed", [])) == (set() if is_lit else {"KHR_materials_unlit"})
    assert gltf["materials"][0].get("extensions", {}).keys() == set(gltf.get("extensionsUsed", []))
    assert "extensionsRequired" not in gltf
    return gltf, arrays, primitive, [arrays[i] for i in places]


@pytest.mark.parametrize(("every", "keys"), [(1, [0, 1, 2, 3, 4, 5]), (2, [0, 2, 4, 5])])
@pytest.mark.parametrize("interpolation", ["linear", "step"])
def test_animated_gltf_keeps_the_rules_and_is_the_frames_at_its_keys(animation, tmp_path, every, keys, interpolation):
    path = tmp_path / "mesh.glb"
    write_gltf(animation, path, fps=10, every=every, interpolation=interpolation, similarity=OWN)
    gltf, arrays, _, (base, *targets) = read_by_the_rules(path)
    (moving,) = gltf["animations"]
    (sampler,), (channel,) = moving["samplers"], moving["channels"]
    seconds, weights = arrays[sampler["input"]][:, 0], arrays[sampler["output"]].reshape(len(keys), -1)
    assert {"min", "max"} <= gltf["accessors"][sampler["input"]].keys()
    np.testing.assert_allclose(seconds, np.array(keys) / 10, rtol=1e-6)
    assert sampler["interpolation"] == interpolation.upper()
    assert channel["target"]["path"] == "weights"
    assert gltf["nodes"][channel["target"]["node"]]["mesh"] == 0
    assert len(gltf["meshes"][0]["weights"]) == weights.shape[1] == len(targets) == len(keys) - 1
    for row, key in zip(weights, keys, strict=True):
        moved = base + sum(weight * target for weight, target in zip(row, targets, strict=True))
        exact = OWN.positions_from_world(animation.positions[key])
        np.testing.assert_allclose(moved, exact, atol=2e-6)  # of float32, in units of some 5


def test_lit_gltf_has_the_normals_of_its_key_frames(animation, tmp_path):
    gltf, arrays, primitive, _ = read_by_the_rules(write_gltf(animation, tmp_path / "mesh.glb", every=2, lit=True))
    assert "KHR_materials_unlit" not in json.dumps(gltf)
    first = arrays[primitive["attributes"]["NORMAL"]]
    for key, target in zip((2, 4, 5), primitive["targets"], strict=True):
        np.testing.assert_allclose(first + arrays[target["NORMAL"]], animation.frame(key).normals, atol=1e-6)
    assert np.abs(arrays[target["NORMAL"]]).max() > 0.1  # it turns


def test_gltf_is_turned_so_that_up_is_y(animation, tmp_path):
    gltf, _, _, (base, *_) = read_by_the_rules(write_gltf(animation, tmp_path / "mesh.glb", similarity=OWN))
    (root,) = gltf["scenes"][gltf["scene"]]["nodes"]
    x, y, z, w = gltf["nodes"][root]["rotation"]
    turn = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3]
    np.testing.assert_allclose(turn @ np.array(UP), [0, 1, 0], atol=1e-6)
    # The world's x, y, z as x, z, -y, but for where the origin is.
    turned, world = base @ turn.T * OWN.scale, animation.positions[0][:, [0, 2, 1]] * torch.tensor([1, 1, -1])
    np.testing.assert_allclose(turned - turned.mean(0), world - world.mean(0), atol=1e-5)


def test_gltf_is_read_back_by_others(animation, tmp_path):
    import pygltflib

    path = write_gltf(animation, tmp_path / "mesh.glb", fps=5)
    scene = trimesh.load(path)
    (mesh,) = scene.geometry.values()
    first = animation.frame(0)
    assert mesh.faces.shape == first.faces.shape
    np.testing.assert_allclose(mesh.bounds, [first.vertices.amin(0), first.vertices.amax(0)], atol=1e-6)
    np.testing.assert_allclose(scene.extents, np.ptp(first.vertices.numpy(), 0)[[0, 2, 1]], atol=1e-5)
    read = pygltflib.GLTF2().load(path)
    assert read.accessors[read.animations[0].samplers[0].input].max == [1.0]  # six frames at five a second
    assert len(read.meshes[0].primitives[0].targets) == 5


def test_colours_of_gltf_are_linear(animation, tmp_path):
    gltf, arrays, primitive, _ = read_by_the_rules(write_gltf(animation, tmp_path / "mesh.glb"))
    number = primitive["attributes"]["COLOR_0"]
    assert gltf["accessors"][number]["normalized"] is True
    linear = arrays[number] / 65535
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(srgb[:, :3], animation.mesh.rgb, atol=2e-4)
    assert (linear[:, 3] == 1).all()


def test_one_frame_has_neither_targets_nor_animation(animation, tmp_path):
    still = animate(animation.mesh, InvertibleRigid(), torch.zeros(1))
    gltf, _, primitive, _ = read_by_the_rules(write_gltf(still, tmp_path / "mesh.glb"))
    assert "animations" not in gltf
    assert not primitive.get("targets")


@pytest.mark.parametrize("format", ["ply", "obj"])
def test_frames_are_read_back_in_the_data_sets_units(animation, tmp_path, format):
    folder = write_meshes(map(animation.frame, range(6)), tmp_path / "frames", format, similarity=OWN)
    assert sorted(path.name for path in folder.iterdir()) == [f"mesh_{i:05d}.{format}" for i in range(6)]
    for i in (0, 5):
        read, faces = trimesh.load(folder / f"mesh_{i:05d}.{format}", process=False), animation.mesh.faces
        own = OWN.positions_from_world(animation.positions[i])
        np.testing.assert_allclose(read.vertices, own, atol=2e-6)
        assert np.array_equal(read.faces, faces)
        origin, normals = OWN.positions_from_world(torch.zeros(3)), animation.frame(i).normals
        exact = OWN.scale * (OWN.positions_from_world(normals) - origin)
        np.testing.assert_allclose(read.vertex_normals, exact, atol=1e-4)
        np.testing.assert_allclose(read.visual.vertex_colors[:, :3] / 255, animation.mesh.rgb, atol=0.004)
        assert read.is_watertight


def test_what_fails_leaves_what_was_there(animation, tmp_path):
    def breaking():
        yield animation.frame(0)
        raise ValueError("broken")

    folder = write_meshes([animation.frame(0)] * 2, tmp_path / "frames")
    with pytest.raises(ValueError, match="broken"):
        write_meshes(breaking(), folder)
    assert len(list(folder.iterdir())) == 2
    (folder / "mine.txt").write_text("keep")
    with pytest.raises(ValueError, match="holds other things"):
        write_meshes([animation.frame(0)], folder)
    with pytest.raises(ValueError, match="hold at least one"):
        write_meshes([], tmp_path / "none")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["frames"]


REFUSED = [
    ({"path": "mesh.gltf"}, "ends in .glb, got mesh.gltf"), ({"fps": 0}, "fps must be > 0"),
    ({"every": 0}, "every must be > 0"), ({"interpolation": "cubic"}, "interpolation must be one of linear, step"),
]  # fmt: skip


@pytest.mark.parametrize(("settings", "said"), REFUSED)
def test_settings_that_do_not_fit_are_named(animation, settings, said, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=said):
        write_gltf(**({"animation": animation, "path": "mesh.glb"} | settings))
    assert not list(tmp_path.iterdir())
