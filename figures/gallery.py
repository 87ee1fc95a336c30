"""A page of everything that moves, runs/gallery.html: one file, to look at and to send.

    python figures/gallery.py [RUN ...] [--out FILE.html] [--seconds 4] [--strip docs/images/everyone.webp]

One clip on every built-in character, by the networks of a run from anny:man where one is given, else by a geometric
method; one character by many methods; and every kind of clip that is made by formula. The strip is the first of these
in one picture, for README.md.
"""

from __future__ import annotations

import argparse
import base64
import io
import os
import sys
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch starts: its idle threads would spin on our cores
sys.path.insert(0, str(Path(__file__).parents[1]))

import jinja2
import torch
from PIL import Image
from rich.console import Console

from reenact.atomic import write_atomically
from reenact.inference import ImageRetargeter
from reenact.portrait import Portrait
from reenact.retargeting import METHODS, Retargeter
from reenact.retargeting.correspondence import find_correspondence
from reenact.rigs import motion
from reenact.rigs.anny import BUILT_IN
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_rig
from reenact.rigs.rig import Rig
from reenact.rigs.timeline import resampled

SOURCE, SHOWN = "anny:man", "anny:toon"
BESIDE = ("shape-matching", "consensus", "delta-transfer", "deformation-transfer", "rbf", "ribera-paper", "copy")
"""Methods that the second section compares."""
SIZE, FPS, COLUMNS = 192, 15.0, 10
SEED = 268  # smiles, speaks, blinks and raises its brows within four seconds

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Gallery · Reenact</title><style>
:root { color-scheme: light dark; --paper: #f6f5f2; --ink: #1b1d22; --soft: #585d68; --link: #2563a8; }
@media (prefers-color-scheme: dark) { :root { --paper: #14161a; --ink: #eceae5; --soft: #a3a8b3; --link: #7db8f5; } }
@media print { button { display: none; } figure { break-inside: avoid; } }
body { margin: 0 auto; padding: 1.5rem; max-width: 1120px; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, "DejaVu Sans", sans-serif; }
header { position: sticky; top: 0; z-index: 1; display: flex; align-items: center; background: var(--paper); }
h1 { margin: .4rem 0; flex: 1; }
button { font: inherit; color: inherit; background: none; border: 1px solid var(--soft); border-radius: 8px;
  padding: .3rem 1rem; cursor: pointer; }
:focus-visible { outline: 2px solid var(--link); outline-offset: 2px; }
div { display: grid; grid-template-columns: repeat(auto-fill, minmax(min(140px, 45%), 1fr)); gap: 1rem; }
figure { margin: 0; } canvas { width: 100%; aspect-ratio: 1; border-radius: 10px; display: block; background: #5c6169; }
figcaption { font-size: .85rem; color: var(--soft); margin-top: .3rem; } figcaption b { color: var(--ink); }
h2 { margin: 2.2rem 0 .2rem; } p { margin: 0 0 .8rem; max-width: 74ch; color: var(--soft); }
</style></head><body>
<header><h1>Gallery</h1><button type="button" id="play">Pause</button></header>
{% for section in sections %}<h2>{{ section.title }}</h2><p>{{ section.note }}</p>
<div>{% for face in section.faces %}<figure>
<canvas width="{{ size }}" height="{{ size }}" role="img" aria-label="{{ face.title }}, {{ face.note }}"
data-frames="{{ face.frames | length }}" data-liveliest="{{ face.liveliest }}" data-sheet="{{ face.sheet }}"></canvas>
<figcaption><b>{{ face.title }}</b><br>{{ face.note }}</figcaption></figure>{% endfor %}</div>
{% endfor %}<script type="module">
// One clock for all, so that faces beside each other are at the same frame.
const FPS = {{ fps }}, COLUMNS = {{ columns }}, SIZE = {{ size }}, button = document.getElementById("play");
const faces = await Promise.all([...document.querySelectorAll("canvas")].map(async (canvas) => {
  const image = new Image();
  image.src = canvas.dataset.sheet;
  await image.decode();
  return { pen: canvas.getContext("2d"), image, count: +canvas.dataset.frames, liveliest: +canvas.dataset.liveliest };
}));
let playing = !matchMedia("(prefers-reduced-motion: reduce)").matches, time = 0, before = performance.now();
const show = ({ pen, image }, n) => pen.drawImage(
  image, (n % COLUMNS) * SIZE, Math.floor(n / COLUMNS) * SIZE, SIZE, SIZE, 0, 0, SIZE, SIZE);
function tick(now) {
  time += (now - before) / 1000;
  before = now;
  for (const face of faces) show(face, Math.floor(time * FPS) % face.count);
  if (playing) requestAnimationFrame(tick);
}
function play(on) {
  playing = on;
  button.textContent = on ? "Pause" : "Play";
  before = performance.now();
  if (on) requestAnimationFrame(tick);
}
for (const face of faces) show(face, face.liveliest);
button.addEventListener("click", () => play(!playing));
play(playing);
</script></body></html>
"""


@dataclass(frozen=True)
class Face:
    """A face that moves."""

    title: str
    note: str
    frames: tuple[Image.Image, ...]
    liveliest: int
    """The frame to show where nothing should move."""
    sheet: str
    """All frames in rows of `COLUMNS`."""


@torch.no_grad()
def face(title: str, note: str, rig: Rig, clip: Clip) -> Face:
    """The clip on the rig, drawn."""
    portrait, pictures = Portrait.of(rig), []
    for part in resampled(clip, FPS).weights.float().split(16):
        drawn = portrait.render(rig.vertices(part), SIZE)["color"].clamp(0, 1)
        pictures += [Image.fromarray(each) for each in (255 * drawn.movedim(1, -1)).round().byte().numpy()]
    liveliest = int(resampled(clip, FPS).weights.sum(1).argmax())
    return Face(title, note, tuple(pictures), liveliest, _sheet(pictures))


def _sheet(pictures: list[Image.Image]) -> str:
    whole = Image.new("RGB", (COLUMNS * SIZE, -(-len(pictures) // COLUMNS) * SIZE))
    for place, picture in enumerate(pictures):
        whole.paste(picture, (place % COLUMNS * SIZE, place // COLUMNS * SIZE))
    packed = io.BytesIO()
    whole.save(packed, "WEBP", quality=70)
    return f"data:image/webp;base64,{base64.b64encode(packed.getvalue()).decode()}"


def _moving(pictures: list[Image.Image]) -> bytes:
    packed = io.BytesIO()
    pictures[0].save(
        packed, "WEBP", save_all=True, append_images=pictures[1:], duration=round(1000 / FPS), loop=0, quality=70
    )
    return packed.getvalue()


def going_round(clip: Clip, seconds: float = 0.4) -> Clip:
    """The clip from rest to rest, as its picture starts again where it ends."""
    places = torch.arange(len(clip))
    near = torch.minimum(places, len(clip) - 1 - places) / (seconds * clip.fps)  # the nearer end
    share = (1 - torch.cos(torch.pi * near.clamp(max=1))) / 2
    return replace(clip, weights=clip.weights * share[:, None])


def strip(faces: list[Face], size: int = 180) -> bytes:
    """The faces side by side, in step."""
    wholes = []
    for moment in zip(*(each.frames for each in faces), strict=True):
        whole = Image.new("RGB", (size * len(faces), size))
        for place, picture in enumerate(moment):
            whole.paste(picture.resize((size, size), Image.Resampling.LANCZOS), (place * size, 0))
        wholes.append(whole)
    return _moving(wholes)


def page_of(sections: list[dict]) -> str:
    """The page: sections with a title, a note and faces."""
    template = jinja2.Environment(autoescape=True).from_string(PAGE)
    return template.render(sections=sections, size=SIZE, fps=FPS, columns=COLUMNS)


def everyone(trained: dict[str, ImageRetargeter], clip: Clip, source: Rig, say) -> list[Face]:
    """The clip on the source, and on every other character."""
    faces = [face(source.name, "the source", source, clip)]
    for name in BUILT_IN:
        if name == SOURCE:
            continue
        say(f"{SOURCE} -> {name}")
        if name in trained:
            faces.append(face(name, f"networks, {trained[name].run.folder.name}", load_rig(name), trained[name](clip)))
            continue
        target = load_rig(name)
        method = "consensus" if name in ("anny:units", "anny:merged") else "shape-matching"
        moved = METHODS[method](source, target, find_correspondence(source, target))(clip)
        faces.append(face(name, method, target, moved))
    return faces


def methods(trained: dict[str, ImageRetargeter], clip: Clip, source: Rig, say) -> list[Face]:
    """One target by one method after the other."""
    target = load_rig(SHOWN)
    found = find_correspondence(source, target)
    retargeters: dict[str, Retargeter] = {"networks": trained[SHOWN]} if SHOWN in trained else {}
    faces = [face(source.name, "the source", source, clip)]
    for name, made in retargeters.items():
        faces.append(face(name, target.name, target, made(clip)))
    for name in BESIDE:
        say(f"{SHOWN}: {name}")
        faces.append(face(name, target.name, target, METHODS[name](source, target, found)(clip)))
    return faces


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="*", type=Path)
    parser.add_argument("--out", type=Path, default=Path("runs") / "gallery.html")
    parser.add_argument("--seconds", type=float, default=4.0)
    parser.add_argument("--strip", type=Path)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of shapes without a namesake
    source = load_rig(SOURCE)
    trained = {}
    for folder in arguments.runs:
        made = ImageRetargeter.load(folder)
        if made.source.name == SOURCE:
            trained[made.target.name] = made
    clip = going_round(motion.synthesize(source.names, arguments.seconds, seed=SEED, kind="mixed"))
    console = Console(stderr=True)
    with console.status("") as status:
        shown = everyone(trained, clip, source, status.update)
        if arguments.strip is not None:
            write_atomically(arguments.strip, strip(shown))
        sections = [
            {
                "title": "One clip on everyone",
                "note": "Nobody paired expressions or placed markers.",
                "faces": shown,
            },
            {
                "title": "One face, many methods",
                "note": "By correspondences that are found. Ribera's method to the letter exaggerates.",
                "faces": methods(trained, clip, source, status.update),
            },
            {
                "title": "Clips by formula",
                "note": "What trainings and evaluations are made of, each kind with another trap.",
                "faces": [
                    face(kind, SOURCE, source, motion.synthesize(source.names, arguments.seconds, seed=3, kind=kind))
                    for kind in motion.KINDS
                ],
            },
        ]
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(arguments.out, page_of(sections).encode())
    print(arguments.out)


if __name__ == "__main__":
    main()
