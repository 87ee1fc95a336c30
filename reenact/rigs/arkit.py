"""The 52 face shapes of Apple's ARKit: names, spellings, left/right pairs, rules.

Source: Apple, ARFaceAnchor.BlendShapeLocation. Names and order are Apple's, which are also those of Live Link Face.
"""

from __future__ import annotations

import re
from functools import lru_cache

NAMES: tuple[str, ...] = (
    *(
        f"eye{shape}{side}"
        for side in ("Left", "Right")
        for shape in ("Blink", "LookDown", "LookIn", "LookOut", "LookUp", "Squint", "Wide")
    ),
    *("jawForward", "jawLeft", "jawRight", "jawOpen"),
    *("mouthClose", "mouthFunnel", "mouthPucker", "mouthLeft", "mouthRight"),
    *(f"mouth{shape}{side}" for shape in ("Smile", "Frown", "Dimple", "Stretch") for side in ("Left", "Right")),
    *("mouthRollLower", "mouthRollUpper", "mouthShrugLower", "mouthShrugUpper"),
    *(f"mouth{shape}{side}" for shape in ("Press", "LowerDown", "UpperUp") for side in ("Left", "Right")),
    *("browDownLeft", "browDownRight", "browInnerUp", "browOuterUpLeft", "browOuterUpRight"),
    *("cheekPuff", "cheekSquintLeft", "cheekSquintRight", "noseSneerLeft", "noseSneerRight", "tongueOut"),
)
"""All 52, in Apple's order."""

DIRECTIONS = (("jawLeft", "jawRight"), ("mouthLeft", "mouthRight"))
"""Shapes that move one thing to two sides: opposites, where a pair are mirror images that go together."""

PAIRS: tuple[tuple[str, str], ...] = tuple(
    (name, name.removesuffix("Left") + "Right")
    for name in NAMES
    if name.endswith("Left") and name not in dict(DIRECTIONS)
)
"""Left and right of each mirrored pair; the person's own left, as Apple counts."""

CORRECTIVES = {"mouthClose": "jawOpen"}
"""A shape that only means something on top of another, and may not exceed it: mouthClose seals the lips of an open
jaw, and alone pushes them through each other."""

SPLIT = ("browInnerUp", "cheekPuff")
"""Shapes that ARKit has once and some rigs have once per side, as `browInnerUp_L` and `browInnerUp_R`."""

REGIONS: dict[str, tuple[str, ...]] = {
    region: tuple(name for name in NAMES if re.match(prefix, name))
    for region, prefix in {
        "eyelids": "eye(Blink|Squint|Wide)",
        "gaze": "eyeLook",
        "brows": "brow",
        "nose and cheeks": "nose|cheek",
        "jaw": "jaw",
        "mouth": "mouth",
        "tongue": "tongue",
    }.items()
}
"""Shapes by the part of the face that they move; every shape is in exactly one."""


@lru_cache(maxsize=4096)
def sides(name: str) -> tuple[str, str | None]:
    """A name without its side, and the side: "left", "right" or None.

    The side is a word of its own (`left`, `l`, `right`, `r`) in camelCase or between separators; a name with no such
    word, or more than one, has no side. `("eye * closure", "left")` for "eye-left-closure". Works for any naming.
    """
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", name)
    words = [word.lower() for word in re.split(r"[^A-Za-z0-9]+", spaced) if word]
    found = [(index, _SIDES[word]) for index, word in enumerate(words) if word in _SIDES]
    if len(found) != 1:
        return " ".join(words), None
    index, side = found[0]
    return " ".join([*words[:index], "*", *words[index + 1 :]]), side


def canonical(name: str) -> str | None:
    """The ARKit name that a shape's name spells, or None.

    Case, separators and a prefix that ends in `.`, `:` or `|` do not matter, and a side may be `_L` or `Left`:
    `eyeBlinkLeft`, `EyeBlinkLeft`, `eyeBlink_L`, `head.EYE_BLINK_LEFT`. Either half of a shape in `SPLIT` is that
    shape: `browInnerUp_L` is `browInnerUp`, whose weight drives both halves and is the mean of both.
    """
    components = meaning(name)
    return components[0] if len(components) == 1 else None


@lru_cache(maxsize=4096)
def meaning(name: str) -> tuple[str, ...]:
    """The ARKit shapes that a shape's name stands for: one, none, or two that are merged.

    Merged are both sides of a pair (`eyeBlink`), and both eyes looking one way (`eyeLookLeft`: the left eye out, the
    right eye in).
    """
    for spelling in (name, re.split(r"[.:|]", name)[-1]):
        key = re.sub(r"[^a-z0-9]", "", spelling.lower())
        if key in _SPELLINGS:
            return _SPELLINGS[key]
    return ()


_SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}


def _spellings() -> dict[str, tuple[str, ...]]:
    spellings = {name.lower(): (name,) for name in NAMES}
    for left, right in (*PAIRS, *DIRECTIONS):
        base = left.removesuffix("Left").lower()
        spellings[f"{base}l"], spellings[f"{base}r"] = (left,), (right,)
    for left, right in PAIRS:
        base = left.removesuffix("Left").lower()
        for both in ("", "both", "lr"):
            spellings[base + both] = (left, right)
    # Blinks of VRM (blinkLeft, blink_l), VRoid (Fcl_EYE_Close_L) and game engines (eyesClosed).
    for base in ("blink", "eyeclose", "eyeclosed", "fcleyeclose"):
        for side, name in (("l", "eyeBlinkLeft"), ("r", "eyeBlinkRight")):
            spellings[base + side] = (name,)
            spellings[base + {"l": "left", "r": "right"}[side]] = (name,)
        spellings[base] = ("eyeBlinkLeft", "eyeBlinkRight")
    spellings["eyesclosed"] = spellings["eyesclose"] = ("eyeBlinkLeft", "eyeBlinkRight")
    spellings["eyelookleft"] = ("eyeLookOutLeft", "eyeLookInRight")
    spellings["eyelookright"] = ("eyeLookOutRight", "eyeLookInLeft")
    for name in SPLIT:
        for side in ("left", "right", "l", "r"):
            spellings[name.lower() + side] = (name,)
    return spellings


_SPELLINGS = _spellings()
