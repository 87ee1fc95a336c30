"""Landmarks: what shapes tell of a face without names of theirs, its jaw, lips and lids. Ours."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.spatial import cKDTree
from torch import Tensor

from reenact.geometry import connected_pieces, edge_graph, mesh_edges, nearest_along, rigid_fit
from reenact.retargeting.face import Face
from reenact.rigs.rig import Rig


@dataclass(frozen=True)
class Contact:
    """Two sides of skin that touch but do not pass through each other, as vertices of the rig."""

    upper: Int[Tensor, "U"]
    lower: Int[Tensor, "L"]
    pairs: Int[Tensor, "P 2"]
    """Upper and lower vertices that meet when it shuts, from the right of the character to its left."""


def face_height(rig: Rig) -> float:
    """H: root of the nose to chin, metres; 1.8 times the height of the lids above the lips where both are found.

    Otherwise the height of what moves. Source: the proportion of an average adult, as in `evaluation`.
    """
    return Landmarks.of(rig).height


@dataclass(frozen=True)
class Landmarks:
    """What shapes tell of a face without names: its jaw, lips and lids."""

    face: Face
    height: float
    jaw_shape: int
    """The shape that opens the jaw: the one that moves most skin downwards."""
    jaw_motion: tuple[Float[ndarray, "3 3"], Float[ndarray, "3"]]
    """Rotation and translation of the jaw in that shape at full strength."""
    jaw_share: Float[ndarray, "N"]
    """How far each vertex of the face follows the jaw, 0 to 1."""
    jaw_vertices: Int[ndarray, "J"]
    """Vertices of the rig that tell where the jaw is: lower teeth, or skin of the chin where there are none."""
    jaw_weights: Float[ndarray, "J"]
    condyles: Float[ndarray, "2 3"] | None
    """Joints of the jaw, where only skin tells its pose; None where teeth do."""
    jaw_pieces: Int[ndarray, "C"]
    """Vertices of loose pieces that move with the jaw as one: lower teeth."""
    skull_pieces: Int[ndarray, "D"]
    """Vertices of loose pieces that no shape moves: upper teeth."""
    contacts: dict[str, Contact]
    """`lips`, `lids_left`, `lids_right`, those that are found."""
    mouth: Float[ndarray, "3"] | None
    eyes: Float[ndarray, "2 3"] | None
    """Middle of the lids, left and right of the character."""

    @classmethod
    def of(cls, rig: Rig) -> Landmarks:
        """
        Raises:
            ReenactError: The shapes move no face, see `face.Face`.
        """
        face = Face.of(rig)
        points, height = face.points, face.height
        jaw_shape = int((face.areas[None] * -face.deltas[:, :, 1].clip(max=0)).sum(1).argmax())
        opening = face.deltas[jaw_shape]
        travel = np.linalg.norm(opening, axis=1)
        # Chin: moves far when the jaw opens, and little otherwise.
        others = np.square(np.delete(face.deltas, jaw_shape, 0)).sum((0, 2))
        telling = np.square(travel**2 / (travel**2 + 0.5 * others + 1e-12 * height**2)) * face.areas
        chin = np.flatnonzero(
            (travel > 0.7 * travel.max()) & (telling > 0.2 * telling[travel > 0.7 * travel.max()].max())
        )
        middle = np.array([np.median(points[face.strength > 0.1, 0]), *points[chin].mean(0)[1:]])
        condyles = middle + np.array([[0.4, 0.32, -0.45], [-0.4, 0.32, -0.45]]) * height
        jaw_vertices, jaw_weights = face.vertices[chin], telling[chin] / telling[chin].sum()
        motion = rigid_pose(points[chin], points[chin] + opening[chin], jaw_weights, condyles)

        jaw_pieces, skull_pieces = _loose_pieces(rig, face, jaw_shape, motion)
        if len(jaw_pieces) >= 12:
            teeth = rig.neutral[jaw_pieces].double().numpy()
            jaw_vertices, condyles = jaw_pieces, None
            jaw_weights = np.full(len(jaw_pieces), 1 / len(jaw_pieces))
            motion = rigid_pose(teeth, teeth + rig.deltas[jaw_shape, jaw_pieces].double().numpy(), jaw_weights, None)
        rigid = points @ motion[0].T + motion[1] - points
        length = np.square(rigid).sum(1)
        share = (opening * rigid).sum(1) / np.maximum(length, (0.02 * height) ** 2)
        share = smoothed(smoothing_matrix(face.faces, len(points)), share.clip(0, 1), 2)

        lips = _lips(face, share, height)
        lids = _lids(face, lips, height)
        if lips is not None and len(lids) == 2:
            sides = [points[pair.ravel()].mean(0) for pair in lids.values()]
            height = 1.8 * float(np.mean([side[1] for side in sides]) - points[lips.ravel(), 1].mean())
        contacts = {}
        if lips is not None:
            contacts["lips"] = _sides(face, lips, 0.07 * height)
        for name, pairs in lids.items():
            contacts[name] = _sides(face, pairs, 0.05 * height)
        eyes = None
        if len(lids) == 2:
            eyes = np.stack([points[lids[name].ravel()].mean(0) for name in ("lids_left", "lids_right")])
        return cls(
            face,
            height,
            jaw_shape,
            motion,
            share,
            jaw_vertices,
            jaw_weights,
            condyles,
            jaw_pieces,
            skull_pieces,
            contacts,
            None if lips is None else points[lips.ravel()].mean(0),
            eyes,
        )


def rigid_pose(
    rest: Float[ndarray, "J 3"], moved: Float[ndarray, "J 3"], weights: ndarray, condyles: ndarray | None
) -> tuple[ndarray, ndarray]:
    """Rotation and translation of the jaw; its joints hold on to the skull where skin alone would leave them open."""
    if condyles is not None:
        rest, moved = np.concatenate([rest, condyles]), np.concatenate([moved, condyles])
        weights = np.concatenate([weights, np.full(len(condyles), 0.15)])
    rotation, translation = rigid_fit(
        *(torch.from_numpy(np.ascontiguousarray(each)) for each in (rest, moved, weights))
    )
    return rotation.numpy(), translation.numpy()


def _loose_pieces(rig: Rig, face: Face, jaw_shape: int, motion: tuple[ndarray, ndarray]) -> tuple[ndarray, ndarray]:
    """Vertices of pieces that move with the jaw as one, and of pieces that never move."""
    points, deltas = rig.neutral.double().numpy(), rig.deltas.double().numpy()
    pieces = connected_pieces(rig.faces.numpy(), len(points))
    own = np.unique(pieces[face.vertices])
    opening = deltas[jaw_shape]
    farthest = np.linalg.norm(opening, axis=1).max()
    jaw, skull = [], []
    for piece in np.setdiff1d(np.arange(pieces.max() + 1), own):
        members = np.flatnonzero(pieces == piece)
        if len(members) < 4:
            continue
        if np.abs(deltas[:, members]).max() < 0.01 * farthest:
            skull.append(members)
            continue
        # As the jaw moves them: nearly rigidly, and far.
        rest, moved = points[members], points[members] + opening[members]
        rotation, translation = rigid_pose(rest, moved, np.ones(len(members)), None)
        miss = np.linalg.norm(rest @ rotation.T + translation - moved, axis=1).max()
        as_jaw = np.linalg.norm(rest @ motion[0].T + motion[1] - moved, axis=1).mean()
        travel = np.linalg.norm(opening[members], axis=1).mean()
        if travel < 0.2 * farthest or miss > 0.15 * travel or as_jaw > 0.35 * travel:
            continue
        # A tongue rides on the jaw, but bends in shapes of its own.
        bends = 0.0
        for delta in deltas[:, members]:
            if np.abs(delta).max() > 0.02 * farthest:
                rotation, translation = rigid_pose(rest, rest + delta, np.ones(len(members)), None)
                bends = max(bends, np.linalg.norm(rest @ rotation.T + translation - rest - delta, axis=1).max())
        if bends < 0.15 * travel:
            jaw.append(members)
    return tuple(np.concatenate(found) if found else np.zeros(0, np.int64) for found in (jaw, skull))


def smoothing_matrix(faces: Int[ndarray, "M 3"], count: int) -> csr_array:
    """(N, N): each value half way to the mean of its neighbours."""
    edges = mesh_edges(faces)
    ends = np.concatenate([edges, edges[:, ::-1]])
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count)).tocsr()
    alone = np.asarray(graph.sum(1)) == 0
    shares = 0.5 / np.maximum(graph.sum(1), 1)
    return (diags_array(np.where(alone, 1.0, 0.5)) + diags_array(shares) @ graph).tocsr()


def smoothed(smoother: csr_array, values: Float[ndarray, "*shape"], steps: int) -> Float[ndarray, "*shape"]:
    """Values of vertices after some steps of a `smoothing_matrix`."""
    for _ in range(steps):
        values = smoother @ values
    return values


def along_surface(face_faces: ndarray, points: ndarray, starts: ndarray, limit: float = np.inf) -> Float[ndarray, "N"]:
    """Distance along edges to the nearest of some vertices."""
    return nearest_along(edge_graph(points, mesh_edges(face_faces)), starts, limit)[1]


def _lips(face: Face, share: Float[ndarray, "N"], height: float) -> Int[ndarray, "P 2"] | None:
    """Pairs of vertices of the face that lie on each other and part when the jaw opens, right to left."""
    points = face.points
    upper, lower = np.flatnonzero(share < 0.5), np.flatnonzero(share >= 0.5)
    if len(upper) == 0 or len(lower) == 0:
        return None
    # Nearest across, mutual; and part: the mouth is open between them, they are no neighbours on one skin.
    distance, there = cKDTree(points[lower]).query(points[upper])
    _, back = cKDTree(points[upper]).query(points[lower])
    mutual = back[there] == np.arange(len(upper))
    jump = share[lower[there]] - share[upper]
    facing = (face.normals[upper] * face.normals[lower[there]]).sum(1)
    found = np.flatnonzero(mutual & (distance < 0.04 * height) & (jump > 0.25) & (facing < 0.5))
    pairs = np.stack([upper[found], lower[there[found]]], 1)
    if len(pairs):
        joined = {tuple(edge) for edge in mesh_edges(face.faces)}
        pairs = pairs[[tuple(sorted(pair)) not in joined for pair in pairs.tolist()]]
    if len(pairs) < 4:
        return None
    return pairs[np.argsort(points[pairs[:, 0], 0])]


def _lids(face: Face, lips: ndarray | None, height: float) -> dict[str, Int[ndarray, "P 2"]]:
    """Pairs above the mouth that lie apart at rest and on each other in one of the shapes, inner to outer corner."""
    points = face.points
    floor = points[lips.ravel(), 1].mean() + 0.2 * height if lips is not None else points[:, 1].mean()
    region = np.flatnonzero((points[:, 1] > floor) & (face.strength > 0.3))
    middle = float(np.median(points[face.strength > 0.1, 0]))
    found: dict[str, ndarray] = {}
    most = {"lids_left": 3, "lids_right": 3}
    for delta in face.deltas[:, region]:
        if np.linalg.norm(delta, axis=1).max() < 0.01 * height:
            continue
        posed, rest = points[region] + delta, points[region]
        near = cKDTree(posed).query_pairs(0.02 * height, output_type="ndarray")
        apart = np.linalg.norm(rest[near[:, 0]] - rest[near[:, 1]], axis=1)
        shut = np.linalg.norm(posed[near[:, 0]] - posed[near[:, 1]], axis=1)
        # Those that were far and met; of them the mutually closest.
        met = near[(apart > 0.02 * height) & (shut < 0.35 * apart)]
        if len(met) == 0:
            continue
        swap = rest[met[:, 0], 1] < rest[met[:, 1], 1]
        met = np.where(swap[:, None], met[:, ::-1], met)
        gaps = np.linalg.norm(posed[met[:, 0]] - posed[met[:, 1]], axis=1)
        best = {}
        for column in (0, 1):
            order = np.argsort(gaps)
            _, first = np.unique(met[order, column], return_index=True)
            best[column] = set(order[first].tolist())
        chosen = region[met[sorted(best[0] & best[1])]]
        for name, left in (("lids_left", True), ("lids_right", False)):
            side = chosen[(points[chosen[:, 0], 0] > middle) == left]
            if len(side) > most[name]:
                most[name] = len(side)
                found[name] = side[np.argsort(np.abs(points[side[:, 0], 0] - middle))]
    return found


def _sides(face: Face, pairs: Int[ndarray, "P 2"], reach: float) -> Contact:
    """The skin around both sides of a slit, each nearer to its own side along the surface."""
    above = along_surface(face.faces, face.points, pairs[:, 0], 2 * reach)
    below = along_surface(face.faces, face.points, pairs[:, 1], 2 * reach)
    upper = np.flatnonzero((above < reach) & (above < below))
    lower = np.flatnonzero((below < reach) & (below < above))
    return Contact(*(torch.from_numpy(face.vertices[part]) for part in (upper, lower, pairs)))
