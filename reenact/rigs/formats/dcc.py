"""Clips as Python scripts that key them in Blender and Maya: the way into both without a plug-in.

A script holds the weights as text and needs nothing but the program that runs it. It finds the shapes by the clip's
names and the other spellings of ARKit's (`matching`), says what it found, and may be run again. The names of a clip are
from anywhere: they enter the code as escaped ASCII literals, and nothing else of them does.

The Blender script was run in Blender 4.2, 4.5 and 5.0. The Maya script was never run in Maya: each call agrees with the
signatures of `maya.cmds` that Autodesk documents (mypy with types-maya 0.6.1), and a stand-in records what it does.
"""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np

from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.formats import disk
from reenact.rigs.matching import matching

MAYA_UNITS = {15: "game", 24: "film", 25: "pal", 30: "ntsc", 48: "show", 50: "palf", 60: "ntscf"}
"""Maya's names of whole frame rates; it calls all others `29.97fps`."""


def save_blender(clip: Clip, path: Path) -> None:
    """Writes a script for Blender's text editor that keys the clip on shape keys.

    It keys the selected objects, or all where no selected one has a shape of the clip, from frame 1 on at the clip's
    rate, which becomes the scene's. Curves of the shapes it keys are replaced, other animation stays.

    Raises:
        ReenactError: The file cannot be written.
    """
    rate = min(max(round(clip.fps), 1), 32767)  # Blender: a whole number over a base
    settings = [f"FPS, FPS_BASE = {rate}, {rate / clip.fps!r}  # {clip.fps:.6g} frames per second"]
    disk.write_bytes(path, _script(clip, path, settings, _BLENDER))


def save_maya(clip: Clip, path: Path) -> None:
    """Writes a script for Maya's script editor that keys the clip on the weights of blendShape nodes.

    It keys the blendShape nodes of what is selected, or all where none of those has a shape of the clip, from frame 1
    on in the clip's time unit, which becomes the scene's. Where Maya has no such unit, keys lie at their seconds.

    Raises:
        ReenactError: The file cannot be written.
    """
    rate = next((known for known in (23.976, 29.97, 47.952, 59.94) if abs(clip.fps - known) < 1e-3), clip.fps)
    unit = MAYA_UNITS.get(rate, f"{rate:.10g}fps")
    disk.write_bytes(path, _script(clip, path, [f"FPS, UNIT = {clip.fps!r}, {unit!r}"], _MAYA))


def _script(clip: Clip, path: Path, settings: list[str], code: tuple[str, str]) -> bytes:
    """The start of the code, the data, the rest of the code."""
    columns = clip.weights.detach().cpu().numpy().astype(np.float32).T  # (K, T)
    lines = [
        code[0].strip(),
        "",
        *settings,
        "START = 1  # frame of the first key",
        f"CLIP = {path.stem.removesuffix('.maya')!a}",
        "",
        "# Weights of each shape, frame by frame; a single number is for all frames.",
        f"FRAMES = {len(clip)}",
        "WEIGHTS = {",
        *(f"    {name!a}: {_numbers(column)}," for name, column in zip(clip.names, columns)),
        "}",
        "",
        "# Other spellings of the shapes, without case and separators, and how much they take of which weights.",
        "ALIASES = {",
        *(f"    {spelling!a}: {shares}," for spelling, shares in _aliases(clip.names).items()),
        "}",
        "",
        "",
        code[1].strip(),
        "",
    ]
    return "\n".join(lines).encode("ascii")


def _numbers(column: np.ndarray) -> str:
    """The weights as a string literal, each in the fewest digits that are the same float32."""
    shortest = [str(value).removesuffix(".0") for value in column]
    if len(set(shortest)) == 1:
        return f'"{shortest[0]}"'
    wrapped = textwrap.fill(" ".join(shortest), 112, break_on_hyphens=False, break_long_words=False)
    return '"""\n' + textwrap.indent(wrapped, " " * 8) + '\n    """' if "\n" in wrapped else f'"{wrapped}"'


def _aliases(names: tuple[str, ...]) -> dict[str, str]:
    """Literals of how much a shape takes of the clip's, by every spelling of an ARKit shape that takes any."""
    spellings = tuple(arkit._SPELLINGS)
    unlike = [f"|{spelling}" for spelling in spellings]  # a name of the clip's own is not meant by it alone
    aliases = {}
    for spelling, shares in zip(spellings, matching(names, unlike).T.numpy()):
        taken = np.flatnonzero(shares)
        if len(taken):
            aliases[spelling] = f"{{{', '.join(f'{names[index]!a}: {shares[index]}' for index in taken)}}}"
    return aliases


_MATCHING = '''
def shares_for(shape):
    """How much a shape takes of which weights; nothing if it is not in the clip."""
    if shape in WEIGHTS:
        return {shape: 1.0}
    for spelling in (shape, re.split("[.:|]", shape)[-1]):
        shares = ALIASES.get(re.sub("[^a-z0-9]", "", spelling.lower()))
        if shares:
            return shares
    return {}


def mixed(shares):
    """A weight for each frame."""
    total = [0.0] * FRAMES
    for name, share in shares.items():
        row = [float(number) for number in WEIGHTS[name].split()]
        total = [before + share * weight for before, weight in zip(total, row * FRAMES if len(row) == 1 else row)]
    return total


def listed(names):
    names = list(names)
    return ", ".join(names[:60]) + (", and {} more".format(len(names) - 60) if len(names) > 60 else "")
'''

_BLENDER = (
    '''
"""Keys a clip of blendshape weights on shape keys. Written by Reenact.

In Blender: open this file in the text editor (Scripting workspace) and press Run. Select objects first to key only
those; otherwise all objects that have the shapes are keyed. Running it again replaces the keys. What it did is printed
to the system console.
"""

import re

import bpy
''',
    _MATCHING
    + '''

def curves_of(key):
    """F-curves that move the shape keys; in a new action where there is none."""
    animation = key.animation_data or key.animation_data_create()
    if animation.action is None or animation.action.library is not None:
        animation.action = bpy.data.actions.new(CLIP)
    action = animation.action
    if not hasattr(action, "slots"):  # before Blender 4.4
        return action.fcurves
    if animation.action_slot is None:
        animation.action_slot = action.slots.new(id_type="KEY", name=key.name)
    layer = action.layers[0] if action.layers else action.layers.new("Layer")
    strip = layer.strips[0] if layer.strips else layer.strips.new(type="KEYFRAME")
    return strip.channelbag(animation.action_slot, ensure=True).fcurves


def key_shape(curves, block, values):
    """Linear keys on every frame."""
    path = block.path_from_id("value")
    before = curves.find(path)
    if before is not None:
        curves.remove(before)
    curve = curves.new(path)
    curve.keyframe_points.add(len(values))
    places = [number for frame, value in enumerate(values, START) for number in (frame, value)]
    curve.keyframe_points.foreach_set("co", places)
    curve.keyframe_points.foreach_set("interpolation", [1] * len(values))
    curve.update()
    # Beyond its slider a shape key stops.
    block.slider_min = min(block.slider_min, *values, 0.0)
    block.slider_max = max(block.slider_max, *values, 0.0)


def shapes_in(things):
    """Shape key blocks of the clip, by the data that holds them; objects that share a mesh share it."""
    found = {}
    for thing in things:
        key = getattr(thing.data, "shape_keys", None)
        if key is not None and key not in found:
            blocks = [block for block in key.key_blocks if block != key.reference_key and shares_for(block.name)]
            if blocks:
                found[key] = (thing.name, blocks)
    return found


def main():
    scene = bpy.context.scene
    things = list(bpy.context.view_layer.objects)
    found = shapes_in([thing for thing in things if thing.select_get()]) or shapes_in(things)
    if not found:
        raise RuntimeError("{}: no object has a shape key named like {}".format(CLIP, listed(list(WEIGHTS)[:5])))
    scene.render.fps, scene.render.fps_base = FPS, FPS_BASE
    scene.frame_end = max(scene.frame_end, START + FRAMES - 1)
    used = set()
    for key, (name, blocks) in found.items():
        driven = {curve.data_path for curve in key.animation_data.drivers} if key.animation_data else set()
        curves = curves_of(key)
        for block in blocks:
            shares = shares_for(block.name)
            key_shape(curves, block, mixed(shares))
            used.update(shares)
        print("{}: {} of {} shape keys keyed".format(name, len(blocks), len(key.key_blocks) - 1))
        still = [block.name for block in key.key_blocks if block != key.reference_key and block not in blocks]
        if still:
            print("    not in the clip: " + listed(still))
        stuck = [block.name for block in blocks if block.path_from_id("value") in driven]
        if stuck:
            print("    driven, keys have no effect until the drivers are removed: " + listed(stuck))
    unused = [name for name in WEIGHTS if name not in used]
    print("{}: frames {} to {} keyed on {} objects".format(CLIP, START, START + FRAMES - 1, len(found)))
    if unused:
        print("    weights that no shape key takes: " + listed(unused))
    scene.frame_set(scene.frame_current)


main()
''',
)

_MAYA = (
    '''
"""Keys a clip of blendshape weights on blendShape nodes. Written by Reenact.

In Maya: open this file in the script editor's Python tab and run it. Select meshes or blendShape nodes first to key
only those; otherwise all blendShape nodes that have the shapes are keyed. Running it again replaces the keys.
"""

import re

from maya import cmds
''',
    _MATCHING
    + '''

def find_shares(shape):
    """As shares_for; Maya's names have only letters, digits and underscores."""
    plain = [name for name in WEIGHTS if re.sub("[^A-Za-z0-9_]", "_", name) == shape]
    return shares_for(shape) or {name: 1.0 for name in plain[:1]}


def shapes_in(nodes):
    """(node, shape) of the clip's shapes, and those that the clip lacks."""
    found, still = [], []
    for node in nodes:
        for shape in cmds.listAttr(node + ".w", multi=True) or []:
            (found if find_shares(shape) else still).append((node, shape))
    return found, still


def key_times():
    """Times of the keys: frames where Maya has the clip's unit of time, else seconds."""
    try:
        cmds.currentUnit(time=UNIT)
    except RuntimeError:
        print("{}: Maya has no time unit {}; keys are placed by seconds, between frames".format(CLIP, UNIT))
        return ["{:.9f}sec".format(frame / FPS) for frame in range(FRAMES)]
    last = START + FRAMES - 1
    cmds.playbackOptions(maxTime=max(cmds.playbackOptions(query=True, maxTime=True), last))
    cmds.playbackOptions(animationEndTime=max(cmds.playbackOptions(query=True, animationEndTime=True), last))
    return list(range(START, START + FRAMES))


def key_shape(plug, times, values):
    """Linear keys at the times; False where the plug takes none."""
    try:
        cmds.cutKey(plug, clear=True)
        keyed = [
            cmds.setKeyframe(plug, time=time, value=value, inTangentType="linear", outTangentType="linear")
            for time, value in zip(times, values)
        ]
        return all(keyed)
    except RuntimeError:
        return False


def main():
    selected = cmds.ls(selection=True) or []
    history = (cmds.listHistory(selected) or []) if selected else []
    found, still = shapes_in(sorted(set(cmds.ls(history, type="blendShape") or [])) if history else [])
    if not found:
        found, still = shapes_in(cmds.ls(type="blendShape") or [])
    if not found:
        raise RuntimeError("{}: no blendShape node has a shape named like {}".format(CLIP, listed(list(WEIGHTS)[:5])))
    cmds.undoInfo(openChunk=True, chunkName="Reenact clip")
    cmds.refresh(suspend=True)
    try:
        times = key_times()
        used, stuck = set(), []
        for node, shape in found:
            shares = find_shares(shape)
            used.update(shares)
            if not key_shape(node + "." + shape, times, mixed(shares)):
                stuck.append(node + "." + shape)
    finally:
        cmds.refresh(suspend=False)
        cmds.undoInfo(closeChunk=True)
    print("{}: {} frames keyed on {} shapes".format(CLIP, FRAMES, len(found) - len(stuck)))
    unused = [name for name in WEIGHTS if name not in used]
    if stuck:
        print("    locked or driven, not keyed: " + listed(stuck))
    if still:
        print("    not in the clip: " + listed(node + "." + shape for node, shape in still))
    if unused:
        print("    weights that no shape takes: " + listed(unused))


main()
''',
)
