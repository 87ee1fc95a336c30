"""The pictures of docs/tutorial.md.

    python figures/tutorial.py AVATAR CLIP [--out docs/images]

tutorial-shapes.png     `reenact inspect AVATAR`, its first rows
tutorial-moved.png      moments of the clip on anny:man, and on the avatar by shape-matching
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import torch
from PIL import Image

from reenact.inspection import inspect, save_sheet
from reenact.portrait import Portrait
from reenact.preview import save_contact_sheet
from reenact.retargeting import METHODS
from reenact.retargeting.correspondence import find_correspondence
from reenact.rigs.files import load_clip, load_rig, read_rig
from reenact.rigs.formats.pieces import Choice

SIZE = 160
MOMENTS = 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("avatar")
    parser.add_argument("clip")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "images")
    arguments = parser.parse_args()
    rig, contents = read_rig(arguments.avatar, Choice())
    sheet = arguments.out / "tutorial-shapes.png"
    save_sheet(rig, inspect(rig, contents), sheet, 120)
    with Image.open(sheet) as picture:
        top = picture.crop((0, 0, picture.width, picture.height // 2))
    top.quantize(128).save(sheet)
    source = load_rig("anny:man")
    clip = load_clip(arguments.clip, source)
    moved = METHODS["shape-matching"](source, rig, find_correspondence(source, rig))(clip)
    activity = clip.weights.sum(1)
    parts = torch.arange(len(clip)).chunk(MOMENTS)
    frames = [int(part[activity[part].argmax()]) for part in parts]  # the liveliest of each part of the clip
    rows = [
        Portrait.of(each).render(each.vertices(weights[frames]), SIZE)["color"]
        for each, weights in ((source, clip.weights), (rig, moved.weights))
    ]
    columns = [torch.stack(pair) for pair in zip(*rows)]
    save_contact_sheet(arguments.out / "tutorial-moved.png", columns)
    print(sheet, arguments.out / "tutorial-moved.png", sep="\n")


if __name__ == "__main__":
    main()
