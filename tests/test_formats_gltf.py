"""glTF: what we write comes back; what others write loads; what lies is refused by name."""

import base64
import io
import json
import struct
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_random_rig
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, gltf, gltf_write, pieces
from reenact.rigs.rig import PARTS, Rig

SHARED = Path(__file__).parents[2] / "shared"


def unpack(data: bytes) -> tuple[dict, bytes]:
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]


def pack(root: dict, binary: bytes) -> bytes:
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body


class Builder:
    """Writes glTF as others do: any types, any nodes."""

    def __init__(self):
        self.binary, self.views, self.accessors = b"", [], []

    def view(self, array: np.ndarray) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.views.append({"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes})
        self.binary += array.tobytes()
        return len(self.views) - 1

    def add(self, array: np.ndarray, kind: str, **more) -> int:
        code = {"f4": 5126, "u1": 5121, "i1": 5120, "u2": 5123, "i2": 5122, "u4": 5125}[array.dtype.str[1:]]
        self.accessors.append(
            {"bufferView": self.view(array), "componentType": code, "count": len(array), "type": kind, **more}
        )
        return len(self.accessors) - 1

    def root(self, meshes: list, nodes: list, **more) -> dict:
        return {
            "asset": {"version": "2.0"},
            "nodes": nodes,
            "meshes": meshes,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.binary)}],
            **more,
        }


SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype="<f4")
PUSH = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 0], [0, 0, 0.5]], dtype="<f4")


def square(builder: Builder, names=("smile",), **attributes) -> dict:
    """A mesh of two triangles with one shape per name."""
    primitive = {
        "attributes": {"POSITION": builder.add(SQUARE, "VEC3"), **attributes},
        "indices": builder.add(np.array([0, 1, 2, 0, 2, 3], dtype="<u2"), "SCALAR"),
        "targets": [{"POSITION": builder.add(PUSH, "VEC3")} for _ in names],
    }
    return {"name": "face", "primitives": [primitive], "extras": {"targetNames": list(names)}}


def load(tmp_path: Path, root: dict, binary: bytes) -> Rig:
    path = tmp_path / "made.glb"
    path.write_bytes(pack(root, binary))
    return gltf.load(path)


def make_clip(rig: Rig, frames: int = 12, fps: float = 30.0) -> Clip:
    return Clip(rig.names, torch.rand(frames, len(rig.names), generator=torch.Generator().manual_seed(3)), fps)


@pytest.mark.parametrize("seed", range(20))
def test_what_is_written_comes_back_and_writes_the_same_bytes(seed, tmp_path):
    rig = make_random_rig(seed)
    clip = make_clip(rig, fps=(30.0, 24.0, 60.0, 29.97)[seed % 4])
    gltf_write.save(rig, tmp_path / "one.glb", clip)
    again, clip_again = gltf.load(tmp_path / "one.glb"), gltf.load_clip(tmp_path / "one.glb")
    assert (again.name, again.names, clip_again.names, clip_again.fps) == (rig.name, rig.names, rig.names, clip.fps)
    for field in ("neutral", "deltas", "faces", "parts"):
        before, after = getattr(rig, field), getattr(again, field)
        assert (before is None) == (after is None)
        assert before is None or torch.equal(before, after)
    assert torch.equal(clip_again.weights, clip.weights)
    if rig.colors is not None:
        torch.testing.assert_close(again.colors, rig.colors, rtol=0, atol=1e-6)  # sRGB to linear float32 and back
    if rig.uv is not None:
        assert torch.equal(again.uv[again.uv_faces], rig.uv[rig.uv_faces])
    if rig.texture is not None:
        torch.testing.assert_close(again.texture, rig.texture, rtol=0, atol=1e-7)  # whole 255ths
    gltf_write.save(again, tmp_path / "two.glb", clip_again)
    thrice = gltf.load(tmp_path / "two.glb")
    gltf_write.save(thrice, tmp_path / "three.glb", clip_again)
    assert (tmp_path / "two.glb").read_bytes() == (tmp_path / "three.glb").read_bytes()


def test_coincident_vertices_of_our_own_stay_apart(tmp_path):
    rig = make_random_rig(0)
    neutral, deltas = rig.neutral.clone(), rig.deltas.clone()
    neutral[7], deltas[:, 7] = neutral[8], deltas[:, 8]
    twin = Rig("twin", neutral, deltas, rig.names, rig.faces)
    gltf_write.save(twin, tmp_path / "twin.glb")
    assert torch.equal(gltf.load(tmp_path / "twin.glb").faces, twin.faces)


def test_split_vertices_are_welded_and_keep_their_uv(tmp_path):
    rig = make_random_rig(1)
    corners = rig.faces.flatten().numpy()
    builder = Builder()
    split = rig.neutral.numpy()[corners]
    uv = np.random.default_rng(0).random((96, 2)).astype("<f4")
    primitive = {
        "attributes": {"POSITION": builder.add(split, "VEC3"), "TEXCOORD_0": builder.add(uv, "VEC2")},
        "targets": [{"POSITION": builder.add(delta[corners], "VEC3")} for delta in rig.deltas.numpy()],
    }
    mesh = {"primitives": [primitive], "extras": {"targetNames": list(rig.names)}}
    loaded = load(tmp_path, builder.root([mesh], [{"mesh": 0}]), builder.binary)
    assert len(loaded.neutral) == 25  # of 96
    assert torch.equal(loaded.neutral[loaded.faces], rig.neutral[rig.faces])
    assert torch.equal(loaded.deltas[:, loaded.faces], rig.deltas[:, rig.faces])
    assert torch.equal(loaded.uv[loaded.uv_faces].reshape(-1, 2), torch.from_numpy(uv))


def test_equal_positions_that_move_apart_are_not_welded(tmp_path):
    builder = Builder()
    lips = np.concatenate([SQUARE, SQUARE]).astype("<f4")
    push = np.concatenate([PUSH, -PUSH]).astype("<f4")
    primitive = {
        "attributes": {"POSITION": builder.add(lips, "VEC3")},
        "indices": builder.add(np.array([0, 1, 2, 4, 5, 6, 0, 2, 3, 4, 6, 7], dtype="<u4"), "SCALAR"),
        "targets": [{"POSITION": builder.add(push, "VEC3")}],
    }
    mesh = {"primitives": [primitive], "extras": {"targetNames": ["open"]}}
    loaded = load(tmp_path, builder.root([mesh], [{"mesh": 0}]), builder.binary)
    assert len(loaded.neutral) == 6  # vertices 1 and 2 move alike, 0 and 3 do not


def test_node_transforms_reach_positions_offsets_and_winding(tmp_path):
    builder = Builder()
    mesh = square(builder)
    half = np.sqrt(0.5)
    nodes = [
        {"children": [1], "scale": [0.01, 0.01, 0.01], "translation": [0, 1, 0]},
        {"mesh": 0, "rotation": [half, 0, 0, half], "scale": [1, 1, -1]},  # a quarter turn about X; a mirror
    ]
    loaded = load(tmp_path, builder.root([mesh], nodes, scenes=[{"nodes": [0]}], scene=0), builder.binary)
    # y -> z, z -> -y by the turn, z first mirrored; then hundredths, then one up.
    expected = np.stack([SQUARE[:, 0], 100 + SQUARE[:, 2], SQUARE[:, 1]], axis=1) / 100
    np.testing.assert_allclose(loaded.neutral, expected, atol=1e-7)  # float32 near 1
    np.testing.assert_allclose(loaded.deltas[0], np.stack([PUSH[:, 0], PUSH[:, 2], PUSH[:, 1]], 1) / 100, atol=1e-9)
    assert loaded.faces.tolist() == [[2, 1, 0], [3, 2, 0]]


def test_a_matrix_is_read_by_columns(tmp_path):
    builder = Builder()
    matrix = [0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 5, 6, 7, 1]  # x -> 2y, y -> -2x, z -> 2z, then (5, 6, 7)
    loaded = load(tmp_path, builder.root([square(builder)], [{"mesh": 0, "matrix": matrix}]), builder.binary)
    assert loaded.neutral[1].tolist() == [5, 8, 7]
    assert loaded.deltas[0, 0].tolist() == [0, 0, 2]


def test_meshes_that_share_names_become_one_rig_with_parts_and_colours(tmp_path):
    builder = Builder()
    head, teeth, shirt = square(builder, ("smile", "open")), square(builder, ("open",)), square(builder)
    teeth["name"], shirt["name"] = "upper_teeth", "shirt"
    del shirt["primitives"][0]["targets"], shirt["extras"]
    head["primitives"][0]["material"] = 0
    material = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.25, 1.0, 1.0]}}
    nodes = [{"mesh": 0}, {"mesh": 1, "translation": [0, 0, 3]}, {"mesh": 2}]
    root = builder.root([head, teeth, shirt], nodes, materials=[material])
    loaded = load(tmp_path, root, builder.binary)
    left = [mesh for mesh in gltf.read(tmp_path / "made.glb")[1].meshes if not mesh.used]
    assert [(mesh.name, mesh.reason) for mesh in left] == [("shirt", "no shapes")]
    assert loaded.names == ("smile", "open")
    assert len(loaded.neutral) == 8
    assert loaded.deltas[0, 4:].abs().sum() == 0
    assert torch.equal(loaded.deltas[1, :4], loaded.deltas[1, 4:])
    assert [PARTS[part] for part in loaded.parts] == ["skin"] * 4 + ["teeth"] * 4
    # 0.5 linear is 0.7354 in sRGB, 0.25 is 0.5371.
    np.testing.assert_allclose(loaded.colors[0], [0.7354, 0.5371, 1.0], atol=1e-4)
    assert loaded.colors[4].tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("label", "part"),
    [
        ("eyes", "eyes"),
        ("Eyelashes", "lashes"),
        ("eyebrow_L", "brows"),
        ("eye_sockets", "skin"),
        ("lips", "lips"),
        ("Eyelid", "skin"),
        ("gums_tongue", "tongue"),
        ("mouth_socket", "mouth"),
        ("LowerTeeth", "teeth"),
        ("head", "skin"),
    ],
)
def test_parts_follow_from_names(label, part):
    assert PARTS[pieces.part_named(label)] == part


@pytest.mark.parametrize("with_view", [False, True])
def test_sparse_offsets_with_and_without_a_view(with_view, tmp_path):
    builder = Builder()
    mesh = square(builder)
    entry = builder.accessors[mesh["primitives"][0]["targets"][0]["POSITION"]]
    if not with_view:
        del entry["bufferView"]
    entry["sparse"] = {
        "count": 1,
        "indices": {"bufferView": builder.view(np.array([1], "<u2")), "componentType": 5123},
        "values": {"bufferView": builder.view(np.array([[0, 9, 0]], "<f4"))},
    }
    expected = PUSH.copy() if with_view else np.zeros_like(PUSH)
    expected[1] = [0, 9, 0]
    loaded = load(tmp_path, builder.root([mesh], [{"mesh": 0}]), builder.binary)
    assert loaded.deltas[0].tolist() == expected.tolist()


def test_quantised_and_interleaved_vertices_load(tmp_path):
    builder = Builder()
    mesh = square(builder)
    stored = np.zeros((4, 8), "<i2")  # 16 bytes a vertex, the position in the first six
    stored[:, :3] = SQUARE * 32767
    position = builder.add(stored, "VEC3", normalized=True)
    builder.views[-1]["byteStride"] = 16
    mesh["primitives"][0]["attributes"]["POSITION"] = position
    color = builder.add(np.array([[255, 0, 0, 255]] * 4, "<u1"), "VEC4", normalized=True)
    mesh["primitives"][0]["attributes"]["COLOR_0"] = color
    root = builder.root([mesh], [{"mesh": 0}], extensionsRequired=["KHR_mesh_quantization"])
    loaded = load(tmp_path, root, builder.binary)
    assert loaded.neutral.tolist() == SQUARE.tolist()
    assert loaded.colors[0].tolist() == [1, 0, 0]


@pytest.mark.parametrize(("mode", "expected"), [(5, [[0, 1, 2], [2, 1, 3]]), (6, [[0, 1, 2], [0, 2, 3]])])
def test_strips_and_fans_become_triangles(mode, expected, tmp_path):
    builder = Builder()
    mesh = square(builder)
    mesh["primitives"][0]["mode"] = mode
    del mesh["primitives"][0]["indices"]
    assert load(tmp_path, builder.root([mesh], [{"mesh": 0}]), builder.binary).faces.tolist() == expected


def test_lines_are_no_part_of_a_rig(tmp_path):
    builder = Builder()
    mesh = square(builder)
    mesh["primitives"].append({**mesh["primitives"][0], "mode": 1})
    assert len(load(tmp_path, builder.root([mesh], [{"mesh": 0}]), builder.binary).faces) == 2


def skinned(builder: Builder, poses: list[np.ndarray]) -> dict:
    """A square whose first two vertices hang on one joint, the others on a second; joints were bound at +x and +y."""
    bound = [np.eye(4), np.eye(4)]
    bound[0][0, 3], bound[1][1, 3] = 1, 1
    inverse = np.stack([np.linalg.inv(each).T.reshape(16) for each in bound]).astype("<f4")
    mesh = square(
        builder,
        JOINTS_0=builder.add(np.array([[0, 0, 0, 0], [0, 0, 0, 0], [1, 0, 0, 0], [1, 0, 0, 0]], "<u1"), "VEC4"),
        WEIGHTS_0=builder.add(np.tile(np.array([[1, 0, 0, 0]], "<f4"), (4, 1)), "VEC4"),
    )
    joints = [{"matrix": (pose @ each).T.reshape(16).tolist()} for pose, each in zip(poses, bound)]
    skin = {"joints": [1, 2], "inverseBindMatrices": builder.add(inverse, "MAT4")}
    return builder.root([mesh], [{"mesh": 0, "skin": 0, "scale": [9, 9, 9]}, *joints], skins=[skin])


def test_a_skin_at_its_bind_pose_stands_where_its_joints_stand_and_not_its_node(tmp_path):
    builder = Builder()
    larger = np.diag([2.0, 2.0, 2.0, 1.0])  # an armature in other units
    loaded = load(tmp_path, skinned(builder, [larger, larger]), builder.binary)
    np.testing.assert_allclose(loaded.neutral, 2 * SQUARE, atol=1e-6)
    np.testing.assert_allclose(loaded.deltas[0], 2 * PUSH, atol=1e-6)


def test_a_posed_skin_keeps_its_bound_shape_at_the_joint_that_carries_the_motion(tmp_path):
    builder = Builder()
    nod, other = np.eye(4), np.eye(4)
    nod[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # a quarter turn about x
    other[:3, 3] = 5
    loaded = load(tmp_path, skinned(builder, [nod, other]), builder.binary)  # vertex 0, on the first, moves most
    np.testing.assert_allclose(loaded.neutral, SQUARE @ nod[:3, :3].T, atol=1e-6)


def test_meshes_are_chosen_by_name_and_shapes_too(tmp_path):
    builder = Builder()
    head, shirt = square(builder, ("smile", "jawOpen", "jawLeft")), square(builder, ("wrinkle",))
    shirt["name"] = "Shirt"
    path = tmp_path / "made.glb"
    path.write_bytes(pack(builder.root([head, shirt], [{"mesh": 0}, {"mesh": 1}]), builder.binary))
    assert gltf.load(path).names == ("smile", "jawOpen", "jawLeft", "wrinkle")
    chosen = gltf.load(path, pieces.Choice(parts=("fa*",), shapes=("JAW*",)))
    assert (chosen.names, len(chosen.neutral)) == (("jawOpen", "jawLeft"), 4)
    with pytest.raises(ReenactError, match="no mesh is called hair; it has face, Shirt"):
        gltf.load(path, pieces.Choice(parts=("hair",)))
    with pytest.raises(ReenactError, match="no shape is called wink; it has smile"):
        gltf.load(path, pieces.Choice(shapes=("wink",)))


def test_eyes_without_shapes_are_taken_where_they_lie_in_the_face(tmp_path):
    builder = Builder()
    meshes = [square(builder) for _ in range(4)]
    for mesh, name in zip(meshes[1:], ("Eyes", "Eyes of a poster", "Hair")):
        mesh["name"] = name
        del mesh["primitives"][0]["targets"], mesh["extras"]
    small = {"scale": [0.3, 0.3, 0.3], "translation": [-0.15, 0.3, 0]}  # shapes move the left edge of the square
    nodes = [{"mesh": 0}, {"mesh": 1, **small}, {"mesh": 2, "translation": [30, 0, 0]}, {"mesh": 3, **small}]
    path = tmp_path / "made.glb"
    path.write_bytes(pack(builder.root(meshes, nodes), builder.binary))
    rig, contents = gltf.read(path)
    assert {mesh.name: mesh.reason for mesh in contents.meshes} == {
        "face": "has shapes",
        "Eyes": "lies in the face",
        "Eyes of a poster": "no shapes",
        "Hair": "no shapes",
    }
    assert len(rig.part("eyes")) == 4


def vrm(version: str, **expressions: list[tuple[int, int, float]]) -> dict:
    """Extensions of a file whose expressions mix morph targets (mesh and node, target, weight from 0 to 1)."""
    if version == "1.0":
        custom = {
            name: {"morphTargetBinds": [{"node": node, "index": k, "weight": weight} for node, k, weight in binds]}
            for name, binds in expressions.items()
        }
        return {"VRMC_vrm": {"specVersion": "1.0", "expressions": {"custom": custom}}}
    groups = [
        {
            "name": name,
            "presetName": "unknown",
            "binds": [{"mesh": m, "index": k, "weight": 100 * w} for m, k, w in binds],
        }
        for name, binds in expressions.items()
    ]
    return {"VRM": {"blendShapeMaster": {"blendShapeGroups": groups}}}


@pytest.mark.parametrize("version", ["0.x", "1.0"])
def test_expressions_of_vrm_are_shapes_that_mix_others(version, tmp_path):
    builder = Builder()
    face, lashes = square(builder, ("smile", "open")), square(builder, ("close",))
    lashes["name"] = "lashes"
    extensions = vrm(version, happy=[(0, 0, 0.5), (0, 1, 0.25), (1, 0, 1.0)], smile=[(0, 0, 1.0)], a=[(0, 1, 1.0)])
    path = tmp_path / "made.vrm"
    path.write_bytes(
        pack(builder.root([face, lashes], [{"mesh": 0}, {"mesh": 1}], extensions=extensions), builder.binary)
    )
    rig, contents = gltf.read(path)
    assert rig.names == ("smile", "open", "happy", "close")
    torch.testing.assert_close(rig.deltas[2, :4], torch.from_numpy(0.75 * PUSH))
    torch.testing.assert_close(rig.deltas[2, 4:], torch.from_numpy(PUSH))
    assert contents.format.startswith(f"VRM {version}")
    assert "expressions that are a shape of another name: a = open" in contents.converted
    assert gltf.load(path, pieces.Choice(shapes=("a", "smile"))).names == ("smile", "a")


def test_an_avatar_keeps_everything_and_gains_the_animation(tmp_path):
    builder = Builder()
    face, lashes = square(builder, ("smile", "open")), square(builder, ("open",))
    extensions = vrm("1.0", happy=[(0, 0, 0.5), (1, 0, 1.0)])
    root = builder.root([face, lashes], [{"mesh": 0}, {"mesh": 1}], extensions=extensions, extensionsUsed=["VRMC_vrm"])
    (tmp_path / "avatar.vrm").write_bytes(pack(root, builder.binary))
    clip = Clip(("happy", "open", "wink"), torch.tensor([[1.0, 0.5, 1.0], [0.0, 1.0, 0.0]]), 25.0)
    lost = gltf_write.animate(tmp_path / "avatar.vrm", clip, tmp_path / "moved.vrm")
    assert lost == ("wink",)
    after, _ = unpack((tmp_path / "moved.vrm").read_bytes())
    for key in ("extensions", "extensionsUsed", "meshes", "nodes"):
        assert after[key] == root[key]
    moved = gltf.load_clip(tmp_path / "moved.vrm")
    assert (moved.names, moved.fps) == (("smile", "open"), 25.0)
    # Half a smile from happy; `open` as the first mesh has it, where happy does not move it.
    assert moved.weights.tolist() == [[0.5, 0.5], [0.0, 1.0]]
    assert len(after["animations"][0]["channels"]) == 2


def test_buffers_beside_an_avatar_move_into_the_file(tmp_path):
    builder = Builder()
    root = builder.root([square(builder)], [{"mesh": 0}])
    root["buffers"][0]["uri"] = "side.bin"
    (tmp_path / "side.bin").write_bytes(builder.binary)
    (tmp_path / "avatar.gltf").write_text(json.dumps(root))
    clip = Clip(("smile",), torch.rand(3, 1), 30.0)
    gltf_write.animate(tmp_path / "avatar.gltf", clip, tmp_path / "moved.glb")
    (tmp_path / "side.bin").unlink()
    assert torch.equal(gltf.load_clip(tmp_path / "moved.glb").weights, clip.weights)
    assert gltf.load(tmp_path / "moved.glb").names == ("smile",)


def test_an_avatar_without_the_shapes_of_a_clip_is_refused(tmp_path):
    builder = Builder()
    (tmp_path / "a.glb").write_bytes(pack(builder.root([square(builder)], [{"mesh": 0}]), builder.binary))
    with pytest.raises(ReenactError, match="expected some of the clip's shapes"):
        gltf_write.animate(tmp_path / "a.glb", Clip(("wink",), torch.ones(1, 1), 30.0), tmp_path / "b.glb")


def test_animations_of_several_meshes_are_one_clip(tmp_path):
    builder = Builder()
    meshes = [square(builder, ("smile",)), square(builder, ("open",)), square(builder, ("smile",))]
    times = builder.add(np.array([0.0, 0.04, 0.08], "<f4"), "SCALAR")

    def action(node, *values):
        output = builder.add(np.array(values, "<f4"), "SCALAR")
        channel = {"sampler": 0, "target": {"node": node, "path": "weights"}}
        return {"samplers": [{"input": times, "output": output}], "channels": [channel]}

    animations = [action(0, 0, 0.5, 1), action(1, 1, 0.5, 0), action(0, 1, 1, 1)]  # the third is another take
    path = tmp_path / "made.glb"
    path.write_bytes(pack(builder.root(meshes, [{"mesh": i} for i in range(3)], animations=animations), builder.binary))
    clip = gltf.load_clip(path)
    assert (clip.names, clip.fps) == (("smile", "open"), 25.0)
    np.testing.assert_allclose(clip.weights, [[0, 1], [0.5, 0.5], [1, 0]], atol=1e-6)  # float32 times


def test_faces_that_are_mostly_transparent_are_left_out(tmp_path):
    builder = Builder()
    uv = builder.add(np.array([[0.1, 0.5], [0.4, 0.5], [0.9, 0.5], [0.6, 0.5]], "<f4"), "VEC2")
    mesh = square(builder, TEXCOORD_0=uv)
    mesh["primitives"][0] |= {"material": 0, "indices": builder.add(np.array([0, 1, 1, 2, 3, 3], "<u2"), "SCALAR")}
    clear = np.full((2, 2, 4), 255, np.uint8)
    clear[:, 1, 3] = 20  # the right half
    packed = io.BytesIO()
    Image.fromarray(clear).save(packed, "PNG")
    uri = "data:image/png;base64," + base64.b64encode(packed.getvalue()).decode()
    surface = {"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}
    more = {"materials": [surface], "textures": [{"source": 0}], "images": [{"uri": uri}]}
    mesh["primitives"].append({**mesh["primitives"][0], "indices": builder.add(np.array([0, 1, 3], "<u2"), "SCALAR")})
    mesh["primitives"][1].pop("material")
    path = tmp_path / "made.glb"
    path.write_bytes(pack(builder.root([mesh], [{"mesh": 0}], **more), builder.binary))
    _, contents = gltf.read(path)
    assert "face: 1 transparent of 2 faces left out" in contents.converted


def png(color) -> bytes:
    packed = io.BytesIO()
    Image.new("RGB", (2, 2), color).save(packed, "PNG")
    return packed.getvalue()


def test_several_pictures_become_one(tmp_path):
    builder = Builder()
    meshes = []
    for _ in range(2):
        uv = builder.add(np.full((4, 2), 0.4, "<f4"), "VEC2")
        meshes.append(square(builder, TEXCOORD_0=uv))
        meshes[-1]["primitives"][0]["material"] = len(meshes) - 1
    uris = ["data:image/png;base64," + base64.b64encode(png(color)).decode() for color in ((255, 0, 0), (0, 51, 0))]
    surface = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": index}}} for index in range(2)]
    more = {"materials": surface, "textures": [{"source": 0}, {"source": 1}], "images": [{"uri": uri} for uri in uris]}
    loaded = load(tmp_path, builder.root(meshes, [{"mesh": 0}, {"mesh": 1}], **more), builder.binary)
    size = len(loaded.texture)
    places = (loaded.uv[loaded.faces if loaded.uv_faces is None else loaded.uv_faces] * size).long()
    seen = loaded.texture[places[..., 1], places[..., 0]]  # (F, 3, 3)
    assert torch.equal(seen[:2], torch.tensor([1.0, 0.0, 0.0]).expand(2, 3, 3))
    torch.testing.assert_close(seen[2:], torch.tensor([0.0, 0.2, 0.0]).expand(2, 3, 3), rtol=0, atol=1e-7)


def test_a_texture_transform_moves_uv(tmp_path):
    builder = Builder()
    mesh = square(builder, TEXCOORD_0=builder.add(np.array([[1, 0], [0, 0], [0, 1], [1, 1]], "<f4"), "VEC2"))
    mesh["primitives"][0]["material"] = 0
    transform = {"KHR_texture_transform": {"offset": [0.5, 0.25], "scale": [0.5, 0.5], "rotation": np.pi / 2}}
    surface = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "extensions": transform}}}
    uri = "data:image/png;base64," + base64.b64encode(png((0, 0, 255))).decode()
    more = {"materials": [surface], "textures": [{"source": 0}], "images": [{"uri": uri}]}
    loaded = load(tmp_path, builder.root([mesh], [{"mesh": 0}], **more), builder.binary)
    # The extension turns u towards -v: (0.5, 0) becomes (0, -0.5).
    np.testing.assert_allclose(loaded.uv[0], [0.5, -0.25], atol=1e-6)  # float32 cosine of a right angle
    assert loaded.texture.shape == (2, 2, 3)


def split_file(tmp_path: Path, uri: str) -> Path:
    builder = Builder()
    root = builder.root([square(builder)], [{"mesh": 0}])
    root["buffers"][0]["uri"] = uri.replace("DATA", base64.b64encode(builder.binary).decode())
    (tmp_path / "inner").mkdir(exist_ok=True)
    (tmp_path / "inner" / "some data.bin").write_bytes(builder.binary)
    (tmp_path / "secret.bin").write_bytes(builder.binary)
    path = tmp_path / "inner" / "face.gltf"
    path.write_text(json.dumps(root))
    return path


@pytest.mark.parametrize("uri", ["some%20data.bin", "data:application/octet-stream;base64,DATA"])
def test_gltf_with_buffers_beside_or_inside_loads(uri, tmp_path):
    assert gltf.load(split_file(tmp_path, uri)).neutral.tolist() == SQUARE.tolist()


@pytest.mark.parametrize(
    "uri",
    [
        "../secret.bin",
        "%2e%2e/secret.bin",
        "/etc/passwd",
        "file:///etc/passwd",
        "..\\secret.bin",
        "https://a.b/c",
        "",
        "a/../../secret.bin",
        "link.bin",
        "a\x00b",
    ],
)
def test_a_buffer_outside_the_folder_is_refused(uri, tmp_path):
    path = split_file(tmp_path, uri)
    (tmp_path / "inner" / "link.bin").symlink_to(tmp_path / "secret.bin")
    with pytest.raises(ReenactError, match=r"face.gltf: buffers\[0\].uri must stay in the file's folder"):
        gltf.load(path)


@pytest.mark.parametrize("uri", ["data:,abc", "data:;base64,@@@", "data:;base64,AAAA", "missing.bin"])
def test_a_buffer_that_is_not_there_is_refused(uri, tmp_path):
    with pytest.raises(ReenactError):
        gltf.load(split_file(tmp_path, uri))


# Animation -----------------------------------------------------------------------------------------------------------


def animated(tmp_path: Path, times, values, interpolation=None, **extras) -> Clip:
    builder = Builder()
    mesh = square(builder)
    sampler = {
        "input": builder.add(np.array(times, "<f4"), "SCALAR"),
        "output": builder.add(np.array(values, "<f4"), "SCALAR"),
    }
    if interpolation:
        sampler["interpolation"] = interpolation
    channels = [{"sampler": 0, "target": {"node": 0, "path": path}} for path in ("rotation", "weights")]
    animation = {"samplers": [sampler], "channels": channels, "extras": extras}
    path = tmp_path / "moving.glb"
    path.write_bytes(pack(builder.root([mesh], [{"mesh": 0}], animations=[animation]), builder.binary))
    return gltf.load_clip(path)


def test_sparse_keys_are_sampled_between(tmp_path):
    clip = animated(tmp_path, [0, 0.5, 2.0], [0, 1, 0])
    assert clip.fps == 30
    assert len(clip) == 61
    assert clip.weights[15, 0] == 1
    assert clip.weights[30, 0] == pytest.approx(2 / 3, abs=1e-6)  # float32


def test_step_keys_hold(tmp_path):
    clip = animated(tmp_path, [0, 0.5, 1.0], [0.2, 0.7, 0.1], "STEP")
    assert clip.weights[[0, 14, 15, 29, 30], 0].tolist() == pytest.approx([0.2, 0.2, 0.7, 0.7, 0.1])


def test_cubic_keys_follow_their_tangents(tmp_path):
    # From 0 to 1 in a second with slope 0 at both ends: 3 x^2 - 2 x^3.
    clip = animated(tmp_path, [0, 1], [0, 0, 0, 0, 1, 0], "CUBICSPLINE")
    x = np.arange(31) / 30
    np.testing.assert_allclose(clip.weights[:, 0], 3 * x**2 - 2 * x**3, atol=1e-6)  # float32


def test_one_key_is_one_frame(tmp_path):
    assert animated(tmp_path, [1.0], [0.5]).weights.tolist() == [[0.5]]
    assert animated(tmp_path, [1.0], [0, 0.5, 0], "CUBICSPLINE").weights.tolist() == [[0.5]]


def test_even_keys_say_the_rate(tmp_path):
    assert animated(tmp_path, np.arange(20) / 24, np.linspace(0, 1, 20)).fps == 24


BAD_MOTION = {
    "endless": ([0, 1e9], [0, 1], None, "too long"),
    "falling": ([1, 0], [0, 1], None, "rising times"),
    "NaN": ([0, float("nan")], [0, 1], None, "NaN"),
    "short": ([0, 1], [0], None, "with 2 elements, got 1"),
    "unknown": ([0, 1], [0, 1], "MAGIC", "LINEAR, STEP or CUBICSPLINE"),
}


@pytest.mark.parametrize(("times", "values", "kind", "message"), BAD_MOTION.values(), ids=BAD_MOTION)
def test_keys_that_cannot_be_are_refused(times, values, kind, message, tmp_path):
    with pytest.raises(ReenactError, match=message):
        animated(tmp_path, times, values, kind)


def test_a_file_without_animation_is_no_clip(tmp_path):
    gltf_write.save(make_random_rig(1), tmp_path / "still.glb")
    with pytest.raises(ReenactError, match="expected an animation of morph weights, got none"):
        gltf.load_clip(tmp_path / "still.glb")


def test_a_clip_of_another_rig_is_not_written(tmp_path):
    with pytest.raises(ReenactError, match="conform it first"):
        gltf_write.save(make_random_rig(1), tmp_path / "x.glb", Clip(("a",), torch.zeros(2, 1), 30.0))
    assert not list(tmp_path.iterdir())


# Hostile files -------------------------------------------------------------------------------------------------------


def change(*path_and_value):
    *path, last, value = path_and_value

    def apply(root):
        for key in path:
            root = root[key]
        root[last] = value

    return apply


HOSTILE = {
    "old version": (change("asset", "version", "1.0"), "expected glTF 2.0, got version 1.0"),
    "asset missing": (change("asset", None), "asset as an object"),
    "unknown extension": (change("extensionsRequired", ["ACME_magic", 7]), "not supported: ACME_magic, 7"),
    "packed view": (
        lambda root: (
            root["bufferViews"][0].update(buffer=1, extensions={"EXT_meshopt_compression": {}})
            or root["buffers"].append({"byteLength": 9})
        ),
        "EXT_meshopt_compression.buffer, it is missing",
    ),
    "packed primitive": (
        lambda root: (
            root["meshes"][0]["primitives"][0].update(extensions={"KHR_draco_mesh_compression": {}})
            or root["accessors"][0].pop("bufferView")
        ),
        "KHR_draco_mesh_compression.bufferView among",
    ),
    "no names": (lambda root: root["meshes"][0].pop("extras"), "name the shapes before exporting"),
    "names as numbers": (change("meshes", 0, "extras", "targetNames", [1, 2, 3]), "named morph targets"),
    "empty name": (change("meshes", 0, "extras", "targetNames", ["a", "", "c"]), "named morph targets"),
    "doubled names": (change("meshes", 0, "extras", "targetNames", ["a", "a", "c"]), "3 different names"),
    "too few names": (change("meshes", 0, "extras", "targetNames", ["a"]), "3 different names"),
    "count lies": (change("accessors", 0, "count", 1 << 40), "needs .* bytes for 1099511627776 elements"),
    "count negative": (change("accessors", 0, "count", -1), "as a whole number from 0, got '-1'"),
    "count text": (change("accessors", 0, "count", "many"), "count as a whole number"),
    "count true": (change("accessors", 0, "count", True), "count as a whole number"),
    "count zero": (change("accessors", 0, "count", 0), "one or more elements, got 0"),
    "no view": (lambda root: root["accessors"][0].pop("bufferView"), "no bufferView"),
    "component": (change("accessors", 0, "componentType", 5130), "component type 5130"),
    "type": (change("accessors", 0, "type", "MAT4"), "of type VEC3, got MAT4"),
    "offset lies": (change("accessors", 0, "byteOffset", 1 << 30), "needs"),
    "stride lies": (change("bufferViews", 0, "byteStride", 4), "needs"),
    "stride odd": (change("bufferViews", 0, "byteStride", 7), "multiple of 4"),
    "view lies": (change("bufferViews", 0, "byteLength", 1 << 45), "ends at byte"),
    "view elsewhere": (change("bufferViews", 0, "buffer", 3), "among 1 buffers, got 3"),
    "buffer lies": (change("buffers", 0, "byteLength", 1 << 33), "byteLength says"),
    "sparse count": (change("accessors", -4, "sparse", "count", 1000), "count from 1 to 93, got 1000"),
    "sparse type": (change("accessors", -4, "sparse", "indices", "componentType", 5126), "unsigned integers"),
    "sparse list": (change("accessors", -4, "sparse", []), "sparse as an object"),
    "target count": (change("accessors", -5, "count", 24), "with 93 elements, got 24"),
    "targets object": (change("meshes", 0, "primitives", 0, "targets", {}), "targets as a list"),
    "target text": (change("meshes", 0, "primitives", 0, "targets", ["a", "b", "c"]), "targets.0. as an object"),
    "primitive text": (change("meshes", 0, "primitives", ["x"]), "primitives.0. as an object"),
    "no primitives": (change("meshes", 0, "primitives", []), "same number of morph targets"),
    "position text": (change("meshes", 0, "primitives", 0, "attributes", "POSITION", "0"), "among 12 accessors"),
    "mesh missing": (change("nodes", 0, "mesh", 9), "among 1 meshes, got 9"),
    "meshes text": (change("meshes", ["x"]), r"meshes\[0\] as an object"),
    "node loop": (change("nodes", [{"mesh": 0, "children": [1]}, {"children": [0]}]), "reached twice"),
    "scale text": (change("nodes", 0, "scale", ["a", 1, 1]), "scale as 3 numbers"),
    "scale short": (change("nodes", 0, "scale", [1]), "scale as 3 numbers"),
    "scale huge": (change("nodes", 0, "scale", [1e31] * 3), "scale as 3 numbers"),
    "scales multiply": (
        change("nodes", [{"children": [1], "scale": [1e29] * 3}, {"mesh": 0, "scale": [1e29] * 3}]),
        "beyond all bounds",
    ),
    "matrix short": (change("nodes", 0, "matrix", [1, 2]), "matrix as 16 numbers"),
    "parts list": (change("meshes", 0, "extras", "partNames", "skin"), "partNames as a list"),
    "parts few": (change("meshes", 0, "extras", "partNames", ["skin"]), "_PART from 0 to 0"),
    "strip of two": (
        lambda root: root["accessors"][6].update(count=2) or root["meshes"][0]["primitives"][0].update(mode=5),
        "at least 3 indices",
    ),
    "not in threes": (lambda root: root["accessors"][6].update(count=5), "in threes, got 5"),
    "image missing": (change("textures", 0, "source", 5), "among 1 images"),
    "image is not one": (change("images", 0, "bufferView", 0), "PNG, JPEG or WebP"),
    "texture text": (change("textures", ["x"]), r"textures\[0\] as an object"),
    "color factor": (
        change("materials", 0, "pbrMetallicRoughness", "baseColorFactor", [1, 1]),
        "baseColorFactor as 4 numbers",
    ),
}


@pytest.fixture(scope="module")
def sample(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("glb") / "sample.glb"
    gltf_write.save(make_random_rig(7), path, make_clip(make_random_rig(7)))
    return path.read_bytes()


@pytest.mark.parametrize(("damage", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_file_that_lies_is_refused_by_file_and_field(damage, message, sample, tmp_path):
    root, binary = unpack(sample)
    damage(root)
    with pytest.raises(ReenactError, match=message) as caught:
        load(tmp_path, root, binary)
    assert str(caught.value).startswith(str(tmp_path / "made.glb"))


def test_numbers_that_are_not_finite_are_refused(sample, tmp_path):
    root, binary = unpack(sample)
    start = root["bufferViews"][0]["byteOffset"]
    broken = binary[:start] + struct.pack("<f", float("inf")) + binary[start + 4 :]
    with pytest.raises(ReenactError, match=r"accessors\[0\] .*POSITION.* holds NaN or infinity"):
        load(tmp_path, root, broken)


def test_an_index_beyond_the_vertices_is_refused(sample, tmp_path):
    root, binary = unpack(sample)
    start = root["bufferViews"][root["accessors"][root["meshes"][0]["primitives"][0]["indices"]]["bufferView"]][
        "byteOffset"
    ]
    with pytest.raises(ReenactError, match="indices as whole numbers below"):
        load(tmp_path, root, binary[:start] + b"\xff\xff\0\0" + binary[start + 4 :])


def test_shapes_of_more_bytes_than_a_file_may_hold_are_refused(tmp_path, monkeypatch):
    builder = Builder()
    mesh = square(builder, [f"shape {index}" for index in range(1000)])
    target = mesh["primitives"][0]["targets"][0]
    mesh["primitives"][0]["targets"] = [target] * 1000
    root = builder.root([mesh], [{"mesh": 0}])
    root["accessors"], root["bufferViews"] = builder.accessors[:3], builder.views[:3]
    path = tmp_path / "many.gltf"
    binary = builder.binary[:200]
    root["buffers"][0] = {"byteLength": len(binary), "uri": "data:;base64," + base64.b64encode(binary).decode()}
    path.write_text(json.dumps(root))
    monkeypatch.setattr(disk, "LIMIT", max(path.stat().st_size, 1000))
    with pytest.raises(ReenactError, match="1000 shapes of 4 vertices are more than"):
        gltf.load(path)


def test_a_picture_bomb_is_refused(sample, tmp_path, monkeypatch):
    monkeypatch.setattr(gltf, "PIXELS", 4)
    with pytest.raises(ReenactError, match=r"images\[0\] of at most 4 pixels, got \(8, 6\)"):
        load(tmp_path, *unpack(sample))


JUNK = {
    "empty": b"",
    "short": b"glTF\2\0\0\0",
    "no magic": b"x" * 40,
    "version 1": struct.pack("<4sII", b"glTF", 1, 40) + b"\0" * 28,
    "length lies": struct.pack("<4sII", b"glTF", 2, 4000) + b"\0" * 28,
    "chunk lies": struct.pack("<4sIII4s", b"glTF", 2, 28, 900, b"JSON") + b"\0" * 8,
    "no JSON": struct.pack("<4sIII4s", b"glTF", 2, 28, 8, b"BIN\0") + b"\0" * 8,
    "deep JSON": pack({}, b"")[:12] + struct.pack("<I4s", 200_000, b"JSON") + b"[" * 200_000,
    "list": struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"[1] ",
    "NaN": struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"NaN ",
    "not UTF-8": struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"\xff\xfe\xff\xff",
    "long number": struct.pack("<4sIII4s", b"glTF", 2, 10_020, 10_000, b"JSON") + b"9" * 10_000,
    "empty object": struct.pack("<4sIII4s", b"glTF", 2, 24, 4, b"JSON") + b"{}  ",
}


@pytest.mark.parametrize("data", JUNK.values(), ids=JUNK)
def test_junk_is_refused(data, tmp_path):
    path = tmp_path / "junk.glb"
    if data[:4] == b"glTF" and b"[[[" in data:
        data = data[:8] + struct.pack("<I", len(data)) + data[12:]
    path.write_bytes(data)
    with pytest.raises(ReenactError, match=r"junk\.glb: "):
        gltf.load(path)


def test_200_mutated_files_load_or_are_refused(sample, tmp_path):
    rng = np.random.default_rng(11)
    size = struct.unpack_from("<I", sample, 12)[0] + 20
    refused = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for round_ in range(200):
            data = bytearray(sample)
            places = rng.integers(0, size if round_ % 2 else len(data), rng.integers(1, 6))
            for place in places:
                data[place] = rng.integers(256) if round_ % 4 else rng.choice(list(b'0123456789-"[]{},:'))
            path = tmp_path / "mutant.glb"
            path.write_bytes(bytes(data[: rng.integers(1, len(data))] if round_ % 10 == 0 else data))
            for read in (gltf.load, gltf.load_clip):
                try:
                    read(path)
                except ReenactError:
                    refused += 1
    assert refused > 100


# A real rig


def test_a_face_of_seven_meshes_in_centimetres_loads_as_one_rig_in_metres():
    path = SHARED / "rigs" / "ict_face.glb"
    if not path.exists():
        pytest.skip("the ICT face is test data that only some machines have")
    rig = gltf.load(path)
    assert rig.deltas.shape[0] == 53
    size = rig.neutral.amax(0) - rig.neutral.amin(0)
    # The file's face mesh spans y from -19.308 to 14.505 cm.
    np.testing.assert_allclose(size[1], 0.33813, atol=1e-5)
    assert {PARTS[part] for part in rig.parts.unique()} == {"skin", "eyes", "teeth", "tongue", "lashes", "mouth"}
    jaw = rig.deltas[rig.names.index("jawOpen")].norm(dim=-1)
    assert jaw.max() == pytest.approx(0.042, abs=0.001)
