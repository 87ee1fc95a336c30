"""USD: what we write comes back and is valid; what others write loads; what lies is refused by name."""

import io
import subprocess
import sys
import warnings
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_random_rig
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import isolated, pictures
from reenact.rigs.formats.pieces import Choice
from reenact.rigs.rig import PARTS, Rig

pytest.importorskip("pxr")
from reenact.rigs.formats import usd


def make_clip(rig: Rig, frames: int = 12, fps: float = 30.0) -> Clip:
    return Clip(rig.names, torch.rand(frames, len(rig.names), generator=torch.Generator().manual_seed(3)), fps)


def same(again: Rig, rig: Rig) -> None:
    assert (again.name, again.names) == (rig.name, rig.names)
    for field in ("neutral", "deltas", "faces", "parts"):
        before, after = getattr(rig, field), getattr(again, field)
        assert (before is None) == (after is None), field
        assert before is None or torch.equal(before, after), field
    assert (rig.colors is None) == (again.colors is None)
    if rig.colors is not None:
        torch.testing.assert_close(again.colors, rig.colors, rtol=0, atol=1e-6)  # sRGB to linear float32 and back
    if rig.uv is not None:
        before, after = rig.uv[rig.uv_faces], again.uv[again.uv_faces]
        torch.testing.assert_close(after, before, rtol=0, atol=1e-7)  # v counts from the other side
    assert (rig.texture is None) == (again.texture is None)
    if rig.texture is not None:
        torch.testing.assert_close(again.texture, rig.texture, rtol=0, atol=1e-7)  # whole 255ths


# Round trips ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_what_is_written_comes_back_and_writes_the_same_bytes(seed, tmp_path):
    rig = make_random_rig(seed)
    clip = make_clip(rig, fps=(30.0, 24.0, 60.0, 29.97, 4.0)[seed % 5])
    suffix = usd.SUFFIXES[seed % 4]
    first, second, third = (tmp_path / folder / f"rig{suffix}" for folder in "abc")
    for place in (first, second, third):
        place.parent.mkdir()
    usd.save(rig, first, clip)
    again, clip_again = usd.load(first), usd.load_clip(first)
    same(again, rig)
    assert (clip_again.names, clip_again.fps) == (rig.names, clip.fps)
    assert torch.equal(clip_again.weights, clip.weights)
    usd.save(again, second, clip_again)
    usd.save(usd.load(second), third, usd.load_clip(second))
    assert second.read_bytes() == third.read_bytes()


def test_names_that_are_no_identifiers_stay_as_they_are(tmp_path):
    names = ("eye-L", "eye_L", "eye L", "2nd", "jawOpen2", "jawOpen", "目を閉じる", "a.b/c", 'say "x"')
    rig = make_random_rig(0)
    rig = replace(rig, names=names, deltas=rig.deltas[[0, 1, 2] * 3] * torch.arange(1, 10)[:, None, None])
    usd.save(rig, tmp_path / "odd.usda", make_clip(rig))
    same(usd.load(tmp_path / "odd.usda"), rig)
    assert usd.load_clip(tmp_path / "odd.usda").names == names


def test_a_texture_lies_in_the_package_or_beside_the_file(tmp_path):
    rig = make_random_rig(7)
    usd.save(rig, tmp_path / "one.usdz")
    with zipfile.ZipFile(tmp_path / "one.usdz") as archive:
        assert archive.namelist() == ["rig.usdc", "textures/texture.png"]
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
    usd.save(rig, tmp_path / "two.usdc")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.usdz", "two.usdc", "two_texture.png"]


def test_one_frame_is_a_clip_of_one_frame(tmp_path):
    rig = make_random_rig(0)
    usd.save(rig, tmp_path / "still.usdc", make_clip(rig, frames=1))
    clip = usd.load_clip(tmp_path / "still.usdc")
    assert (len(clip), clip.fps) == (1, 30)


def complaints(path: Path) -> list[str]:
    """What the validators of usd-core find, all of them."""
    from pxr import Usd, UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    errors = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [f"{error.GetName()}: {error.GetMessage()}" for error in errors]


@pytest.mark.parametrize("suffix", usd.SUFFIXES)
@pytest.mark.parametrize("seed", range(20))
def test_the_validators_find_nothing(seed, suffix, tmp_path):
    rig = make_random_rig(seed)
    path = tmp_path / f"rig{suffix}"
    usd.save(rig, path, make_clip(rig) if seed % 2 else None)
    assert complaints(path) == []


def test_the_validators_do_find_what_is_wrong(tmp_path):
    path = tmp_path / "bare.usda"
    path.write_text('#usda 1.0\ndef Mesh "face" {\nuniform token[] skel:blendShapes = ["a"]\n}')
    assert complaints(path)


def test_usd_poses_the_mesh_as_the_rig_does(tmp_path):
    """The library's own skinning, not our reader, at frame 5."""
    from pxr import Usd, UsdGeom, UsdSkel

    rig = make_random_rig(3)
    clip = make_clip(rig)
    usd.save(rig, tmp_path / "rig.usdc", clip)
    stage = Usd.Stage.Open(str(tmp_path / "rig.usdc"))
    assert UsdSkel.BakeSkinning(UsdSkel.Root(stage.GetDefaultPrim()), __import__("pxr").Gf.Interval(0, 11))
    points = np.array(UsdGeom.Mesh(stage.GetPrimAtPath("/rig/face")).GetPointsAttr().Get(5))
    np.testing.assert_allclose(points, rig.vertices(clip.weights[5]), rtol=0, atol=1e-6)  # float32 sums


# What others write ----------------------------------------------------------------------------------------------------

SQUARE = """
        int[] faceVertexCounts = [4]
        int[] faceVertexIndices = [0, 1, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
        uniform token[] skel:blendShapes = ["smile"]
        rel skel:blendShapeTargets = <PATH/smile>
        def BlendShape "smile" { uniform vector3f[] offsets = [(0, 0, 1)]
            uniform int[] pointIndices = [2] }
"""
FIRST = '#usda 1.0\n(metersPerUnit = 1\nupAxis = "Y")\n'


def square(name: str = "face", more: str = "", body: str = SQUARE, parent: str = "") -> str:
    return f'def Mesh "{name}" (prepend apiSchemas = ["SkelBindingAPI"]) {{{more}{body}}}\n'.replace(
        "PATH", f"{parent}/{name}"
    )


def write(tmp_path: Path, text: str, name: str = "made.usda") -> Path:
    path = tmp_path / name
    path.write_text(text.replace("{ ", "{\n").replace(" }", "\n}"))  # the grammar wants a line for each
    return path


def load(tmp_path: Path, text: str) -> Rig:
    return usd.load(write(tmp_path, text))


def test_polygons_become_fans(tmp_path):
    rig = load(tmp_path, FIRST + square())
    assert rig.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    assert rig.deltas[0].tolist() == [[0, 0, 0], [0, 0, 0], [0, 0, 1], [0, 0, 0]]
    assert (rig.name, rig.names) == ("made", ("smile",))


def test_left_handed_faces_and_mirrors_are_turned(tmp_path):
    left = '\nuniform token orientation = "leftHanded"\n'
    mirror = '\ndouble3 xformOp:scale = (1, 1, -1)\nuniform token[] xformOpOrder = ["xformOp:scale"]\n'
    assert load(tmp_path, FIRST + square(more=left)).faces.tolist() == [[0, 2, 1], [0, 3, 2]]
    assert load(tmp_path, FIRST + square(more=mirror)).faces.tolist() == [[0, 2, 1], [0, 3, 2]]
    assert load(tmp_path, FIRST + square(more=left + mirror)).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_holes_are_no_faces(tmp_path):
    body = SQUARE.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]")
    assert load(tmp_path, FIRST + square(more="\nint[] holeIndices = [0]\n", body=body)).faces.tolist() == [[0, 2, 3]]


def test_unit_axis_and_transforms_reach_positions_and_offsets(tmp_path):
    place = (
        "\ndouble3 xformOp:translate = (0, 0, 100)\ndouble3 xformOp:scale = (2, 2, 2)\n"
        'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n'
    )
    path = write(tmp_path, '#usda 1.0\n(metersPerUnit = 0.01\nupAxis = "Z")\n' + square(more=place))
    rig, contents = usd.read(path)
    # Doubled, one metre up along Z, then Z becomes Y and Y becomes -Z.
    np.testing.assert_allclose(rig.neutral, [[0, 1, 0], [0.02, 1, 0], [0.02, 1, -0.02], [0, 1, -0.02]], atol=1e-7)
    np.testing.assert_allclose(rig.deltas[0, 2], [0, 0.02, 0], atol=1e-9)
    assert contents.converted[:2] == ("units of 0.01 m made metres", "+Z up made +Y up")


def test_a_stage_without_a_unit_is_in_centimetres_and_says_so(tmp_path):
    rig, contents = usd.read(write(tmp_path, "#usda 1.0\n" + square()))
    assert float(rig.neutral.max()) == pytest.approx(0.01)
    assert "taken as centimetres" in contents.converted[0]


SKIN = """
#usda 1.0
(metersPerUnit = 1
upAxis = "Y")
def SkelRoot "root" {
    def Skeleton "bones" (prepend apiSchemas = ["SkelBindingAPI"]) {
        uniform token[] joints = ["a"]
        uniform matrix4d[] bindTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,1))]
        uniform matrix4d[] restTransforms = [((1,0,0,0),(0,1,0,0),(0,0,1,0),(9,9,9,1))]
        double3 xformOp:translate = (0, 5, 0)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    }
    MESH
}
"""


def test_a_skinned_mesh_stands_as_it_was_bound(tmp_path):
    more = """
        rel skel:skeleton = </root/bones>
        matrix4d primvars:skel:geomBindTransform = ((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,2,1))
        int[] primvars:skel:jointIndices = [0] (interpolation = "constant")
        float[] primvars:skel:jointWeights = [1] (interpolation = "constant")
        double3 xformOp:translate = (7, 7, 7)
        uniform token[] xformOpOrder = ["xformOp:translate"]
    """
    text = SKIN.strip().replace("MESH", square(more=more, parent="/root"))
    rig, contents = usd.read(write(tmp_path, text))
    assert rig.neutral[0].tolist() == [0, 5, 2]  # bound at z = 2 in a skeleton at y = 5, whatever its own place says
    assert "face: skinned; taken as it was bound" in contents.converted


def test_meshes_that_share_names_become_one_rig_and_choice_takes_some(tmp_path):
    body = SQUARE.replace('["smile"]', '["jaw2"]').replace('"smile"', '"jaw"').replace("/smile", "/jaw")
    text = FIRST + square("Head") + square("upper_teeth", body=body) + square("Gums", body=body.replace("jaw2", "jaw"))
    path = write(tmp_path, text)
    rig = usd.load(path)
    assert rig.names == ("smile", "jaw")  # Blender's number on the second token is not part of the name
    assert [PARTS[part] for part in rig.parts[[0, 4, 8]]] == ["skin", "teeth", "teeth"]
    assert len(usd.load(path, Choice(parts=("head",))).neutral) == 4
    assert usd.load(path, Choice(shapes=("JAW",))).names == ("jaw",)


def test_what_is_hidden_or_only_a_guide_is_left_out_and_said(tmp_path):
    text = FIRST + square() + square("old", '\ntoken visibility = "invisible"\n')
    text += square("low", '\nuniform token purpose = "proxy"\n')
    rig, contents = usd.read(write(tmp_path, text))
    assert len(rig.neutral) == 4
    assert {"old: hidden; left out", "low: only a proxy; left out"} <= set(contents.converted)


def test_shapes_in_between_are_left_out_and_said(tmp_path):
    between = "uniform vector3f[] inbetweens:half = [(0, 5, 0)] (weight = 0.5)\nuniform int[] pointIndices = [2]"
    text = FIRST + square(body=SQUARE.replace("uniform int[] pointIndices = [2]", between))
    rig, contents = usd.read(write(tmp_path, text))
    assert rig.deltas[0, 2].tolist() == [0, 0, 1]
    assert any("in between" in line for line in contents.converted)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ('color3f[] primvars:displayColor = [(1, 0, 0)] (interpolation = "constant")', [[1, 0, 0]] * 4),
        ('color3f[] primvars:displayColor = [(0, 1, 0)] (interpolation = "uniform")', [[0, 1, 0]] * 4),
        (
            'color3f[] primvars:displayColor = [(1,0,0), (0,0,1)] (interpolation = "vertex")\n'
            "int[] primvars:displayColor:indices = [0, 1, 1, 0]",
            [[1, 0, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0]],
        ),
        (
            'color3f[] primvars:displayColor = [(1,0,0),(0,1,0),(0,0,1),(1,1,0)] (interpolation = "faceVarying")',
            [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]],
        ),
    ],
)
def test_display_colours_reach_vertices(line, expected, tmp_path):
    assert load(tmp_path, FIRST + square(more=f"\n{line}\n")).colors.tolist() == expected


UV = '\ntexCoord2f[] primvars:UVMap = [(0, 0), (1, 0), (1, 1), (0, 0.75)] (interpolation = "HOW")\n'


@pytest.mark.parametrize("how", ["vertex", "varying", "faceVarying"])
def test_uv_of_any_name_count_from_the_top(how, tmp_path):
    rig = load(tmp_path, FIRST + square(more=UV.replace("HOW", how)))
    corners = rig.uv[rig.faces if rig.uv_faces is None else rig.uv_faces]
    assert corners[0].tolist() == [[0, 1], [1, 1], [1, 0]]
    assert corners[1, 2].tolist() == [0, 0.25]


def material(picture: str) -> str:
    return f"""
def Material "skin" {{
    token outputs:surface.connect = </skin/s.outputs:surface>
    def Shader "s" {{ uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor.connect = </skin/t.outputs:rgb>
        token outputs:surface }}
    def Shader "t" {{ uniform token info:id = "UsdUVTexture"
        asset inputs:file = @{picture}@
        float3 outputs:rgb }}
}}
def Material "lips" {{
    token outputs:surface.connect = </lips/s.outputs:surface>
    def Shader "s" {{ uniform token info:id = "UsdPreviewSurface"
        color3f inputs:diffuseColor = (0.5, 0.25, 1)
        token outputs:surface }}
}}
"""


TWO = SQUARE.replace("[4]", "[3, 3]").replace("[0, 1, 2, 3]", "[0, 1, 2, 0, 2, 3]")
SUBSETS = """
    rel material:binding = </lips>
    uniform token subsetFamily:materialBind:familyType = "nonOverlapping"
    def GeomSubset "upper" (prepend apiSchemas = ["MaterialBindingAPI"]) {
        uniform token elementType = "face"
        uniform token familyName = "materialBind"
        int[] indices = [1]
        rel material:binding = </MATERIAL>
    }
"""


def png(color) -> bytes:
    packed = io.BytesIO()
    Image.new("RGB", (2, 2), color).save(packed, "PNG")
    return packed.getvalue()


def test_a_material_per_subset_colours_its_faces(tmp_path):
    text = FIRST + material("none.png") + square(more=SUBSETS.replace("MATERIAL", "none"), body=TWO)
    rig = load(tmp_path, text)
    assert rig.neutral[4:].tolist() == rig.neutral[[0, 2]].tolist()  # vertices between two colours are there twice
    assert rig.faces.tolist() == [[0, 1, 2], [4, 5, 3]]
    # 0.5 linear is 0.7354 in sRGB, 0.25 is 0.5371.
    np.testing.assert_allclose(rig.colors[:3], [[0.7354, 0.5371, 1.0]] * 3, atol=1e-4)
    assert rig.colors[3:].min() == 1
    assert torch.equal(rig.deltas[:, 5], rig.deltas[:, 2])


def test_a_picture_lies_beside_the_file_or_is_left_out_and_said(tmp_path):
    (tmp_path / "inner" / "textures").mkdir(parents=True)
    (tmp_path / "inner" / "textures" / "red.png").write_bytes(png((255, 0, 0)))
    (tmp_path / "outside.png").write_bytes(png((0, 255, 0)))
    (tmp_path / "inner" / "link.png").symlink_to(tmp_path / "outside.png")
    bound = UV.replace("HOW", "vertex") + "rel material:binding = </skin>\n"
    for name in ("textures/red.png", "./textures/red.png", "C:\\\\work\\\\red.png", "/elsewhere/red.png", "../red.png"):
        rig = load(tmp_path / "inner", FIRST + material(name) + square(more=bound))
        assert rig.texture[0, 0].tolist() == [1, 0, 0], name
    for name in ("../outside.png", str(tmp_path / "outside.png"), "link.png", "http://a.b/outside.png"):
        path = write(tmp_path / "inner", FIRST + material(name) + square(more=bound))
        rig, contents = usd.read(path)
        assert rig.texture is None, name
        assert any("not in the file's folder; left out" in line for line in contents.converted), name


def test_transparent_materials_are_left_out(tmp_path):
    clear = material("none.png").replace("color3f inputs:diffuseColor = (0.5, 0.25, 1)", "float inputs:opacity = 0.1")
    text = FIRST + clear + square(more=SUBSETS.replace("MATERIAL", "skin"), body=TWO)
    rig, contents = usd.read(write(tmp_path, text))
    assert len(rig.faces) == 1
    assert any("transparent" in line for line in contents.converted)


def test_a_reference_inside_the_folder_is_followed(tmp_path):
    write(tmp_path, FIRST + square(), "part.usda")
    text = FIRST + 'def "head" (references = @./part.usda@</face>) {}\n'
    path = write(tmp_path, text)
    assert usd.load(path).names == ("smile",)


# Motion ---------------------------------------------------------------------------------------------------------------


def animated(tmp_path: Path, samples: str, rate: float = 24, tokens: str = '["smile"]') -> Clip:
    text = FIRST.replace("upAxis", f"timeCodesPerSecond = {rate}\nupAxis")
    text += f"""def SkelAnimation "motion" {{ uniform token[] blendShapes = {tokens}
        float[] blendShapeWeights.timeSamples = {{{samples}}} }}\n"""
    bound = "\nrel skel:animationSource = </motion>\n"
    return usd.load_clip(write(tmp_path, text + square(more=bound)))


def test_evenly_spaced_samples_stay_as_they_are(tmp_path):
    clip = animated(tmp_path, "10: [0.25], 11: [0.5], 12: [1]")
    assert (clip.names, clip.fps, clip.weights.flatten().tolist()) == (("smile",), 24, [0.25, 0.5, 1])
    assert animated(tmp_path, "0: [0], 2: [0.5], 4: [1]").fps == 12  # animated on twos


def test_keys_far_apart_are_sampled_at_the_stage_s_rate(tmp_path):
    clip = animated(tmp_path, "0: [0], 48: [1]")
    assert (len(clip), clip.fps) == (49, 24)
    assert clip.weights[12, 0] == 0.25


def test_a_dropped_frame_is_filled(tmp_path):
    clip = animated(tmp_path, "0: [0], 1: [0.1], 2: [0.2], 4: [0.4], 5: [0.5]")
    np.testing.assert_allclose(clip.weights.flatten(), np.arange(6) / 10, atol=1e-6)  # float32


def test_animation_bound_to_no_mesh_keeps_its_tokens(tmp_path):
    assert animated(tmp_path, "0: [0, 1]", tokens='["a", "b"]').names == ("a", "b")


BAD_MOTION = {
    "none": ("", "expected an animation of blend shape weights, got none"),
    "short row": ("0: [0], 1: [0, 1]", "another number of weights at 1"),
    "NaN": ("0: [0], 1: [inf]", "NaN or infinity"),
    "endless": ("0: [0], 1e12: [1]", "too long"),
}


@pytest.mark.parametrize(("samples", "message"), BAD_MOTION.values(), ids=BAD_MOTION)
def test_motion_that_cannot_be_is_refused(samples, message, tmp_path):
    with pytest.raises(ReenactError, match=message):
        animated(tmp_path, samples)


# Hostile files --------------------------------------------------------------------------------------------------------

OUTSIDE = {
    "reference up": 'def "x" (references = @../secret.usda@</face>) {}',
    "reference absolute": 'def "x" (references = @/etc/secret.usda@</face>) {}',
    "payload": 'def "x" (payload = @../secret.usda@</face>) {}',
    "address": 'def "x" (references = @https://a.b/c.usda@</face>) {}',
    "link": 'def "x" (references = @./link.usda@</face>) {}',
    "expression": 'def "x" (references = @`"${WHERE}.usda"`@</face>) {}',
    "in a variant": 'def "x" (variantSets = "v") { variantSet "v" = { "a" (payload = @../secret.usda@) { } } }',
    "below": 'def "x" (references = @./inner.usda@</x>) {}',
}


@pytest.mark.parametrize("line", OUTSIDE.values(), ids=OUTSIDE)
def test_files_outside_the_folder_are_not_composed(line, tmp_path):
    folder = tmp_path / "inner"
    folder.mkdir()
    write(tmp_path, FIRST + square(), "secret.usda")
    (folder / "link.usda").symlink_to(tmp_path / "secret.usda")
    write(folder, FIRST + 'def "x" (references = @../secret.usda@</face>) {}', "inner.usda")
    with pytest.raises(ReenactError, match=r"made\.usda: takes in .* not in the file's folder"):
        load(folder, FIRST + square() + line)


def test_sublayers_and_clips_outside_are_not_composed(tmp_path):
    with pytest.raises(ReenactError, match="not in the file's folder"):
        load(tmp_path, FIRST.replace("(", "(subLayers = [@../secret.usda@]\n") + square())
    clips = 'def "x" (clips = {dictionary default = {asset[] assetPaths = [@../secret.usda@]}}) {}'
    with pytest.raises(ReenactError, match="takes its values from clips"):
        load(tmp_path, FIRST + square() + clips)


HOSTILE = {
    "no shapes": (("skel:blendShapes", "other"), "expected a mesh with named blendshapes"),
    "corner far": (("[0, 1, 2, 3]", "[0, 1, 2, 9]"), r"mesh 'face': a face names a vertex outside 0\.\.3"),
    "corner negative": (("[0, 1, 2, 3]", "[0, 1, 2, -1]"), "names a vertex outside"),
    "count lies": (("[4]", "[7]"), "corners"),
    "count negative": (("[4]", "[-4]"), "corners"),
    "count huge": (("[4]", "[2147483647]"), "corners"),
    "points NaN": (("(1, 1, 0)", "(nan, 1, 0)"), "positions hold NaN"),
    "points infinite": (("(1, 1, 0)", "(inf, 1, 0)"), "positions hold NaN"),
    "offset NaN": (("(0, 0, 1)", "(0, nan, 1)"), "shape 'smile': holds NaN"),
    "row far": (("pointIndices = [2]", "pointIndices = [4]"), "moves a vertex outside"),
    "row negative": (("pointIndices = [2]", "pointIndices = [-1]"), "moves a vertex outside"),
    "rows many": (("pointIndices = [2]", "pointIndices = [1, 2]"), "expected 2 offsets, got 1"),
    "offsets few": (("uniform int[] pointIndices = [2]", ""), "expected 4 offsets, got 1"),
    "no target": (("PATH/smile", "PATH/frown"), "is no BlendShape"),
    "target a mesh": (("PATH/smile", "PATH"), "is no BlendShape"),
    "tokens doubled": (('["smile"]', '["smile", "smile"]'), "different skel:blendShapes"),
    "token empty": (('["smile"]', '[""]'), "different skel:blendShapes"),
    "tokens many": (('["smile"]', '["smile", "frown"]'), "as many targets, got 1"),
    "points missing": (("point3f[] points", "point3f[] dots"), "names a vertex outside"),
    "unit zero": (("metersPerUnit = 1", "metersPerUnit = 0"), "positive metersPerUnit, got 0"),
    "unit negative": (("metersPerUnit = 1", "metersPerUnit = -1"), "positive metersPerUnit"),
}


@pytest.mark.parametrize(("change", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_file_that_lies_is_refused_by_file_and_field(change, message, tmp_path):
    text = FIRST.replace(*change) + square(body=SQUARE.replace(*change))
    with pytest.raises(ReenactError, match=message) as caught:
        load(tmp_path, text)
    assert str(caught.value).startswith(str(tmp_path / "made.usda"))


def test_scales_that_multiply_beyond_bounds_are_refused(tmp_path):
    scale = '\ndouble3 xformOp:scale = (1e40, 1e40, 1e40)\nuniform token[] xformOpOrder = ["xformOp:scale"]\n'
    with pytest.raises(ReenactError, match="beyond all bounds"):
        load(tmp_path, FIRST + square(more=scale))


@pytest.mark.parametrize("indices", ["[9]", "[-1]"])
def test_a_subset_of_faces_that_are_not_there_is_refused(indices, tmp_path):
    more = SUBSETS.replace("MATERIAL", "skin").replace("[1]", indices)
    with pytest.raises(ReenactError, match="upper names a face outside"):
        load(tmp_path, FIRST + material("x.png") + square(more=more, body=TWO))


def test_uv_and_colours_of_a_wrong_number(tmp_path):
    rig, contents = usd.read(write(tmp_path, FIRST + square(more=UV.replace("(1, 1), ", "").replace("HOW", "vertex"))))
    assert rig.uv is None
    assert "face: uv UVMap do not fit the mesh; left out" in contents.converted
    with pytest.raises(ReenactError, match=r"expected 4 colours \(vertex\), got 1"):
        load(
            tmp_path,
            FIRST + square(more='\ncolor3f[] primvars:displayColor = [(1, 0, 0)] (interpolation = "vertex")\n'),
        )


def test_parts_that_are_none_of_ours_are_refused(tmp_path):
    usd.save(make_random_rig(1), tmp_path / "parts.usda")
    text = (tmp_path / "parts.usda").read_text()
    start = text.index("reenactPart = [") + len("reenactPart = [")
    (tmp_path / "parts.usda").write_text(text[:start] + "99" + text[text.index(",", start) :])
    with pytest.raises(ReenactError, match="expected reenactPart of face as one index"):
        usd.load(tmp_path / "parts.usda")


def test_a_picture_that_is_none_or_a_bomb_is_refused(tmp_path, monkeypatch):
    usd.save(make_random_rig(7), tmp_path / "rig.usdz")
    monkeypatch.setattr(pictures, "PIXELS", 4)
    with pytest.raises(ReenactError, match=r"rig\.usdz: .*texture\.png: expected a picture of at most 4 pixels"):
        usd.load(tmp_path / "rig.usdz")
    bound = UV.replace("HOW", "vertex") + "rel material:binding = </skin>\n"
    (tmp_path / "bad.png").write_bytes(b"no picture")
    with pytest.raises(ReenactError, match=r"bad\.png: expected a PNG, JPEG or WebP picture"):
        load(tmp_path, FIRST + material("bad.png") + square(more=bound))


JUNK = {
    "empty.usda": b"",
    "text.usda": b"hello",
    "cut.usdc": b"PXR-USDC\0\0",
    "zeros.usdc": b"\0" * 200,
    "other.usdz": b"PK\3\4" + b"\0" * 60,
    "header.usda": b"#usda 1.0\n",
    "deep.usda": b"#usda 1.0\n" + b'def "a" {' * 3000,
    "wild.usd": bytes(range(256)),
}


@pytest.mark.parametrize(("name", "data"), JUNK.items(), ids=JUNK)
def test_junk_is_refused(name, data, tmp_path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ReenactError, match=name):
        usd.load(tmp_path / name)


def test_what_is_no_file_is_refused(tmp_path):
    for path, message in ((tmp_path, "found a folder"), (tmp_path / "none.usda", "found nothing")):
        with pytest.raises(ReenactError, match=message):
            usd.load(path)


def test_what_cannot_be_written_is_refused(tmp_path):
    rig = make_random_rig(1)
    with pytest.raises(ReenactError, match="conform it first"):
        usd.save(rig, tmp_path / "x.usda", Clip(("a",), torch.zeros(2, 1), 30.0))
    with pytest.raises(ReenactError, match=r"expected one of \.usd"):
        usd.save(rig, tmp_path / "x.obj")
    with pytest.raises(ReenactError, match="cannot be written"):
        usd.save(rig, tmp_path / "missing" / "x.usda")
    assert not list(tmp_path.iterdir())


def test_without_the_package_its_name_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    path = write(tmp_path, FIRST)
    for work in (usd.load, usd.load_clip, lambda place: usd.save(make_random_rig(1), place)):
        with pytest.raises(ReenactError, match=r"needs the package usd-core; pip install reenact\[usd\]"):
            work(path)


# The process that reads -----------------------------------------------------------------------------------------------


def test_a_reader_that_takes_too_long_is_stopped(tmp_path, monkeypatch):
    monkeypatch.setattr(isolated, "SECONDS", 0.05)  # less than the process takes to start
    with pytest.raises(ReenactError, match=r"made\.usda: expected a USD file, reading it took more than"):
        load(tmp_path, FIRST + square())


def ended(code: int, stderr: bytes = b""):
    return lambda *args, **kwargs: subprocess.CompletedProcess(args, code, b"", stderr)


def test_a_reader_that_crashes_is_one_error(tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "run", ended(-11))
    with pytest.raises(ReenactError, match=r"made\.usda: .* the library that reads it crashed \(SIGSEGV\)"):
        load(tmp_path, FIRST + square())
    monkeypatch.setattr(subprocess, "run", ended(3221225477))  # as Windows says it
    with pytest.raises(ReenactError, match=r"crashed \(exit 3221225477\)"):
        load(tmp_path, FIRST + square())


def test_a_mistake_of_ours_keeps_its_traceback(tmp_path, monkeypatch):
    monkeypatch.setattr(subprocess, "run", ended(1, b"Traceback (most recent call last):\nKeyError: 'x'"))
    with pytest.raises(RuntimeError, match="KeyError"):
        load(tmp_path, FIRST + square())


def test_answers_come_back_as_they_were():
    answer = {"a": np.arange(6, dtype=np.int64).reshape(2, 3), "b": [b"bytes", "ü", None, 1.5, {"c": np.zeros((0, 3))}]}
    again = isolated._unpack(isolated._pack(answer))
    np.testing.assert_array_equal(again["a"], answer["a"])
    assert again["b"][:4] == answer["b"][:4]
    assert again["b"][4]["c"].shape == (0, 3)


def test_a_module_in_the_current_folder_is_not_run(tmp_path, monkeypatch):
    path = write(tmp_path, FIRST + square())
    (tmp_path / "numpy.py").write_text("open('ran', 'w')\nraise SystemExit(9)")
    monkeypatch.chdir(tmp_path)
    assert usd.load(path).names == ("smile",)
    assert not (tmp_path / "ran").exists()


# Mutants --------------------------------------------------------------------------------------------------------------


def mutants(sample: bytes, seed: int, count: int):
    """Copies of a file with up to seven bytes changed, every tenth cut short."""
    rng = np.random.default_rng(seed)
    for round_ in range(count):
        data = bytearray(sample)
        for place in rng.integers(0, len(data), rng.integers(1, 8)):
            data[place] = rng.integers(256) if round_ % 3 else data[place] ^ (1 << rng.integers(8))
        yield bytes(data[: rng.integers(1, len(data))] if round_ % 10 == 0 else data)


def survive(tmp_path: Path, suffix: str, count: int) -> None:
    rig = make_random_rig(7)
    usd.save(rig, tmp_path / f"whole{suffix}", make_clip(rig))
    messages = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for data in mutants((tmp_path / f"whole{suffix}").read_bytes(), 13, count):
            path = tmp_path / f"mutant{suffix}"
            path.write_bytes(data)
            for read in (usd.load, usd.load_clip):
                try:
                    read(path)
                except ReenactError as error:
                    messages.append(str(error))
    assert all(message.startswith(str(path)) for message in messages)
    assert len(messages) > count // 2


@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_15_mutated_files_load_or_are_refused(suffix, tmp_path):
    survive(tmp_path, suffix, 15)  # half a second each: every file is read by a process of its own


@pytest.mark.nightly
@pytest.mark.parametrize("suffix", [".usda", ".usdc", ".usdz"])
def test_2000_mutated_files_load_or_are_refused(suffix, tmp_path):
    survive(tmp_path, suffix, 2000)


def test_the_reading_process_does_not_load_torch():
    code = (
        "import reenact.rigs.formats.usd_scene, reenact.rigs.formats.isolated, sys; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parents[1])
