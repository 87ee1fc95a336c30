"""Shapes of a clip matched with those of a rig, by name."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.rigs import arkit
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


def conform(clip: Clip, rig: Rig, where: str = "clip") -> Clip:
    """The clip with the rig's shapes, in the rig's order.

    A shape takes the column with its name. Without one it takes the mean of the columns that stand for the same ARKit
    shapes (`arkit.meaning`): `eyeBlink_L` takes `EyeBlinkLeft`; both halves of a split `browInnerUp` take the whole,
    and the whole the mean of the halves; a merged `eyeBlink` takes the mean of both sides. Shapes that nothing matches
    stay at 0. Warns of columns that move but match no shape, and of shapes that stay at 0.

    Raises:
        ReenactError: Nothing matches.
    """
    if clip.names == rig.names:
        return clip
    mixing = matching(clip.names, rig.names).to(clip.weights)
    if not mixing.any():
        raise ReenactError(
            f"{where}: none of its {len(clip.names)} shapes ({', '.join(clip.names[:3])}, ...) is one of {rig.name} "
            f"({', '.join(rig.names[:3])}, ...); rename its columns"
        )
    unused = (mixing == 0).all(1) & (clip.weights.abs().amax(0) > 0 if len(clip) else False)
    lost = [clip.names[index] for index in unused.nonzero().flatten().tolist()]
    still = [rig.names[index] for index in (mixing == 0).all(0).nonzero().flatten().tolist()]
    if lost:
        warnings.warn(f"{where}: shapes that {rig.name} lacks are left out: {', '.join(lost)}", stacklevel=2)
    if still:
        warnings.warn(f"{where}: shapes of {rig.name} that it lacks stay at 0: {', '.join(still)}", stacklevel=2)
    return replace(clip, names=rig.names, weights=clip.weights @ mixing)


def matching(given: Sequence[str], wanted: Sequence[str]) -> Float[Tensor, "given wanted"]:
    """How much of each given shape goes into each wanted one: `given_weights @ matching(...)` are the wanted weights.

    A column of zeros is a wanted shape that nothing matches. The rules are those of `conform`.
    """
    column_of = {name: index for index, name in enumerate(given)}
    standing: dict[str, list[int]] = {}
    for index, name in enumerate(given):
        for part in arkit.meaning(name):
            standing.setdefault(part, []).append(index)
    mixing = torch.zeros(len(given), len(wanted))
    for index, name in enumerate(wanted):
        if name in column_of:
            mixing[column_of[name], index] = 1
            continue
        parts = [standing[part] for part in arkit.meaning(name) if part in standing]
        for columns in parts:
            for column in columns:
                mixing[column, index] += 1 / (len(parts) * len(columns))
    return mixing
