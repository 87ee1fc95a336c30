"""What a USD file says, as plain arrays; runs in a process of its own, see `isolated`.

Source: Pixar, OpenUSD 26 documentation of UsdGeom, UsdSkel and UsdShade. Nothing here imports PyTorch: the process
starts for every file.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Ar, Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, UsdSkel, Vt

from reenact.errors import ReenactError

LAYERS = 100
"""Most files that one file may be composed of."""

_FIRST = Usd.TimeCode.EarliestTime()


def scene(path: Path) -> dict[str, Any]:
    """Meshes, materials, pictures and animation of the stage.

    Raises:
        ReenactError: The file is damaged, or it composes files from outside its folder.
    """
    try:
        return _scene(path)
    except (Tf.ErrorException, RuntimeError, UnicodeDecodeError, OverflowError) as error:
        raise ReenactError(f"{path}: expected a USD file, it is damaged or something else{_said(error)}") from None


def _scene(path: Path) -> dict[str, Any]:
    layer = Sdf.Layer.FindOrOpen(str(path))
    if layer is None:
        raise ReenactError(f"{path}: expected a USD file, it is damaged or something else")
    notes = _check_layers(path, layer)
    stage = Usd.Stage.Open(layer)
    if stage is None:
        raise ReenactError(f"{path}: expected a USD file, it cannot be composed")
    reader = _Reader(path, stage, notes)
    reader.read_meshes()
    return {
        "meters": UsdGeom.GetStageMetersPerUnit(stage),
        "meters_said": bool(UsdGeom.StageHasAuthoredMetersPerUnit(stage)),
        "up": str(UsdGeom.GetStageUpAxis(stage)),
        "creator": str(layer.documentation or layer.customLayerData.get("creator", ""))[:80],
        "rate": stage.GetTimeCodesPerSecond(),
        "meshes": reader.meshes,
        "pictures": reader.pictures,
        "animations": reader.animations,
        "notes": list(dict.fromkeys(notes)),
    }


# Which files are composed ---------------------------------------------------------------------------------------------


def _check_layers(path: Path, root: Sdf.Layer) -> list[str]:
    """Refuses a stage whose layers lie outside the file's folder; says which are missing."""
    folder, notes, seen, waiting = path.parent.resolve(), [], set(), [root]
    while waiting:
        layer = waiting.pop()
        if layer.identifier in seen:
            continue
        seen.add(layer.identifier)
        if len(seen) > LAYERS:
            raise ReenactError(f"{path}: is made of more than {LAYERS} files; flatten it")
        _check_clips(path, layer)
        for name in layer.GetCompositionAssetDependencies():
            if not name:
                continue
            if not _inside(folder, layer, name):
                raise ReenactError(f"{path}: takes in {name[:80]!r}, which is not in the file's folder; flatten it")
            try:
                below = Sdf.Layer.FindOrOpen(layer.ComputeAbsolutePath(name))
            except Tf.ErrorException:
                below = None
            if below is None:
                notes.append(f"takes in {name[:80]}, which is missing or damaged; left out")
            else:
                waiting.append(below)
    return notes


def _inside(folder: Path, layer: Sdf.Layer, name: str) -> bool:
    """Whether a name in a layer leads to a file of the folder, or of the package that the layer is in."""
    if re.search(r"[\0`]|:", name):  # an address, a drive, an expression that is evaluated later
        return False
    outer = Ar.SplitPackageRelativePathOuter(layer.ComputeAbsolutePath(name))[0]
    try:
        return Path(outer).is_absolute() and Path(outer).resolve().is_relative_to(folder)
    except (OSError, ValueError):
        return False


def _check_clips(path: Path, layer: Sdf.Layer) -> None:
    """Value clips name files that are opened when a value is asked for."""
    found = []

    def visit(spec_path: Sdf.Path) -> None:
        spec = layer.GetObjectAtPath(spec_path)
        if isinstance(spec, Sdf.PrimSpec) and (spec.HasInfo("clips") or spec.HasInfo("clipSets")):
            found.append(str(spec_path))

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    if found:
        raise ReenactError(f"{path}: {found[0][:80]} takes its values from clips in other files; flatten it")


# Meshes ---------------------------------------------------------------------------------------------------------------


class _Reader:
    def __init__(self, path: Path, stage: Usd.Stage, notes: list[str]) -> None:
        self.path, self.stage, self.notes = path, stage, notes
        self.folder = path.parent.resolve()
        self.worlds = UsdGeom.XformCache(_FIRST)
        self.meshes: list[dict[str, Any]] = []
        self.pictures: dict[str, bytes | str] = {}
        self.surfaces: dict[str, dict[str, Any]] = {}
        self.animations: list[dict[str, Any]] = []
        self.sources: dict[str, int] = {}

    def read_meshes(self) -> None:
        for prim in Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()):
            if prim.IsA(UsdGeom.Mesh):
                shown = UsdGeom.Imageable(prim)
                purpose = shown.ComputePurpose()
                if purpose in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
                    self.notes.append(f"{prim.GetName()}: only a {purpose}; left out")
                elif shown.ComputeVisibility(_FIRST) == UsdGeom.Tokens.invisible:
                    self.notes.append(f"{prim.GetName()}: hidden; left out")
                else:
                    self._mesh(UsdGeom.Mesh(prim))
        for prim in Usd.PrimRange.Stage(self.stage, Usd.TraverseInstanceProxies()):
            if prim.IsA(UsdSkel.Animation):  # one that no mesh is bound to still says names and weights
                self._animation(prim)

    def _mesh(self, mesh: UsdGeom.Mesh) -> None:
        prim = mesh.GetPrim()
        where = f"{self.path}: {prim.GetPath()}"
        positions = _array(where, mesh.GetPointsAttr(), np.float32, 3)
        counts = _array(where, mesh.GetFaceVertexCountsAttr(), np.int64)
        corners = _array(where, mesh.GetFaceVertexIndicesAttr(), np.int64)
        names, shapes = self._shapes(where, prim)
        binding = UsdSkel.BindingAPI(prim)
        own = prim.GetCustomDataByKey("reenact")
        entry: dict[str, Any] = {
            "name": prim.GetName(),
            "path": str(prim.GetPath()),
            "label": " ".join(str(prim.GetPath()).split("/")[-2:]),
            "positions": positions,
            "counts": counts,
            "corners": corners,
            "clockwise": mesh.GetOrientationAttr().Get(_FIRST) == UsdGeom.Tokens.leftHanded,
            "matrix": np.array(self._world(prim, binding), np.float64).T,
            "names": list(names.values()),
            "tokens": list(names.keys()),
            "shapes": shapes,
            "animation": self._animation_of(prim, binding),
            "own": {key: str(own[key]) for key in ("name", "partNames") if key in own} if isinstance(own, dict) else {},
        }
        rows = _array(where, mesh.GetHoleIndicesAttr(), np.int64)
        if len(rows):
            kept = np.ones(len(counts), bool)
            kept[rows[(rows >= 0) & (rows < len(counts))]] = False
            entry["holes"] = kept
        self._faces_look(where, prim, entry)
        self.meshes.append(entry)

    def _world(self, prim: Usd.Prim, binding: UsdSkel.BindingAPI) -> Gf.Matrix4d:
        """Transform of the mesh, on rows; of a skinned one as it was bound."""
        skeleton = binding.GetInheritedSkeleton()
        rigid = not binding.GetJointIndicesAttr().HasAuthoredValue()
        if not skeleton or rigid:
            return self.worlds.GetLocalToWorldTransform(prim)
        bound = binding.GetGeomBindTransformAttr().Get(_FIRST)
        self.notes.append(f"{prim.GetName()}: skinned; taken as it was bound")
        world = self.worlds.GetLocalToWorldTransform(skeleton.GetPrim())
        return world if bound is None else bound * world

    def _shapes(self, where: str, prim: Usd.Prim) -> tuple[dict[str, str], dict[str, Any]]:
        """Names of the shapes by the token that animation has for them; rows and offsets of each name."""
        binding = UsdSkel.BindingAPI(prim)
        tokens = _tokens(where, binding.GetBlendShapesAttr())
        targets = binding.GetBlendShapeTargetsRel().GetTargets()
        if not tokens:
            return {}, {}
        if len(tokens) != len(targets) or len(set(tokens)) != len(tokens) or not all(tokens):
            raise ReenactError(
                f"{where}: expected {len(tokens)} different skel:blendShapes with as many targets, got {len(targets)}"
            )
        names, shapes = {}, {}
        for token, target in zip(tokens, targets):
            shape = UsdSkel.BlendShape(self.stage.GetPrimAtPath(target))
            if not shape:
                raise ReenactError(f"{where}: skel:blendShapeTargets names {target}, which is no BlendShape")
            name = _shape_name(token, target.name)
            while name in shapes:
                name = token if token not in shapes else name + "_"
            names[token] = name
            offsets = _array(f"{where}.{target.name}", shape.GetOffsetsAttr(), np.float32, 3)
            rows = _array(f"{where}.{target.name}", shape.GetPointIndicesAttr(), np.int64)
            # Without indices the offsets are those of all points; without either nothing moves.
            shapes[name] = [None if len(rows) == 0 and len(offsets) else rows, offsets]
            if shape.GetInbetweens():
                self.notes.append(f"{name}: shapes in between are left out, the full one counts")
        return names, shapes

    # How it looks -----------------------------------------------------------------------------------------------------

    def _faces_look(self, where: str, prim: Usd.Prim, entry: dict[str, Any]) -> None:
        api = UsdShade.MaterialBindingAPI(prim)
        surfaces = [self._surface(api.ComputeBoundMaterial()[0])]
        surface = np.zeros(len(entry["counts"]), np.int64)
        subsets = UsdGeom.Subset.GetGeomSubsets(
            UsdGeom.Imageable(prim), UsdGeom.Tokens.face, UsdShade.Tokens.materialBind
        )
        for subset in subsets:
            rows = _array(where, subset.GetIndicesAttr(), np.int64)
            if len(rows) and (rows.min() < 0 or rows.max() >= len(surface)):
                raise ReenactError(f"{where}: {subset.GetPrim().GetName()} names a face outside 0..{len(surface) - 1}")
            surface[rows] = len(surfaces)
            material = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]
            surfaces.append(self._surface(material))
            surfaces[-1]["name"] += f" {subset.GetPrim().GetName()}"
        entry["surfaces"], entry["surface"] = surfaces, surface
        readers = {each["reader"] for each in surfaces if each["reader"]}
        entry |= self._uv(where, prim, entry, readers)
        bound = any(each["bound"] for each in surfaces)
        if not bound or entry["own"] or any(each["colored"] for each in surfaces):
            color = UsdGeom.Gprim(prim).GetDisplayColorPrimvar()
            if color and color.HasAuthoredValue():
                entry["colors"] = _per_vertex(where, entry, *self._primvar(where, color, 3))
        part = UsdGeom.PrimvarsAPI(prim).GetPrimvar("reenactPart")
        if part and part.GetTypeName() == Sdf.ValueTypeNames.IntArray and entry["own"].get("partNames"):
            entry["part"] = _array(where, part.GetAttr(), np.int64)

    def _uv(self, where: str, prim: Usd.Prim, entry: dict[str, Any], readers: set[str]) -> dict[str, Any]:
        api = UsdGeom.PrimvarsAPI(prim)
        kinds = (Sdf.ValueTypeNames.TexCoord2fArray, Sdf.ValueTypeNames.Float2Array, Sdf.ValueTypeNames.TexCoord2hArray,
                 Sdf.ValueTypeNames.TexCoord2dArray)  # fmt: skip
        found = {
            each.GetPrimvarName(): each for each in api.FindPrimvarsWithInheritance() if each.GetTypeName() in kinds
        }
        for name in (*sorted(readers), "st", *found):
            if name not in found or not found[name].HasValue():
                continue
            values, indices, how = self._primvar(where, found[name], 2)
            vertices, corners = len(entry["positions"]), len(entry["corners"])
            indices = np.arange(len(values)) if indices is None else indices
            if how in ("vertex", "varying") and len(indices) == vertices:
                if len(entry["corners"]) and not 0 <= entry["corners"].min() <= entry["corners"].max() < vertices:
                    return {}  # said of the mesh later
                return {"uv": values, "uv_corners": indices[entry["corners"]]}
            if how == "faceVarying" and len(indices) == corners:
                return {"uv": values, "uv_corners": indices}
            self.notes.append(f"{entry['name']}: uv {name} do not fit the mesh; left out")
        return {}

    def _primvar(self, where: str, primvar: UsdGeom.Primvar, width: int) -> tuple[np.ndarray, np.ndarray | None, str]:
        values = _array(where, primvar.GetAttr(), np.float32, width)
        indices = None
        if primvar.IsIndexed():
            indices = _array(where, primvar.GetIndicesAttr(), np.int64)
            if len(indices) and (indices.min() < 0 or indices.max() >= len(values)):
                raise ReenactError(f"{where}: {primvar.GetName()} indexes values outside 0..{len(values) - 1}")
        return values, indices, str(primvar.GetInterpolation())

    def _surface(self, material: UsdShade.Material) -> dict[str, Any]:
        key = str(material.GetPath()) if material else ""
        if key not in self.surfaces:
            self.surfaces[key] = self._material(material)
        return dict(self.surfaces[key])

    def _material(self, material: UsdShade.Material) -> dict[str, Any]:
        """Colour, picture and opacity of a UsdPreviewSurface."""
        plain = {"name": "", "bound": bool(material), "color": [1.0, 1.0, 1.0], "picture": None, "opacity": 1.0,
                 "reader": "", "colored": False}  # fmt: skip
        if not material:
            return plain
        plain["name"] = material.GetPrim().GetName()
        shader = material.ComputeSurfaceSource()[0]
        if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
            return plain
        value = _value(shader, "opacity")
        if isinstance(value, float):
            plain["opacity"] = value
        source = _source(shader, "diffuseColor")
        kind = source.GetIdAttr().Get() if source else None
        if kind == "UsdUVTexture":
            plain["picture"] = self._picture(_value(source, "file"))
            scale = _value(source, "scale")
            if isinstance(scale, Gf.Vec4f):
                plain["color"] = [float(each) for each in scale][:3]
            reader = _source(source, "st")
            name = _value(reader, "varname") if reader else None
            plain["reader"] = str(name) if isinstance(name, str) else ""
        elif kind == "UsdPrimvarReader_float3":
            plain["colored"] = True
        else:
            color = _value(shader, "diffuseColor")
            # The specification's own colour where a material says none.
            plain["color"] = [float(each) for each in color] if isinstance(color, Gf.Vec3f) else [0.18, 0.18, 0.18]
        if not all(0 <= each < 1e6 for each in plain["color"]):
            plain["color"] = [1.0, 1.0, 1.0]
        return plain

    def _picture(self, asset: Any) -> str | None:
        """Key of a picture: its bytes where it is packed in the file, else its name, to be looked for beside it."""
        if not isinstance(asset, Sdf.AssetPath) or not asset.path:
            return None
        key = asset.path
        if key not in self.pictures:
            self.pictures[key] = key
            resolved = str(asset.resolvedPath)
            outer, inner = Ar.SplitPackageRelativePathOuter(resolved)
            if inner and Path(outer).resolve().is_relative_to(self.folder):
                data = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(resolved))
                if data is not None:
                    self.pictures[key] = bytes(data.GetBuffer())
        return key

    # Motion -----------------------------------------------------------------------------------------------------------

    def _animation_of(self, prim: Usd.Prim, binding: UsdSkel.BindingAPI) -> int | None:
        source = binding.GetInheritedAnimationSource()
        skeleton = binding.GetInheritedSkeleton()
        if not source and skeleton:
            source = UsdSkel.BindingAPI(skeleton.GetPrim()).GetInheritedAnimationSource()
        return self._animation(source) if source else None

    def _animation(self, prim: Usd.Prim) -> int | None:
        key = str(prim.GetPath())
        if key not in self.sources:
            animation = UsdSkel.Animation(prim)
            tokens = _tokens(f"{self.path}: {key}", animation.GetBlendShapesAttr()) if animation else []
            attribute = animation.GetBlendShapeWeightsAttr() if tokens else None
            times = attribute.GetTimeSamples() if attribute else []
            if not times:
                self.sources[key] = -1
                return None
            rows = [_array(f"{self.path}: {key}", attribute, np.float32, None, time) for time in times]
            wrong = [time for time, row in zip(times, rows) if len(row) != len(tokens)]
            if wrong:
                raise ReenactError(
                    f"{self.path}: {key} has {len(tokens)} blendShapes, but another number of weights at {wrong[0]:g}"
                )
            self.sources[key] = len(self.animations)
            self.animations.append(
                {"name": key, "tokens": tokens, "times": np.array(times, np.float64), "weights": np.stack(rows)}
            )
        index = self.sources[key]
        return index if index >= 0 else None


def _shape_name(token: str, prim: str) -> str:
    """What a shape is called: its token, where that is not the prim's name with a number.

    Blender numbers tokens so that they differ between the meshes of a skeleton, and keeps the names of the prims.
    """
    return prim if re.fullmatch(re.escape(prim) + r"_?\d+", token) else token


def _array(
    where: str, attribute: Usd.Attribute, dtype: type, width: int | None = None, time: Any = _FIRST
) -> np.ndarray:
    """The value of an attribute as (N,) or (N, width); empty where it has none."""
    value = attribute.Get(time)
    try:
        array = np.array(() if value is None else value)
        if array.size and array.dtype.kind not in "fiu":
            raise ValueError(array.dtype)
        return array.astype(dtype).reshape(-1) if width is None else array.astype(dtype).reshape(-1, width)
    except (ValueError, TypeError):
        raise ReenactError(
            f"{where}: expected {attribute.GetName()} as numbers{f' in rows of {width}' if width else ''}, got "
            f"{type(value).__name__}; export it again"
        ) from None


def _tokens(where: str, attribute: Usd.Attribute) -> list[str]:
    value = attribute.Get()
    if value is None:
        return []
    if not isinstance(value, Vt.TokenArray):
        raise ReenactError(f"{where}: expected {attribute.GetName()} as names, got {type(value).__name__}")
    return [str(token) for token in value]


def _said(error: Exception) -> str:
    """What the library says of an error, in brackets; nothing where that is not text."""
    try:
        lines = str(error).split()
    except UnicodeDecodeError:
        return ""
    text = " ".join(lines).rsplit(" : ", 1)[-1].strip("'")
    return f" ({text[:160]})" if text else ""


def _per_vertex(
    where: str, entry: dict[str, Any], values: np.ndarray, indices: np.ndarray | None, how: str
) -> np.ndarray:
    """Colours of vertices; those of a vertex's faces or corners are averaged."""
    values = values if indices is None else values[indices]
    count, corners, counts = len(entry["positions"]), entry["corners"], entry["counts"]
    expected = {"constant": 1, "uniform": len(counts), "faceVarying": len(corners)}.get(how, count)
    if len(values) != expected:
        raise ReenactError(f"{where}: expected {expected} colours ({how}), got {len(values)}; export it again")
    if how == "constant":
        return np.repeat(values, count, axis=0)
    if how not in ("uniform", "faceVarying"):
        return values
    if (
        counts.sum() != len(corners)
        or (counts < 0).any()
        or (len(corners) and not 0 <= corners.min() <= corners.max() < count)
    ):
        return np.ones((count, 3), np.float32)  # said of the mesh later
    each = np.repeat(values, counts, axis=0) if how == "uniform" else values
    total = np.stack([np.bincount(corners, each[:, axis], count) for axis in range(3)], axis=1)
    uses = np.bincount(corners, minlength=count)[:, None]
    return np.where(uses > 0, total / np.maximum(uses, 1), 1).astype(np.float32)


def _source(shader: UsdShade.Shader, name: str) -> UsdShade.Shader | None:
    """The shader that an input is connected to, through node graphs."""
    port = shader.GetInput(name)
    for attribute in UsdShade.Utils.GetValueProducingAttributes(port) if port else ():
        prim = attribute.GetPrim()
        if prim != shader.GetPrim() and prim.IsA(UsdShade.Shader):
            return UsdShade.Shader(prim)
    return None


def _value(shader: UsdShade.Shader, name: str) -> Any:
    """The value of an input that is not connected to a shader."""
    port = shader.GetInput(name)
    for attribute in UsdShade.Utils.GetValueProducingAttributes(port) if port else ():
        if not UsdShade.Output.IsOutput(attribute):
            value = attribute.Get(_FIRST)
            return float(value) if isinstance(value, (int, float)) and not isinstance(value, bool) else value
    return None
