"""glTF 2.0 and VRM: rigs with morph targets, and their weight animation, in .glb, .gltf and .vrm.

Source: Khronos, glTF 2.0 Specification; VRM Consortium, VRM 0.x and 1.0. The reader is lenient where exporters differ:
meshes and primitives that share morph names become one rig, vertices that an exporter split along seams are put
together, skinned meshes stand as they were bound, and compression is undone.

Beside the standard our files have two vertex attributes: `_VERTEX`, the rig vertex that each glTF vertex came from, and
`_PART`, an index into `mesh.extras.partNames`; with them a rig comes back with the same vertices and parts.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk
from reenact.rigs.formats.gltf_document import COMPONENTS, DRACO, WIDTHS, Document, open_document
from reenact.rigs.formats.pieces import DEFAULT, Choice, Contents, Piece, assemble, matches, part_named
from reenact.rigs.rig import PARTS, Rig
from reenact.rigs.timeline import steady

PIXELS = 8192 * 8192
"""Largest picture that is unpacked."""


def load(path: Path, choice: Choice = DEFAULT) -> Rig:
    """The rig in the file; see `read`.

    Raises:
        ReenactError: As `read`.
    """
    return read(path, choice)[0]


def read(path: Path, choice: Choice = DEFAULT) -> tuple[Rig, Contents]:
    """The rig that a file's meshes make together, and what the file held.

    Node transforms are applied; a skinned mesh is left as it was bound, and placed by the joint that carries most of
    what its shapes move. Shapes with the same name on several meshes are one shape; a mesh without some shape stays
    still under it. A vertex belongs to the part that its mesh, node or material is named after. The expressions of a
    VRM file are shapes beside its morph targets, mixed of them; one that is the same as a morph target is left out
    unless `choice` names it.

    Raises:
        ReenactError: The file is damaged, lies about a size, reaches outside its folder, needs an extension that we
            lack, or has no named morph targets.
    """
    document = open_document(path)
    pictures = _Pictures(document)
    scene = _Scene.of(document)
    expressions = _expressions(document, scene)
    pieces = _pieces(document, scene, expressions, pictures, choice)
    extras = document.root["asset"].get("extras")
    stored = extras.get("name") if isinstance(extras, dict) else None
    try:
        made = assemble(
            path, pieces, choice, pictures.loaders(), stored if isinstance(stored, str) and stored else path.stem
        )
    except ReenactError as error:
        text = str(error)
        raise error if text.startswith(str(path)) else ReenactError(f"{path}: {text}") from None
    converted = [*(f"{kind} compression undone" for kind in sorted(document.decoded)), *scene.noted(), *made.converted]
    return made.rig, Contents(
        _format(document), made.meshes, tuple(dict.fromkeys(converted)), _animations(document), pictures.described()
    )


def load_clip(path: Path) -> Clip:
    """The first weight animation of a file, by the names of its shapes, at a constant rate.

    Animations that follow it and move other meshes are taken as parts of it.

    The rate is `animation.extras.fps` where it fits the keys, else that of evenly spaced keys at 10 per second or more,
    else 30. Keys of LINEAR, STEP and CUBICSPLINE are evaluated at every frame.

    Raises:
        ReenactError: As `read`, or no animation moves morph weights.
    """
    return _clip(open_document(path))


# Scene ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Scene:
    meshes: list[tuple[int, dict[str, Any]]]
    """Nodes that have a mesh, in the order of the tree."""
    worlds: dict[int, np.ndarray]
    """Transform of every node to world space (4, 4)."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """What was done, and to which meshes or shapes."""

    def note(self, what: str, *names: str) -> None:
        self.notes.setdefault(what, []).extend(name for name in names if name not in self.notes.get(what, []))

    def noted(self) -> list[str]:
        return [f"{what}: {', '.join(names)[:300]}" for what, names in self.notes.items()]

    @classmethod
    def of(cls, document: Document) -> _Scene:
        nodes = document.get(document.root, "nodes", list, "glTF", [])
        children = {str(child) for node in nodes if isinstance(node, dict) for child in _children(document, node)}
        roots = [index for index in range(len(nodes)) if str(index) not in children]
        drawn = roots
        if "scenes" in document.root:
            entry = document.item("scenes", document.root.get("scene", 0), "glTF.scene")
            drawn = document.get(entry, "nodes", list, "scene", [])
        found, worlds = [], {}
        # First what is drawn, with its meshes; then joints that stand elsewhere.
        for tops, seen in ((drawn, True), ([index for index in roots if index not in drawn], False)):
            stack = [(index, np.eye(4)) for index in reversed(tops)]
            while stack:
                index, above = stack.pop()
                node = document.item("nodes", index, "a scene's or node's children")
                if index in worlds:
                    if seen:
                        raise document.fail(f"nodes[{index}] is reached twice; nodes must form a tree")
                    continue
                world = above @ _local(document, node, f"nodes[{index}]")
                if not np.isfinite(world).all() or np.abs(world).max() > 1e30:
                    raise document.fail(f"the transforms above nodes[{index}] grow beyond all bounds")
                worlds[index] = world
                if "mesh" in node and seen:
                    found.append((index, node))
                stack += [(child, world) for child in reversed(_children(document, node))]
        return cls(found, worlds)


def _children(document: Document, node: dict[str, Any]) -> list[Any]:
    return document.get(node, "children", list, "node", [])


def _local(document: Document, node: dict[str, Any], where: str) -> np.ndarray:
    if "matrix" in node:
        return document.numbers(node, "matrix", 16, where, []).reshape(4, 4).T
    x, y, z, w = document.numbers(node, "rotation", 4, where, [0, 0, 0, 1])
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    local = np.eye(4)
    local[:3, :3] = rotation * document.numbers(node, "scale", 3, where, [1, 1, 1])
    local[:3, 3] = document.numbers(node, "translation", 3, where, [0, 0, 0])
    return local


def _shape_names(document: Document, mesh: dict[str, Any], where: str) -> tuple[str, ...]:
    """Names of a mesh's morph targets; empty where it has none."""
    primitives = document.get(mesh, "primitives", list, where)
    counts = set()
    for index, primitive in enumerate(primitives):
        if not isinstance(primitive, dict):
            raise document.fail(f"expected {where}.primitives[{index}] as an object, got {str(primitive)[:40]!r}")
        counts.add(len(document.get(primitive, "targets", list, f"{where}.primitives[{index}]", [])))
    if len(counts) != 1:
        raise document.fail(f"expected the same number of morph targets on all primitives of {where}, got {counts}")
    count = counts.pop()
    extras = mesh.get("extras")
    names = extras.get("targetNames") if isinstance(extras, dict) else None
    if count == 0:
        return ()
    if not isinstance(names, list) or not all(isinstance(name, str) and name for name in names):
        raise document.fail(
            f"expected named morph targets ({where}.extras.targetNames), got none; name the shapes before exporting"
        )
    if len(names) != count or len(set(names)) != count:
        raise document.fail(f"expected {count} different names in {where}.extras.targetNames, got {len(set(names))}")
    return tuple(names)


# Meshes ---------------------------------------------------------------------------------------------------------------


def _pieces(
    document: Document, scene: _Scene, expressions: list[_Expression], pictures: _Pictures, choice: Choice
) -> list[Piece]:
    pieces, wanted = [], []
    for index, node in scene.meshes:
        mesh_index = node["mesh"]
        mesh = document.item("meshes", mesh_index, f"nodes[{index}].mesh")
        where = f"meshes[{mesh_index}]"
        names = _shape_names(document, mesh, where)
        label = str(node.get("name") or mesh.get("name") or where)[:80]
        for number, primitive in enumerate(mesh["primitives"]):
            piece = _piece(document, scene, pictures, index, node, mesh, primitive, names, label, number)
            if piece is not None:
                pieces.append(piece)
                wanted.append([expression.on(index, mesh_index) for expression in expressions])
    return _with_expressions(pieces, expressions, wanted, scene, choice)


def _piece(
    document: Document,
    scene: _Scene,
    pictures: _Pictures,
    index: int,
    node: dict[str, Any],
    mesh: dict[str, Any],
    primitive: dict[str, Any],
    names: tuple[str, ...],
    label: str,
    number: int,
) -> Piece | None:
    where = f"meshes[{node['mesh']}].primitives[{number}]"
    mode = document.get(primitive, "mode", int, where, 4)
    if mode not in (4, 5, 6):
        return None  # points and lines are not part of a face
    attributes = _Attributes.of(document, primitive, where)
    positions = attributes.read("POSITION", ("VEC3",)).astype(np.float32)
    count = len(positions)
    if len(names) * count * 12 > disk.LIMIT:
        raise document.fail(f"{where}: {len(names)} shapes of {count} vertices are more than {disk.LIMIT:,} bytes")
    shapes = {}
    for shape, (name, target) in enumerate(zip(names, primitive.get("targets", []))):
        if not isinstance(target, dict):
            raise document.fail(f"expected {where}.targets[{shape}] as an object, got {str(target)[:40]!r}")
        if "POSITION" in target:
            place = f"{where}.targets[{shape}].POSITION"
            shapes[name] = document.accessor(target["POSITION"], place, ("VEC3",), count).astype(np.float32)
    world = scene.worlds[index]
    if "skin" in node:
        world = _bound(document, scene, node, attributes, shapes, count)
        scene.note("skinned, taken as bound", label)
    faces = _triangles(document, primitive, attributes, mode, count, where)
    linear = world[:3, :3]
    if not np.array_equal(world, np.eye(4)):
        positions = (positions.astype(np.float64) @ linear.T + world[:3, 3]).astype(np.float32)
        shapes = {name: offsets @ linear.T.astype(np.float32) for name, offsets in shapes.items()}
        size = float(np.cbrt(abs(np.linalg.det(linear))))
        if abs(size - 1) > 1e-3:
            scene.note(f"scaled by {size:.4g} as nodes say", label)
        if np.linalg.det(linear) < 0:
            faces = faces[:, ::-1]
    material, colors, image, uv, opacity = _surface(document, primitive, attributes, count, where)
    labels = [owner.get("name") for owner in (mesh, node, material)]
    words = " ".join(each for each in labels if isinstance(each, str))
    return Piece(
        mesh=label,
        positions=positions,
        shapes=shapes,
        names=names,
        faces=faces,
        colors=colors,
        uv=uv,
        picture=image,
        part=_stored_parts(document, mesh, attributes, part_named(words), count),
        label=words,
        split=True,
        vertex=attributes.read("_VERTEX", ("SCALAR",), count)[:, 0] if "_VERTEX" in attributes else None,
        cutout=_solidity(document, material, opacity, image, uv, faces, pictures),
    )


@dataclass(frozen=True)
class _Attributes:
    """Vertex attributes and indices of a primitive, unpacked where they are packed with Draco."""

    document: Document
    entries: dict[str, Any]
    where: str
    unpacked: dict[str, np.ndarray]

    @classmethod
    def of(cls, document: Document, primitive: dict[str, Any], where: str) -> _Attributes:
        entries = document.get(primitive, "attributes", dict, where)
        extensions = document.get(primitive, "extensions", dict, where, {})
        unpacked = {}
        if DRACO in extensions:
            unpacked = _draco(document, document.get(extensions, DRACO, dict, where), entries, f"{where}.{DRACO}")
        return cls(document, entries, where, unpacked)

    def __contains__(self, name: str) -> bool:
        return name in self.entries

    def read(self, name: str, kinds: tuple[str, ...], count: int | None = None) -> np.ndarray:
        place = f"{self.where}.attributes.{name}"
        if name in self.unpacked:
            values = self.unpacked[name]
            widths = [WIDTHS[kind] for kind in kinds]
            if values.shape[1] not in widths or len(values) != (count or len(values)):
                raise self.document.fail(
                    f"expected {place} with {count or 'any number of'} elements of {' or '.join(kinds)}, got "
                    f"{len(values)} of {values.shape[1]}"
                )
            return values
        return self.document.accessor(self.entries.get(name), place, kinds, count)


def _draco(document: Document, packed: dict[str, Any], entries: dict[str, Any], where: str) -> dict[str, np.ndarray]:
    """Attributes and `indices` of a primitive that Draco compressed."""
    try:
        import DracoPy
    except ImportError:
        raise document.fail(
            f"{where} is packed with Draco; needs the package DracoPy: pip install 'reenact[gltf]'"
        ) from None
    data, start, length, _ = document.view(packed.get("bufferView"), f"{where}.bufferView")
    try:
        mesh = DracoPy.decode(data[start : start + length])
        found = {int(each["unique_id"]): np.asarray(each["data"]) for each in mesh.attributes}
        faces = np.asarray(mesh.faces, dtype=np.uint32)
    except Exception as error:  # the decoder raises what it likes on damaged data
        raise document.fail(f"{where} cannot be unpacked ({str(error)[:80]})") from None
    document.decoded.add("Draco")
    values = {"indices": faces.reshape(-1, 1)}
    for name, number in document.get(packed, "attributes", dict, where).items():
        if not isinstance(number, int) or number not in found:
            raise document.fail(f"expected {where}.attributes.{name} among {sorted(found)}, got {str(number)[:20]}")
        stored = found[number].reshape(len(found[number]), -1)
        entry = document.item("accessors", entries.get(name), f"{where}.attributes.{name}")
        code, count = entry.get("componentType"), entry.get("count")
        if code not in COMPONENTS or stored.dtype.kind != np.dtype(COMPONENTS[code]).kind or count != len(stored):
            raise document.fail(
                f"expected {where}.attributes.{name} with {str(count)[:20]} elements of component type "
                f"{str(code)[:20]}, got {len(stored)} of {stored.dtype}"
            )
        values[name] = document.plain(stored, entry.get("normalized") is True, f"{where}.attributes.{name}")
    return values


def _bound(
    document: Document,
    scene: _Scene,
    node: dict[str, Any],
    attributes: _Attributes,
    shapes: Mapping[str, np.ndarray],
    count: int,
) -> np.ndarray:
    """World transform (4, 4) of a skinned mesh: of the joint that carries most of what the shapes move.

    One transform for the whole mesh keeps it as it was bound, whatever pose the file was saved in; the joint of the
    head puts it where the head is.
    """
    skin = document.item("skins", node["skin"], "node.skin")
    where = f"skins[{node['skin']}]"
    joints = document.get(skin, "joints", list, where)
    if not joints or not all(isinstance(joint, int) and joint in scene.worlds for joint in joints):
        raise document.fail(f"expected {where}.joints among the nodes, got {str(joints)[:40]}")
    inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    if "inverseBindMatrices" in skin:
        place = f"{where}.inverseBindMatrices"
        stored = document.accessor(skin["inverseBindMatrices"], place, ("MAT4",), None)
        if len(stored) < len(joints) or stored.dtype.kind != "f":
            raise document.fail(f"expected {place} with {len(joints)} matrices of floats, got {len(stored)}")
        inverse = stored[: len(joints)].reshape(-1, 4, 4).transpose(0, 2, 1).astype(np.float64)
    if "JOINTS_0" not in attributes or "WEIGHTS_0" not in attributes:
        return scene.worlds[joints[0]] @ inverse[0]
    chosen = attributes.read("JOINTS_0", ("VEC4",), count).astype(np.int64)
    share = attributes.read("WEIGHTS_0", ("VEC4",), count).astype(np.float64)
    if chosen.min() < 0 or chosen.max() >= len(joints):
        raise document.fail(f"expected JOINTS_0 below {len(joints)}, got {chosen.max()}")
    moved = sum((np.abs(offsets).sum(1, dtype=np.float64) for offsets in shapes.values()), start=np.zeros(count))
    if not moved.any():
        moved = np.ones(count)
    carried = np.bincount(chosen.reshape(-1), (share * moved[:, None]).reshape(-1), len(joints))
    head = int(carried.argmax())
    world = scene.worlds[joints[head]] @ inverse[head]
    if not np.isfinite(world).all() or np.abs(world).max() > 1e30:
        raise document.fail(f"{where} moves joint {head} beyond all bounds")
    return world


def _stored_parts(
    document: Document, mesh: dict[str, Any], attributes: _Attributes, default: int, count: int
) -> np.ndarray | None:
    """Parts that a file of ours says."""
    if "_PART" not in attributes:
        return None
    where = f"{attributes.where}.attributes._PART"
    values = attributes.read("_PART", ("SCALAR",), count)[:, 0]
    extras = mesh.get("extras")
    names = extras.get("partNames", list(PARTS)) if isinstance(extras, dict) else list(PARTS)
    if not isinstance(names, list) or not names:
        raise document.fail(f"expected mesh.extras.partNames as a list of names, got {str(names)[:60]}")
    known = np.array([PARTS.index(name) if name in PARTS else PARTS.index("skin") for name in names])
    if values.min() < 0 or values.max() >= len(known):
        raise document.fail(f"expected {where} from 0 to {len(known) - 1}, got {values.max():g}")
    return known[values.astype(np.int64)]


def _triangles(
    document: Document, primitive: dict[str, Any], attributes: _Attributes, mode: int, count: int, where: str
) -> np.ndarray:
    if "indices" in attributes.unpacked:
        corners, mode = attributes.unpacked["indices"][:, 0], 4
    elif "indices" in primitive:
        corners = document.accessor(primitive["indices"], f"{where}.indices", ("SCALAR",))[:, 0]
    else:
        corners = np.arange(count, dtype=np.uint32)
    if corners.dtype.kind != "u" or (len(corners) and corners.max() >= count):
        raise document.fail(f"expected {where}.indices as whole numbers below {count}, got {corners.max():g}")
    corners = corners.astype(np.int64)
    if mode == 4:
        if len(corners) % 3:
            raise document.fail(f"expected {where}.indices in threes, got {len(corners)}")
        return corners.reshape(-1, 3)
    if len(corners) < 3:
        raise document.fail(f"expected {where} with at least 3 indices, got {len(corners)}")
    if mode == 6:
        return np.stack([np.full(len(corners) - 2, corners[0]), corners[1:-1], corners[2:]], axis=1)
    strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
    strip[1::2] = strip[1::2, [1, 0, 2]]
    return strip


# Expressions of VRM ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Expression:
    """A mix of morph targets."""

    name: str
    binds: tuple[tuple[str, int, int, float], ...]
    """"mesh" or "node", its index, the morph target, its weight."""

    def on(self, node: int, mesh: int) -> dict[int, float]:
        """Weights of the morph targets of that node's mesh."""
        here = {"node": node, "mesh": mesh}
        mix: dict[int, float] = {}
        for owner, index, target, weight in self.binds:
            if here[owner] == index:
                mix[target] = mix.get(target, 0.0) + weight
        return {target: weight for target, weight in mix.items() if weight}


def _expressions(document: Document, scene: _Scene) -> list[_Expression]:
    extensions = document.get(document.root, "extensions", dict, "glTF", {})
    found = []
    if "VRMC_vrm" in extensions:
        where = "extensions.VRMC_vrm.expressions"
        groups = document.get(document.get(extensions, "VRMC_vrm", dict, "extensions"), "expressions", dict, where, {})
        for kind in ("preset", "custom"):
            for name, entry in document.get(groups, kind, dict, where, {}).items():
                place = f"{where}.{kind}.{name[:40]}"
                if not isinstance(entry, dict):
                    raise document.fail(f"expected {place} as an object, got {str(entry)[:40]!r}")
                binds = document.get(entry, "morphTargetBinds", list, place, [])
                found.append(_Expression(name, tuple(_bind(document, bind, "node", 1.0, place) for bind in binds)))
    elif "VRM" in extensions:
        where = "extensions.VRM.blendShapeMaster"
        master = document.get(document.get(extensions, "VRM", dict, "extensions"), "blendShapeMaster", dict, where, {})
        for number, entry in enumerate(document.get(master, "blendShapeGroups", list, where, [])):
            place = f"{where}.blendShapeGroups[{number}]"
            if not isinstance(entry, dict):
                raise document.fail(f"expected {place} as an object, got {str(entry)[:40]!r}")
            preset = document.get(entry, "presetName", str, place, "unknown")
            name = document.get(entry, "name", str, place, "") if preset in ("unknown", "") else preset
            binds = document.get(entry, "binds", list, place, [])
            # VRM 0.x counts weights in percent.
            found.append(_Expression(name, tuple(_bind(document, bind, "mesh", 0.01, place) for bind in binds)))
    found = [expression for expression in found if expression.name and expression.binds]
    if found:
        scene.note("VRM expressions", *(each.name for each in found))
    return found


def _bind(document: Document, bind: Any, owner: str, unit: float, where: str) -> tuple[str, int, int, float]:
    if not isinstance(bind, dict):
        raise document.fail(f"expected {where}.binds of objects, got {str(bind)[:40]!r}")
    index, target = document.get(bind, owner, int, where), document.get(bind, "index", int, where)
    return owner, index, target, unit * document.get(bind, "weight", float, where)


def _with_expressions(
    pieces: list[Piece],
    expressions: list[_Expression],
    mixes: list[list[dict[int, float]]],
    scene: _Scene,
    choice: Choice,
) -> list[Piece]:
    """The pieces with the expressions as further shapes."""
    taken = {name for piece in pieces for name in piece.names}
    for column, expression in enumerate(expressions):
        parts = [
            [(piece.names[target], weight) for target, weight in row[column].items() if target < len(piece.names)]
            for piece, row in zip(pieces, mixes)
        ]
        moved = [part for part in parts if part]
        if not moved:
            continue
        same = {part[0][0] for part in moved if len(part) == 1 and abs(part[0][1] - 1) < 1e-6}
        alias = len(same) == 1 and all(len(part) == 1 and part[0][0] in same for part in moved)
        if alias and (same == {expression.name} or not matches(expression.name, choice.shapes)):
            if same != {expression.name}:
                scene.note("expressions that are a shape of another name", f"{expression.name} = {next(iter(same))}")
            continue
        name = expression.name if expression.name not in taken else f"{expression.name} (VRM)"
        if name in taken:
            continue
        taken.add(name)
        for place, (piece, part) in enumerate(zip(pieces, parts)):
            if part:
                offsets = sum(
                    (np.float32(weight) * piece.shapes[shape] for shape, weight in part if shape in piece.shapes),
                    start=np.zeros_like(piece.positions),
                )
                pieces[place] = replace(piece, names=(*piece.names, name), shapes={**piece.shapes, name: offsets})
    return pieces


# Surfaces -------------------------------------------------------------------------------------------------------------


def _surface(
    document: Document, primitive: dict[str, Any], attributes: _Attributes, count: int, where: str
) -> tuple[dict[str, Any], np.ndarray, int | None, np.ndarray | None, float]:
    """Material, vertex colours (V, 3) linear, image, texture coordinates and opacity of a primitive."""
    material: dict[str, Any] = {}
    if "material" in primitive:
        material = document.item("materials", primitive["material"], f"{where}.material")
    name = f"materials[{primitive.get('material')}]"
    surface = document.get(material, "pbrMetallicRoughness", dict, name, {})
    factor_key, texture_key = "baseColorFactor", "baseColorTexture"
    extensions = document.get(material, "extensions", dict, name, {})
    if not surface and "KHR_materials_pbrSpecularGlossiness" in extensions:
        surface = document.get(extensions, "KHR_materials_pbrSpecularGlossiness", dict, name)
        factor_key, texture_key = "diffuseFactor", "diffuseTexture"
    factor = document.numbers(surface, factor_key, 4, name, [1, 1, 1, 1]).clip(0, 1)
    colors = np.broadcast_to(factor[:3], (count, 3))
    if "COLOR_0" in attributes:
        stored = attributes.read("COLOR_0", ("VEC3", "VEC4"), count)
        colors = colors * stored[:, :3].astype(np.float64).clip(0, 1)
    texture = document.get(surface, texture_key, dict, name, {})
    image = None
    if texture:
        entry = document.item("textures", texture.get("index"), f"{name}.{texture_key}.index")
        options = document.get(entry, "extensions", dict, "texture", {})
        webp = document.get(options, "EXT_texture_webp", dict, "texture.extensions", {})
        image = document.get(webp or entry, "source", int, "texture", None)
        if image is not None:
            document.item("images", image, "texture.source")
    options = document.get(texture, "extensions", dict, f"{name}.{texture_key}", {})
    transform = document.get(options, "KHR_texture_transform", dict, f"{name}.{texture_key}.extensions", {})
    channel = document.get(texture, "texCoord", int, f"{name}.{texture_key}", 0)
    channel = document.get(transform, "texCoord", int, "KHR_texture_transform", channel)
    uv = None
    if f"TEXCOORD_{channel}" in attributes:
        uv = attributes.read(f"TEXCOORD_{channel}", ("VEC2",), count).astype(np.float32)
        if transform:
            scale = document.numbers(transform, "scale", 2, "KHR_texture_transform", [1, 1])
            offset = document.numbers(transform, "offset", 2, "KHR_texture_transform", [0, 0])
            turn = document.get(transform, "rotation", float, "KHR_texture_transform", 0.0)
            cos, sin = np.cos(turn), np.sin(turn)
            uv = ((uv * scale) @ np.array([[cos, -sin], [sin, cos]]) + offset).astype(np.float32)
    return material, colors, image if uv is not None else None, uv, float(factor[3])


def _solidity(
    document: Document,
    material: dict[str, Any],
    opacity: float,
    image: int | None,
    uv: np.ndarray | None,
    faces: np.ndarray,
    pictures: _Pictures,
) -> np.ndarray | None:
    """How opaque each face is, where the material lets light through: at its corners and its middle."""
    mode = document.get(material, "alphaMode", str, "material", "OPAQUE")
    if mode not in ("MASK", "BLEND"):
        return None
    alpha = np.full(len(faces), opacity)
    if image is not None and uv is not None and len(faces):
        picture = pictures.load(image)
        if picture.shape[2] == 4:
            corners = uv[faces]  # (F, 3, 2)
            places = np.concatenate([corners, corners.mean(1, keepdims=True)], axis=1) % 1
            size = np.array([picture.shape[1], picture.shape[0]])
            column, row = np.moveaxis((places * size).astype(np.int64).clip(0, size - 1), -1, 0)
            seen = picture[row, column, 3] / 255 * opacity
            if mode == "MASK":
                seen = seen >= document.get(material, "alphaCutoff", float, "material", 0.5)
            alpha = seen.mean(1)
    return alpha


class _Pictures:
    """The images of a file, unpacked when they are first asked for."""

    def __init__(self, document: Document) -> None:
        self.document = document
        self.load = lru_cache(maxsize=None)(self._load)

    def loaders(self) -> dict[Any, Callable[[], np.ndarray]]:
        count = len(self.document.get(self.document.root, "images", list, "glTF", []))
        return {index: lambda index=index: self.load(index) for index in range(count)}

    def described(self) -> tuple[str, ...]:
        texts = []
        for index, entry in enumerate(self.document.get(self.document.root, "images", list, "glTF", [])):
            name = entry.get("name") if isinstance(entry, dict) else None
            try:
                with self._open(index) as picture:
                    texts.append(
                        f"{str(name or f'picture {index}')[:60]}: {picture.width} x {picture.height}, {picture.format}"
                    )
            except ReenactError as error:
                texts.append(f"{str(name or f'picture {index}')[:60]}: {error}")
        return tuple(texts)

    def _open(self, index: int) -> Image.Image:
        document = self.document
        entry = document.item("images", index, "texture.source")
        where = f"images[{index}]"
        if "uri" in entry:
            data = document.uri(document.get(entry, "uri", str, where), f"{where}.uri")
        else:
            buffer, start, length, _ = document.view(entry.get("bufferView"), f"{where}.bufferView")
            data = buffer[start : start + length]
        try:
            picture = Image.open(io.BytesIO(data), formats=["PNG", "JPEG", "WEBP"])
        except Exception as error:  # Pillow's decoders raise what they like on damaged data
            raise document.fail(
                f"expected {where} as PNG, JPEG or WebP, it cannot be read ({str(error)[:80]})"
            ) from None
        if picture.width * picture.height > PIXELS:
            raise document.fail(f"expected {where} of at most {PIXELS} pixels, got {picture.size}")
        return picture

    def _load(self, index: int) -> np.ndarray:
        """Pixels (H, W, 3) or, where some are transparent, (H, W, 4), uint8."""
        with self._open(index) as picture:
            try:
                clear = "A" in picture.getbands() or "transparency" in picture.info
                return np.asarray(picture.convert("RGBA" if clear else "RGB"))
            except Exception as error:
                raise self.document.fail(
                    f"expected images[{index}] as PNG, JPEG or WebP, it cannot be read ({str(error)[:80]})"
                ) from None


# Animation ------------------------------------------------------------------------------------------------------------


def _format(document: Document) -> str:
    extensions = document.get(document.root, "extensions", dict, "glTF", {})
    kind = "VRM 1.0" if "VRMC_vrm" in extensions else "VRM 0.x" if "VRM" in extensions else "glTF 2.0"
    generator = document.root["asset"].get("generator")
    return f"{kind}, made by {generator[:80]}" if isinstance(generator, str) and generator else kind


def _animations(document: Document) -> tuple[str, ...]:
    """What each animation moves, in words."""
    texts = []
    for number, animation in enumerate(document.get(document.root, "animations", list, "glTF", [])):
        if not isinstance(animation, dict):
            raise document.fail(f"expected animations[{number}] as an object, got {str(animation)[:40]!r}")
        channels = document.get(animation, "channels", list, f"animations[{number}]")
        tracks = [
            _track(document, animation, each, f"animations[{number}].channels[{i}]") for i, each in enumerate(channels)
        ]
        tracks = [track for track in tracks if track is not None]
        title = str(animation.get("name") or f"animation {number}")[:60]
        if not tracks:
            texts.append(f"{title}: moves no weights")
            continue
        shapes = len({name for track in tracks for name in track.names})
        seconds = max(track.times[-1] for track in tracks) - min(track.times[0] for track in tracks)
        texts.append(f"{title}: {shapes} shapes, {max(len(track.times) for track in tracks)} keys, {seconds:.2f} s")
    return tuple(texts)


def _clip(document: Document) -> Clip:
    chosen: dict[str, Any] = {}
    tracks: list[_Track] = []
    for number, animation in enumerate(document.get(document.root, "animations", list, "glTF", [])):
        if not isinstance(animation, dict):
            raise document.fail(f"expected animations[{number}] as an object, got {str(animation)[:40]!r}")
        found = _tracks(document, animation, f"animations[{number}]")
        if found and not chosen:
            chosen = animation
        # An animation that moves other meshes belongs to the first: Blender writes one for each mesh.
        if not {track.node for track in found} & {track.node for track in tracks}:
            tracks += found
    if not tracks:
        raise document.fail(
            "expected an animation of morph weights, got none; export the file with its shape key animation"
        )
    return _sampled(document, chosen, tracks)


@dataclass(frozen=True)
class _Track:
    node: int
    names: tuple[str, ...]
    times: np.ndarray  # (N,) float64
    keys: np.ndarray  # (N, K), or (N, 3, K) of tangent in, value, tangent out
    interpolation: str

    def at(self, times: np.ndarray) -> np.ndarray:
        """Weights (T, K) at the times; before the first and after the last key they stay."""
        after = np.searchsorted(self.times, times, side="right").clip(1, max(1, len(self.times) - 1))
        if len(self.times) == 1:
            value = self.keys[0, 1] if self.interpolation == "CUBICSPLINE" else self.keys[0]
            return np.broadcast_to(value, (len(times), len(self.names)))
        t0, t1 = self.times[after - 1], self.times[after]
        x = ((times - t0) / (t1 - t0)).clip(0, 1)[:, None]
        if self.interpolation == "CUBICSPLINE":
            span = (t1 - t0)[:, None]
            p0, p1 = self.keys[after - 1, 1], self.keys[after, 1]
            m0, m1 = span * self.keys[after - 1, 2], span * self.keys[after, 0]
            x2, x3 = x * x, x * x * x
            return (2 * x3 - 3 * x2 + 1) * p0 + (x3 - 2 * x2 + x) * m0 + (3 * x2 - 2 * x3) * p1 + (x3 - x2) * m1
        if self.interpolation == "STEP":
            x = np.floor(x + 1e-6)
        return (1 - x) * self.keys[after - 1] + x * self.keys[after]


def _tracks(document: Document, animation: dict[str, Any], where: str) -> list[_Track]:
    """Those of an animation's channels that move morph weights."""
    channels = document.get(animation, "channels", list, where)
    tracks = [_track(document, animation, channel, f"{where}.channels[{i}]") for i, channel in enumerate(channels)]
    return [track for track in tracks if track is not None]


def _track(document: Document, animation: dict[str, Any], channel: Any, where: str) -> _Track | None:
    if not isinstance(channel, dict):
        raise document.fail(f"expected {where} as an object, got {str(channel)[:40]!r}")
    target = document.get(channel, "target", dict, where)
    if target.get("path") != "weights" or "node" not in target:
        return None
    node = document.item("nodes", target["node"], f"{where}.target.node")
    mesh = document.item("meshes", node.get("mesh"), f"the mesh of {where}.target.node")
    names = _shape_names(document, mesh, f"meshes[{node['mesh']}]")
    samplers = document.get(animation, "samplers", list, "animation")
    index = document.get(channel, "sampler", int, where)
    if index >= len(samplers) or not isinstance(samplers[index], dict):
        raise document.fail(f"expected {where}.sampler among {len(samplers)} samplers, got {index}")
    sampler = samplers[index]
    interpolation = document.get(sampler, "interpolation", str, where, "LINEAR")
    if interpolation not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise document.fail(f"expected {where} LINEAR, STEP or CUBICSPLINE, got {interpolation[:20]}")
    times = document.accessor(sampler.get("input"), f"{where} input", ("SCALAR",))[:, 0].astype(np.float64)
    if not names or (np.diff(times) <= 0).any():
        raise document.fail(f"expected {where} to have named shapes and rising times")
    each = 3 if interpolation == "CUBICSPLINE" else 1
    values = document.accessor(sampler.get("output"), f"{where} output", ("SCALAR",), len(times) * len(names) * each)
    shape = (len(times), each, len(names)) if each == 3 else (len(times), len(names))
    return _Track(target["node"], names, times, values.astype(np.float64).reshape(shape), interpolation)


def _sampled(document: Document, animation: dict[str, Any], tracks: list[_Track]) -> Clip:
    names = tuple(dict.fromkeys(name for track in tracks for name in track.names))
    first = tracks[0]
    extras = animation.get("extras")
    stored = extras.get("fps") if isinstance(extras, dict) else None
    if len(tracks) == 1 and first.interpolation != "CUBICSPLINE":
        steps = np.diff(first.times)
        fits = isinstance(stored, (int, float)) and not isinstance(stored, bool) and 0 < stored < 1e6
        if fits and np.abs((first.times - first.times[0]) * stored - np.arange(len(first.times))).max() < 0.1:
            return Clip(names, torch.from_numpy(first.keys.astype(np.float32)), float(stored))
        if len(steps) and np.ptp(steps) < 0.1 * steps.min() and np.median(steps) <= 0.1:
            weights, fps = steady(str(document.path), first.times, first.keys)
            return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)
    start, end = min(track.times[0] for track in tracks), max(track.times[-1] for track in tracks)
    steps = np.diff(first.times)
    even = len(steps) and np.ptp(steps) < 0.1 * steps.min() and 1 / 240 < np.median(steps) <= 0.1
    fps = 1 / float(np.median(steps)) if even else 30.0
    fps = float(round(fps)) if abs(fps - round(fps)) < 0.002 * fps else fps
    if (end - start) * fps * len(names) > disk.LIMIT / 32:
        raise document.fail(f"the animation lasts {end - start:g} s, too long for {len(names)} shapes; check its times")
    times = start + np.arange(round((end - start) * fps) + 1) / fps
    weights = np.zeros((len(times), len(names)))
    for track in reversed(tracks):  # where meshes disagree, the first counts
        weights[:, [names.index(name) for name in track.names]] = track.at(times)
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def morph_mixes(document: Document) -> list[tuple[int, dict[str, np.ndarray]]]:
    """For each node whose mesh has morph targets: its index, and by shape the weights (M,) of its M targets.

    A morph target is the shape with its own name; a VRM expression is a mix of them.

    Raises:
        ReenactError: As `read`.
    """
    scene = _Scene.of(document)
    expressions = _expressions(document, scene)
    found = []
    for index, node in scene.meshes:
        mesh = document.item("meshes", node["mesh"], f"nodes[{index}].mesh")
        names = _shape_names(document, mesh, f"meshes[{node['mesh']}]")
        if not names:
            continue
        mixing = {}
        for expression in expressions:
            mix = np.zeros(len(names))
            for target, weight in expression.on(index, node["mesh"]).items():
                if target < len(names):
                    mix[target] = weight
            if mix.any():
                mixing[f"{expression.name} (VRM)" if expression.name in names else expression.name] = mix
        found.append((index, {**mixing, **dict(zip(names, np.eye(len(names))))}))
    return found
