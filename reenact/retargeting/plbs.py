"""Patchwise linear blendshapes: an expression explained by a few examples, with weights of its own in every patch.

AnaConDaR, "Anatomically Constrained Data-Adaptive Facial Retargeting", 2024, section 3.2.1, after the anatomical local
model of Chandran et al. 2022. The text of the paper that we have ends at Eq. 1: 80 patches from METIS, linear
blendshapes (LBS) as the plain case and a regularised least-squares problem are theirs; overlap, partition of unity and
all terms of the energy but the first are our reconstruction.

Symbol    Code                  Shape
S, T      source.neutral, ...   (V, 3)
S_E, T_E  source_examples, ...  (E, V, 3) the same expressions on both
phi_p     Patches.shares        (V, P) how much of a vertex belongs to a patch; rows sum to 1
O_p                             vertices with a share in patch p
w^P_i     weights               (T, P, E)
S^P, T^P  explained, shown      (T, V, 3)

    E = sum_p sum_v phi_p(v) |S + sum_j w_pj (S_j - S) - S_i|^2(v)               explain the expression
      + overlap    sum_{p~q} sum_{v in O_p and O_q} |S^P_p - S^P_q|^2(v)         patches agree where they overlap
      + smoothness sum_{p~q} |w_p - w_q|^2  +  ridge sum_p |w_p|^2

    S^P_i = S + sum_p phi_p sum_j w_pj (S_j - S),     T^P_i = T + sum_p phi_p sum_j w_pj (T_j - T)

A vertex counts once, however many patches hold it: so equal weights in all patches are plain LBS, and no patch can make
the explanation worse than LBS. The first two sums are divided by what a patch of average size that moves has to
explain, which makes the others free of units.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import bsr_array, coo_array, csr_array, diags_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import connected_pieces, edge_graph, farthest_points, mesh_edges, nearest_along
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import apply_sparse, densify, vertex_pairs
from reenact.rigs.rig import Rig

try:
    import pymetis
except ImportError:  # an extra, `reenact[patches]`
    pymetis = None

_CHUNK = 16  # frames at a time: bounds memory, not results


@dataclass(frozen=True)
class PatchConfig:
    """How an expression is explained by patches; weights of the terms as in the head of this file."""

    patches: int = 80
    """Parts of the mesh; 1 is plain LBS. Meshes of fewer vertices have as many patches as vertices at most."""
    rings: int = 2
    """Rings of edges by which a patch reaches into its neighbours; 0 cuts the face along its borders."""
    overlap: float = 1.0
    """Patches agree where they overlap."""
    smoothness: float = 0.01
    """Neighbouring patches have equal weights."""
    ridge: float = 1e-5
    """Weights are small; examples that say the same share their weight."""
    metis: bool | None = None
    """Whether METIS cuts the mesh; otherwise areas around far points do. None: METIS where it is installed."""


# ---------------------------------------------------------------------------------------------------------------------
# Patches


@dataclass(frozen=True)
class Patches:
    """Parts of a mesh that overlap.

    Raises:
        ReenactError: A row of the shares does not sum to 1.
    """

    shares: csr_array
    """phi, (V, P): a partition of unity."""
    neighbours: Int[ndarray, "N 2"]
    """Patches with a common border."""

    def __post_init__(self) -> None:
        sums = self.shares.sum(1)
        if not np.allclose(sums, 1, rtol=0, atol=1e-9):
            vertex = int(np.abs(sums - 1).argmax())
            raise ReenactError(f"patches: expected shares that sum to 1, got {sums[vertex]} at vertex {vertex}")

    def __len__(self) -> int:
        return self.shares.shape[1]

    @classmethod
    def of(cls, rig: Rig, count: int = 80, rings: int = 2, metis: bool | None = None) -> Patches:
        """Patches of about equally many vertices; see `PatchConfig`.

        A share falls with the distance to the patch, in edges, like the first half of a cosine: with two rings of
        overlap 1, 0.75, 0.25, then 0. Each vertex divides them by their sum. Source: METIS is the paper's, the rest
        ours.
        """
        graph = mesh_graph(rig)
        labels = partition(rig, count, metis)
        shape = (len(labels), int(labels.max()) + 1)
        reached = coo_array((np.ones(len(labels)), (np.arange(len(labels)), labels)), shape=shape).tocsr()
        steps = ((graph + diags_array(np.ones(len(labels)))) > 0).astype(float).tocsr()
        fall = (1 + np.cos(np.pi * np.arange(rings + 2) / (rings + 1))) / 2
        shares = csr_array(shape)
        for ring in range(rings + 1):
            shares = shares + (fall[ring] - fall[ring + 1]) * reached
            reached = ((steps @ reached) > 0).astype(float)
        edges = graph.tocoo()
        ends = np.stack([labels[edges.coords[0]], labels[edges.coords[1]]], axis=1)
        return cls(_normalised(shares.tocsr()), np.unique(ends[ends[:, 0] < ends[:, 1]], axis=0))

    def carried(self, source: Rig, target: Rig, pairs: csr_array, smoothing: int = 6) -> Patches:
        """The same patches on another mesh.

        Args:
            source: Whose patches these are.
            target: That other mesh.
            pairs: (Vt, Vs) vertices that each vertex of it follows, as from `vertex_pairs`. Rows without any take after
                the nearest vertex along the surface that has one. Pieces without any (eyeballs, teeth, tongue) look for
                such pieces of the source, at the place beside the face where they are on the target.
            smoothing: Steps in which a vertex takes half of its share from its neighbours. Pairs that change from
                lid to lid and back would fray the edge; on two heads six steps leave the mean error of vertices as it
                is, and take 13 and 30 % from that of edges. None where each vertex has a partner of its own.
        """
        shares = (pairs @ self.shares).tocsr()
        paired = np.flatnonzero(shares.sum(1) > 1e-6)
        graph = mesh_graph(target, bridges=False)
        nearest, _ = nearest_along(graph, paired)
        shares = shares[paired[np.maximum(nearest, 0)]]
        lost = np.flatnonzero(nearest < 0)
        if len(lost):
            here, there = target.neutral.double().numpy(), source.neutral.double().numpy()
            beside = paired[cKDTree(here[paired]).query(here[lost])[1]]
            follows = (diags_array(1 / pairs[paired].sum(1)) @ pairs[paired] @ there)[np.searchsorted(paired, beside)]
            size = _spread(follows) / _spread(here[beside]) if _spread(here[beside]) > 0 else 1.0
            pieces = connected_pieces(source.faces.numpy(), len(there))
            alone = np.flatnonzero(~np.isin(pieces, pieces[pairs.tocoo().coords[1]]))
            alone = alone if len(alone) else np.arange(len(there))
            found = alone[cKDTree(there[alone]).query(follows + size * (here[lost] - here[beside]))[1]]
            shares = shares.tolil()
            shares[lost] = self.shares[found]
            shares = shares.tocsr()
        steps = (graph > 0).astype(float)
        around = steps.sum(1)
        steps = diags_array(np.where(around > 0, 0.5, 1.0)) + diags_array(0.5 / np.maximum(around, 1)) @ steps
        for _ in range(0 if _one_to_one(pairs) else smoothing):
            shares = (steps @ shares).tocsr()
        return Patches(_normalised(shares), self.neighbours)


def _one_to_one(pairs: csr_array) -> bool:
    rows, columns = pairs.max(axis=1).toarray(), pairs.sum(axis=0)
    return pairs.shape[0] == pairs.shape[1] and bool(rows.min() > 1 - 1e-6 and np.abs(columns - 1).max() < 1e-6)


def _spread(points: ndarray) -> float:
    return float(np.linalg.norm(points - points.mean(0)))


def _normalised(shares: csr_array) -> csr_array:
    return (diags_array(1 / shares.sum(1)) @ shares).tocsr()


def mesh_graph(rig: Rig, bridges: bool = True) -> csr_array:
    """(V, V) lengths of edges, in both directions.

    Bridges tie loose pieces (lashes, eyeballs, teeth) to the rest: for each an edge from its vertex that is closest to
    the pieces that are tied already, the largest first.
    """
    points, faces = rig.neutral.double().numpy(), rig.faces.numpy()
    ends = mesh_edges(faces)
    if bridges:
        ends = np.concatenate([ends, _bridges(points, ends)])
    graph = edge_graph(points, ends)
    return (graph + graph.T).tocsr()


def _bridges(points: ndarray, ends: ndarray) -> Int[ndarray, "N 2"]:
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(points),) * 2)
    count, pieces = connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(pieces), kind="stable")
    tied = np.flatnonzero(pieces == order[0])
    found = []
    for piece in order[1:count]:
        own = np.flatnonzero(pieces == piece)
        distance, nearest = cKDTree(points[tied]).query(points[own])
        closest = int(distance.argmin())
        found.append((own[closest], tied[nearest[closest]]))
        tied = np.concatenate([tied, own])
    return np.array(found, dtype=np.int64).reshape(-1, 2)


def partition(rig: Rig, count: int, metis: bool | None = None) -> Int[ndarray, "V"]:
    """The patch of each vertex, numbered from 0 without gaps; at most as many as asked for.

    Without METIS: farthest points as seeds, each vertex to the nearest seed along the edges, and three rounds in which
    the seed moves to the middle of its patch.

    Raises:
        ReenactError: No patch is asked for, or METIS is, and is not installed.
    """
    if count < 1:
        raise ReenactError(f"patches: expected at least 1, got {count}")
    if metis and pymetis is None:
        raise ReenactError("patches: METIS was asked for and is not installed; pip install 'reenact[patches]'")
    count = min(count, len(rig.neutral))
    graph = mesh_graph(rig)
    if count == 1:
        return np.zeros(len(rig.neutral), np.int64)
    if metis or (metis is None and pymetis is not None):
        adjacency = pymetis.CSRAdjacency(graph.indptr, graph.indices)
        _, labels = pymetis.part_graph(count, adjacency, options=pymetis.Options(seed=0), recursive=False)
        return np.unique(np.asarray(labels), return_inverse=True)[1].astype(np.int64)
    points = rig.neutral.double()
    seeds = farthest_points(points, count).numpy()
    for _ in range(3):
        labels, _ = nearest_along(graph, seeds)
        middles = np.stack([np.bincount(labels, axis, count) for axis in points.numpy().T], 1)
        middles /= np.maximum(np.bincount(labels, minlength=count), 1)[:, None]
        distance = np.linalg.norm(points.numpy() - middles[labels], axis=1)
        order = np.lexsort((distance, labels))
        found, first = np.unique(labels[order], return_index=True)
        seeds[found] = order[first]
    return np.unique(nearest_along(graph, seeds)[0], return_inverse=True)[1]


# ---------------------------------------------------------------------------------------------------------------------
# Blendshapes


class PatchwiseBlendshapes:
    """Explains meshes of one rig by examples, and shows the same mixture of the same examples on another.

    One factorisation serves all frames. Usable alone:

        plbs = PatchwiseBlendshapes(source, target, source_examples, target_examples, correspondence)
        target_vertices = plbs(source_vertices)
    """

    def __init__(
        self,
        source: Rig,
        target: Rig,
        source_examples: Float[Tensor, "E Vs 3"],
        target_examples: Float[Tensor, "N Vt 3"],
        correspondence: Correspondence | None = None,
        config: PatchConfig | None = None,
        *,
        importance: Float[Tensor, "Vs"] | None = None,
    ) -> None:
        """
        Args:
            source: Neutral and faces of what is explained; its shapes are not used.
            target: The same of what is shown.
            source_examples: Expressions of the source, metres.
            target_examples: The same expressions of the target.
            correspondence: Pairs that carry the patches; not needed where target and source are one mesh.
            config: Number of patches, and weights of the terms.
            importance: How much the squared error of each vertex of the source counts; 1 where None.

        Raises:
            ReenactError: Examples do not fit the rigs or each other, or there is no correspondence between two meshes.
        """
        self.source, self.target, self.config = source, target, config or PatchConfig()
        check_examples(source, source_examples)
        check_examples(target, target_examples)
        if len(source_examples) != len(target_examples):
            raise ReenactError(
                f"{source.name} to {target.name}: expected as many examples of both, got {len(source_examples)} and "
                f"{len(target_examples)}; find source expressions for target ones with `embed`"
            )
        self.patches = Patches.of(source, self.config.patches, self.config.rings, self.config.metis)
        """On the source."""
        self.target_patches = self.patches
        """The same on the target."""
        if correspondence is not None or not torch.equal(source.faces, target.faces):
            pairs = vertex_pairs(source, target, densify(source, target, correspondence), reach=0.05)
            self.target_patches = self.patches.carried(source, target, pairs)
        self._source_neutral, self._target_neutral = source.neutral.double(), target.neutral.double()
        self._source_deltas = source_examples.double() - self._source_neutral
        self._target_deltas = target_examples.double() - self._target_neutral
        counts = torch.ones(len(source.neutral)) if importance is None else importance
        self._shares = (diags_array(counts.double().numpy()) @ self.patches.shares).tocsc()  # (V, P)
        # What a patch has to explain, on average over the examples, and over patches by how much that is.
        moved = self._shares.T @ self._source_deltas.square().sum(-1).mean(0).numpy()  # (P,)
        self._unit = float((moved**2).sum() / moved.sum()) if moved.sum() > 0 else 1.0
        self._factor = self._factorised()

    def __call__(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T Vt 3"]:
        """T^P: target vertices in metres for meshes of the source."""
        return self.shown(self.weights(vertices))

    def weights(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T P E"]:
        """The weights of each patch that explain meshes of the source best; of any sign and size, float64."""
        check_examples(self.source, vertices)
        parts = [self._solved(part.double() - self._source_neutral) for part in vertices.split(_CHUNK) if len(part)]
        return (
            torch.cat(parts) if parts else vertices.new_zeros(0, len(self.patches), len(self._source_deltas)).double()
        )

    def explained(self, weights: Float[Tensor, "T P E"]) -> Float[Tensor, "T Vs 3"]:
        """S^P: the source as the weights have it."""
        return _mixed(self._source_neutral, self._source_deltas, self.patches, weights)

    def shown(self, weights: Float[Tensor, "T P E"]) -> Float[Tensor, "T Vt 3"]:
        """T^P: the target as the weights have it."""
        return _mixed(self._target_neutral, self._target_deltas, self.target_patches, weights)

    def _solved(self, offsets: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T P E"]:
        agreement = torch.einsum("tvc,evc->tve", offsets, self._source_deltas)
        sides = apply_sparse(self._shares.T.tocsr(), agreement).flatten(1) / self._unit
        return torch.from_numpy(self._factor.solve(sides.numpy().T.copy()).T.copy()).unflatten(
            1, (len(self.patches), -1)
        )

    def _factorised(self) -> SuperLU:
        """The quadratic form of the energy over the weights of all patches, (P E, P E)."""
        deltas, unit = self._source_deltas.numpy(), np.eye(len(self._source_deltas))
        members = [self._shares[:, [patch]].tocoo() for patch in range(len(self.patches))]
        blocks = {
            (p, p): _gram(deltas[:, own.coords[0]], own.data) / self._unit + self.config.ridge * unit
            for p, own in enumerate(members)
        }
        for p, q in self.patches.neighbours.tolist():
            both = np.intersect1d(members[p].coords[0], members[q].coords[0])
            apart = self.config.overlap * _gram(deltas[:, both]) / self._unit + self.config.smoothness * unit
            blocks[p, p], blocks[q, q] = blocks[p, p] + apart, blocks[q, q] + apart
            blocks[p, q] = blocks[q, p] = -apart
        places = sorted(blocks)
        rows = np.searchsorted([p for p, _ in places], np.arange(len(self.patches) + 1))
        size = len(self.patches) * len(unit)
        stacked = np.stack([blocks[place] for place in places])
        matrix = bsr_array((stacked, np.array([q for _, q in places]), rows), shape=(size, size)).tocsc()
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _gram(deltas: Float[ndarray, "E M 3"], weights: Float[ndarray, "M"] | float = 1.0) -> Float[ndarray, "E E"]:
    flat = deltas.reshape(len(deltas), -1)
    return flat * np.repeat(weights, 3) @ flat.T if isinstance(weights, ndarray) else weights * flat @ flat.T


def _mixed(
    neutral: Tensor, deltas: Tensor, patches: Patches, weights: Float[Tensor, "T P E"]
) -> Float[Tensor, "T V 3"]:
    """neutral + sum_p phi_p sum_j w_pj deltas_j, in float64."""
    if weights.shape[1:] != (len(patches), len(deltas)):
        raise ReenactError(
            f"patches: expected weights (frames, {len(patches)}, {len(deltas)}), got {tuple(weights.shape)}"
        )
    parts = [
        torch.einsum("tve,evc->tvc", apply_sparse(patches.shares, part.double()), deltas)
        for part in weights.split(_CHUNK)
        if len(part)
    ]
    return neutral + torch.cat([*parts, neutral.new_zeros(0, *neutral.shape)])


def check_examples(rig: Rig, meshes: Float[Tensor, "T V 3"]) -> None:
    """
    Raises:
        ReenactError: The meshes have another number of vertices than the rig.
    """
    if meshes.shape[1] != len(rig.neutral):
        raise ReenactError(
            f"{rig.name}: expected meshes of {len(rig.neutral)} vertices, got {meshes.shape[1]}; give meshes of the "
            "rig's own topology"
        )
