"""What an FBX file says, as plain arrays; runs in a process of its own, see `isolated`.

The package `ufbx` 0.0.5 remembers the Python object of an element without holding it: one that is asked for again after
it was dropped is freed memory, and dropping it shortens its name where that is still in use. So every element is held
until the process ends, and text is copied.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import ufbx

from reenact.errors import ReenactError

_HELD: list[Any] = []
"""Elements of the scene; never emptied."""


def scene(path: Path) -> dict[str, Any]:
    """Meshes, materials, pictures and animation of the file, in metres, +Y up.

    Raises:
        ReenactError: The file is damaged or something else.
    """
    try:
        loaded = ufbx.load_file(
            str(path),
            target_axes=ufbx.axes_right_handed_y_up,
            target_unit_meters=1.0,
            space_conversion=ufbx.SpaceConversion.TRANSFORM_ROOT,
            load_external_files=False,
            ignore_missing_external_files=True,
            file_format=ufbx.FileFormat.FBX,
            index_error_handling=ufbx.IndexErrorHandling.ABORT_LOADING,
            node_depth_limit=1000,
        )
    except ufbx.UfbxError as error:
        raise ReenactError(
            f"{path}: expected an FBX file, it is damaged or something else ({' '.join(str(error).split())[:160]})"
        ) from None
    _HELD.append(loaded)
    held = _HELD
    held += [*loaded.elements]
    meshes = [*loaded.meshes]
    held += [*meshes, *loaded.nodes, *loaded.materials, *loaded.textures, *loaded.videos, *loaded.anim_stacks]
    held += [*loaded.blend_deformers, *loaded.blend_channels, *loaded.blend_shapes]
    held += [*loaded.skin_deformers, *loaded.skin_clusters]
    notes: list[str] = []
    pictures: dict[str, bytes | str] = {}
    found, channels = [], []
    for mesh in meshes:
        entries, animated = _mesh(path, mesh, held, pictures, notes)
        found += entries
        channels += animated
    settings, facts = loaded.settings, loaded.metadata
    turn = facts.root_rotation
    return {
        "meshes": found,
        "pictures": pictures,
        "animations": _animations(path, loaded, channels, float(settings.frames_per_second), held),
        "rate": float(settings.frames_per_second),
        "meters": float(settings.original_unit_meters),
        "turned": bool(abs(turn.w) < 1 - 1e-9),
        "creator": _text(facts.creator)[:80],
        "notes": list(dict.fromkeys(notes)),
    }


def _mesh(
    path: Path, mesh: Any, held: list[Any], pictures: dict[str, bytes | str], notes: list[str]
) -> tuple[list[dict[str, Any]], list[tuple[str, Any]]]:
    """A mesh once per node that shows it, and its blend channels by name."""
    nodes = [*mesh.instances]
    held += nodes
    faces = np.array(mesh.faces, np.int64).reshape(-1, 2)
    corners = np.array(mesh.vertex_indices, np.int64)
    begins, counts = faces[:, 0], faces[:, 1]
    if len(faces) and ((counts < 0) | (begins < 0) | (begins + counts > len(corners))).any():
        raise ReenactError(f"{path}: a face of {_text(mesh.name)[:60]} lies outside its {len(corners)} corners")
    order = np.repeat(begins - np.cumsum(counts) + counts, counts) + np.arange(int(counts.sum()))
    shapes: dict[str, list[np.ndarray]] = {}
    channels = []
    for deformer in [*mesh.blend_deformers]:
        held.append(deformer)
        for channel in [*deformer.channels]:
            target = channel.target_shape
            held += [channel, target]
            # Maya puts the deformer's name before the channel's.
            name = _text(channel.name).removeprefix(f"{_text(deformer.name)}.")
            name = name or (_text(target.name) if target is not None else "")
            channels.append((name, channel))
            if target is None or name in shapes:
                if name in shapes:
                    notes.append(f"{_text(mesh.name)}: two channels are called {name}; the first counts")
                continue
            steps = channel.keyframes
            held.append(steps)
            if len(steps) > 1:
                notes.append(f"{name}: shapes in between are left out, the full one counts")
            rows = np.array(target.offset_vertices, np.int64)
            offsets = np.array(target.position_offsets, np.float64).reshape(-1, 3)
            shapes[name] = [rows, offsets]
    entry: dict[str, Any] = {
        "positions": np.array(mesh.vertices, np.float64).reshape(-1, 3),
        "counts": counts,
        "corners": corners[order],
        "names": list(shapes),
        "shapes": shapes,
    }
    uv = mesh.vertex_uv
    if uv.exists:
        entry["uv"] = np.array(uv.values, np.float64).reshape(-1, 2)
        entry["uv_corners"] = np.array(uv.indices, np.int64)[order]
    color = mesh.vertex_color
    if color.exists:
        values = np.array(color.values, np.float64).reshape(-1, 4)
        each = values[np.array(color.indices, np.int64)[order], :3]
        entry["colors"] = _per_vertex(each, entry["corners"], len(entry["positions"]))
    material = np.array(mesh.face_material, np.int64)
    entries = []
    for node in nodes:
        if not node.visible:
            notes.append(f"{_text(node.name)}: hidden; left out")
            continue
        materials = [*node.materials] or [*mesh.materials]
        held += materials
        surfaces = [_surface(each, held, pictures, notes) for each in materials]
        known = len(material) == len(faces) and len(surfaces) > 0
        surfaces = surfaces or [_PLAIN]
        placed = {
            "name": _text(node.name) or _text(mesh.name),
            "label": f"{_text(node.name)} {_text(mesh.name)}",
            "matrix": _placed(node, mesh, held, notes),
            "surfaces": surfaces,
            "surface": material.clip(0, len(surfaces) - 1) if known else np.zeros(len(faces), np.int64),
        }
        entries.append(entry | placed)
    return entries, channels


def _per_vertex(each: np.ndarray, corners: np.ndarray, count: int) -> np.ndarray:
    """Colours of vertices: the mean of their corners, white without any."""
    if len(corners) and (corners.min() < 0 or corners.max() >= count):
        return np.ones((count, 3))  # said of the mesh later
    total = np.stack([np.bincount(corners, each[:, axis], count) for axis in range(3)], axis=1)
    uses = np.bincount(corners, minlength=count)[:, None]
    return np.where(uses > 0, total / np.maximum(uses, 1), 1.0)


def _placed(node: Any, mesh: Any, held: list[Any], notes: list[str]) -> np.ndarray:
    """Transform of the mesh to the world; of a skinned one as it was bound, where its clusters agree on that."""
    matrix = _matrix(node.geometry_to_world)
    skins = [*mesh.skin_deformers]
    held += skins
    clusters = [cluster for skin in skins for cluster in [*skin.clusters]]
    held += clusters
    bound = []
    for cluster in clusters:
        to_bone, world = _matrix(cluster.geometry_to_bone), _matrix(cluster.bind_to_world)
        if len(cluster.weights):
            bound.append((float(np.abs(np.array(cluster.weights, np.float64)).sum()), world @ to_bone))
    if not bound:
        return matrix
    notes.append(f"{_text(node.name)}: skinned; taken as it was bound")
    heaviest = max(bound, key=lambda pair: pair[0])[1]
    return heaviest if np.isfinite(heaviest).all() else matrix


def _text(value: str) -> str:
    """The same text in memory of its own."""
    return value.encode("utf-8", "replace").decode("utf-8", "replace")


def _matrix(value: Any) -> np.ndarray:
    matrix = np.eye(4)
    for column, vector in enumerate((value.c0, value.c1, value.c2, value.c3)):
        matrix[:3, column] = vector.x, vector.y, vector.z
    return matrix


_PLAIN = {"name": "", "color": [1.0, 1.0, 1.0], "picture": None, "opacity": 1.0}


def _surface(material: Any, held: list[Any], pictures: dict[str, bytes | str], notes: list[str]) -> dict[str, Any]:
    surface = {**_PLAIN, "name": _text(material.name)}
    pbr, fbx = material.pbr, material.fbx
    held += [pbr, fbx]
    base, factor, opacity = pbr.base_color, pbr.base_factor, pbr.opacity
    held += [base, factor, opacity]
    texture = base.texture if base.texture_enabled else None
    if texture is not None:
        held.append(texture)
        surface["picture"] = _picture(texture, held, pictures)
    elif base.has_value:
        color = base.value_vec4
        strength = factor.value_vec4.x if factor.has_value else 1.0
        values = [color.x * strength, color.y * strength, color.z * strength]
        if all(0 <= each < 1e6 for each in values):
            surface["color"] = values
    if opacity.has_value and opacity.texture is None:
        surface["opacity"] = float(np.clip(np.nan_to_num(opacity.value_vec4.x, nan=1.0), 0, 1))
    return surface


def _picture(texture: Any, held: list[Any], pictures: dict[str, bytes | str]) -> str | None:
    """Key of a picture: its bytes where the file embeds it, else its name, to be looked for beside the file."""
    files = [*texture.file_textures]
    held += files
    texture = files[0] if files else texture
    key = next(
        filter(
            None, map(_text, (texture.relative_filename, texture.filename, texture.absolute_filename, texture.name))
        ),
        None,
    )
    if not key:
        return None
    if key not in pictures:
        content = texture.content
        video = texture.video
        if video is not None and not content:
            held.append(video)
            content = video.content
        pictures[key] = bytes(content) if content else key
    return key


def _animations(
    path: Path, loaded: Any, channels: list[tuple[str, Any]], rate: float, held: list[Any]
) -> list[dict[str, Any]]:
    """The weights that each take gives the channels, at the file's frame rate, where they change."""
    if not 1 <= rate <= 1000:
        rate = 30.0
    names = list(dict.fromkeys(name for name, _ in channels))
    takes = []
    for stack in [*loaded.anim_stacks]:
        anim = stack.anim
        held += [stack, anim]
        begin, end = float(stack.time_begin), float(stack.time_end)
        if begin == end:  # a take that does not say when it ends lasts as long as its keys
            begin, end = _span(loaded, held)
        if not (np.isfinite([begin, end]).all() and begin <= end) or not names:
            continue
        if (end - begin) * rate * len(names) > 1 << 25:
            raise ReenactError(f"{path}: the animation {_text(stack.name)[:60]} lasts {end - begin:g} s, too long")
        times = begin + np.arange(round((end - begin) * rate) + 1) / rate
        weights = np.full((len(times), len(names)), np.nan)
        for name, channel in channels:
            column = names.index(name)
            if np.isnan(weights[0, column]):  # where two meshes disagree, the first counts
                weights[:, column] = [channel.evaluate_blend_weight(anim, float(time)) for time in times]
        takes.append({"name": _text(stack.name), "names": names, "weights": weights, "rate": rate})
    return takes


def _span(loaded: Any, held: list[Any]) -> tuple[float, float]:
    """Time of the first and of the last key."""
    times = []
    for curve in [*loaded.anim_curves]:
        keys = curve.keyframes
        held += [curve, keys]
        if len(keys):
            times += [float(keys[0].time), float(keys[len(keys) - 1].time)]
    return (min(times), max(times)) if times else (0.0, 0.0)
