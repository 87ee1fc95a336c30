"""What is inside a rig, and what looks wrong with it before hours are spent on it.

Ours. Strengths are in parts of the rig's own face, so that they mean the same for a man, a child and a toon in inches.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from reenact.errors import ReenactError
from reenact.portrait import Portrait, face_lines
from reenact.rigs import arkit
from reenact.rigs.formats.pieces import Contents
from reenact.rigs.rig import PARTS, Rig

ADULT = 0.0717
"""Metres between the eye line and the mouth line of an adult; tells a rig's unit."""

_REGIONS = ((1.22, "brows"), (0.78, "eyes"), (0.32, "nose and cheeks"), (-0.3, "mouth"), (-torch.inf, "jaw"))
"""Lowest height of each region, 0 at the mouth line and 1 at the eye line."""


@dataclass(frozen=True)
class ShapeFacts:
    """One blendshape at weight 1."""

    name: str
    arkit: str
    """The ARKit shape or shapes that the name spells; empty where none."""
    strength: float
    """Largest offset, as a share of the distance from eyes to mouth."""
    moved: float
    """Share of the vertices that move by more than a hundredth of the largest offset."""
    region: str
    side: str
    """"left" or "right" of the person, or "both"."""
    problems: tuple[str, ...]


@dataclass(frozen=True)
class Inspection:
    """What is known about a rig."""

    name: str
    contents: Contents
    vertices: int
    faces: int
    shapes: tuple[ShapeFacts, ...]
    size: tuple[float, float, float]
    """Extent in metres."""
    face: float | None
    """Metres from the eye line to the mouth line; None where they cannot be told apart."""
    parts: tuple[str, ...]
    problems: tuple[str, ...]
    """Of the rig as a whole."""

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)


def inspect(rig: Rig, contents: Contents) -> Inspection:
    """The facts about a rig, and sentences about what looks wrong."""
    problems = []
    try:
        eyes, mouth = face_lines(rig)
        face: float | None = float((eyes - mouth).norm())
        if float(eyes[1] - mouth[1]) < 0.5 * face:
            problems.append("the eyes are not above the mouth: turn the mesh, +Y is up")
    except ReenactError as error:
        eyes, mouth, face = rig.neutral.mean(0), rig.neutral.mean(0), None
        problems.append(str(error).removeprefix(f"{rig.name}: "))
    problems += _unit_problem(face)
    problems += _facing_problem(rig)
    problems += _mesh_problems(rig)
    shapes = _shapes(rig, eyes, mouth, face)
    shapes = _with_twins(rig, _with_partners(rig, shapes))
    spellings: dict[tuple[str, ...], list[str]] = {}
    for name in rig.names:
        if arkit.meaning(name):
            spellings.setdefault((*arkit.meaning(name), str(arkit.sides(name)[1])), []).append(name)
    problems += [f"several names spell one shape: {', '.join(names)}" for names in spellings.values() if len(names) > 1]
    size = rig.neutral.amax(0) - rig.neutral.amin(0)
    present = () if rig.parts is None else tuple(PARTS[index] for index in rig.parts.unique().tolist())
    return Inspection(
        rig.name,
        contents,
        len(rig.neutral),
        len(rig.faces),
        shapes,
        tuple(size.tolist()),
        face,
        present,
        tuple(problems),
    )


def save_sheet(
    rig: Rig, facts: Inspection, path: Path, size: int = 160, tick: Callable[[int], None] = lambda _: None
) -> None:
    """A picture of the neutral and of every shape at 1, with its name, red where something looks wrong.

    Args:
        rig: What `facts` are about.
        facts: From `inspect`.
        path: A .png.
        size: Of each picture, in pixels.
        tick: Called with the number of pictures drawn so far.

    Raises:
        ReenactError: The rig's eyes and mouth cannot be told apart, so that nothing can be framed.
    """
    portrait = Portrait.of(rig)
    names = ["neutral", *rig.names]
    columns = min(len(names), max(4, int(np.ceil(np.sqrt(len(names) * 1.5)))))
    label = max(16, size // 9)
    rows = -(-len(names) // columns)
    sheet = Image.new("RGB", (columns * size, rows * (size + label)), "white")
    pen, font = ImageDraw.Draw(sheet), ImageFont.load_default(0.62 * label)
    wrong = {"neutral": False} | {shape.name: bool(shape.problems) for shape in facts.shapes}
    for start in range(0, len(names), 16):
        weights = torch.zeros(len(names[start : start + 16]), len(rig.names))
        for row in range(len(weights)):
            if start + row:
                weights[row, start + row - 1] = 1
        pictures = portrait.render(rig.vertices(weights), size)["color"]
        for row, pixels in enumerate((pictures.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()):
            down, across = divmod(start + row, columns)
            left, top = across * size, down * (size + label)
            sheet.paste(Image.fromarray(pixels), (left, top + label))
            name = names[start + row]
            text = name
            while len(text) > 4 and pen.textlength(text, font=font) > size - 4:
                text = text[:-2] + "…"
            pen.text(
                (left + 3, top + label / 2), text, fill="#b00020" if wrong[name] else "black", anchor="lm", font=font
            )
        tick(min(start + 16, len(names)))
    sheet.save(path)


# The rig as a whole ---------------------------------------------------------------------------------------------------


def _unit_problem(face: float | None) -> list[str]:
    if face is None or 0.3 * ADULT < face < 3 * ADULT:
        return []
    units = {"millimetres": 0.001, "centimetres": 0.01, "decimetres": 0.1, "inches": 0.0254, "feet": 0.3048}
    near = min(units, key=lambda unit: abs(np.log(face * units[unit] / ADULT)))
    hint = f"; it may be in {near}" if abs(np.log(face * units[near] / ADULT)) < 0.7 else ""
    return [
        f"the face measures {face:.3g} m from eyes to mouth, an adult's {ADULT} m{hint}; pictures are framed anyway"
    ]


def _facing_problem(rig: Rig) -> list[str]:
    """Whether what moves looks along +Z."""
    motion = rig.deltas.norm(dim=-1).amax(0)
    moving = motion > 0.2 * motion.max().clamp_min(1e-12)
    corners = rig.neutral[rig.faces]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    seen = normals[moving[rig.faces].all(1)].sum(0)
    if float(seen.norm()) < 1e-12:
        return []
    axis = int(seen.abs().argmax())
    if axis == 2 and seen[2] > 0:
        return []
    sign = "+" if seen[axis] > 0 else "-"
    return [
        f"what moves looks along {sign}{'XYZ'[axis]}, a face should along +Z: turn the mesh, or its faces are flipped"
    ]


def _mesh_problems(rig: Rig) -> list[str]:
    problems = []
    corners = rig.neutral[rig.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=1)
    flat = int((area <= 1e-10 * float(area.max().clamp_min(1e-30))).sum())
    if flat:
        problems.append(f"{flat} of {len(rig.faces)} faces have no area; they are drawn as nothing")
    around = corners - rig.neutral.mean(0)
    volume = float((around[:, 0] * torch.linalg.cross(around[:, 1], around[:, 2])).sum() / 6)
    if volume < -0.1 * float((rig.neutral.amax(0) - rig.neutral.amin(0)).prod()):  # an open head has volume enough
        problems.append("the surface is inside out: its faces are clockwise from outside; flip their normals")
    loose = len(rig.neutral) - len(rig.faces.unique())
    if loose:
        problems.append(f"{loose} of {len(rig.neutral)} vertices belong to no face")
    edges = torch.cat([rig.faces[:, [0, 1]], rig.faces[:, [1, 2]], rig.faces[:, [2, 0]]]).sort(1).values
    crowded = int((edges.unique(dim=0, return_counts=True)[1] > 2).sum())
    if crowded:
        problems.append(f"{crowded} edges are shared by more than two faces")
    return problems


# Shapes ---------------------------------------------------------------------------------------------------------------


def _shapes(rig: Rig, eyes: Tensor, mouth: Tensor, face: float | None) -> list[ShapeFacts]:
    unit = face or max(float((rig.neutral.amax(0) - rig.neutral.amin(0)).max()) / 3, 1e-12)
    motion = rig.deltas.norm(dim=-1)  # (K, V)
    largest = motion.amax(1)  # (K,)
    typical = float(largest[largest > 0].median()) if bool((largest > 0).any()) else 0.0
    facts = []
    for index, name in enumerate(rig.names):
        reach, problems = float(largest[index]), []
        moved = motion[index] > 0.01 * reach
        share = float(moved.float().mean()) if reach else 0.0
        region, side = "-", "-"
        if reach <= 1e-3 * typical or reach == 0:
            problems.append("moves nothing")
        else:
            region, side = _place(rig, motion[index], moved, eyes, mouth, face)
            if region == "whole body":
                problems.append("moves the whole body, not the face")
            if reach > 3 * unit:
                problems.append(f"moves something by {reach / unit:.1f} times the distance from eyes to mouth")
        known = arkit.meaning(name)
        if side in ("left", "right") and len(known) == 1 and known[0] not in dict(arkit.DIRECTIONS):
            said = arkit.sides(name)[1]
            if said is not None and said != side and not name.lower().startswith(("jaw", "mouthleft", "mouthright")):
                problems.append(f"is called {said} and moves the person's {side}")
        facts.append(ShapeFacts(name, " + ".join(known), reach / unit, share, region, side, tuple(problems)))
    return facts


def _place(
    rig: Rig, motion: Float[Tensor, "V"], moved: Tensor, eyes: Tensor, mouth: Tensor, face: float | None
) -> tuple[str, str]:
    """Region of the face, and side, where a shape's motion has its middle."""
    share = motion.square() / motion.square().sum()  # squares: what moves most says where a shape belongs
    middle = share @ rig.neutral
    axis = (eyes + mouth)[0] / 2
    if face is None:
        return "-", "-"
    extent = rig.neutral[moved].amax(0) - rig.neutral[moved].amin(0)
    if float(extent.max()) > 8 * face:
        return "whole body", "both"
    height = float(middle[1] - mouth[1]) / float((eyes[1] - mouth[1]).clamp_min(1e-9))
    region = next(word for least, word in _REGIONS if height >= least)
    left = float((share * (rig.neutral[:, 0] > axis)).sum())
    return region, "left" if left > 0.8 else "right" if left < 0.2 else "both"


def _with_partners(rig: Rig, shapes: list[ShapeFacts]) -> list[ShapeFacts]:
    """With a problem where a left or right shape has no partner, or one of another strength."""
    place = {}
    for index, name in enumerate(rig.names):
        base, side = arkit.sides(name)
        if side is not None and name not in ("jawLeft", "jawRight", "mouthLeft", "mouthRight"):
            place[base, side] = index
    found = list(shapes)
    for (base, side), index in place.items():
        other = place.get((base, "right" if side == "left" else "left"))
        mine = shapes[index].strength
        if other is None:
            found[index] = _add(found[index], "has no partner on the other side")
        elif mine > 0 and shapes[other].strength > 0:
            ratio = mine / shapes[other].strength
            if ratio > 1.25:
                found[index] = _add(found[index], f"moves {ratio:.2f} times as far as {shapes[other].name}")
    return found


def _with_twins(rig: Rig, shapes: list[ShapeFacts]) -> tuple[ShapeFacts, ...]:
    """With a problem where two shapes do the same."""
    flat = rig.deltas.flatten(1).double()
    length = flat.norm(dim=1)
    gram = flat @ flat.T
    found = list(shapes)
    for k in range(len(shapes)):
        for j in range(k):
            size = float(length[k] * length[j])
            if size > 0 and float(gram[k, j]) > 0.9999 * size and 0.99 < float(length[k] / length[j]) < 1.01:
                found[k] = _add(found[k], f"is the same as {shapes[j].name}")
                break
    return tuple(found)


def _add(facts: ShapeFacts, problem: str) -> ShapeFacts:
    return ShapeFacts(**{**vars(facts), "problems": (*facts.problems, problem)})
