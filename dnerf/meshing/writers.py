"""Meshes to files: PLY or OBJ for each frame, one animated glTF for all of them.

Vertices are in the data set's own units and axes. A glTF viewer takes y for up, so the root node of a glTF file turns
what is up in the scene to y. Blender turns y to z again: up is up there, too.
"""

from collections.abc import Iterable
from pathlib import Path

import torch
from torch import Tensor

from dnerf.core.checks import check_choice, check_positive, check_whole
from dnerf.core.files import replaced_folder, write_bytes
from dnerf.data.normalization import IDENTITY, Similarity
from dnerf.meshing.animation import Animation
from dnerf.meshing.surface import Mesh, imported

FORMATS = ("ply", "obj")
MOST_BYTES = 2**32 - 2**20  # of a GLB file, whose length is a 32-bit number; some are left for the header
COMPONENTS = {torch.float32: 5126, torch.uint16: 5123, torch.uint32: 5125}  # glTF 2.0, section 3.6.2.2
KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # by columns
VERTICES, INDICES = 34962, 34963  # what buffer views are for, section 5.11.5
UNLIT = "KHR_materials_unlit"
TO_Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))  # from axes with z up


def own_units(mesh: Mesh, similarity: Similarity) -> Mesh:
    """A mesh in the data set's own units and axes, whose world is that of a similarity; float32."""
    turn = torch.tensor(similarity.rotation)
    return Mesh(
        similarity.positions_from_world(mesh.vertices).float(), mesh.faces, mesh.normals.float() @ turn, mesh.rgb
    )


def write_meshes(
    meshes: Iterable[Mesh], folder: str | Path, format: str = "ply", *, similarity: Similarity = IDENTITY
) -> Path:
    """Write meshes as `mesh_00000.ply`, ... with normals and 8-bit vertex colours; returns the folder.

    The folder appears when it is complete; an existing one is replaced if it holds nothing but such files.

    Args:
        meshes: in world units; may be a generator.
        folder: missing parents are made.
        format: "ply" (binary) or "obj" (text, colours behind the positions).
        similarity: from the data set's own units to the world: files are in the former.

    Raises:
        ValueError: for an unknown format, no meshes, a folder that holds other things or a missing extra.
    """
    check_choice("format", format, FORMATS)
    trimesh, count = imported("trimesh"), 0
    with replaced_folder(Path(folder), lambda name: name.startswith("mesh_") and name.endswith(f".{format}")) as made:
        for count, mesh in enumerate(meshes, 1):
            own = own_units(mesh, similarity)
            trimesh.Trimesh(
                own.vertices.numpy(), own.faces.numpy(), vertex_normals=own.normals.numpy(),
                vertex_colors=(own.rgb * 255).round().to(torch.uint8).numpy(), process=False,
            ).export(made / f"mesh_{count - 1:05d}.{format}")  # fmt: skip
        if not count:
            raise ValueError("meshes must hold at least one, got none")
    return Path(folder)


def write_gltf(
    animation: Animation, path: str | Path, *, fps: float = 20.0, every: int = 1,
    interpolation: str = "linear", lit: bool = False, similarity: Similarity = IDENTITY,
) -> Path:  # fmt: skip
    """Write a mesh that moves as one binary glTF 2.0 file; returns the path.

    The mesh is that of the first frame. Every key frame behind it is a morph target (differences of positions), and
    one animation fades their weights: at a key frame's time its weight is one, the others' are zero. Colours are
    light as the images show it, so the material is unlit by default; glTF wants them linear, images are sRGB.

    Args:
        animation: in world units.
        path: ends in .glb.
        fps: frames in a second: frame i stands at i / fps.
        every: one key frame of so many frames, the last one among them.
        interpolation: between key frames, "linear" or "step".
        lit: whether the viewer's lamps shade the mesh. It then has normals at each key frame, which takes twice the
            bytes; otherwise they stay those of the first frame, which no unlit material looks at.
        similarity: see `write_meshes`.

    Raises:
        ValueError: for settings out of range, another suffix, a file of more than 4 GiB or a missing extra.
    """
    if Path(path).suffix.lower() != ".glb":
        raise ValueError(f"path must be a file that ends in .glb, got {path}")
    check_positive("fps", fps)
    check_whole("every", every)
    check_choice("interpolation", interpolation, ("linear", "step"))
    keys = [*range(0, len(animation.times) - 1, every), len(animation.times) - 1]
    first = own_units(animation.frame(0), similarity)
    if ((1 + lit) * len(keys) + 3) * 12 * len(first.vertices) + 12 * len(first.faces) > MOST_BYTES:
        raise ValueError(f"every must leave a file of less than 4 GiB, got {len(keys)} key frames; choose a larger one")
    lib, blob = imported("pygltflib"), bytearray()
    gltf = lib.GLTF2(asset=lib.Asset(version="2.0", generator="dnerf"), scene=0, scenes=[lib.Scene(nodes=[0])])

    def add(values: Tensor, target: int | None = None) -> int:
        """Append an array (N, n) to the binary chunk; the number of its accessor."""
        data = values.contiguous().numpy().tobytes()
        part = lib.BufferView(buffer=0, byteOffset=len(blob), byteLength=len(data), target=target)
        gltf.bufferViews.append(part)
        is_real, kind = values.dtype == torch.float32, KINDS[values.shape[1]]
        gltf.accessors.append(lib.Accessor(
            bufferView=len(gltf.bufferViews) - 1, componentType=COMPONENTS[values.dtype], count=len(values), type=kind,
            normalized=values.dtype == torch.uint16, min=values.amin(0).tolist() if is_real else [],
            max=values.amax(0).tolist() if is_real else [],
        ))  # fmt: skip
        blob.extend(data)  # a multiple of four bytes, as the next one's offset has to be
        return len(gltf.accessors) - 1

    attributes = lib.Attributes(
        POSITION=add(first.vertices, VERTICES), NORMAL=add(first.normals, VERTICES),
        COLOR_0=add(_linear_colours(first.rgb), VERTICES),
    )  # fmt: skip
    indices = add(first.faces.reshape(-1, 1).to(torch.uint32), INDICES)
    targets = []
    for moved in (own_units(animation.frame(key), similarity) for key in keys[1:]):
        changes = {"POSITION": moved.vertices - first.vertices} | (
            {"NORMAL": moved.normals - first.normals} if lit else {}
        )
        targets.append({name: add(change, VERTICES) for name, change in changes.items()})
    gltf.meshes = [lib.Mesh(name="surface", weights=[0.0] * len(targets), primitives=[
        lib.Primitive(attributes=attributes, indices=indices, material=0, targets=targets)
    ])]  # fmt: skip
    matte = lib.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
    gltf.materials = [lib.Material(pbrMetallicRoughness=matte, extensions={} if lit else {UNLIT: {}}, doubleSided=True)]
    gltf.extensionsUsed = [] if lit else [UNLIT]
    turn = imported("scipy.spatial.transform").Rotation.from_matrix(TO_Y_UP)
    turn = turn * imported("scipy.spatial.transform").Rotation.from_matrix(similarity.rotation)
    gltf.nodes = [lib.Node(name="y is up", rotation=turn.as_quat().tolist(), children=[1]), lib.Node(mesh=0)]
    if targets:
        seconds, weights = torch.tensor(keys)[:, None] / fps, torch.eye(len(keys))[:, 1:].reshape(-1, 1)
        sampler = lib.AnimationSampler(input=add(seconds), output=add(weights), interpolation=interpolation.upper())
        channel = lib.AnimationChannel(sampler=0, target=lib.AnimationChannelTarget(node=1, path="weights"))
        gltf.animations = [lib.Animation(name="motion", samplers=[sampler], channels=[channel])]
    gltf.buffers = [lib.Buffer(byteLength=len(blob))]
    gltf.set_binary_blob(bytes(blob))
    write_bytes(Path(path), b"".join(gltf.save_to_bytes()))
    return Path(path)


def _linear_colours(rgb: Tensor) -> Tensor:
    """sRGB (V, 3) in [0, 1] to linear RGBA (V, 4) in 16 bits (IEC 61966-2-1)."""
    linear = torch.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    return (torch.nn.functional.pad(linear, (0, 1), value=1.0) * 65535).round().to(torch.uint16)
