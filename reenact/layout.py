"""A shared layout: one 2-D warp that puts a rig's eyes, mouth and outline on the pixels of another's.

Ours. A shared encoder reads place before it reads meaning: where two faces have their mouths on different pixels, it
keeps two codes for one expression. A single warp of every picture of the target, found once from pictures of both rigs,
takes that difference away. Nothing here sees paired expressions, blendshape names or mesh topology: what is registered
are the neutral pictures (camera-space normals, mask), the maps of face parts, and the motion energy, where and how
strongly random expressions of each rig change its pictures. Where a correspondence between the surfaces is known,
`lay_out` makes the warp from that, twice as exactly.
"""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from scipy.interpolate import RBFInterpolator
from torch import Tensor

from reenact.config import LayoutConfig
from reenact.data import identity_grid, warp
from reenact.errors import ReenactError
from reenact.geometry import vertex_normals
from reenact.portrait import Portrait, made_up
from reenact.retargeting.correspondence import Correspondence
from reenact.rigs import motion
from reenact.rigs.rig import PARTS, Rig

_SCALES = (0.06, 0.03, 0.015)
"""Standard deviations of the blur, coarse to fine, as shares of the picture's width."""
_REGISTERED_PARTS = ("lips", "brows", "eyes")


def find_layout(
    source: Rig, target: Rig, resolution: int, config: LayoutConfig, seed: int = 0
) -> Float[Tensor, "{resolution} {resolution} 2"]:
    """The sampling grid that warps pictures of the target onto the layout of the source.

    A displacement grid, mirror symmetric, is fitted by Adam to the normalised cross-correlation of blurred feature
    maps, coarse to fine, with a penalty on bending.

    Args:
        source: Its pictures stay where they are.
        target: Its pictures are warped.
        resolution: Pixels along each side of the pictures; a wider picture gives a finer registration.
        config: Size and stiffness of the displacement grid, and how long it is fitted.
        seed: Of the random expressions that measure motion energy, drawn independently for both rigs.

    Returns:
        Positions in the target's picture, (x, y) in [-1, 1], as `data.warp` takes them.

    Raises:
        ReenactError: A rig cannot be photographed, or its pictures do not change.
    """
    both = source.parts is not None and target.parts is not None
    fixed, fixed_weight = _features(source, resolution, config.samples, [seed, 0], both)
    moving, moving_weight = _features(target, resolution, config.samples, [seed, 1], both)
    weight = (fixed_weight * moving_weight).sqrt()
    base = identity_grid(resolution)
    control = torch.zeros(1, 2, config.grid, config.grid, requires_grad=True)
    for scale in _SCALES:
        optimizer = torch.optim.Adam([control], lr=scale / 2)
        fixed_blurred = _blur(fixed, scale)
        moving_blurred = _blur(moving, scale / 2)  # half before the warp, half after: cheap, and smooth to the warp
        for _ in range(config.steps):
            grid = base + _displacement(control, resolution)
            warped = _blur(warp(moving_blurred, grid), scale * 0.87)
            mismatch = (weight * (1 - _correlation(fixed_blurred, warped))).sum() / weight.sum()
            loss = mismatch + config.bending * _bending(control)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    return (base + _displacement(control.detach(), resolution)).detach()


_FACING = 0.2
"""Cosine with the viewing direction from which a place of the surface counts as seen."""
_MOST = 4000
"""Pairs that the warp follows, of those that are given: what each gets wrong averages out among its neighbours, and the
time grows with the cube."""
_SMOOTHING = 1 / 300
"""How far the warp may miss pairs of places, which are found one by one, for each of them, so that it is as smooth
whatever their number; squared pixels of 64, about."""
_ROUNDS = 3
"""How often found pairs that the warp misses by more than is usual lose weight. Between a man and ICT FaceKit some on
the lids contradict their neighbours, and would fold the picture."""


def lay_out(
    source: Rig, target: Rig, correspondence: Correspondence, resolution: int
) -> Float[Tensor, "{resolution} {resolution} 2"]:
    """The sampling grid that warps pictures of the target onto the layout of the source, from pairs of places. Ours.

    A thin-plate spline through where both rigs' pictures show the pairs that face the camera in both; the denser they
    are, the more exact it is. Those that are not certain and contradict the others lose weight (reweighted least
    squares).

    Args:
        source: Its pictures stay where they are.
        target: Its pictures are warped.
        correspondence: From the source's surface to the target's.
        resolution: Pixels along each side of the pictures.

    Raises:
        ReenactError: Fewer than ten pairs face the camera, or a rig cannot be photographed.
    """
    if len(correspondence) > _MOST:
        correspondence = correspondence.sample(source, _MOST)
    places = ((source, correspondence.source), (target, correspondence.target))
    here, there = (Portrait.of(rig).project(each.of(rig.neutral), 64) for rig, each in places)
    facing = [each.of(vertex_normals(rig.neutral, rig.faces))[:, 2] > _FACING for rig, each in places]
    seen = facing[0] & facing[1] & ((here > -16) & (here < 80)).all(1)  # a quarter beyond the picture, for its rim
    if int(seen.sum()) < 10:
        raise ReenactError(
            f"{source.name} to {target.name}: expected ten pairs of places that face the camera, got "
            f'{int(seen.sum())}; give more with pairs.correspondence, or set layout.method to "pictures"'
        )
    at, move = here[seen].double().numpy(), (there - here)[seen].double().numpy()
    certain = (correspondence.confidence[seen] == 1).numpy()
    trust = np.ones(len(at))
    for _ in range(1 if certain.all() else _ROUNDS + 1):
        moved = RBFInterpolator(at, move, kernel="thin_plate_spline", smoothing=_SMOOTHING * len(at) / trust)
        miss = np.linalg.norm(moved(at) - move, axis=1)
        trust = np.where(certain, 1.0, 1 / (1 + np.square(miss / (2 * np.median(miss) + 1e-3))))
    grid = identity_grid(resolution)
    pixels = (grid + 1) * 32
    displacement = torch.from_numpy(moved(pixels.flatten(0, 1).double().numpy())).float()
    return grid + displacement.unflatten(0, grid.shape[:2]) / 32


def _features(
    rig: Rig, resolution: int, samples: int, seed: list[int], with_parts: bool
) -> tuple[Float[Tensor, "1 C R R"], Float[Tensor, "C"]]:
    """Feature maps of one rig in its own framing, and the weight of each."""
    portrait = Portrait.of(made_up(rig))
    buffers = ("color", "normals", "mask", "parts") if with_parts else ("color", "normals", "mask")
    neutral = portrait.render(rig.neutral[None], resolution, buffers)
    weights = motion.expressions(rig.names, samples, np.random.default_rng(seed))
    energy = {"color": 0.0, "normals": 0.0}
    for chunk in weights.split(32):
        pictures = portrait.render(rig.vertices(chunk), resolution, ("color", "normals"))
        for name in energy:
            energy[name] = energy[name] + (pictures[name] - neutral[name]).abs().sum(dim=(0, 1), keepdim=True)
    if not all(bool(energy[name].any()) for name in energy):
        raise ReenactError(
            f"{rig.name}: expected expressions that change its picture, got {samples} equal ones; check that the "
            "export kept the deltas"
        )
    maps = [(energy[name] / energy[name].mean()).sqrt() for name in energy] + [neutral["normals"], neutral["mask"]]
    weight = [1.0, 1.0, 0.5, 0.5, 0.5, 0.5]
    if with_parts:
        for part in _REGISTERED_PARTS:
            maps.append((neutral["parts"] == PARTS.index(part)).float())
            weight.append(1.0 if bool(maps[-1].any()) else 0.0)
    return torch.cat(maps, dim=1), torch.tensor(weight)


def _displacement(control: Float[Tensor, "1 2 G G"], resolution: int) -> Float[Tensor, "R R 2"]:
    """The control grid, mirrored left to right and enlarged to pixels."""
    mirrored = control.flip(-1) * torch.tensor([-1.0, 1.0])[None, :, None, None]
    symmetric = (control + mirrored) / 2
    fine = F.interpolate(symmetric, size=(resolution, resolution), mode="bicubic", align_corners=True)
    return fine[0].permute(1, 2, 0)


def _blur(pictures: Float[Tensor, "1 C R R"], scale: float) -> Float[Tensor, "1 C R R"]:
    sigma = scale * pictures.shape[-1]
    size = 2 * int(np.ceil(2.5 * sigma)) + 1
    return gaussian_blur2d(pictures, (size, size), (sigma, sigma), border_type="replicate")


def _correlation(a: Float[Tensor, "1 C R R"], b: Float[Tensor, "1 C R R"]) -> Float[Tensor, "C"]:
    """Normalised cross-correlation of each channel over the picture."""
    a, b = (x[0].flatten(1) - x[0].flatten(1).mean(1, keepdim=True) for x in (a, b))
    return (a * b).sum(1) / (a.norm(dim=1) * b.norm(dim=1) + 1e-6)


def _bending(control: Float[Tensor, "1 2 G G"]) -> Float[Tensor, ""]:
    """Mean square second difference of the control grid, in steps of the grid."""
    size = control.shape[-1]
    rows, columns = control.diff(n=2, dim=2), control.diff(n=2, dim=3)
    mixed = control.diff(dim=2).diff(dim=3)
    return (rows.square().mean() + columns.square().mean() + 2 * mixed.square().mean()) * (size - 1) ** 2
