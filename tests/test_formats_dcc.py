"""Scripts that key a clip in Blender and Maya.

The Maya script is run against a stand-in with the calls that it makes. The Blender script is run where REENACT_BPY
names Python interpreters that have Blender's `bpy`, as in REENACT_BPY=/tmp/a/bin/python:/tmp/b/bin/python.
"""

import ast
import json
import os
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
import torch

from reenact.errors import ReenactError
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.formats import dcc
from reenact.rigs.matching import matching

FIXTURES = Path(__file__).parent / "fixtures"
DATA = ("FPS", "FPS_BASE", "UNIT", "START", "CLIP", "FRAMES", "WEIGHTS", "ALIASES")
SAVE = {"blender": dcc.save_blender, "maya": dcc.save_maya}
HOSTILE = (
    '"""\nimport os\nos.abort()\n"""',
    "'); __import__('os').abort(); ('",
    "a\\",
    "{0}%s\r\n\t\x00\x1b",
    "ünïcode 口 👩 \u2028\u202e",
    "# coding: utf-7",
    "} ",
    "jawOpen",
)


def make_clip(names=("jawOpen", "eyeBlink_L", "EyeBlinkRight", "browInnerUp", "smirk"), frames=7, seed=0, fps=30.0):
    weights = torch.rand(frames, len(names), generator=torch.Generator().manual_seed(seed))
    weights[:, 0] = 0.25
    return Clip(tuple(names), weights, fps)


def parts(path: Path) -> tuple[dict, str]:
    """The data of a script, read without running it, and what else it is."""
    tree = ast.parse(path.read_bytes())
    values, rest = {}, []
    for statement in tree.body:
        targets = statement.targets[0] if isinstance(statement, ast.Assign) else None
        names = [target.id for target in getattr(targets, "elts", [targets])] if targets is not None else []
        if names and set(names) <= set(DATA):
            value = ast.literal_eval(statement.value)
            values.update(zip(names, value) if len(names) > 1 else [(names[0], value)])
        else:
            rest.append(ast.dump(statement))
    return values, "\n".join(rest)


def weights_in(values: dict) -> np.ndarray:
    rows = [[float(number) for number in text.split()] for text in values["WEIGHTS"].values()]
    return np.array([row * values["FRAMES"] if len(row) == 1 else row for row in rows]).T


@pytest.mark.parametrize("program", SAVE)
@pytest.mark.parametrize("seed", range(20))
def test_a_script_holds_the_names_and_weights_exactly(seed, program, tmp_path):
    rng = np.random.default_rng(seed)
    weights = rng.normal(0.3, 1, (rng.integers(1, 200), 6)) ** rng.integers(1, 12)
    weights[:, rng.integers(0, 6)] = rng.choice([0, 1, -0.0, 1e-30])
    clip = Clip(("a", *HOSTILE[:5]), torch.tensor(weights, dtype=torch.float32), 30.0)
    SAVE[program](clip, tmp_path / "take.py")
    values, _ = parts(tmp_path / "take.py")
    assert tuple(values["WEIGHTS"]) == clip.names
    assert np.array_equal(weights_in(values).astype(np.float32), clip.weights.numpy())


@pytest.mark.parametrize("program", SAVE)
def test_names_of_shapes_and_files_never_become_code(program, tmp_path):
    SAVE[program](make_clip(), tmp_path / "plain.py")
    _, plain = parts(tmp_path / "plain.py")
    for stem in ("x", "'''+__import__('os').abort()+'''", 'a"\\'):
        SAVE[program](make_clip(HOSTILE), tmp_path / f"{stem}.py")
        data = (tmp_path / f"{stem}.py").read_bytes()
        assert data.isascii()
        values, code = parts(tmp_path / f"{stem}.py")
        assert code == plain
        assert (values["CLIP"], tuple(values["WEIGHTS"])) == (stem, HOSTILE)


@pytest.mark.parametrize("program", SAVE)
def test_a_script_says_what_it_is_and_its_lines_fit_an_editor(program, tmp_path):
    SAVE[program](make_clip(frames=500), tmp_path / "take.py")
    lines = (tmp_path / "take.py").read_text().splitlines()
    assert lines[0].startswith('"""Keys a clip of blendshape weights on ')
    assert max(map(len, lines)) <= 120


@pytest.mark.parametrize(("fps", "rate"), [(30, 30), (24, 24), (29.97, 30), (30000 / 1001, 30), (12.5, 12), (0.25, 1)])
def test_blender_counts_frames_at_a_whole_rate_over_a_base(fps, rate, tmp_path):
    dcc.save_blender(make_clip(fps=float(fps)), tmp_path / "take.py")
    values, _ = parts(tmp_path / "take.py")
    assert values["FPS"] == rate
    assert values["FPS"] / values["FPS_BASE"] == pytest.approx(fps, rel=1e-12)


UNITS = {30.0: "ntsc", 24.0: "film", 60.0: "ntscf", 25.0: "pal", 120.0: "120fps", 30000 / 1001: "29.97fps"}
UNITS |= {24000 / 1001: "23.976fps", 59.94: "59.94fps", 12.5: "12.5fps"}


@pytest.mark.parametrize(("fps", "unit"), UNITS.items())
def test_maya_has_names_for_its_rates(fps, unit, tmp_path):
    dcc.save_maya(make_clip(fps=fps), tmp_path / "take.maya.py")
    values, _ = parts(tmp_path / "take.maya.py")
    assert (values["UNIT"], values["CLIP"]) == (unit, "take")


def test_a_folder_that_is_missing_is_named(tmp_path):
    for save in SAVE.values():
        with pytest.raises(ReenactError, match="cannot be written"):
            save(make_clip(), tmp_path / "none" / "take.py")


# Maya ---------------------------------------------------------------------------------------------------------------


class Cmds(types.ModuleType):
    """What of maya.cmds the script calls, on a scene of blendShape nodes; keys are kept by plug and time."""

    def __init__(self, nodes: dict[str, list[str]], selected=(), units=("film", "ntsc", "pal"), locked=()):
        super().__init__("maya.cmds")
        self.nodes, self.selected, self.units, self.locked = nodes, list(selected), units, locked
        self.keys, self.unit, self.open, self.paused = {}, "film", 0, False
        self.range = {"maxTime": 5.0, "animationEndTime": 200.0}

    def ls(self, names=None, selection=False, type=None):
        found = self.selected if selection else list(self.nodes) if names is None else names
        return [name for name in found if type is None or name in self.nodes]

    def listHistory(self, names):
        return [node for name in names for node in (name, f"{name}_blendShape", f"{name}_skinCluster")]

    def listAttr(self, plug, multi=False):
        assert multi
        return self.nodes[plug.removesuffix(".w")] or None

    def currentUnit(self, time):
        if time not in self.units:
            raise RuntimeError("Invalid time unit")
        self.unit = time

    def playbackOptions(self, query=False, **limits):
        if query:
            return self.range[next(iter(limits))]
        self.range.update(limits)
        return None

    def cutKey(self, plug, clear):
        assert clear
        return len(self.keys.pop(plug, {}))

    def setKeyframe(self, plug, time, value, inTangentType, outTangentType):
        node, shape = plug.split(".")
        assert shape in self.nodes[node]
        assert inTangentType == outTangentType == "linear"
        assert self.open
        if plug in self.locked:
            raise RuntimeError("locked")
        self.keys.setdefault(plug, {})[time] = value
        return 1

    def undoInfo(self, openChunk=False, closeChunk=False, chunkName=None):
        self.open += openChunk - closeChunk

    def refresh(self, suspend):
        self.paused = suspend


def run_maya(clip: Clip, cmds: Cmds, monkeypatch, tmp_path) -> None:
    dcc.save_maya(clip, tmp_path / "take.maya.py")
    maya = types.ModuleType("maya")
    maya.cmds = cmds
    monkeypatch.setitem(sys.modules, "maya", maya)
    monkeypatch.setitem(sys.modules, "maya.cmds", cmds)
    exec(compile((tmp_path / "take.maya.py").read_bytes(), "take.maya.py", "exec"), {"__name__": "__main__"})
    assert (cmds.open, cmds.paused) == (0, False)


FACE = {"Face_blendShape": ["jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "wink"], "ns:Teeth": ["JawOpen"], "Empty": []}


def test_maya_keys_every_frame_by_any_spelling_and_twice_is_once(monkeypatch, tmp_path, capsys):
    clip, cmds = make_clip(fps=30.0), Cmds(FACE)
    for _ in range(2):
        run_maya(clip, cmds, monkeypatch, tmp_path)
        expected = {
            "Face_blendShape.jawOpen": clip.weights[:, 0],
            "Face_blendShape.eyeBlinkLeft": clip.weights[:, 1],
            "Face_blendShape.eyeBlinkRight": clip.weights[:, 2],
            "ns:Teeth.JawOpen": clip.weights[:, 0],
        }
        assert {plug: list(keys) for plug, keys in cmds.keys.items()} == {key: [*range(1, 8)] for key in expected}
        for plug, keys in cmds.keys.items():
            assert np.array_equal(np.float32(list(keys.values())), expected[plug].numpy())
        assert (cmds.unit, cmds.range) == ("ntsc", {"maxTime": 7, "animationEndTime": 200.0})
        printed = capsys.readouterr().out
        assert "take: 7 frames keyed on 4 shapes" in printed
        assert "not in the clip: Face_blendShape.wink" in printed
        assert "weights that no shape takes: browInnerUp, smirk" in printed


def test_maya_keys_only_what_is_selected_if_that_has_the_shapes(monkeypatch, tmp_path):
    nodes = FACE | {"Other_blendShape": ["jawOpen"], "Hat_blendShape": ["brim"]}
    for selected, expected in ((["Other"], {"Other_blendShape.jawOpen"}), (["ns:Teeth"], {"ns:Teeth.JawOpen"})):
        cmds = Cmds(nodes, selected)
        run_maya(make_clip(), cmds, monkeypatch, tmp_path)
        assert set(cmds.keys) == expected
    cmds = Cmds(nodes, ["Hat"])
    run_maya(make_clip(), cmds, monkeypatch, tmp_path)
    assert len(cmds.keys) == 5


def test_maya_places_keys_by_seconds_where_it_lacks_the_unit(monkeypatch, tmp_path, capsys):
    cmds = Cmds(FACE)
    run_maya(make_clip(frames=3, fps=12.5), cmds, monkeypatch, tmp_path)
    assert list(cmds.keys["ns:Teeth.JawOpen"]) == ["0.000000000sec", "0.080000000sec", "0.160000000sec"]
    assert cmds.unit == "film"
    assert "no time unit 12.5fps" in capsys.readouterr().out


def test_maya_leaves_what_is_locked_and_says_so(monkeypatch, tmp_path, capsys):
    cmds = Cmds(FACE, locked=["Face_blendShape.jawOpen"])
    run_maya(make_clip(), cmds, monkeypatch, tmp_path)
    printed = capsys.readouterr().out
    assert "keyed on 3 shapes" in printed
    assert "locked or driven, not keyed: Face_blendShape.jawOpen" in printed


def test_maya_names_that_had_to_be_spelt_otherwise_are_found(monkeypatch, tmp_path):
    cmds = Cmds({"b": ["口_L", "mouth_open_1_", "____"]})
    run_maya(make_clip(("x", "mouth open(1)"), frames=2), cmds, monkeypatch, tmp_path)
    assert set(cmds.keys) == {"b.mouth_open_1_"}


@pytest.mark.parametrize("nodes", [{}, {"Hat": ["brim"]}])
def test_maya_without_the_shapes_is_told(nodes, monkeypatch, tmp_path):
    with pytest.raises(RuntimeError, match="take: no blendShape node has a shape named like jawOpen, eyeBlink_L"):
        run_maya(make_clip(), Cmds(nodes), monkeypatch, tmp_path)


def test_scripts_mix_split_and_merged_shapes_as_conversion_does(monkeypatch, tmp_path):
    rng = np.random.default_rng(5)
    spellings = [
        *arkit.NAMES,
        *arkit._SPELLINGS,
        "Face.eyeBlink_L",
        "a|BROW_INNER_UP",
        "browInnerUp_L",
        "eyeBlink",
        "hat",
    ]
    for seed in range(20):
        given = tuple(dict.fromkeys(rng.choice(spellings, 30).tolist()))
        wanted = tuple(dict.fromkeys(rng.choice(spellings, 40).tolist()))
        clip = make_clip(given, frames=3, seed=seed)
        cmds = Cmds({"b": list(wanted)})
        monkeypatch.setattr(
            Cmds, "setKeyframe", lambda self, plug, time, value, **_: self.keys.setdefault(plug, []).append(value) or 1
        )
        run_maya(clip, cmds, monkeypatch, tmp_path)
        expected = clip.weights @ matching(given, wanted)
        for index, name in enumerate(wanted):
            row = cmds.keys.get(f"b.{name}")
            assert (row is None) == bool((matching(given, wanted)[:, index] == 0).all())
            if row is not None:
                np.testing.assert_allclose(row, expected[:, index], atol=1e-7)  # float32


# Blender ------------------------------------------------------------------------------------------------------------

IN_BLENDER = """
import json, sys
import bpy
import numpy as np

def curves(key):
    action = key.animation_data and key.animation_data.action
    if action is None:
        return []
    if not hasattr(action, "slots"):
        return list(action.fcurves)
    bags = [bag for layer in action.layers for strip in layer.strips for bag in strip.channelbags]
    return [curve for bag in bags if bag.slot == key.animation_data.action_slot for curve in bag.fcurves]

def state(keys):
    out = {}
    for key in keys:
        for curve in curves(key):
            flat = np.empty(2 * len(curve.keyframe_points))
            curve.keyframe_points.foreach_get("co", flat)
            linear = all(point.interpolation == "LINEAR" for point in curve.keyframe_points)
            block = key.path_resolve(curve.data_path.removesuffix(".value"))
            values = []
            for frame in flat[::2]:
                bpy.context.scene.frame_set(int(frame))
                values.append(block.value)
            out.setdefault(key.name, []).append([block.name, flat.reshape(-1, 2).tolist(), values, linear])
    render = bpy.context.scene.render
    return {"keys": out, "fps": render.fps / render.fps_base, "end": bpy.context.scene.frame_end,
            "actions": len(bpy.data.actions)}

def run(path):
    exec(compile(open(path, "rb").read(), path, "exec"), {"__name__": "__main__"})

task = json.load(open(sys.argv[1]))
bpy.ops.wm.read_factory_settings(use_empty=True)
exec(task["scene"])
states = []
for path in task["scripts"]:
    run(path)
    states.append(state(sorted(bpy.data.shape_keys, key=lambda key: key.name)))
json.dump(states, open(sys.argv[2], "w"))
"""

SCENE = """
def add(name, shapes, select=False):
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([(0, 0, 0), (1, 0, 0), (0, 1, 0)], [], [(0, 1, 2)])
    thing = bpy.data.objects.new(name, mesh)
    bpy.context.collection.objects.link(thing)
    for shape in ["Basis", *shapes]:
        thing.shape_key_add(name=shape)
    mesh.shape_keys.name = name
    thing.select_set(select)
    return thing
"""


def run_blender(python: str, scene: str, scripts: list[Path], tmp_path: Path) -> tuple[list[dict], str]:
    (tmp_path / "in.py").write_text(IN_BLENDER)
    task = {"scene": SCENE + scene, "scripts": [str(path) for path in scripts]}
    (tmp_path / "task.json").write_text(json.dumps(task))
    command = [python, str(tmp_path / "in.py"), str(tmp_path / "task.json"), str(tmp_path / "out.json")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, cwd=tmp_path)
    if not (tmp_path / "out.json").exists():
        raise RuntimeError(done.stdout + done.stderr)
    return json.loads((tmp_path / "out.json").read_text()), done.stdout


BLENDERS = [path for path in os.environ.get("REENACT_BPY", "").split(":") if path]
with_blender = pytest.mark.parametrize(
    "python", BLENDERS or [pytest.param("", marks=pytest.mark.skip(reason="REENACT_BPY names no Blender"))]
)


def assert_keyed(state: dict, expected: dict[str, dict[str, np.ndarray]]) -> None:
    assert set(state["keys"]) == set(expected)
    for mesh, shapes in expected.items():
        assert sorted(name for name, *_ in state["keys"][mesh]) == sorted(shapes)
        for name, points, values, linear in state["keys"][mesh]:
            assert linear
            assert [frame for frame, _ in points] == list(range(1, len(points) + 1))
            np.testing.assert_allclose([value for _, value in points], shapes[name], rtol=0, atol=1e-7)
            np.testing.assert_allclose(values, shapes[name], rtol=0, atol=1e-6, err_msg="what the frame shows")


@with_blender
def test_blender_keys_every_frame_by_any_spelling_and_twice_is_once(python, tmp_path):
    clip = make_clip((*HOSTILE, "eyeBlink_L", "EyeBlinkRight", "browInnerUp"), frames=30, fps=30000 / 1001)
    clip.weights[3, :] = 1.5  # beyond a slider
    clip.weights[4, :] = -0.5
    dcc.save_blender(clip, tmp_path / "take.py")
    names = [name for name in HOSTILE if "\0" not in name]  # which Blender cannot hold
    scene = f"add('Face', {[*names, 'eyeBlinkLeft', 'brim']!r})\n"
    scene += "add('Eyes', ['eyeBlink', 'browInnerUp_L'])\nadd('Hat', ['brim'])"
    states, printed = run_blender(python, scene, [tmp_path / "take.py"] * 2, tmp_path)
    of = dict(zip(clip.names, clip.weights.T.numpy()))
    face = {name: of[name] for name in names} | {"eyeBlinkLeft": of["eyeBlink_L"]}
    eyes = {"eyeBlink": (of["eyeBlink_L"] + of["EyeBlinkRight"]) / 2, "browInnerUp_L": of["browInnerUp"]}
    for state in states:
        assert_keyed(state, {"Face": face, "Eyes": eyes})
        assert state["fps"] == pytest.approx(30000 / 1001, rel=1e-6)
    assert states[0] == states[1]
    assert "not in the clip: brim" in printed
    assert "weights that no shape key takes: {0}%s" in printed


@with_blender
def test_blender_keys_what_is_selected_and_leaves_other_curves(python, tmp_path):
    first, second = make_clip(("jawOpen", "wink"), 300), make_clip(("jawOpen",), 5, seed=1)
    dcc.save_blender(first, tmp_path / "first.py")
    dcc.save_blender(second, tmp_path / "second.py")
    scene = """
add('A', ['jawOpen', 'wink'], select=True)
other = add('B', ['jawOpen'])
key = other.data.shape_keys
key.key_blocks['jawOpen'].driver_add('value').driver.expression = '0'
"""
    states, _ = run_blender(python, scene, [tmp_path / "first.py", tmp_path / "second.py"], tmp_path)
    assert_keyed(states[0], {"A": {"jawOpen": first.weights[:, 0], "wink": first.weights[:, 1]}})
    assert_keyed(states[1], {"A": {"jawOpen": second.weights[:, 0], "wink": first.weights[:, 1]}})
    assert [state["end"] for state in states] == [300, 300]
    assert [state["actions"] for state in states] == [1, 1]
    _, printed = run_blender(python, scene.replace(", select=True", ""), [tmp_path / "second.py"], tmp_path)
    assert "driven, keys have no effect until the drivers are removed: jawOpen" in printed


@with_blender
def test_blender_replaces_the_keys_that_came_with_a_file(python, tmp_path):
    truth = np.load(FIXTURES / "truth.npz")
    clip = Clip(tuple(truth["names"].tolist()), torch.rand(20, 6, generator=torch.Generator().manual_seed(2)), 24.0)
    dcc.save_blender(clip, tmp_path / "take.py")
    scene = f"bpy.ops.import_scene.gltf(filepath={str(FIXTURES / 'blender_sparse.glb')!r})"
    scene += "\nfor thing in bpy.data.objects:\n    if thing.type == 'MESH' and thing.data.shape_keys:"
    scene += "\n        thing.data.shape_keys.name = thing.name.split('.')[0]"
    states, _ = run_blender(python, scene, [tmp_path / "take.py"] * 2, tmp_path)
    of = dict(zip(clip.names, clip.weights.T.numpy()))
    teeth, eyes = {"jawOpen": of["jawOpen"]}, {name: of[name] for name in ("eyeBlinkLeft", "eyeBlinkRight")}
    for state in states:
        assert_keyed(state, {"Face": of, "Eyes": eyes, "Teeth": teeth})


@with_blender
def test_blender_without_the_shapes_is_told(python, tmp_path):
    dcc.save_blender(make_clip(), tmp_path / "take.py")
    with pytest.raises(RuntimeError, match="take: no object has a shape key named like jawOpen, eyeBlink_L"):
        run_blender(python, "add('Hat', ['brim'])", [tmp_path / "take.py"], tmp_path)


class Curves(list):
    """F-curves of an action as Blender 4.2 has them."""

    def find(self, path):
        return next((curve for curve in self if curve.path == path), None)

    def new(self, path):
        assert self.find(path) is None
        self.append(Curve(path))
        return self[-1]


class Curve:
    def __init__(self, path):
        self.path, self.updated, self.values, self.keyframe_points = path, False, {}, self

    def add(self, count):
        self.count = count

    def foreach_set(self, field, values):
        assert len(values) == self.count * (2 if field == "co" else 1)
        self.values[field] = values

    def update(self):
        self.updated = True


def fake_blender(objects: dict[str, list[str]]) -> types.SimpleNamespace:
    space = types.SimpleNamespace

    def block(name):
        return space(name=name, slider_min=0.0, slider_max=1.0, path_from_id=lambda field: f"{name}.{field}")

    class Key(space):
        __hash__ = object.__hash__

        def animation_data_create(self):
            self.animation_data = space(action=None, drivers=[])
            return self.animation_data

    things = [space(name="Lamp", data=space(), select_get=lambda: True)]
    for name, shapes in objects.items():
        blocks = [block(shape) for shape in ("Basis", *shapes)]
        key = Key(name=name, key_blocks=blocks, reference_key=blocks[0], animation_data=None)
        things.append(space(name=name, data=space(shape_keys=key), select_get=lambda: False))
    scene = space(render=space(fps=24, fps_base=1.0), frame_end=250, frame_current=1, frame_set=lambda frame: None)
    context = space(scene=scene, view_layer=space(objects=things))
    actions = space(new=lambda name: space(name=name, library=None, fcurves=Curves()))
    return space(context=context, data=space(actions=actions))


def test_blender_before_slots_keys_every_frame_and_twice_is_once(monkeypatch, tmp_path, capsys):
    bpy = fake_blender({"Face": ["jawOpen", "eyeBlinkLeft", "brim"], "Hat": ["brim"]})
    monkeypatch.setitem(sys.modules, "bpy", bpy)
    clip = make_clip(frames=300, fps=30000 / 1001)
    clip.weights[5, 0] = 1.5
    dcc.save_blender(clip, tmp_path / "take.py")
    for _ in range(2):
        exec(compile((tmp_path / "take.py").read_bytes(), "take.py", "exec"), {"__name__": "__main__"})
        _, face, hat = (getattr(thing.data, "shape_keys", None) for thing in bpy.context.view_layer.objects)
        curves = face.animation_data.action.fcurves
        assert hat.animation_data is None
        assert [curve.path for curve in curves] == ["jawOpen.value", "eyeBlinkLeft.value"]
        for curve, weights in zip(curves, clip.weights.T.numpy()):
            assert curve.values["co"][::2] == list(range(1, 301))
            assert np.array_equal(np.float32(curve.values["co"][1::2]), weights)
            assert (curve.values["interpolation"], curve.updated) == ([1] * 300, True)
        assert (bpy.context.scene.render.fps, bpy.context.scene.frame_end) == (30, 300)
        assert [block.slider_max for block in face.key_blocks] == [1, 1.5, 1, 1]
        printed = capsys.readouterr().out
        assert "Face: 2 of 3 shape keys keyed\n    not in the clip: brim" in printed
        assert "weights that no shape key takes: EyeBlinkRight, browInnerUp, smirk" in printed
