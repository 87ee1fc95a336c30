"""Avatars as people bring them, made of a built-in character: several meshes, other names, a body, a scan."""

import json
import struct
from pathlib import Path

import numpy as np
import torch
import trimesh

from reenact.rigs.rig import PARTS, Rig

_VROID = {
    "ALL": "Neutral Angry Fun Joy Sorrow Surprised",
    "BRW": "Angry Fun Joy Sorrow Surprised",
    "EYE": "Natural Angry Close Close_R Close_L Fun Joy Joy_R Joy_L Sorrow Surprised Spread Iris_Hide Highlight_Hide",
    "MTH": "Close Up Down Angry Small Large Neutral Fun Joy Sorrow Surprised SkinFung SkinFung_R SkinFung_L A I U E O",
    "HA": "Hide Fung1 Fung1_Low Fung1_Up Fung2 Fung2_Low Fung2_Up Fung3 Fung3_Up Fung3_Low Short Short_Up Short_Low",
}
VROID = tuple(f"Fcl_{part}_{name}" for part, names in _VROID.items() for name in names.split())
"""The 57 shapes of a VRoid face."""

MMD = (
    "まばたき",
    "笑い",
    "ウィンク",
    "ウィンク右",
    "びっくり",
    "じと目",
    "あ",
    "い",
    "う",
    "え",
    "お",
    "にやり",
    "困る",
    "怒り",
)
"""Names of MikuMikuDance, beside them."""

_MEANT = {
    "close_l": ("eyeBlinkLeft",), "close_r": ("eyeBlinkRight",), "eye_close": ("eyeBlinkLeft", "eyeBlinkRight"),
    "まばたき": ("eyeBlinkLeft", "eyeBlinkRight"), "ウィンク": ("eyeBlinkLeft",), "ウィンク右": ("eyeBlinkRight",),
    "mth_a": ("jawOpen",), "mth_u": ("mouthPucker",), "mth_o": ("mouthFunnel",), "あ": ("jawOpen",),
    "う": ("mouthPucker",), "mth_joy": ("mouthSmileLeft", "mouthSmileRight"),
    "brw_angry": ("browDownLeft", "browDownRight"),
    "brw_joy": ("browInnerUp",), "eye_surprised": ("eyeWideLeft", "eyeWideRight"), "びっくり": ("eyeWideLeft",),
}  # fmt: skip
_GROUPS = {"eye": "eye", "mth": "mouth", "brw": "brow", "ha": "mouth", "all": ""}


def renamed(man: Rig, names: tuple[str, ...]) -> Rig:
    """A rig with those shapes: what the name means where it is known, else a mix of shapes of the same region."""
    rng = np.random.default_rng(0)
    deltas = torch.zeros(len(names), *man.neutral.shape)
    for index, name in enumerate(names):
        meant = next((shapes for words, shapes in _MEANT.items() if name.lower().endswith(words)), None)
        if meant is None:
            group = next((region for word, region in _GROUPS.items() if f"_{word}_" in name.lower()), "mouth")
            several = [shape for shape in man.names if shape.startswith(group)]
            meant = tuple(rng.choice(several, 2, replace=False))
        for shape in meant:
            deltas[index] += man.deltas[man.names.index(shape)] * float(rng.uniform(0.7, 1.0))
    return Rig("renamed", man.neutral, deltas, names, man.faces, colors=man.colors, parts=man.parts)


def dense(man: Rig, names: tuple[str, ...], least: int) -> Rig:
    """The skin with some of the shapes, its triangles divided until it has so many vertices: a scan."""
    skin = man.part("skin", "lips", "brows")
    inside = torch.isin(man.faces, skin).all(1)
    used, faces = man.faces[inside].unique(return_inverse=True)
    rows = [man.names.index(name) for name in names]
    attached = torch.cat([man.neutral[None], man.deltas[rows]])[:, used]  # (1 + K, V, 3)
    values, faces = attached.permute(1, 0, 2).flatten(1).numpy(), faces.numpy()
    while len(values) < least:
        divided = min(len(faces), least - len(values))  # each brings one to three
        values, faces = trimesh.remesh.subdivide(values, faces, face_index=np.arange(divided))
    stacked = torch.from_numpy(np.ascontiguousarray(values)).float().unflatten(1, (-1, 3)).permute(1, 0, 2)
    return Rig(
        "scan", stacked[0].contiguous(), stacked[1:].contiguous(), names, torch.from_numpy(np.asarray(faces)).long()
    )


def write_avatar(path: Path, rig: Rig, meshes: dict[str, tuple[str, ...]], scale: float, body: bool) -> None:
    """A .glb of several meshes as game avatars are: in other units below a scaled node, skinned to bones, on a body.

    Args:
        path: Where.
        rig: What is split.
        meshes: Name of each mesh and the parts that it takes.
        scale: Units of the file per metre; the armature undoes it.
        body: Adds a body without shapes, below the head.
    """
    binary, views, accessors = bytearray(), [], []

    def add(values: np.ndarray, kind: str, **more) -> int:
        code = {"f": 5126, "u": 5125}[values.dtype.kind] if values.dtype.itemsize == 4 else 5121
        binary.extend(b"\0" * (-len(binary) % 4))
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": values.nbytes})
        binary.extend(np.ascontiguousarray(values).tobytes())
        accessors.append(
            {"bufferView": len(views) - 1, "componentType": code, "count": len(values), "type": kind, **more}
        )
        return len(accessors) - 1

    def bounded(values: np.ndarray) -> int:
        return add(values, "VEC3", min=values.min(0).tolist(), max=values.max(0).tolist())

    written, nodes = [], [{"name": "Armature", "scale": [1 / scale] * 3, "children": []}]
    nodes += [{"name": "Hips"}, {"name": "Head", "translation": [0.0, float(1.5 * scale), 0.0]}]
    nodes[0]["children"], nodes[1]["children"] = [1], [2]
    inverse = np.stack([np.eye(4), np.eye(4)]).astype("<f4")
    inverse[1, 3, 1] = -1.5 * scale  # by columns: the head was bound 1.5 m up
    lifted = np.add(rig.neutral.numpy(), [0, 1.5, 0]) * scale
    for name, parts in meshes.items():
        inside = torch.isin(rig.faces, rig.part(*parts)).any(1)
        used, faces = rig.faces[inside].unique(return_inverse=True)
        moved = [k for k in range(len(rig.names)) if bool(rig.deltas[k, used].any())]
        primitive = {
            "attributes": {
                "POSITION": bounded(lifted[used].astype("<f4")),
                "JOINTS_0": add(np.tile(np.array([1, 0, 0, 0], "u1"), (len(used), 1)), "VEC4"),
                "WEIGHTS_0": add(np.tile(np.array([1, 0, 0, 0], "<f4"), (len(used), 1)), "VEC4"),
            },
            "indices": add(faces.numpy().astype("<u4").reshape(-1), "SCALAR"),
            "targets": [{"POSITION": bounded((rig.deltas[k, used].numpy() * scale).astype("<f4"))} for k in moved],
        }
        if rig.colors is not None:
            linear = (rig.colors[used].numpy() ** 2.2).astype("<f4")
            primitive["attributes"]["COLOR_0"] = add(linear, "VEC3")
        written.append(
            {"name": name, "primitives": [primitive], "extras": {"targetNames": [rig.names[k] for k in moved]}}
        )
        nodes.append({"name": name, "mesh": len(written) - 1, "skin": 0})
    if body:
        box = trimesh.creation.box((0.4 * scale, 1.2 * scale, 0.25 * scale))
        written.append(
            {
                "name": "Body",
                "primitives": [
                    {
                        "attributes": {"POSITION": bounded(np.add(box.vertices, [0, 0.7 * scale, 0]).astype("<f4"))},
                        "indices": add(box.faces.astype("<u4").reshape(-1), "SCALAR"),
                    }
                ],
            }
        )
        nodes.append({"name": "Body", "mesh": len(written) - 1})
    root = {
        "asset": {"version": "2.0", "generator": "an avatar maker"},
        "scene": 0,
        "scenes": [{"nodes": [0, *range(3, len(nodes))]}],
        "nodes": nodes,
        "meshes": written,
        "skins": [{"joints": [1, 2], "inverseBindMatrices": add(inverse.reshape(2, 16), "MAT4")}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(binary)}],
    }
    text = json.dumps(root).encode()
    text += b" " * (-len(text) % 4)
    binary.extend(b"\0" * (-len(binary) % 4))
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


FACE, EYES, MOUTH = ("skin", "lips", "brows"), ("eyes", "lashes"), ("teeth", "tongue", "mouth")
assert {*FACE, *EYES, *MOUTH} == set(PARTS)
