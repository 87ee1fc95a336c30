"""Deformation transfer: every face of the target is turned, stretched and sheared like its partner on the source.

Sumner & Popović 2004, "Deformation Transfer for Triangle Meshes", doi:10.1145/1015706.1015736. The fourth vertex that
they give to each face is eliminated, and faces are weighted by area, as in Botsch et al. 2006, "Deformation Transfer
for Detail-Preserving Surface Editing".

Symbol  Code                 Shape
S       gradients            (T, Fs, 3, 3) what the source's faces did
M       face_pairs           (Ft, Fs) which face of the source each face of the target follows, and how far
A       GradientSolver       (3 Ft, Vt) from vertices to the gradients that they make
x~      offsets              (T, Vt, 3) of the transferred expressions from the target's neutral
c(v)    vertex_pairs         (Vt, Vs) the place of the source that each vertex of the target follows, and how far
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import coo_array, csr_array, diags_array, sparray
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import (
    closest_points,
    connected_pieces,
    deformation_gradients,
    edge_graph,
    face_areas,
    face_frames,
    farthest_points,
    mesh_edges,
    nearest_along,
    similarity_fit,
    sound_faces,
    vertex_normals,
)
from reenact.retargeting.correspondence import Correspondence, Places
from reenact.retargeting.inverse_rig import InverseRig, nonnegative_least_squares
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig

_CHUNK = 8  # expressions at a time: bounds memory, not results


class DeformationTransfer:
    """Transfers the source's deformation gradients; one factorisation and one solve for all of its shapes.

    The solve is linear in the gradients, and these are linear in the weights but along the normal, the direction that
    a face does not know and where Sumner & Popović take the scaled normal. So the source's shapes are transferred once,
    at full strength, and a clip combines them. That is what `transfer` does to each frame where partner faces lie in
    parallel planes; between heads of different proportions the two differ by 2 to 3 % of the motion.
    """

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        weighting: Literal["areas", "faces"] = "areas",
        reach: float = 0.05,
    ) -> None:
        """
        Args:
            source: Where motion comes from.
            target: Where it goes to.
            correspondence: Pairs, best one for each vertex; where there are none, see `densify`.
            training: Not used.
            weighting: `faces` weights all faces alike, as Sumner & Popović do; `areas` makes the result independent of
                how finely a surface is cut into faces.
            reach: How far along the target's surface a pair speaks for vertices without one, in heights of the target;
                from there to the double of it they stiffen. What no pair reaches is not deformed.

        Raises:
            ReenactError: There is no correspondence, or it belongs to other rigs.
        """
        self.source, self.target = source, target
        correspondence = densify(source, target, correspondence)
        followed = vertex_pairs(source, target, correspondence, reach)
        sound = sound_faces(source.neutral, source.faces).numpy()
        self.face_pairs = face_pairs(source, target, followed)
        unsound = self.face_pairs @ (~sound).astype(float) > 0  # follows a face that says nothing
        importance = face_areas(target.neutral.double(), target.faces).numpy() if weighting == "areas" else 1.0
        self.solver = GradientSolver(target, importance * ~unsound)
        scale, _, _ = similarity_fit(
            correspondence.source.of(source.neutral.double()),
            correspondence.target.of(target.neutral.double()),
            correspondence.confidence.double(),
        )
        self._carried = float(scale) * followed  # source offsets -> what plain delta transfer would make of them
        self._anchors = Anchors(target, self.solver.pieces, self._carry(source.deltas.double()))
        self.covered = torch.from_numpy(followed.sum(1))
        """How far each vertex of the target follows the source, (Vt,) in [0, 1]."""
        self._explanation = Explanation(target, self.solver.pieces, followed.sum(1))
        offsets = self._transfer(source.vertices(torch.eye(len(source.names))).double())
        self._projection = self._explanation.projections(offsets)  # (Ks, Kt)
        offsets = self._explanation.complete(offsets)
        self.shapes = Rig(
            f"{source.name} on {target.name}", target.neutral, offsets.float(), source.names, target.faces
        )
        """The source's shapes on the target's mesh."""

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target: bounded least squares of `vertices(clip)`, weights in [0, 1]."""
        check_names(clip, self.source)
        weights = self._explanation.weights(clip.weights.double() @ self._projection)
        return replace(clip, names=self.target.names, weights=weights.float())

    def vertices(self, clip: Clip) -> Float[Tensor, "T V 3"]:
        """Target vertices in metres, outside the span of the target's own shapes."""
        check_names(clip, self.source)
        return self.shapes.vertices(clip.weights)

    def transfer(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T Vt 3"]:
        """Target vertices for any meshes of the source's topology: the method to the letter, a solve for each.

        Source: Sumner & Popović 2004, the section on deformation transfer.
        """
        if vertices.shape[1] != len(self.source.neutral):
            raise ReenactError(
                f"{self.source.name}: expected {len(self.source.neutral)} vertices a frame, got {vertices.shape[1]}"
            )
        moved = self.target.neutral.double() + self._explanation.complete(self._transfer(vertices.double()))
        return moved.to(vertices.dtype)

    def gradients(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T Ft 3 3"]:
        """What each face of the target should do, less the identity, in float64."""
        unit = torch.eye(3, dtype=torch.float64)
        source = deformation_gradients(self.source.neutral.double(), vertices.double(), self.source.faces) - unit
        return apply_sparse(self.face_pairs, source.flatten(2)).unflatten(2, (3, 3))

    def settle(self, gradients: Float[Tensor, "T Ft 3 3"], offsets: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T Vt 3"]:
        """Target offsets from gradients of its faces, less the identity; the source's offsets place loose pieces."""
        return self._anchors(self.solver(gradients), self._carry(offsets))

    def _transfer(self, vertices: Tensor) -> Tensor:
        neutral = self.source.neutral.double()
        return torch.cat([self.settle(self.gradients(part), part - neutral) for part in vertices.split(_CHUNK)])

    def _carry(self, offsets: Tensor) -> Tensor:
        return apply_sparse(self._carried, offsets)


def apply_sparse(matrix: csr_array, values: Float[Tensor, "T N C"]) -> Float[Tensor, "T M C"]:
    """The sparse (M, N) matrix times each frame."""
    frames, count, channels = values.shape
    columns = values.permute(1, 0, 2).reshape(count, -1).numpy()
    return torch.from_numpy(matrix @ columns).reshape(-1, frames, channels).permute(1, 0, 2)


# ---------------------------------------------------------------------------------------------------------------------
# From gradients to vertices


class GradientSolver:
    """Vertices whose faces deform as asked, by least squares; factored once for x, y, z and all expressions.

    Faces that share no edge are not tied to each other: each connected piece may still be moved as a whole, and is
    returned with its first vertex at rest.

    Source: Sumner & Popović 2004, the system A^T A x = A^T c. Their fourth vertex of a face occurs in that face only;
    it always meets the gradient along the normal exactly, so what is left is the gradient in the plane of the face.
    """

    def __init__(self, rig: Rig, importance: Float[ndarray, "F"]) -> None:
        """
        Args:
            rig: Its neutral and faces; faces without area are left out.
            importance: Weight of the squared error of each face; 0 leaves it out.
        """
        faces, count = rig.faces.numpy(), len(rig.neutral)
        used = sound_faces(rig.neutral, rig.faces).numpy() & (importance > 0)
        faces, self._used = faces[used], used
        edges = face_frames(rig.neutral.double(), rig.faces)[..., :2].numpy()[used]  # (F, 3, 2)
        slopes = np.linalg.pinv(edges)  # (F, 2, 3): gradients of the second and third corner's hat functions
        slopes = np.concatenate([-slopes.sum(1, keepdims=True), slopes], 1)  # (F, 3 corners, 3 axes)
        rows = np.broadcast_to(3 * np.arange(len(faces))[:, None, None] + np.arange(3), slopes.shape)
        columns = np.broadcast_to(faces[:, :, None], slopes.shape)
        shape = (3 * len(faces), count)
        operator = coo_array((slopes.ravel(), (rows.ravel(), columns.ravel())), shape=shape).tocsr()  # A
        self._weighted = (diags_array(np.repeat(importance[used], 3)) @ operator).T.tocsr()  # A^T W
        self.pieces = connected_pieces(faces, count)
        _, first = np.unique(self.pieces, return_index=True)
        self._free = np.setdiff1d(np.arange(count), first)
        normal = (self._weighted @ operator).tocsr()[self._free][:, self._free]
        self._factor = _factored(normal)

    def __call__(self, gradients: Float[Tensor, "T F 3 3"]) -> Float[Tensor, "T V 3"]:
        """Offsets from the neutral for gradients less the identity, float64."""
        frames = len(gradients)
        # Row (face, axis of the neutral), column (frame, axis of the offset).
        wanted = gradients.numpy()[:, self._used].transpose(1, 3, 0, 2).reshape(-1, 3 * frames)
        offsets = np.zeros((self._weighted.shape[0], 3 * frames))
        offsets[self._free] = self._factor.solve((self._weighted @ wanted)[self._free])
        return torch.from_numpy(offsets).unflatten(1, (frames, 3)).transpose(0, 1)


class Anchors:
    """Puts the connected pieces of a transferred mesh where they belong: gradients leave three numbers open for each.

    A piece with vertices that no shape of the source moves, like the back of the head, keeps these at rest on average.
    Any other (eyeball, lash, lower teeth) follows the surface beside it as far as it does so on the source, and what it
    does there on its own is added in the target's size: a lash rides on its lid, an eyeball behind it stays.

    Source: ours; Sumner & Popović fix one vertex.
    """

    _STILL = 0.005
    """Share of the largest offset; vertices that move less than that count as still."""

    def __init__(self, rig: Rig, pieces: ndarray, carried: Float[Tensor, "K V 3"]) -> None:
        """
        Args:
            rig: The mesh that is put together.
            pieces: Piece of each vertex.
            carried: Offsets of the source's shapes at the partners of the vertices, in this mesh's size.
        """
        largest = carried.norm(dim=-1).amax(0).numpy()
        still = largest <= self._STILL * largest.max()
        members = [np.flatnonzero(pieces == piece) for piece in range(pieces.max() + 1)]
        grounded = [still[vertices].sum() >= min(4, len(vertices)) for vertices in members]
        self._held = [(vertices, vertices[still[vertices]]) for vertices, held in zip(members, grounded) if held]
        hosts = [vertices for vertices, held in zip(members, grounded) if held and not still[vertices].all()]
        ground = np.concatenate(hosts) if hosts else None
        tree = cKDTree(rig.neutral[ground].numpy()) if hosts else None
        self._loose: list[tuple[ndarray, ndarray, ndarray, float]] = []
        for vertices in (vertices for vertices, held in zip(members, grounded) if not held):
            roots, beside, follows = vertices, vertices, 0.0
            if tree is not None:
                distance, nearest = tree.query(rig.neutral[vertices].numpy())
                close = np.argsort(distance, kind="stable")[: max(1, len(vertices) // 4)]
                roots, beside = vertices[close], ground[nearest[close]]
                own, led = carried[:, roots].mean(1), carried[:, beside].mean(1)  # (K, 3)
                follows = float(((own * led).sum() / led.square().sum().clamp_min(1e-30)).clamp(0, 1))
            self._loose.append((vertices, roots, beside, follows))

    def __call__(self, offsets: Float[Tensor, "T V 3"], carried: Float[Tensor, "T V 3"]) -> Float[Tensor, "T V 3"]:
        """The offsets with each piece moved as a whole, given what the source does at its partners."""
        offsets = offsets.clone()
        for vertices, still in self._held:
            offsets[:, vertices] += (carried[:, still] - offsets[:, still]).mean(1, keepdim=True)
        for vertices, roots, beside, follows in self._loose:
            wanted = carried[:, roots] + follows * (offsets[:, beside] - carried[:, beside])
            offsets[:, vertices] += (wanted - offsets[:, roots]).mean(1, keepdim=True)
        return offsets


class Explanation:
    """Weights of the target's shapes for transferred vertices, and what these say of pieces without partners.

    Pieces that have no partner on the source (often teeth, tongue, eyes) move as the target's own shapes do. In doubt
    they rest: a shape that moves little else, like a glance, needs good reason.

    Source: ours, but for the bounded least squares.
    """

    _REST = 0.05
    """Mean squared motion of the pieces without partner, against mean squared error on the rest."""

    def __init__(self, rig: Rig, pieces: ndarray, covered: Float[ndarray, "V"]) -> None:
        """
        Args:
            rig: The target.
            pieces: Piece of each vertex.
            covered: How far each vertex follows the source, in [0, 1].
        """
        lost = (np.bincount(pieces, covered) / np.bincount(pieces) < 0.1)[pieces]
        rest = self._REST * covered.sum() / max(lost.sum(), 1)
        self._rig, self._lost = rig, torch.from_numpy(np.flatnonzero(lost))
        self._inverse = InverseRig(rig, importance=torch.from_numpy(np.where(lost, rest, covered)))

    def projections(self, offsets: Float[Tensor, "T V 3"]) -> Float[Tensor, "T K"]:
        """What the target's shapes have in common with the offsets; see `weights`."""
        offsets = offsets.clone()
        offsets[:, self._lost] = 0
        return self._inverse.projections(self._rig.neutral.double() + offsets)

    def weights(self, projections: Float[Tensor, "T K"]) -> Float[Tensor, "T K"]:
        """Bounded least squares, in [0, 1]."""
        return nonnegative_least_squares(self._inverse.gram, projections, high=1.0)

    def complete(self, offsets: Float[Tensor, "T V 3"]) -> Float[Tensor, "T V 3"]:
        """The offsets with the pieces without partners filled in."""
        if len(self._lost) == 0:
            return offsets
        offsets, weights = offsets.clone(), self.weights(self.projections(offsets))
        offsets[:, self._lost] = torch.einsum("tk,kvc->tvc", weights, self._rig.deltas[:, self._lost].double())
        return offsets


# ---------------------------------------------------------------------------------------------------------------------
# Who follows whom


def vertex_pairs(source: Rig, target: Rig, correspondence: Correspondence, reach: float) -> csr_array:
    """(Vt, Vs) shares of the source in each vertex of the target; a row sums to how far it follows, from 0 to 1.

    A vertex takes the mean of the pairs at it, by confidence and closeness. Without one, it takes after the paired
    vertex that is nearest along the surface: never after the other lip, however close. An unsure pair yields to a surer
    one, but alone it counts fully: stiffening where in doubt shrinks every expression.

    Args:
        source: The columns.
        target: The rows.
        correspondence: Pairs; those with a confidence of 0 are left out.
        reach: Distance in heights of the target up to which pairs speak for their neighbours; it fades to the double.

    Raises:
        ReenactError: The correspondence names vertices that the rigs do not have.
    """
    _check_belongs(source, target, correspondence)
    sampled = _sampling(correspondence.source, len(source.neutral))  # (N, Vs)
    confidence = correspondence.confidence.double().numpy()
    votes = (_sampling(correspondence.target, len(target.neutral)).T @ diags_array(confidence)).tocsr()  # (Vt, N)
    total = votes.sum(1)
    paired = np.flatnonzero(total > 1e-6)
    shares = diags_array(1 / total[paired]) @ votes[paired]
    nearest, fade = _reached(target, paired, reach)
    chosen = np.flatnonzero(fade > 0)
    rows = coo_array((fade[chosen], (chosen, nearest[chosen])), shape=(len(total), len(paired))).tocsr()
    return (rows @ shares @ sampled).tocsr()


def _check_belongs(source: Rig, target: Rig, correspondence: Correspondence) -> None:
    for rig, places in ((source, correspondence.source), (target, correspondence.target)):
        if int(places.corners.max()) >= len(rig.neutral):
            raise ReenactError(
                f"correspondence: expected places on the {len(rig.neutral)} vertices of {rig.name}, got vertex "
                f"{int(places.corners.max())}; it was made for another rig"
            )


def _sampling(places: Places, count: int) -> csr_array:
    """(N, V) matrix that samples at the places."""
    rows = np.repeat(np.arange(len(places)), 3)
    shares, corners = places.shares.double().numpy().ravel(), places.corners.numpy().ravel()
    kept = shares > 1e-9  # a whole vertex is stored as three, two of them without a share
    return coo_array((shares[kept], (rows[kept], corners[kept])), shape=(len(places), count)).tocsr()


def _reached(rig: Rig, paired: ndarray, reach: float) -> tuple[ndarray, ndarray]:
    """For each vertex the paired one that is nearest along edges, as an index into `paired`, and how far it holds."""
    points, faces = rig.neutral.double().numpy(), rig.faces.numpy()
    nearest, distance = nearest_along(edge_graph(points, mesh_edges(faces)), paired)
    limit = reach * np.ptp(points[:, 1])
    fade = np.clip(2 - distance / limit, 0, 1) if limit > 0 else (distance == 0).astype(float)
    return np.maximum(nearest, 0), fade


def face_pairs(source: Rig, target: Rig, followed: csr_array) -> csr_array:
    """(Ft, Fs) face of the source that the centre of each target face corresponds to; a row sums to how far it follows.

    Candidates are the source faces around the vertices that the face's corners follow, so that a face of the upper lip
    never looks at the lower one. Of these the one wins whose centre lies closest to where the target's centre goes.

    Args:
        source: The columns.
        target: The rows.
        followed: `vertex_pairs` of the same rigs.
    """
    target_count, source_count = len(target.faces), len(source.faces)
    corners = coo_array(
        (np.full(3 * target_count, 1 / 3), (np.repeat(np.arange(target_count), 3), target.faces.numpy().ravel())),
        shape=(target_count, len(target.neutral)),
    ).tocsr()
    around = coo_array(
        (np.ones(3 * source_count), (source.faces.numpy().ravel(), np.repeat(np.arange(source_count), 3))),
        shape=(len(source.neutral), source_count),
    ).tocsr()
    centres = corners @ followed  # (Ft, Vs)
    coverage = centres.sum(1)
    points = source.neutral.double().numpy()
    wanted = (centres @ points) / np.maximum(coverage, 1e-12)[:, None]
    candidates = (centres @ around).tocsr()
    rows = np.repeat(np.arange(target_count), np.diff(candidates.indptr))
    middles = points[source.faces.numpy()].mean(1)
    distance = np.linalg.norm(middles[candidates.indices] - wanted[rows], axis=1)
    order = np.lexsort((candidates.indices, distance, rows))
    found, first = np.unique(rows[order], return_index=True)
    winners = candidates.indices[order][first]
    return coo_array((coverage[found], (found, winners)), shape=(target_count, source_count)).tocsr()


def densify(source: Rig, target: Rig, correspondence: Correspondence | None) -> Correspondence:
    """The correspondence itself if it covers the target; else with its gaps filled.

    Gradients must be known between what moves and what rests, or the face drifts. Where a tenth of the target's
    vertices or more is not close to a pair, 300 pairs serve as markers of `transfer_correspondence`, whose pairs fill
    the gaps on both rigs. Then unsure pairs, below 0.3, are better left to it too, unless fewer than a hundred stay.
    Connected pieces without any given pair stay without, and do not count: an eyeball has no partner in a lid.

    Raises:
        ReenactError: There is no correspondence, or it belongs to other rigs.
    """
    if correspondence is None:
        raise ReenactError(f"{source.name} to {target.name}: expected a correspondence, got none; let it be found")
    _check_belongs(source, target, correspondence)
    gaps, held = _gaps(target, correspondence.target)
    if gaps.sum() < 0.1 * held.sum():
        return correspondence
    best = correspondence.confidence.sort(descending=True).values[:100]
    sure = correspondence[(correspondence.confidence >= best[-1].clamp_max(0.3)).nonzero().flatten()]
    count = min(300, int((sure.confidence > 0).sum()))
    markers = sure[farthest_points(sure.source.of(source.neutral), count, sure.confidence)]
    dense = transfer_correspondence(source, target, markers)
    source_gaps, target_gaps = _gaps(source, sure.source)[0], _gaps(target, sure.target)[0]
    fills = source_gaps[dense.source.corners.numpy()].all(1) | target_gaps[dense.target.corners.numpy()].all(1)
    added = torch.from_numpy(np.flatnonzero(fills))
    return Correspondence(
        _joined(sure.source, dense.source[added]),
        _joined(sure.target, dense.target[added]),
        torch.cat([sure.confidence, dense.confidence[added]]),
    )


def _joined(first: Places, second: Places) -> Places:
    return Places(torch.cat([first.corners, second.corners]), torch.cat([first.shares, second.shares]))


def _gaps(rig: Rig, places: Places) -> tuple[ndarray, ndarray]:
    """Vertices that are not close to any place along the surface, and vertices of pieces that hold a place."""
    paired = np.unique(places.corners.numpy()[places.shares.numpy() > 1e-6])
    _, fade = _reached(rig, paired, 0.01)
    pieces = connected_pieces(rig.faces.numpy(), len(rig.neutral))
    held = np.isin(pieces, pieces[paired])
    return (fade == 0) & held, held


@dataclass(frozen=True)
class CorrespondenceConfig:
    """How a source is deformed onto a target to learn which faces belong together."""

    smoothness: float = 1.0
    """w_S: neighbouring faces deform alike."""
    identity: float = 0.001
    """w_I: faces deform little."""
    closeness: tuple[float, ...] = (1.0, 10.0, 200.0, 5000.0)
    """w_C of each step after the first, which has none: vertices move to the closest points of the target."""
    distance: float = 0.02
    """Pairs this far apart at the end, in heights of the target, have a confidence of 1 / e."""


def transfer_correspondence(
    source: Rig, target: Rig, markers: Correspondence, config: CorrespondenceConfig | None = None
) -> Correspondence:
    """Dense pairs from a few markers: the source is deformed until it lies on the target.

    Returns:
        Each vertex of the source with its closest point on the target, then each vertex of the target with its closest
        point on the deformed source; vertices of connected pieces with markers only, since an eyeball left to itself
        would find a lid. Confidence falls with the distance left, and is 0 where the normals are more than a right
        angle apart.

    Source: Sumner & Popović 2004, E_S, E_I and E_C of the section on correspondence. Their weights depend on the size
    of the meshes, which they do not tell: we scale the target's box to a diagonal of 1. Ours too: markers hold to about
    a millionth, not exactly; the source starts from the similarity that brings them closest; and a vertex whose closest
    point faces away is left free, where the paper searches on for one that does not.
    """
    config = config or CorrespondenceConfig()
    _check_belongs(source, target, markers)
    (own, source_faces), (theirs, target_faces) = (
        _pieces_with(source, markers.source),
        _pieces_with(target, markers.target),
    )
    size = float(np.linalg.norm(np.ptp(target.neutral.numpy(), axis=0)))
    goal, wanted = target.neutral.double()[theirs] / size, markers.target.of(target.neutral.double()) / size
    scale, rotation, translation = similarity_fit(markers.source.of(source.neutral.double()), wanted)
    start = scale * source.neutral.double()[own] @ rotation.T + translation
    count = len(start)

    # Unknowns are the vertices, then a fourth one for each face: along its normal it must be smooth as well.
    unknown = torch.cat([start, start[source_faces[:, 0]] + face_frames(start, source_faces)[..., 2]]).numpy()
    operator = _full_gradients(start, source_faces)  # (3 F, V + F)
    first, second = _neighbours(source_faces.numpy())
    rows = 3 * np.stack([first, second])[..., None] + np.arange(3)  # (2, pairs, 3)
    differences = operator[rows[0].ravel()] - operator[rows[1].ravel()]
    units = np.tile(np.eye(3), (len(source_faces), 1))
    sampled = _sampling(markers.source, len(source.neutral))[:, own.numpy()]
    sampled = csr_array((sampled.data, sampled.indices, sampled.indptr), shape=(len(markers), len(unknown)))
    smooth = config.smoothness * (differences.T @ differences) + config.identity * (operator.T @ operator)
    # The last term keeps what nothing else determines, like a vertex without faces, where it starts.
    fixed = smooth + 1e6 * (sampled.T @ sampled) + 1e-6 * diags_array(np.ones(len(unknown)))
    fixed_side = config.identity * (operator.T @ units) + 1e6 * (sampled.T @ wanted.numpy()) + 1e-6 * unknown
    for weight in (0.0, *config.closeness):
        pulled = np.zeros(len(unknown))
        side = fixed_side.copy()
        if weight > 0:
            places, _, agreement = _project(torch.from_numpy(unknown[:count]), source_faces, goal, target_faces)
            pulled[:count] = weight * (agreement > 0).double().numpy()
            side[:count] += pulled[:count, None] * places.of(goal).numpy()
        unknown = _factored(fixed + diags_array(pulled)).solve(side)

    deformed = torch.from_numpy(unknown[:count])
    there, there_gap, there_agreement = _project(deformed, source_faces, goal, target_faces)
    back, back_gap, back_agreement = _project(goal, target_faces, deformed, source_faces)
    gap = torch.cat([there_gap, back_gap]) * size / float(np.ptp(target.neutral[:, 1].numpy()))
    confidence = torch.exp(-gap / config.distance) * (torch.cat([there_agreement, back_agreement]) > 0)
    return Correspondence(
        _joined(Places.at(own), Places(own[back.corners], back.shares)),
        _joined(Places(theirs[there.corners], there.shares), Places.at(theirs)),
        confidence.float(),
    )


def _pieces_with(rig: Rig, places: Places) -> tuple[Int[Tensor, "V"], Int[Tensor, "F 3"]]:
    """Vertices of the connected pieces that hold a place, and the faces between them, by their new numbers."""
    pieces = connected_pieces(rig.faces.numpy(), len(rig.neutral))
    chosen = np.isin(pieces, pieces[places.corners.numpy()[places.shares.numpy() > 1e-6]])
    number = torch.from_numpy(np.cumsum(chosen) - 1)
    return torch.from_numpy(np.flatnonzero(chosen)), number[rig.faces[torch.from_numpy(chosen)[rig.faces[:, 0]]]]


def _factored(matrix: sparray) -> SuperLU:
    """Factors of a symmetric, positive definite matrix: no pivoting, so that the order that keeps them sparse holds."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _full_gradients(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> csr_array:
    """(3 F, V + F) matrix from vertices, and a fourth one for each face, to gradients. Source: Q = V~ V^-1."""
    sound = sound_faces(vertices, faces)[:, None, None]
    frames = torch.where(sound, face_frames(vertices, faces), torch.eye(3, dtype=vertices.dtype))
    slopes = (torch.linalg.inv(frames) * sound).numpy()  # (F, 3 corners after the first, 3 axes)
    slopes = np.concatenate([-slopes.sum(1, keepdims=True), slopes], 1)  # (F, 4, 3)
    corners = np.concatenate([faces.numpy(), len(vertices) + np.arange(len(faces))[:, None]], 1)  # (F, 4)
    rows = np.broadcast_to(3 * np.arange(len(faces))[:, None, None] + np.arange(3), slopes.shape)
    columns = np.broadcast_to(corners[:, :, None], slopes.shape)
    shape = (3 * len(faces), len(vertices) + len(faces))
    return coo_array((slopes.ravel(), (rows.ravel(), columns.ravel())), shape=shape).tocsr()


def _neighbours(faces: ndarray) -> tuple[ndarray, ndarray]:
    """Pairs of faces with a common edge."""
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.lexsort((owner, edges[:, 1], edges[:, 0]))
    same = (edges[order][1:] == edges[order][:-1]).all(1)
    return owner[order][:-1][same], owner[order][1:][same]


def _project(
    points: Float[Tensor, "V 3"],
    point_faces: Int[Tensor, "F 3"],
    vertices: Float[Tensor, "W 3"],
    faces: Int[Tensor, "G 3"],
) -> tuple[Places, Float[Tensor, "V"], Float[Tensor, "V"]]:
    """The closest places of a second mesh, how far they are, and the cosine between the normals."""
    face, shares = closest_points(points, vertices, faces)
    places = Places(faces[face], shares)
    agreement = (vertex_normals(points, point_faces) * places.of(vertex_normals(vertices, faces))).sum(-1)
    return places, (places.of(vertices) - points).norm(dim=-1), agreement
