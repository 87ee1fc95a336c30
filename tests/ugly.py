"""Rigs that nobody would want, made from the toy ball."""

from dataclasses import replace

import numpy as np
import torch
import trimesh
from conftest import make_toy_rig

from reenact.rigs.rig import Rig


def _rows(rig: Rig, keep: torch.Tensor) -> Rig:
    """Some vertices of a rig, in that order; faces are kept as numbers."""
    colors = None if rig.colors is None else rig.colors[keep]
    return replace(rig, neutral=rig.neutral[keep], deltas=rig.deltas[:, keep], colors=colors)


def loose(rig: Rig) -> Rig:
    """Vertices in no face, far away."""
    grown = _rows(rig, torch.cat([torch.arange(len(rig.neutral)), torch.zeros(50, dtype=torch.int64)]))
    neutral = grown.neutral.clone()
    neutral[-50:] += 1.0
    return replace(grown, neutral=neutral)


def doubled(rig: Rig) -> Rig:
    """Every face with vertices of its own: nothing is connected."""
    split = _rows(rig, rig.faces.reshape(-1))
    return replace(split, faces=torch.arange(3 * len(rig.faces)).reshape(-1, 3))


def degenerate(rig: Rig) -> Rig:
    """Triangles without an area: a corner twice, and three points on each other."""
    flat = torch.stack([rig.faces[:60, 0], rig.faces[:60, 0], rig.faces[:60, 1]], 1)
    return replace(rig, faces=torch.cat([rig.faces, flat, rig.faces[:9, :1].expand(-1, 3)]))


def flipped(rig: Rig) -> Rig:
    return replace(rig, faces=rig.faces.flip(1))


def half_flipped(rig: Rig) -> Rig:
    faces = rig.faces.clone()
    faces[::2] = faces[::2].flip(1)
    return replace(rig, faces=faces)


def three_faces_at_an_edge(rig: Rig) -> Rig:
    fins = torch.stack([rig.faces[:40, 0], rig.faces[:40, 1], rig.faces[40:80, 2]], 1)
    return replace(rig, faces=torch.cat([rig.faces, fins]))


def doubled_faces(rig: Rig) -> Rig:
    return replace(rig, faces=torch.cat([rig.faces, rig.faces]))


def holes(rig: Rig) -> Rig:
    return replace(rig, faces=rig.faces[torch.arange(len(rig.faces)) % 5 > 0])


def two_pieces(rig: Rig) -> Rig:
    both = _rows(rig, torch.arange(len(rig.neutral)).repeat(2))
    neutral = both.neutral.clone()
    neutral[len(rig.neutral) :] *= 0.2
    deltas = both.deltas.clone()
    deltas[:, len(rig.neutral) :] = 0
    return replace(both, neutral=neutral, deltas=deltas, faces=torch.cat([rig.faces, rig.faces + len(rig.neutral)]))


def one_shape(rig: Rig) -> Rig:
    return replace(rig, deltas=rig.deltas[3:4], names=rig.names[3:4])


def an_empty_shape(rig: Rig) -> Rig:
    deltas = rig.deltas.clone()
    deltas[2] = 0
    return replace(rig, deltas=deltas)


def only_empty_shapes(rig: Rig) -> Rig:
    return replace(rig, deltas=torch.zeros_like(rig.deltas))


def shapes_300(rig: Rig) -> Rig:
    random = torch.Generator().manual_seed(0)
    mixes = torch.rand(293, len(rig.names), generator=random)
    more = torch.einsum("nk,kvc->nvc", mixes / 7, rig.deltas)
    names = rig.names + tuple(f"corrective {number}" for number in range(293))
    return replace(rig, deltas=torch.cat([rig.deltas, more]), names=names)


def names_of_no_meaning(rig: Rig) -> Rig:
    return replace(rig, names=tuple(f"shape {number}" for number in range(len(rig.names))))


def z_up(rig: Rig) -> Rig:
    turn = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    return replace(rig, neutral=rig.neutral @ turn.T, deltas=rig.deltas @ turn.T)


def backwards(rig: Rig) -> Rig:
    turn = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))
    return replace(rig, neutral=rig.neutral @ turn, deltas=rig.deltas @ turn)


def far_away(rig: Rig) -> Rig:
    return replace(rig, neutral=rig.neutral + torch.tensor([100.0, 50.0, -30.0]))


def flat(rig: Rig) -> Rig:
    """A disc: what was behind lies in the same plane."""
    squash = torch.tensor([1.0, 1.0, 0.0])
    return replace(rig, neutral=rig.neutral * squash, deltas=rig.deltas * squash)


def one_triangle(rig: Rig) -> Rig:
    neutral = torch.tensor([[-0.1, -0.1, 0.0], [0.1, -0.1, 0.0], [0.0, 0.1, 0.0]])
    deltas = 0.02 * torch.eye(3)[:2, :, None] * torch.tensor([0.0, 1.0, 0.0])
    return Rig(rig.name, neutral, deltas, ("jawOpen", "browInnerUp"), torch.tensor([[0, 1, 2]]))


def one_point(rig: Rig) -> Rig:
    return replace(rig, neutral=torch.zeros_like(rig.neutral))


def vertices_100_000(rig: Rig) -> Rig:
    ball = trimesh.creation.icosphere(subdivisions=7, radius=1.0)  # 163,842
    points = torch.tensor(np.asarray(ball.vertices), dtype=torch.float32)
    places = torch.tensor([[0.35, 0.35, 0.85], [-0.35, 0.35, 0.85], [0.0, -0.6, 0.75]])
    ways = torch.tensor([[0.0, -0.1, 0.02], [0.0, -0.1, 0.02], [0.0, -0.25, 0.0]])
    near = torch.exp(-torch.cdist(places, points).square() / 0.05)
    deltas = near[:, :, None] * ways[:, None]
    names = ("eyeBlinkLeft", "eyeBlinkRight", "jawOpen")
    return Rig(rig.name, 0.1 * points, 0.1 * deltas, names, torch.tensor(np.asarray(ball.faces), dtype=torch.int64))


def scaled(factor: float):
    def made(rig: Rig) -> Rig:
        return replace(rig, neutral=factor * rig.neutral, deltas=factor * rig.deltas)

    return made


UGLY = {
    make.__name__: make
    for make in (
        loose,
        doubled,
        degenerate,
        flipped,
        half_flipped,
        three_faces_at_an_edge,
        doubled_faces,
        holes,
        two_pieces,
        one_shape,
        an_empty_shape,
        only_empty_shapes,
        shapes_300,
        names_of_no_meaning,
        z_up,
        backwards,
        far_away,
        flat,
        one_triangle,
        one_point,
    )
} | {f"times {factor:g}": scaled(factor) for factor in (1e-3, 1e-2, 10.0, 1e3)}
LARGE = {"100,000 vertices": vertices_100_000}


def make(name: str) -> Rig:
    return replace((UGLY | LARGE)[name](make_toy_rig("ugly", stretch=1.25, hue=2.0)), name="ugly")
