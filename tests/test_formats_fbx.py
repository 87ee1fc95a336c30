"""FBX: files as others write them load; what lies is refused by name. Blender's are in test_formats_fixtures."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats.pieces import Choice
from reenact.rigs.rig import PARTS, Rig

pytest.importorskip("ufbx")
from reenact.rigs.formats import fbx

FIXTURE = Path(__file__).parent / "fixtures" / "blender.fbx"
SECOND = 46186158000
"""Units of time in a second, by the format."""


def array(key: str, values) -> str:
    return f"{key}: *{len(values)} {{ a: {','.join(map(str, values))} }}\n"


def properties(*lines: str) -> str:
    return "Properties70: {\n" + "".join(f"P: {line}\n" for line in lines) + "}\n"


class Builder:
    """Writes FBX 7.4 as text: objects and what they are connected to."""

    def __init__(self, unit: float = 100, up: int = 1):
        self.unit, self.up = unit, up  # centimetres per unit; axis
        self.objects, self.links, self.count = "", "", 0

    def add(self, kind: str, name: str, sort: str, body: str, *parents: str) -> int:
        self.count += 1
        self.objects += f'{kind}: {self.count}, "{name}", "{sort}" {{\n{body}}}\n'
        for parent in parents or ():
            self.links += f"C: {parent.replace('ME', str(self.count))}\n"
        return self.count

    def mesh(self, name: str, more: str = "", place: str = "", polygons=(0, 1, 2, -4), points=None) -> tuple[int, int]:
        """Model and geometry of a square of one."""
        model = self.add("Model", f"Model::{name}", "Mesh", f"Version: 232\n{place}", '"OO",ME,0')
        points = [0, 0, 0, 1, 0, 0, 1, 1, 0, 0, 1, 0] if points is None else points
        body = array("Vertices", points) + array("PolygonVertexIndex", polygons) + more
        return model, self.add("Geometry", f"Geometry::{name}", "Mesh", body, f'"OO",ME,{model}')

    def blend(self, geometry: int, names, deformer: str = "blend", rows=(2,), offsets=(0, 0, 1), weights=(100,)):
        """Channels of one shape each, or of one per weight, each twice as far as the one before."""
        holder = self.add("Deformer", f"Deformer::{deformer}", "BlendShape", "Version: 100\n", f'"OO",ME,{geometry}')
        channels = []
        for name in names:
            body = "Version: 100\nDeformPercent: 0\n" + array("FullWeights", weights)
            channels.append(
                self.add("Deformer", f"SubDeformer::{name}", "BlendShapeChannel", body, f'"OO",ME,{holder}')
            )
            for step, _ in enumerate(weights):
                pushed = [each * 2**step for each in offsets]
                body = "Version: 100\n" + array("Indexes", rows) + array("Vertices", pushed)
                self.add("Geometry", f"Geometry::{name}", "Shape", body, f'"OO",ME,{channels[-1]}')
        return channels

    def animate(self, channel: int, times, values) -> None:
        stack = self.add("AnimationStack", "AnimStack::Take", "", "")
        layer = self.add("AnimationLayer", "AnimLayer::Base", "", "", f'"OO",ME,{stack}')
        node = self.add(
            "AnimationCurveNode", "AnimCurveNode::DeformPercent", "",
            properties('"d|DeformPercent", "Number", "", "A",0'),
            f'"OO",ME,{layer}', f'"OP",ME,{channel},"DeformPercent"',
        )  # fmt: skip
        body = "Default: 0\nKeyVer: 4009\n" + array("KeyTime", [round(time * SECOND) for time in times])
        body += array("KeyValueFloat", values) + array("KeyAttrFlags", [4]) + array("KeyAttrDataFloat", [0, 0, 0, 0])
        body += array("KeyAttrRefCount", [len(times)])
        self.add("AnimationCurve", "AnimCurve::", "", body, f'"OP",ME,{node},"d|DeformPercent"')

    def text(self) -> str:
        axes = {1: (1, 1, 2, 1, 0, 1), 2: (2, 1, 1, -1, 0, 1)}[self.up]
        keys = ("UpAxis", "UpAxisSign", "FrontAxis", "FrontAxisSign", "CoordAxis", "CoordAxisSign")
        settings = [f'"{key}", "int", "Integer", "",{value}' for key, value in zip(keys, axes)]
        settings += [f'"UnitScaleFactor", "double", "Number", "",{self.unit}', '"TimeMode", "enum", "", "",11']
        return (
            "; FBX 7.4.0 project file\nFBXHeaderExtension: {\nFBXHeaderVersion: 1003\nFBXVersion: 7400\n}\n"
            f"GlobalSettings: {{\nVersion: 1000\n{properties(*settings)}}}\nObjects: {{\n{self.objects}}}\n"
            f"Connections: {{\n{self.links}}}\n"
        )

    def write(self, tmp_path: Path) -> Path:
        path = tmp_path / "made.fbx"
        path.write_text(self.text())
        return path

    def load(self, tmp_path: Path) -> Rig:
        return fbx.load(self.write(tmp_path))


def test_polygons_become_fans_and_shapes_move_what_they_name(tmp_path):
    builder = Builder()
    _, geometry = builder.mesh("Face")
    builder.blend(geometry, ["smile"])
    rig = builder.load(tmp_path)
    assert rig.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert rig.names == ("smile",)
    np.testing.assert_allclose(rig.neutral[2], [1, 1, 0], atol=1e-7)
    np.testing.assert_allclose(rig.deltas[0], [[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 0]], atol=1e-7)


def test_unit_axes_and_transforms_reach_positions_and_offsets(tmp_path):
    builder = Builder(unit=1, up=2)  # centimetres, Z up
    place = properties(
        '"Lcl Translation", "Lcl Translation", "", "A",0,0,100',
        '"Lcl Scaling", "Lcl Scaling", "", "A",2,2,2',
        '"GeometricTranslation", "Vector3D", "Vector", "",0,0,50',
    )
    _, geometry = builder.mesh("Face", place=place)
    builder.blend(geometry, ["smile"])
    rig, contents = fbx.read(builder.write(tmp_path))
    # Half a metre up before it is doubled, one metre after; then Z becomes Y and Y becomes -Z.
    np.testing.assert_allclose(rig.neutral, [[0, 2, 0], [0.02, 2, 0], [0.02, 2, -0.02], [0, 2, -0.02]], atol=1e-6)
    np.testing.assert_allclose(rig.deltas[0, 2], [0, 0.02, 0], atol=1e-8)
    assert contents.converted[:2] == ("units of 0.01 m made metres", "axes turned to +Y up")


def test_a_mirrored_node_turns_its_faces(tmp_path):
    builder = Builder()
    _, geometry = builder.mesh("Face", place=properties('"Lcl Scaling", "Lcl Scaling", "", "A",1,1,-1'))
    builder.blend(geometry, ["smile"])
    assert builder.load(tmp_path).faces.tolist() == [[0, 2, 1], [0, 3, 2]]


def test_names_lose_the_deformer_but_not_their_dots(tmp_path):
    builder = Builder()
    _, geometry = builder.mesh("Face")
    names = ("Face_blend.jawOpen", "Blink.L", "a name of more than twenty letters, ünïcode")
    builder.blend(geometry, names, deformer="Face_blend")
    assert builder.load(tmp_path).names == ("jawOpen", "Blink.L", names[2])


def test_the_full_shape_counts_where_others_lie_between(tmp_path):
    builder = Builder()
    _, geometry = builder.mesh("Face")
    builder.blend(geometry, ["smile"], weights=(50, 100))
    rig, contents = fbx.read(builder.write(tmp_path))
    assert float(rig.deltas[0, 2, 2]) == pytest.approx(2)
    assert "smile: shapes in between are left out, the full one counts" in contents.converted


def test_meshes_that_share_names_become_one_rig_and_choice_takes_some(tmp_path):
    builder = Builder()
    for name, shapes in (("Head", ["smile", "jaw"]), ("Upper_Teeth", ["jaw"]), ("Shirt", [])):
        _, geometry = builder.mesh(name)
        if shapes:
            builder.blend(geometry, shapes)
    path = builder.write(tmp_path)
    rig, contents = fbx.read(path)
    assert rig.names == ("smile", "jaw")
    assert [PARTS[part] for part in rig.parts[[0, 4]]] == ["skin", "teeth"]
    assert {mesh.name: mesh.used for mesh in contents.meshes} == {"Head": True, "Upper_Teeth": True, "Shirt": False}
    assert len(fbx.load(path, Choice(parts=("head",))).neutral) == 4


def test_a_skinned_mesh_stands_as_it_was_bound(tmp_path):
    builder = Builder()
    model, geometry = builder.mesh("Face", place=properties('"Lcl Translation", "Lcl Translation", "", "A",7,7,7'))
    builder.blend(geometry, ["smile"])
    bone = builder.add("Model", "Model::Bone", "LimbNode", "Version: 232\n", '"OO",ME,0')
    skin = builder.add("Deformer", "Deformer::Skin", "Skin", "Version: 101\n", f'"OO",ME,{geometry}')
    still = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
    body = "Version: 100\n" + array("Indexes", range(4)) + array("Weights", [1] * 4)
    # Bound when the mesh was at y = -3 of a bone that was at y = 5: at y = 2 in the world.
    body += array("Transform", [*still, 0, -3, 0, 1]) + array("TransformLink", [*still, 0, 5, 0, 1])
    cluster = builder.add("Deformer", "SubDeformer::Cluster", "Cluster", body, f'"OO",ME,{skin}')
    builder.links += f'C: "OO",{bone},{cluster}\n'
    rig, contents = fbx.read(builder.write(tmp_path))
    np.testing.assert_allclose(rig.neutral[0], [0, 2, 0], atol=1e-6)
    assert "Face: skinned; taken as it was bound" in contents.converted
    assert model


UV = (
    'LayerElementUV: 0 {\nVersion: 101\nName: "map"\nMappingInformationType: "ByPolygonVertex"\n'
    'ReferenceInformationType: "IndexToDirect"\n'
    + array("UV", [0, 0, 1, 0, 1, 1, 0, 0.75])
    + array("UVIndex", [0, 1, 2, 3])
    + "}\n"
)
LAYER = "Layer: 0 {\nVersion: 100\nLayerElement: {\nType: KIND\nTypedIndex: 0\n}\n}\n"


def png(color) -> bytes:
    packed = io.BytesIO()
    Image.new("RGB", (2, 2), color).save(packed, "PNG")
    return packed.getvalue()


def with_picture(name: str) -> Builder:
    builder = Builder()
    model, geometry = builder.mesh("Face", UV + LAYER.replace("KIND", '"LayerElementUV"'))
    builder.blend(geometry, ["smile"])
    material = builder.add("Material", "Material::skin", "", "Version: 102\n", f'"OO",ME,{model}')
    body = f'Type: "TextureVideoClip"\nVersion: 202\nFileName: "{name}"\nRelativeFilename: "{name}"\n'
    builder.add("Texture", "Texture::t", "", body, f'"OP",ME,{material},"DiffuseColor"')
    return builder


def test_a_picture_lies_beside_the_file_or_is_left_out_and_said(tmp_path):
    (tmp_path / "inner" / "made.fbm").mkdir(parents=True)
    (tmp_path / "inner" / "made.fbm" / "red.png").write_bytes(png((255, 0, 0)))
    (tmp_path / "outside.png").write_bytes(png((0, 255, 0)))
    for name in ("made.fbm/red.png", "red.png", "C:\\work\\red.png", "/elsewhere/red.png", "..\\red.png"):
        rig = with_picture(name).load(tmp_path / "inner")
        assert rig.texture[0, 0].tolist() == [1, 0, 0], name
        corners = rig.uv[rig.faces if rig.uv_faces is None else rig.uv_faces]
        assert corners[0].tolist() == [[0, 1], [1, 1], [1, 0]]  # v counts from the top
    for name in ("../outside.png", str(tmp_path / "outside.png"), "http://a.b/outside.png"):
        rig, contents = fbx.read(with_picture(name).write(tmp_path / "inner"))
        assert rig.texture is None
        assert any("not in the file's folder; left out" in line for line in contents.converted), name


def test_colours_of_materials_reach_their_faces(tmp_path):
    builder = Builder()
    which = array("Materials", [0, 1])
    more = 'LayerElementMaterial: 0 {\nVersion: 101\nName: ""\nMappingInformationType: "ByPolygon"\n'
    more += f'ReferenceInformationType: "IndexToDirect"\n{which}}}\n'
    more += LAYER.replace("KIND", '"LayerElementMaterial"')
    model, geometry = builder.mesh("Face", more, polygons=(0, 1, -3, 0, 2, -4))
    builder.blend(geometry, ["smile"])
    for name, color in (("skin", "1,1,1"), ("lips", "0.5,0.25,1")):
        body = "Version: 102\n" + properties(f'"DiffuseColor", "Color", "", "A",{color}')
        builder.add("Material", f"Material::{name}", "", body, f'"OO",ME,{model}')
    rig = builder.load(tmp_path)
    assert rig.faces.tolist() == [[0, 1, 2], [4, 5, 3]]
    # 0.5 linear is 0.7354 in sRGB, 0.25 is 0.5371.
    np.testing.assert_allclose(rig.colors[3:], [[0.7354, 0.5371, 1.0]] * 3, atol=1e-4)
    assert rig.colors[:3].min() == 1
    assert [PARTS[part] for part in rig.parts] == ["lips", "skin", "lips", "lips", "lips", "lips"]


# Motion ---------------------------------------------------------------------------------------------------------------


def animated(tmp_path: Path, times, values) -> Clip:
    builder = Builder()
    _, geometry = builder.mesh("Face")
    channels = builder.blend(geometry, ["smile", "jaw"])
    builder.animate(channels[0], times, values)
    return fbx.load_clip(builder.write(tmp_path))


def test_percent_become_weights_at_the_rate_of_the_file(tmp_path):
    clip = animated(tmp_path, [0, 0.5, 1], [0, 50, 0])
    assert (clip.names, clip.fps, len(clip)) == (("smile", "jaw"), 24, 25)
    np.testing.assert_allclose(clip.weights[:, 0], 0.5 - np.abs(np.arange(25) / 24 - 0.5), atol=1e-6)  # float32
    assert clip.weights[:, 1].abs().max() == 0


@pytest.mark.parametrize("values", [[0, 0], [30, 30]])
def test_a_file_that_stands_still_is_no_clip(values, tmp_path):
    with pytest.raises(ReenactError, match=r"made\.fbx: expected an animation of blend channels, got none"):
        animated(tmp_path, [0, 1], values)


def test_an_endless_take_is_refused(tmp_path):
    with pytest.raises(ReenactError, match="too long"):
        animated(tmp_path, [0, 1e8], [0, 100])


# Hostile files --------------------------------------------------------------------------------------------------------


def made(**change) -> Builder:
    builder = Builder()
    _, geometry = builder.mesh("Face", **{key: change[key] for key in ("polygons", "points") if key in change})
    more = {key: change[key] for key in ("rows", "offsets", "weights") if key in change}
    builder.blend(geometry, change.get("names", ["smile"]), **more)
    return builder


HOSTILE = {
    "corner far": ({"polygons": (0, 1, 99, -4)}, "made.fbx: "),
    "no polygons": ({"polygons": ()}, "made.fbx: "),
    "only a line": ({"polygons": (0, -2)}, "made.fbx: "),
    "points cut": ({"points": [0, 0, 0, 1]}, "made.fbx: "),
    "points NaN": ({"points": [0, 0, "nan", 1, 0, 0, 1, 1, 0, 0, 1, 0]}, "positions hold NaN|FBX file"),
    "points huge": ({"points": [0, 0, 1e300, 1, 0, 0, 1, 1, 0, 0, 1, 0]}, "positions hold NaN"),
    "offset huge": ({"offsets": (0, 1e300, 0)}, "shape 'smile': holds NaN, infinity or numbers far too large"),
    "no channels": ({"names": []}, "expected a mesh with named blendshapes"),
}


@pytest.mark.parametrize(("change", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_file_that_lies_is_refused_by_file_and_field(change, message, tmp_path):
    with pytest.raises(ReenactError, match=message) as caught:
        made(**change).load(tmp_path)
    assert str(caught.value).startswith(str(tmp_path / "made.fbx"))


@pytest.mark.parametrize("rows", [(4,), (-1,), (2**31 - 1,)])
def test_a_shape_of_a_vertex_that_is_not_there_moves_nothing_or_is_refused(rows, tmp_path):
    with contextlib.suppress(ReenactError):
        assert made(rows=rows).load(tmp_path).deltas.shape == (1, 4, 3)


def test_doubled_channels_are_said(tmp_path):
    rig, contents = fbx.read(made(names=["smile", "smile"]).write(tmp_path))
    assert rig.names == ("smile",)
    assert "Face: two channels are called smile; the first counts" in contents.converted


JUNK = {
    "empty": b"",
    "text": b"hello",
    "header": b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0",
    "lying": b"Kaydara FBX Binary  \0\x1a\0\xe8\x1c\0\0" + b"\xff" * 100,
    "deep": b"; FBX 7.4.0 project file\n" + b"A: {\n" * 20_000,
    "long": b'; FBX 7.4.0 project file\nObjects: { Geometry: 1, "", "Mesh" { Vertices: *4000000000000 { a: 1 } } }',
    "an OBJ": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
}


@pytest.mark.parametrize("data", JUNK.values(), ids=JUNK)
def test_junk_is_refused(data, tmp_path):
    (tmp_path / "junk.fbx").write_bytes(data)
    with pytest.raises(ReenactError, match=r"junk\.fbx: "):
        fbx.load(tmp_path / "junk.fbx")


def test_without_the_package_its_name_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for read in (fbx.load, fbx.load_clip):
        with pytest.raises(ReenactError, match=r"needs the package ufbx; pip install reenact\[fbx\]"):
            read(tmp_path / "x.fbx")


# Mutants --------------------------------------------------------------------------------------------------------------


def survive(tmp_path: Path, sample: bytes, count: int, by_line: bool) -> None:
    rng = np.random.default_rng(17)
    path = tmp_path / "mutant.fbx"
    messages = []
    for round_ in range(count):
        data = bytearray(sample)
        for place in rng.integers(0, len(data), rng.integers(1, 8)):
            data[place] = rng.choice(list(b'0123456789-.,"{}*: \n')) if by_line else rng.integers(256)
        path.write_bytes(bytes(data[: rng.integers(1, len(data))] if round_ % 10 == 0 else data))
        try:
            (fbx.load, fbx.load_clip)[round_ % 2](path)
        except ReenactError as error:
            messages.append(str(error))
    assert all(message.startswith(str(path)) for message in messages)
    assert len(messages) > count // 5


@pytest.mark.parametrize("threshold", [70, 700, 1000])
def test_a_file_is_read_whenever_garbage_is_collected(threshold):
    """ufbx 0.0.5 crashes where a scene that nobody holds any more is collected."""
    code = (
        f"import gc, sys; gc.set_threshold({threshold}, 1, 1)\n"
        "from reenact.rigs.formats import isolated\n"
        "isolated.main('fbx_scene:scene', *sys.argv[1:], str(16 << 30))"
    )
    places = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-c", code, FIXTURE, FIXTURE],
        capture_output=True,
        check=False,
        env={**os.environ, "PYTHONPATH": places},
    )
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    assert len(done.stdout) > 1000


def samples() -> list[bytes]:
    builder = with_picture("red.png")
    builder.animate(builder.blend(2, ["jaw"], deformer="more")[0], [0, 1], [0, 100])
    return [FIXTURE.read_bytes(), builder.text().encode()]


@pytest.mark.parametrize("kind", [0, 1])
def test_50_mutated_files_load_or_are_refused(kind, tmp_path):
    survive(tmp_path, samples()[kind], 50, kind == 1)  # an eighth of a second each, in a process of its own


@pytest.mark.nightly
@pytest.mark.parametrize("kind", [0, 1])
def test_2000_mutated_files_load_or_are_refused(kind, tmp_path):
    survive(tmp_path, samples()[kind], 2000, kind == 1)
