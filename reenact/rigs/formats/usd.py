"""USD: rigs as UsdSkel blend shapes, and their weight animation, in .usd, .usda, .usdc and .usdz.

Source: Pixar, OpenUSD 26 documentation of UsdSkel, UsdGeom and UsdShade. Reading needs the package `usd-core` and runs
in a process of its own (`isolated`): the library crashes on some damaged files.

Beside the standard our files have `primvars:reenactPart`, an index into `customData.reenact.partNames` of the mesh.
"""

from __future__ import annotations

import importlib.util
import io
import re
import tempfile
import zipfile
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk, isolated, pictures
from reenact.rigs.formats.pieces import DEFAULT, Choice, Contents, assemble, to_linear
from reenact.rigs.formats.polygons import Mesh, Surface, pieces_of, vertex_normals
from reenact.rigs.rig import PARTS, Rig
from reenact.rigs.timeline import steady

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
"""Of files that are read and written."""

_UP = {  # rows: what becomes of x, y and z of the file
    "Y": np.eye(3),
    "Z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "X": np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


# Reading --------------------------------------------------------------------------------------------------------------


def load(path: Path, choice: Choice = DEFAULT) -> Rig:
    """The rig in the file; see `read`.

    Raises:
        ReenactError: As `read`.
    """
    return read(path, choice)[0]


def read(path: Path, choice: Choice = DEFAULT) -> tuple[Rig, Contents]:
    """The rig that the blend shapes of a stage make together, and what the stage held.

    Transforms, unit and up axis of the stage are applied; a skinned mesh stands as it was bound. Colour, picture and
    opacity are those of UsdPreviewSurface materials, or `displayColor` where there is none. Layers and pictures may lie
    in the file's folder or below, or in its package, and nowhere else.

    Raises:
        ReenactError: `usd-core` is not installed; the file is damaged, lies about a size, composes files from outside
            its folder, or has no blend shapes.
    """
    scene = _scene(path)
    found, described, missing = pictures.gather(path, scene["pictures"])
    meshes = _meshes(path, scene, found)
    pieces = [piece for mesh in meshes for piece in pieces_of(path, mesh)]
    own = next((mesh["own"]["name"] for mesh in scene["meshes"] if mesh["own"].get("name")), None)
    made = assemble(path, pieces, choice, found, own if len(meshes) == 1 else None)
    converted = list(dict.fromkeys([*_units(scene), *scene["notes"], *missing, *made.converted]))
    creator = f", made by {scene['creator']}" if scene["creator"] else ""
    animations = tuple(
        f"{entry['name']}: {len(entry['times'])} frames of {len(entry['tokens'])} shapes, "
        f"{float(np.ptp(entry['times'])) / scene['rate']:.2f} s"
        for entry in scene["animations"]
    )
    return made.rig, Contents(f"USD{creator}", made.meshes, tuple(converted), animations, described)


def load_clip(path: Path) -> Clip:
    """The blend shape weights of a stage's SkelAnimation, by the names of its shapes, at a constant rate.

    Samples at a constant step stay as they are; others are made even, see `timeline.steady`.

    Raises:
        ReenactError: As `read`, or no animation moves blend shapes.
    """
    scene = _scene(path)
    rate, animations = scene["rate"], scene["animations"]
    if not animations:
        raise ReenactError(
            f"{path}: expected an animation of blend shape weights, got none; export the file with its animation"
        )
    if not 0 < rate < 1e9:
        raise ReenactError(f"{path}: expected a positive timeCodesPerSecond, got {rate:g}")
    columns = _columns(scene)
    names = tuple(dict.fromkeys(name for name, _, _ in columns))
    codes = np.unique(np.concatenate([entry["times"] for entry in animations]))
    if len(codes) * len(names) > disk.LIMIT // 32 or not np.isfinite(codes).all():
        raise ReenactError(f"{path}: {len(codes)} frames of {len(names)} shapes are too many; check its times")
    weights = np.zeros((len(codes), len(names)))
    for name, animation, token in reversed(columns):  # where two meshes disagree, the first counts
        entry = animations[animation]
        weights[:, names.index(name)] = np.interp(codes, entry["times"], entry["weights"][:, token])
    if not np.isfinite(weights).all():
        raise ReenactError(f"{path}: the animation holds NaN or infinity; export it again")
    weights, fps = _paced(path, codes, weights, rate)
    return Clip(names, torch.from_numpy(weights.astype(np.float32)), fps)


def _scene(path: Path) -> dict[str, Any]:
    _require(path)
    return isolated.read(path, "usd_scene:scene", "a USD file")


def _require(path: Path) -> None:
    if importlib.util.find_spec("pxr") is None:
        raise ReenactError(f"{path}: needs the package usd-core; pip install reenact[usd]")


def _meshes(path: Path, scene: dict[str, Any], found: Collection[str]) -> list[Mesh]:
    meters = scene["meters"]
    if not 0 < meters < 1e9:
        raise ReenactError(f"{path}: expected a positive metersPerUnit, got {meters:g}")
    turn = np.eye(4)
    turn[:3, :3] = _UP.get(scene["up"], _UP["Y"]) * meters
    names = [mesh["name"] for mesh in scene["meshes"]]
    meshes = []
    for entry in scene["meshes"]:
        shapes = {name: (rows, offsets) for name, (rows, offsets) in entry["shapes"].items()}
        uv = entry.get("uv")
        alone = names.count(entry["name"]) == 1
        counts, corners, surface = entry["counts"], entry["corners"], entry["surface"]
        uv_corners = entry.get("uv_corners")
        if "holes" in entry and counts.sum() == len(corners) and (counts >= 0).all():
            kept = np.repeat(entry["holes"], counts)
            counts, surface, corners = counts[entry["holes"]], surface[entry["holes"]], corners[kept]
            uv_corners = None if uv_corners is None else uv_corners[kept]
        meshes.append(
            Mesh(
                name=entry["name"] if alone else entry["path"].lstrip("/"),
                positions=entry["positions"],
                names=tuple(entry["names"]),
                shapes=shapes,
                counts=counts,
                corners=corners,
                matrix=turn @ entry["matrix"],
                clockwise=entry["clockwise"],
                uv=None if uv is None else np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1),
                uv_corners=uv_corners,
                colors=entry.get("colors"),
                surfaces=tuple(
                    Surface(
                        each["name"],
                        tuple(each["color"]),
                        each["picture"] if each["picture"] in found else None,
                        each["opacity"],
                    )
                    for each in entry["surfaces"]
                ),
                surface=surface,
                label=entry["label"],
                part=_parts(path, entry),
            )
        )
    return meshes


def _parts(path: Path, entry: dict[str, Any]) -> np.ndarray | None:
    if "part" not in entry:
        return None
    known = np.array([PARTS.index(name) if name in PARTS else 0 for name in entry["own"]["partNames"].split()])
    part = entry["part"]
    if len(part) != len(entry["positions"]) or (len(part) and not 0 <= part.min() <= part.max() < len(known)):
        raise ReenactError(
            f"{path}: expected reenactPart of {entry['name']} as one index into partNames for each of "
            f"{len(entry['positions'])} vertices, got {len(part)}"
        )
    return known[part]


def _units(scene: dict[str, Any]) -> list[str]:
    texts = []
    if not scene["meters_said"]:
        texts.append("no unit said: taken as centimetres, as USD wants it")
    elif scene["meters"] != 1:
        texts.append(f"units of {scene['meters']:g} m made metres")
    if scene["up"] != "Y":
        texts.append(f"+{scene['up']} up made +Y up")
    return texts


def _columns(scene: dict[str, Any]) -> list[tuple[str, int, int]]:
    """Shape, animation and column in it of every weight that moves something, meshes in their order."""
    columns, bound = [], set()
    for mesh in scene["meshes"]:
        if mesh["animation"] is None:
            continue
        tokens = {token: index for index, token in enumerate(scene["animations"][mesh["animation"]]["tokens"])}
        bound.add(mesh["animation"])
        pairs = zip(mesh["tokens"], mesh["names"])
        columns += [(name, mesh["animation"], tokens[token]) for token, name in pairs if token in tokens]
    if not columns:  # only animation in the file, or bound to nothing: its tokens are the names
        columns = [
            (token, animation, index)
            for animation, entry in enumerate(scene["animations"])
            for index, token in enumerate(entry["tokens"])
        ]
    return columns


def _paced(path: Path, codes: np.ndarray, weights: np.ndarray, rate: float) -> tuple[np.ndarray, float]:
    """Weights at a constant rate. Time codes that are whole steps apart need no repair."""
    steps = np.diff(codes)
    if len(steps) == 0:
        return weights, rate if 1 <= rate <= 1000 else 30.0
    step = float(codes[-1] - codes[0]) / len(steps)
    even = np.abs(codes - codes[0] - step * np.arange(len(codes))).max() < 1e-6 * step
    if even and (abs(step - 1) < 1e-9 or rate / step >= 10):
        return weights, rate / (round(step) if abs(step - round(step)) < 1e-9 and step >= 0.5 else step)
    times = codes / rate
    if np.median(steps) / rate > 0.1:  # keys, not frames: what lies between them is linear
        fps = rate if 10 <= rate <= 240 else 30.0
        span = float(times[-1] - times[0])
        if span * fps * weights.shape[1] > disk.LIMIT // 32:
            raise ReenactError(f"{path}: the animation lasts {span:g} s, too long; check its times")
        grid = times[0] + np.arange(round(span * fps) + 1) / fps
        return np.stack([np.interp(grid, times, column) for column in weights.T], axis=1), fps
    return steady(str(path), times, weights)


# Writing --------------------------------------------------------------------------------------------------------------


def save(rig: Rig, path: Path, clip: Clip | None = None) -> None:
    """Writes the rig as one mesh with UsdSkel blend shapes, and the clip as a SkelAnimation.

    Numbers are stored as they are, in metres, +Y up; colours become linear, a texture an 8-bit PNG: in the package of
    a .usdz, else beside the file as <stem>_texture.png. Time codes are frames.

    Args:
        rig: What to write.
        path: A .usd (binary), .usda (text), .usdc (binary) or .usdz file (a package, for Apple's viewers among others).
        clip: Motion whose names are the rig's, in its order.

    Raises:
        ReenactError: `usd-core` is not installed, the clip is for another rig, another suffix, or the file cannot be
            written.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ReenactError(f"{path}: expected one of {', '.join(SUFFIXES)}, got {path.suffix or 'no suffix'}")
    if clip is not None and clip.names != rig.names:
        raise ReenactError(f"{path}: expected a clip with the {len(rig.names)} shapes of {rig.name}; conform it first")
    _require(path)
    texture = None
    if rig.texture is not None:
        texture = pictures.png((rig.texture.detach().cpu().numpy() * 255).round().clip(0, 255).astype(np.uint8))
    packed = suffix == ".usdz"
    picture = "textures/texture.png" if packed else f"{path.stem}_texture.png"
    stage = _stage(rig, clip, f"./{picture}" if texture else None)
    inner = ".usda" if suffix == ".usda" else ".usdc"
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / f"rig{inner}"
        stage.GetRootLayer().Export(str(place))
        data = place.read_bytes()
    if packed:
        data = _package([("rig.usdc", data), *([(picture, texture)] if texture else [])])
    elif texture:
        disk.write_bytes(path.with_name(picture), texture)
    disk.write_bytes(path, data)


def _package(members: list[tuple[str, bytes]]) -> bytes:
    """A .usdz: a zip file, nothing compressed, every member at a multiple of 64 bytes."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_STORED) as archive:
        for name, data in members:
            entry = zipfile.ZipInfo(name)  # dated 1980: the same rig makes the same bytes
            start = packed.tell() + 30 + len(name.encode()) + 4
            padding = -start % 64
            entry.extra = b"\x86\x19" + padding.to_bytes(2, "little") + b"\0" * padding
            archive.writestr(entry, data)
    return packed.getvalue()


def _stage(rig: Rig, clip: Clip | None, picture: str | None) -> Usd.Stage:
    from pxr import Gf, Usd, UsdGeom, UsdSkel, Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    layer = stage.GetRootLayer()
    layer.documentation = "Reenact"
    root = UsdSkel.Root.Define(stage, "/rig")
    stage.SetDefaultPrim(root.GetPrim())
    skeleton = UsdSkel.Skeleton.Define(stage, "/rig/skeleton")
    still = np.eye(4)[None]
    skeleton.CreateJointsAttr(["root"])
    skeleton.CreateBindTransformsAttr(Vt.Matrix4dArray.FromNumpy(still))
    skeleton.CreateRestTransformsAttr(Vt.Matrix4dArray.FromNumpy(still))
    mesh = _mesh(stage, rig)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    binding.CreateBlendShapesAttr(list(rig.names))
    taken: set[str] = set()
    targets = []
    for name, offsets in zip(rig.names, rig.deltas.detach().cpu().numpy().astype(np.float32)):
        shape = UsdSkel.BlendShape.Define(stage, f"/rig/face/{_identifier(name, taken)}")
        rows = np.flatnonzero(offsets.any(1))
        if len(rows) == 0:
            rows = np.zeros(1, np.int64)  # Blender leaves out a shape without any
        shape.CreateOffsetsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(offsets[rows])))
        shape.CreatePointIndicesAttr(Vt.IntArray.FromNumpy(rows.astype(np.int32)))
        targets.append(shape.GetPath())
    binding.CreateBlendShapeTargetsRel().SetTargets(targets)
    _material(stage, mesh, picture, rig.colors is not None)
    if clip is not None:
        layer.timeCodesPerSecond = layer.framesPerSecond = clip.fps
        layer.startTimeCode, layer.endTimeCode = 0, len(clip) - 1
        animation = UsdSkel.Animation.Define(stage, "/rig/skeleton/animation")
        animation.CreateBlendShapesAttr(list(rig.names))
        weights = animation.CreateBlendShapeWeightsAttr()
        for frame, row in enumerate(clip.weights.detach().cpu().numpy().astype(np.float32)):
            weights.Set(Vt.FloatArray.FromNumpy(row), frame)
        # A skeleton plays an animation only where that also moves its joints: the one there is stays where it is.
        animation.CreateJointsAttr(["root"])
        animation.CreateTranslationsAttr(Vt.Vec3fArray([Gf.Vec3f(0)]))
        animation.CreateRotationsAttr(Vt.QuatfArray([Gf.Quatf(1)]))
        animation.CreateScalesAttr(Vt.Vec3hArray([Gf.Vec3h(1)]))
        holder = UsdSkel.BindingAPI.Apply(skeleton.GetPrim())
        holder.CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    return stage


def _mesh(stage: Usd.Stage, rig: Rig) -> UsdGeom.Mesh:
    from pxr import Sdf, UsdGeom, Vt

    arrays = {key: value.detach().cpu().numpy() for key, value in vars(rig).items() if isinstance(value, torch.Tensor)}
    neutral, faces = np.ascontiguousarray(arrays["neutral"], np.float32), arrays["faces"].astype(np.int32)
    mesh = UsdGeom.Mesh.Define(stage, "/rig/face")
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(neutral))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([neutral.min(0), neutral.max(0)])))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1)))
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(vertex_normals(neutral, faces)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    primvars = UsdGeom.PrimvarsAPI(mesh)
    own = {"name": rig.name}
    if "colors" in arrays:
        linear = to_linear(arrays["colors"].astype(np.float64).clip(0, 1)).astype(np.float32)
        mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex).Set(Vt.Vec3fArray.FromNumpy(linear))
    if "uv" in arrays:
        uv = arrays["uv"].astype(np.float32)
        st = primvars.CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.faceVarying)
        st.Set(Vt.Vec2fArray.FromNumpy(np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1)))
        st.SetIndices(Vt.IntArray.FromNumpy(arrays.get("uv_faces", faces).astype(np.int32).reshape(-1)))
    if "parts" in arrays:
        own["partNames"] = " ".join(PARTS)
        part = primvars.CreatePrimvar("reenactPart", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex)
        part.Set(Vt.IntArray.FromNumpy(arrays["parts"].astype(np.int32)))
    mesh.GetPrim().SetCustomDataByKey("reenact", own)
    return mesh


def _material(stage: Usd.Stage, mesh: UsdGeom.Mesh, picture: str | None, colored: bool) -> None:
    """What the surface looks like: its picture, else its vertex colours, else white."""
    from pxr import Sdf, UsdShade

    kinds = Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, "/rig/materials/face")
    shader = UsdShade.Shader.Define(stage, "/rig/materials/face/surface")
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("roughness", kinds.Float).Set(0.6)
    color = shader.CreateInput("diffuseColor", kinds.Color3f)
    material.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    if picture is not None:
        reader = UsdShade.Shader.Define(stage, "/rig/materials/face/uv")
        reader.CreateIdAttr("UsdPrimvarReader_float2")
        reader.CreateInput("varname", kinds.String).Set("st")
        reader.CreateOutput("result", kinds.Float2)
        texture = UsdShade.Shader.Define(stage, "/rig/materials/face/texture")
        texture.CreateIdAttr("UsdUVTexture")
        texture.CreateInput("file", kinds.Asset).Set(picture)
        texture.CreateInput("sourceColorSpace", kinds.Token).Set("sRGB")
        texture.CreateInput("st", kinds.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
        for side in ("wrapS", "wrapT"):
            texture.CreateInput(side, kinds.Token).Set("repeat")
        texture.CreateOutput("rgb", kinds.Float3)
        color.ConnectToSource(texture.ConnectableAPI(), "rgb")
    elif colored:
        reader = UsdShade.Shader.Define(stage, "/rig/materials/face/color")
        reader.CreateIdAttr("UsdPrimvarReader_float3")
        reader.CreateInput("varname", kinds.String).Set("displayColor")
        reader.CreateOutput("result", kinds.Float3)
        color.ConnectToSource(reader.ConnectableAPI(), "result")
    else:
        color.Set((1.0, 1.0, 1.0))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def _identifier(name: str, taken: set[str]) -> str:
    """A prim name like the shape's, not taken before; tools know fewer characters than tokens may have."""
    base = re.sub(r"[^A-Za-z0-9_]", "_", name) or "_"
    base = f"_{base}" if base[0].isdigit() else base
    found, number = base, 1
    while found in taken:
        number += 1
        found = f"{base}_{number}"
    taken.add(found)
    return found
