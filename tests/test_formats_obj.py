"""OBJ folders: what we write comes back; what others write loads; what lies is refused by file and line."""

import io
import shutil
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_random_rig
from PIL import Image

from reenact.errors import ReenactError
from reenact.rigs.clip import Clip
from reenact.rigs.formats import obj, pictures
from reenact.rigs.formats.pieces import Choice
from reenact.rigs.rig import PARTS, Rig

FIXTURE = Path(__file__).parent / "fixtures" / "obj"


# Round trips ----------------------------------------------------------------------------------------------------------


def same(again: Rig, rig: Rig) -> None:
    assert (again.name, again.names) == (rig.name, rig.names)
    for field in ("neutral", "faces", "parts", "colors"):
        before, after = getattr(rig, field), getattr(again, field)
        assert (before is None) == (after is None), field
        assert before is None or torch.equal(before, after), field
    torch.testing.assert_close(again.deltas, rig.deltas, rtol=0, atol=1e-9)  # nine digits of positions of 0.1
    assert torch.equal(again.deltas == 0, rig.deltas == 0)
    if rig.uv is not None:
        torch.testing.assert_close(again.uv[again.uv_faces], rig.uv[rig.uv_faces], rtol=0, atol=1e-9)
    assert (rig.texture is None) == (again.texture is None)
    if rig.texture is not None:
        torch.testing.assert_close(again.texture, rig.texture, rtol=0, atol=1e-7)  # whole 255ths


@pytest.mark.parametrize("seed", range(20))
def test_what_is_written_comes_back_twice(seed, tmp_path):
    rig = make_random_rig(seed)
    obj.save(rig, tmp_path / "one")
    again = obj.load(tmp_path / "one")
    same(again, rig)
    obj.save(again, tmp_path / "two")
    same(obj.load(tmp_path / "two"), again)


def test_names_that_are_no_file_names_stay_as_they_are(tmp_path):
    names = ("neutral", "Neutral", "a/b", "../up", "con", "JAW", "jaw", "ünïcode shape", "dot.", "x" * 300, "a\nb")
    rig = replace(make_random_rig(0), names=names, deltas=torch.rand(len(names), 25, 3))
    obj.save(rig, tmp_path / "odd")
    assert obj.load(tmp_path / "odd").names == names
    assert not (tmp_path / "up.obj").exists()
    # With the neutral and its .mtl, all different where case does not count.
    assert len({path.name.lower() for path in (tmp_path / "odd").iterdir()}) == len(names) + 2


def test_shapes_added_and_removed_by_hand_are_seen(tmp_path):
    obj.save(make_random_rig(0), tmp_path / "rig")
    (tmp_path / "rig" / "jawOpen.obj").rename(tmp_path / "rig" / "aah.obj")
    assert obj.load(tmp_path / "rig").names == ("eyeBlink_L", "ünïcode shape", "aah")


def test_a_folder_of_other_files_and_a_clip_are_refused(tmp_path):
    rig = make_random_rig(0)
    obj.save(rig, tmp_path / "rig")
    obj.save(rig, tmp_path / "rig")  # again in the same place
    (tmp_path / "rig" / "smile.obj").write_text("v 0 0 0\n")
    with pytest.raises(ReenactError, match=r"holds other \.obj files \(smile\.obj\)"):
        obj.save(rig, tmp_path / "rig")
    with pytest.raises(ReenactError, match="no place for a clip"):
        obj.save(rig, tmp_path / "new", Clip(rig.names, torch.zeros(1, 3), 30.0))
    with pytest.raises(ReenactError, match="cannot be written"):
        obj.save(rig, tmp_path / "missing" / "new")
    assert not (tmp_path / "new").exists()


# What others write ----------------------------------------------------------------------------------------------------

SQUARE = "v 0 0 0\nv 0.2 0 0\nv 0.2 0.2 0\nv 0 0.2 0\nf 1 2 3 4\n"
SMILE = SQUARE.replace("v 0.2 0.2 0", "v 0.2 0.2 0.1")


def folder(tmp_path: Path, neutral: str = SQUARE, smile: str = SMILE, **files: str) -> Path:
    place = tmp_path / "head_of_x"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    for name, text in {"neutral": neutral, "smile": smile, **files}.items():
        name = name.replace("__", ".")
        (place / (name if "." in name else f"{name}.obj")).write_bytes(text.encode())
    return place


def test_polygons_become_fans_and_targets_are_absolute(tmp_path):
    rig = obj.load(folder(tmp_path))
    assert (rig.name, rig.names) == ("head_of_x", ("smile",))
    assert rig.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    np.testing.assert_allclose(rig.deltas[0], [[0, 0, 0], [0, 0, 0], [0, 0, 0.1], [0, 0, 0]], atol=1e-8)
    assert rig.uv is None


@pytest.mark.parametrize(
    "face",
    [
        "f -4 -3 -2 -1",
        "f 1// 2// 3// 4//",
        "f 1//1 2//1 3//1 4//1",
        "f 1 2 3 \\\n 4",
        "f\t1\t2  3 4 # a comment",
        "  f 1 2 3 4",
        "s off\ng a b\nf 1/ 2 3// 4",
    ],
)
def test_faces_may_be_written_in_many_ways(face, tmp_path):
    text = "vn 0 0 1\n" + SQUARE.replace("f 1 2 3 4", face)
    assert obj.load(folder(tmp_path, text, SMILE)).faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_negative_indices_count_back_from_their_line(tmp_path):
    more = "v 1 0 0\nv 1 1 0\nv 0 1 0\nf -3 -2 -1\n"
    rig = obj.load(
        folder(tmp_path, SQUARE.replace("1 2 3 4", "-4 -3 -2 -1") + more, SMILE + more.replace("-3 -2 -1", "5 6 7"))
    )
    assert rig.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6]]


def test_line_ends_byte_order_mark_and_exponents_do_not_matter(tmp_path):
    text = "\ufeff# made elsewhere\r\n" + SQUARE.replace("0.2", "+2.0e-1").replace("\n", "\r\n")
    assert torch.equal(obj.load(folder(tmp_path, text)).neutral, obj.load(folder(tmp_path)).neutral)


def test_uv_split_seams_and_count_from_the_top(tmp_path):
    lines = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 0.75\nvt 0.5 0.5\nf 1/1 2/2 3/3\nf 1/5/1 3/3/1 4/4/1"
    text = SQUARE.replace("f 1 2 3 4", lines)
    rig = obj.load(folder(tmp_path, text, SMILE.replace("f 1 2 3 4", "f 1 2 3\nf 1 3 4")))
    assert len(rig.neutral) == 4
    corners = rig.uv[rig.uv_faces]
    assert corners[0].tolist() == [[0, 1], [1, 1], [1, 0]]
    assert corners[1].tolist() == [[0.5, 0.5], [1, 0], [0, 0.25]]


def test_vertex_colours_follow_the_position(tmp_path):
    lines = [line + (" 1 0.5 0" if line.startswith("v ") else "") for line in SQUARE.splitlines()]
    rig = obj.load(folder(tmp_path, "\n".join(lines)))
    np.testing.assert_allclose(rig.colors, [[1, 0.5, 0]] * 4, atol=1e-6)  # sRGB to linear and back
    lines = [line.replace("1 0.5 0", "255 51 0") for line in lines]
    np.testing.assert_allclose(obj.load(folder(tmp_path, "\n".join(lines))).colors, [[1, 0.2, 0]] * 4, atol=1e-6)


@pytest.mark.parametrize(
    ("size", "unit"), [(1, "m"), (10, "dm"), (100, "cm"), (1000, "mm"), (0.4, "m"), (2.5, "m"), (70, "cm"), (250, "cm")]
)
def test_the_unit_is_guessed_by_the_size_of_the_face(size, unit, tmp_path):
    texts = []
    for text in (SQUARE, SMILE):
        rows = [[float(word) * size for word in line.split()[1:]] for line in text.splitlines()[:4]]
        # All corners of the 20 cm square move; a body hangs below it, which must not count.
        shift = 0.01 * size if text is SMILE else 0
        lines = [f"v {x} {y} {z + shift}" for x, y, z in rows] + [f"v 0 {-1.6 * size} 0"]
        texts.append("\n".join([*lines, "f 1 2 3 4", "f 1 2 5"]))
    rig, contents = obj.read(folder(tmp_path, *texts))
    assert contents.converted[0].startswith(f"no unit in OBJ: taken as {unit}, its face is then")
    np.testing.assert_allclose(rig.neutral[1, 0], 0.2 * size * obj.UNITS[unit], rtol=1e-6)


def test_the_unit_can_be_said(tmp_path):
    assert float(obj.load(folder(tmp_path), unit="cm").neutral.max()) == pytest.approx(0.002)
    with pytest.raises(ReenactError, match="expected a unit among m, dm, cm, mm, in, got foot"):
        obj.read(folder(tmp_path), unit="foot")


def test_a_jaw_that_opens_along_z_says_that_z_is_up(tmp_path):
    jaw = SQUARE.replace("v 0 0 0", "v 0 0.01 -0.1")
    rig, contents = obj.read(folder(tmp_path, jawOpen=jaw))
    assert "jawOpen moves along -Z: +Z up made +Y up" in contents.converted
    np.testing.assert_allclose(rig.deltas[rig.names.index("jawOpen"), 0], [0, -0.1, -0.01], atol=1e-8)
    upright = SQUARE.replace("v 0 0 0", "v 0 -0.1 -0.05")
    assert not any("up" in line for line in obj.read(folder(tmp_path, jawOpen=upright))[1].converted)


@pytest.mark.parametrize("name", ["neutral", "Base", "basis", "REST", "generic_neutral_mesh", "head_of_x"])
def test_the_neutral_is_guessed_by_its_name(name, tmp_path):
    place = folder(tmp_path)
    (place / "neutral.obj").rename(place / f"{name}.obj")
    assert obj.load(place).names == ("smile",)


def test_the_neutral_can_be_said_and_is_asked_for(tmp_path):
    place = folder(tmp_path, frown=SQUARE)
    (place / "neutral.obj").rename(place / "start.obj")
    with pytest.raises(ReenactError, match=r"which file is the neutral\? .*among frown, smile, start"):
        obj.load(place)
    assert obj.load(place / "start.obj").names == ("frown", "smile")
    assert obj.load(place, neutral="start").names == ("frown", "smile")
    assert obj.load(place, neutral="smile.obj").names == ("frown", "start")
    with pytest.raises(ReenactError, match="expected nose among"):
        obj.load(place, neutral="nose")


def test_shapes_come_in_natural_order_and_can_be_chosen(tmp_path):
    place = folder(tmp_path, shape10=SMILE, shape9=SMILE, Shape1=SMILE)
    assert obj.load(place).names == ("Shape1", "shape9", "shape10", "smile")
    (place / "smile.obj").write_text("damaged")
    assert obj.load(place, Choice(shapes=("shape1*",))).names == ("Shape1", "shape10")
    with pytest.raises(ReenactError, match=r"no shape is called \*grin"):
        obj.load(place, Choice(shapes=("*grin",)))


TWO = "o Head\nv 0 0 0\nv 0.2 0 0\nv 0.2 0.2 0\nf 1 2 3\no Upper_Teeth\nv 0 0 0.1\nv 0.1 0 0.1\nv 0 0.1 0.1\nf 4 5 6\n"


def test_objects_are_meshes_that_can_be_chosen(tmp_path):
    place = folder(tmp_path, TWO, TWO.replace("v 0.2 0 0", "v 0.2 0 0.1"))
    rig = obj.load(place)
    assert [PARTS[part] for part in rig.parts] == ["skin"] * 3 + ["teeth"] * 3
    assert len(obj.load(place, Choice(parts=("head",))).neutral) == 3


def test_objects_that_share_vertices_stay_one_mesh_in_the_order_of_the_file(tmp_path):
    text = TWO.replace("f 4 5 6", "f 6 5 1")
    rig = obj.load(folder(tmp_path, text, text.replace("v 0.2 0 0", "v 0.2 0 0.1")))
    assert rig.faces.tolist() == [[0, 1, 2], [5, 4, 0]]


def test_groups_and_materials_name_parts(tmp_path):
    text = SQUARE.replace("f 1 2 3 4", "g tongue\nf 1 2 3\ng\nusemtl eye_white\nf 1 3 4")
    rig = obj.load(folder(tmp_path, text, SMILE.replace("f 1 2 3 4", "f 1 2 3\nf 1 3 4")))
    assert [PARTS[part] for part in rig.parts] == ["tongue", "tongue", "tongue", "eyes"]


def png(color) -> bytes:
    packed = io.BytesIO()
    Image.new("RGB", (2, 2), color).save(packed, "PNG")
    return packed.getvalue()


def painted(tmp_path: Path, library: str, name: str = "skin.mtl") -> Path:
    text = f"mtllib {name}\nusemtl skin\n" + SQUARE.replace("f 1 2 3 4", "vt 0 0\nvt 1 0\nvt 1 1\nf 1/1 2/2 3/3 4/1")
    return folder(tmp_path, text, **{name.replace(".", "__"): library} if "/" not in name else {})


def test_colours_and_pictures_are_those_of_the_library(tmp_path):
    rig = obj.load(painted(tmp_path, "newmtl skin\nKd 0.5 0.25 1\nillum 2\n"))
    # 0.5 linear is 0.7354 in sRGB, 0.25 is 0.5371.
    np.testing.assert_allclose(rig.colors, [[0.7354, 0.5371, 1.0]] * 4, atol=1e-4)
    place = painted(tmp_path, "newmtl skin\nKd 0.8 0.8 0.8\nmap_Kd -o 0 0 0 -clamp on maps\\red 1.png\n")
    (place / "maps").mkdir()
    (place / "maps" / "red 1.png").write_bytes(png((255, 0, 0)))
    rig = obj.load(place)
    assert rig.texture[0, 0].tolist() == [1, 0, 0]
    assert rig.colors is None


def test_a_see_through_material_is_left_out(tmp_path):
    text = "mtllib a.mtl\n" + SQUARE.replace("f 1 2 3 4", "usemtl skin\nf 1 2 3\nusemtl cornea\nf 1 3 4")
    more = {"a__mtl": "newmtl skin\nd 1\nnewmtl cornea\nd 0.1\n"}
    rig = obj.load(folder(tmp_path, text, SMILE.replace("f 1 2 3 4", "f 1 2 3\nf 1 3 4"), **more))
    assert len(rig.faces) == 1


@pytest.mark.parametrize("name", ["../out.png", "/tmp/out.png", "C:\\out.png", "link.png", "http://a.b/out.png"])
def test_a_picture_outside_the_folder_is_left_out_and_said(name, tmp_path):
    place = painted(tmp_path, f"newmtl skin\nmap_Kd {name}\n")
    (tmp_path / "out.png").write_bytes(png((0, 255, 0)))
    (place / "link.png").symlink_to(tmp_path / "out.png")
    rig, contents = obj.read(place)
    assert rig.texture is None
    assert any("not in the file's folder; left out" in line for line in contents.converted)


def test_a_library_outside_the_folder_is_left_out_and_said(tmp_path):
    (tmp_path / "out.mtl").write_text("newmtl skin\nKd 1 0 0\n")
    rig, contents = obj.read(painted(tmp_path, "", "../out.mtl"))
    assert rig.colors is None
    assert "material library ../out.mtl is not in the folder; left out" in contents.converted


# Hostile files --------------------------------------------------------------------------------------------------------

HOSTILE = {
    "no vertices": ("f 1 2 3\n", None, r"neutral\.obj: expected an OBJ file with vertices, got none"),
    "no faces": ("v 0 0 0\n", None, r"neutral\.obj: expected an OBJ file with faces, got none"),
    "two numbers": (SQUARE.replace("v 0.2 0 0", "v 0.2 0"), None, "numbers in line 2 of v, got .0.2 0."),
    "moved number": ("v 0 0 0\nv 0.2 0\nv 0.2 0.2 0 0\nv 0 0.2 0\nf 1 2 3 4\n", None, "in line 2 of v"),
    "text": (SQUARE.replace("0.2 0 0", "0.2 x 0"), None, "in line 2 of v, got '0.2 x 0'"),
    "comma": (SQUARE.replace("0.2 0 0", "0,2 0 0"), None, "in line 2 of v"),
    "NaN": (SQUARE.replace("0.2 0 0", "nan 0 0"), None, "NaN|in line 2"),
    "infinity": (SQUARE.replace("0.2 0 0", "1e999 0 0"), None, "far too large"),
    "index far": (SQUARE.replace("3 4", "3 5"), None, r"face 1 names a vertex outside 1\.\.4"),
    "index back": (SQUARE.replace("f 1", "f -5"), None, r"face 1 names a vertex outside 1\.\.4"),
    "index zero": (SQUARE.replace("f 1", "f 0"), None, "v, v/vt or v/vt/vn in face 1, got '0'"),
    "index huge": (SQUARE.replace("f 1", f"f {10**30}"), None, "in face 1|outside"),
    "index text": (SQUARE.replace("f 1", "f one"), None, "in face 1, got 'one'"),
    "index real": (SQUARE.replace("f 1", "f 1.5"), None, "in face 1, got '1.5'"),
    "index parts": (SQUARE.replace("f 1", "f 1/2/3/4"), None, "in face 1, got '1/2/3/4'"),
    "uv far": (SQUARE.replace("f 1 2 3 4", "vt 0 0\nf 1/1 2/1 3/2 4/1"), None, r"face 1 names a uv outside 1\.\.1"),
    "uv without": (SQUARE.replace("f 1 2 3 4", "f 1/1 2/1 3/1 4/1"), None, r"names a uv outside 1\.\.0"),
    "uv infinite": (SQUARE.replace("f 1 2 3 4", "vt 1e999 0\nf 1/1 2/1 3/1 4/1"), None, "uv hold NaN, infinity"),
    "two corners": (SQUARE.replace("f 1 2 3 4", "f 1 2"), None, "at least 3 corners in face 1, got 'f 1 2'"),
    "fewer vertices": (None, "v 0 0 0\n", r"the 4 vertices and 1 faces of neutral\.obj, got 1 and 0"),
    "fewer faces": (None, SMILE + "f 1 2 3\n", "vertices and 1 faces of neutral.obj, got 4 and 2"),
    "other faces": (SQUARE + "f 1 2 3\n", SMILE + "f 2 3 4\n", r"smile\.obj: its faces join other vertices"),
    "shape text": (None, SMILE.replace("0.1", "high"), r"smile\.obj: expected 3 or 4 .* in line 3 of v"),
    "shape empty": (None, "", r"smile\.obj: expected content"),
    "binary": ("\0\0\0\0", None, r"neutral\.obj: expected an OBJ file, which is text"),
    "colour text": ("mtllib a.mtl\n" + SQUARE, None, r"a\.mtl: expected Kd as 3 numbers, got 'red'"),
    "parts few": ('# reenact {"parts": [["skin", 3]]}\n' + SQUARE, None, "expected parts in the line # reenact"),
    "parts unknown": ('# reenact {"parts": [["hat", 4]]}\n' + SQUARE, None, "expected parts in the line # reenact"),
    "parts nested": ('# reenact {"parts": [[["skin"], 4]]}\n' + SQUARE, None, "expected parts in the line # reenact"),
    "parts huge": ('# reenact {"parts": [["skin", 1e400]]}\n' + SQUARE, None, "expected parts in the line # reenact"),
    "names doubled": (
        '# reenact {"shapes": [["smile", "a"], ["frown", "a"]]}\n' + SQUARE, None, "shapes must differ, doubled: a"
    ),
}  # fmt: skip


@pytest.mark.parametrize(("neutral", "smile", "message"), HOSTILE.values(), ids=HOSTILE)
def test_a_file_that_lies_is_refused_by_file_and_line(neutral, smile, message, tmp_path):
    place = folder(tmp_path, neutral if neutral is not None else SQUARE, smile if smile is not None else SMILE)
    (place / "a.mtl").write_text("newmtl skin\nKd red\n")
    if "doubled" in message:
        shutil.copy(place / "smile.obj", place / "frown.obj")
    with pytest.raises(ReenactError, match=message) as caught:
        obj.load(place)
    assert str(caught.value).startswith(str(place))


@pytest.mark.parametrize("line", ["{", "[1]", '{"name": 7, "shapes": "x"}', '{"shapes": [[1, 2], "a"]}', "[" * 100_000])
def test_a_damaged_line_of_ours_is_a_comment(line, tmp_path):
    assert obj.load(folder(tmp_path, f"# reenact {line}\n{SQUARE}")).names == ("smile",)


def test_folders_that_are_none_are_refused(tmp_path):
    with pytest.raises(ReenactError, match=r"expected a folder of \.obj files, found nothing"):
        obj.load(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ReenactError, match="one neutral and one per shape, got none"):
        obj.load(tmp_path / "empty")
    (tmp_path / "empty" / "neutral.obj").write_text(SQUARE)
    with pytest.raises(ReenactError, match=r"expected one \.obj per shape beside neutral\.obj, got none"):
        obj.load(tmp_path / "empty")
    with pytest.raises(ReenactError, match=r"expected a folder of \.obj files"):
        obj.load(Path("a\0b"))


def test_a_folder_of_too_many_files_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(obj, "FILES", 1)
    with pytest.raises(ReenactError, match=r"at most 1 \.obj files, got 2"):
        obj.load(folder(tmp_path))


def test_two_files_of_one_name_are_refused(tmp_path):
    place = folder(tmp_path)
    (place / "smile.OBJ").write_text(SMILE)
    with pytest.raises(ReenactError, match=r"two \.obj files have the same name"):
        obj.load(place)


def test_a_picture_bomb_is_refused(tmp_path, monkeypatch):
    obj.save(make_random_rig(7), tmp_path / "rig")
    monkeypatch.setattr(pictures, "PIXELS", 4)
    with pytest.raises(
        ReenactError, match=r"neutral_texture\.png: expected a picture of at most 4 pixels, got \(8, 6\)"
    ):
        obj.load(tmp_path / "rig")


def test_2000_mutated_folders_load_or_are_refused(tmp_path):
    obj.save(make_random_rig(7), tmp_path / "ours")
    shutil.copytree(FIXTURE, tmp_path / "theirs")
    rng = np.random.default_rng(19)
    refused, start = 0, time.perf_counter()
    for round_ in range(2000):
        place = tmp_path / ("ours", "theirs")[round_ % 2]
        files = sorted(path for path in place.iterdir() if path.suffix in (".obj", ".mtl"))
        target = place / "neutral.obj" if round_ % 3 == 0 else files[rng.integers(len(files))]
        whole = target.read_bytes()
        data = bytearray(whole)
        for byte in rng.integers(0, len(data), rng.integers(1, 6)):
            data[byte] = rng.integers(256) if round_ % 4 else rng.choice(list(b"0123456789-+.eE/ \n#vfgo"))
        target.write_bytes(bytes(data[: rng.integers(1, len(data))] if round_ % 10 == 0 else data))
        try:
            obj.load(place)
        except ReenactError:
            refused += 1
        target.write_bytes(whole)
    assert 500 < refused < 1999
    assert time.perf_counter() - start < 200  # a tenth of a second each; it takes 2 ms


def test_a_large_face_loads_in_seconds(tmp_path):
    """26,000 vertices and 53 shapes take 8 s; this is a fifth of them."""
    side, shapes = 161, 11
    across, up = np.meshgrid(np.linspace(-0.1, 0.1, side), np.linspace(-0.1, 0.1, side))
    corner = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).reshape(-1)
    faces = np.stack([corner, corner + 1, corner + side + 1], 1)
    neutral = torch.tensor(np.stack([across, up, 0 * up], 2).reshape(-1, 3), dtype=torch.float32)
    deltas = torch.rand(shapes, side * side, 3, generator=torch.Generator().manual_seed(0)) / 100
    rig = Rig("large", neutral, deltas, tuple(f"shape {index}" for index in range(shapes)), torch.tensor(faces))
    obj.save(rig, tmp_path / "large")
    start = time.perf_counter()
    again = obj.load(tmp_path / "large")
    assert time.perf_counter() - start < 15
    torch.testing.assert_close(again.deltas, deltas, rtol=0, atol=1e-9)
