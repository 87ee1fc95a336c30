"""Triangles over sparse markers, and edges where lips and lids touch.

Ribera et al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674,
Sec. 4.4, triangulates its markers in the rig's texture chart and adds edges between upper and lower lids and lips, by
whose hand it does not say. Ours needs none: an opening is where neighbours in the chart lie far apart along the
surface.

Symbol  Code       Shape
s_0     points     (M, 3) markers at rest
Lap     laplacian  (M, M)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import Delaunay, QhullError
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import cotangent_laplacian
from reenact.retargeting.correspondence import Places
from reenact.rigs.rig import Rig

LONGEST = 4.0
"""An edge may have this many times the median length; longer ones bridge what has no markers."""
DETOUR = 2.0
"""An edge spans an opening where the way along the surface is longer than this many times the straight one."""


@dataclass(frozen=True)
class MarkerMesh:
    """How markers hang together; made once at rest, and the same for every expression and every face."""

    faces: Int[Tensor, "F 3"]
    """Triangles of marker numbers."""
    contacts: Int[Tensor, "E 2"]
    """Pairs of markers on the two sides of an opening."""

    def laplacian(self, points: Float[Tensor, "M 3"]) -> Float[Tensor, "M M"]:
        """Cotangent operator of the triangles, all weights positive, and the median weight on each contact; float64.

        Source: RB17, Eq. 11. Where weights are clamped and what a contact weighs is ours: it has no angles.
        """
        operator = torch.from_numpy(cotangent_laplacian(points, self.faces, low=0.01).toarray())
        weights = -operator[operator < 0]
        weight = weights.median() if len(weights) else operator.new_tensor(1.0)
        a, b = self.contacts.T
        operator = operator.index_put((a, b), -weight, accumulate=True)
        operator = operator.index_put((b, a), -weight, accumulate=True)
        ends = torch.cat([a, b])
        return operator.index_put((ends, ends), weight, accumulate=True)


def marker_mesh(
    points: Float[Tensor, "M 3"],
    distances: Float[Tensor, "M M"] | None = None,
    chart: Float[Tensor, "M 2"] | None = None,
) -> MarkerMesh:
    """Delaunay triangles of the markers in a chart, without those over openings.

    Args:
        points: Markers at rest, +Y up, the face looking along +Z.
        distances: How far apart markers are along the surface, `surface_distances`; without them openings stay closed
            and there are no contacts.
        chart: Where the markers lie in a texture chart; around an upright cylinder where None.

    Raises:
        ReenactError: Fewer than three markers, or all on one line of the chart.

    Source: RB17, Sec. 4.4. The cylinder, and how openings and contacts are found, are ours.
    """
    flat = (_around_cylinder(points) if chart is None else chart).detach().cpu().double().numpy()
    if len(flat) < 3:
        raise ReenactError(f"marker mesh: expected at least 3 markers, got {len(flat)}")
    try:
        triangles = Delaunay(flat).simplices.astype(np.int64)
    except QhullError:
        raise ReenactError(
            f"marker mesh: expected markers spread over the face, got {len(flat)} on one line; spread them"
        ) from None
    sides = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    places = points.detach().cpu().double().numpy()
    straight = np.linalg.norm(places[sides[:, 0]] - places[sides[:, 1]], axis=1)
    long = straight > LONGEST * np.median(straight)
    spanning = np.zeros(len(sides), dtype=bool)
    if distances is not None:
        along = distances.detach().cpu().double().numpy()[sides[:, 0], sides[:, 1]]
        spanning = along > DETOUR * straight
    kept = triangles[~(long | spanning).reshape(3, -1).any(0)]
    return MarkerMesh(torch.from_numpy(kept), torch.from_numpy(_contacts(sides, straight, spanning & ~long)))


def surface_distances(rig: Rig, places: Places) -> Float[Tensor, "N N"]:
    """How far apart places are along the edges of the surface, metres; infinite where no path joins them."""
    vertices = rig.neutral.detach().cpu().double().numpy()
    faces = rig.faces.detach().cpu().numpy()
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    # The nearest corner stands for a place: an edge length off, which is small beside the way around an opening.
    nearest = places.corners.gather(1, places.shares.argmax(1, keepdim=True))[:, 0].cpu().numpy()
    pairs, first = np.unique(np.sort(ends, axis=1), axis=0, return_index=True)
    lengths = np.linalg.norm(vertices[ends[first, 0]] - vertices[ends[first, 1]], axis=1)
    graph = coo_array((np.maximum(lengths, 1e-12), (pairs[:, 0], pairs[:, 1])), (len(vertices), len(vertices))).tocsr()
    return torch.from_numpy(dijkstra(graph, directed=False, indices=nearest)[:, nearest])


def _around_cylinder(points: Float[Tensor, "M 3"]) -> Float[Tensor, "M 2"]:
    """Arc length around an upright axis through the middle of the head, and height."""
    x, y, z = points.double().unbind(1)
    width = x.max() - x.min()
    middle = (x.max() + x.min()) / 2
    # Half a width behind the foremost marker: the axis of a head that is as deep as wide.
    depth = (z - (z.max() - 0.5 * width - 0.25 * width)).clamp_min(1e-3 * float(width) + 1e-12)
    return torch.stack([0.5 * width * torch.atan2(x - middle, depth), y], 1)


def _contacts(sides: np.ndarray, lengths: np.ndarray, spanning: np.ndarray) -> np.ndarray:
    """(E, 2) the shortest edge over an opening from each marker that has one."""
    pairs, lengths = sides[spanning], lengths[spanning]
    order = np.argsort(lengths, kind="stable")
    best: dict[int, tuple[int, int]] = {}
    for a, b in pairs[order].tolist():
        best.setdefault(a, (a, b))
        best.setdefault(b, (a, b))
    return np.array(sorted(set(best.values())), dtype=np.int64).reshape(-1, 2)
