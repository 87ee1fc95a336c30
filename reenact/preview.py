"""Contact sheets: a picture of how far the training is."""

from __future__ import annotations

from pathlib import Path

import torch
from PIL import Image
from torch import Tensor

from reenact.atomic import replacing
from reenact.data import Studio
from reenact.models import Networks
from reenact.rigs import arkit, motion

_ROWS = 6
"""Expressions in a preview."""
_SHOWN_AT = 128
"""Pixels along each side of a picture in a sheet."""


@torch.no_grad()
def save_preview(path: Path, studios: dict[str, Studio], networks: Networks, trained: list[str]) -> None:
    """Columns: source, reenacted, target with predicted weights, and truth where the names are shared; a row each.

    Args:
        path: A .png; its folder is made.
        studios: The source first.
        networks: Draw and read.
        trained: Keys whose BPNet has been trained; the others' columns stay out.
    """
    source_key, *target_keys = studios
    source = studios[source_key]
    weights = motion.expressions(source.rig.names, _ROWS, seed=7)
    columns = [source.photograph(weights)]
    for key in target_keys:
        target = studios[key]
        shown = source.show(columns[0])
        columns.append(target.picture(networks.redraw(shown, source_key, key)))
        if key in trained:
            columns.append(target.photograph(networks.retarget(shown, source_key, key).clamp(0, 1)))
        truth = shared_weights(weights, source.rig.names, target.rig.names)
        if truth is not None:
            columns.append(target.photograph(truth))
    save_contact_sheet(path, [pictures[:, :3] for pictures in columns])


def shared_weights(weights: Tensor, source_names: tuple[str, ...], target_names: tuple[str, ...]) -> Tensor | None:
    """Weights (N, K) copied by ARKit name; None where fewer than half of the target's names are shared."""
    known = {arkit.canonical(name): index for index, name in enumerate(source_names)}
    known.pop(None, None)
    pairs = [(known[arkit.canonical(name)], k) for k, name in enumerate(target_names) if arkit.canonical(name) in known]
    if len(pairs) < len(target_names) / 2:
        return None
    copied = torch.zeros(len(weights), len(target_names))
    here, there = zip(*pairs)
    copied[:, list(there)] = weights[:, list(here)]
    return copied


def save_contact_sheet(path: Path, columns: list[Tensor]) -> None:
    """Pictures in columns (each (rows, 3, H, W) in [0, 1]), one row per expression, as a PNG."""
    sized = [
        torch.nn.functional.interpolate(c.clamp(0, 1), size=(_SHOWN_AT, _SHOWN_AT), mode="bilinear") for c in columns
    ]
    sheet = torch.cat([torch.cat(list(column), dim=1) for column in sized], dim=2)  # (3, rows H, columns W)
    pixels = (sheet.permute(1, 2, 0) * 255).round().to(torch.uint8).cpu().numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as whole:  # a viewer may be looking
        Image.fromarray(pixels).save(whole, format="PNG")
