"""A picture of rigs in a few poses, for who has to choose one."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

from reenact.portrait import Portrait
from reenact.rigs import arkit, motion
from reenact.rigs.files import load_rig

_POSES: tuple[dict[str, float], ...] = (
    {"mouthSmileLeft": 0.9, "mouthSmileRight": 0.9, "cheekSquintLeft": 0.6, "cheekSquintRight": 0.6, "jawOpen": 0.12},
    {"browInnerUp": 0.9, "browOuterUpLeft": 0.8, "browOuterUpRight": 0.8, "eyeWideLeft": 0.9, "eyeWideRight": 0.9}
    | {"jawOpen": 0.6},
    {"eyeBlinkLeft": 1.0, "eyeBlinkRight": 1.0},
    {"mouthPucker": 0.9, "browInnerUp": 0.3},
    {"browDownLeft": 0.9, "browDownRight": 0.9, "noseSneerLeft": 0.7, "noseSneerRight": 0.7, "mouthFrownLeft": 0.4}
    | {"mouthFrownRight": 0.4, "eyeSquintLeft": 0.4, "eyeSquintRight": 0.4},
)
"""Joy, surprise, a blink, a kiss, anger."""


def draw_rigs(names: list[str], size: int, out: Path) -> None:
    """Write a sheet with a row per rig: name, neutral, and a few poses; random expressions where the shapes have no
    ARKit meaning.

    Args:
        names: Built-in rigs, or files.
        size: Height and width of each picture, in pixels.
        out: The sheet, in any format of Pillow.
    """
    count, label = len(_POSES), max(16, size // 8)
    sheet = Image.new("RGB", (size * (1 + count), (size + label) * len(names)), "white")
    for row, name in enumerate(names):
        rig = load_rig(name)
        meanings = [arkit.meaning(shape) for shape in rig.names]
        poses = torch.tensor(
            [[max((pose.get(part, 0.0) for part in parts), default=0.0) for parts in meanings] for pose in _POSES]
        )
        if not poses.any():
            poses = motion.expressions(rig.names, count, seed=4)
        weights = torch.cat([torch.zeros(1, len(rig.names)), poses])
        pictures = Portrait.of(rig).render(rig.vertices(weights), size)["color"]
        top = row * (size + label)
        ImageDraw.Draw(sheet).text(
            (label // 3, top + label // 2),
            f"{name}   {len(rig.names)} blendshapes",
            fill="black",
            anchor="lm",
            font=ImageFont.load_default(0.7 * label),
        )
        for column, pixels in enumerate((pictures.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()):
            sheet.paste(Image.fromarray(pixels), (column * size, top + label))
    sheet.save(out)
