"""The soft tissue of a face as a layered shell of tetrahedra: skin outside, bone inside, muscle and fat between.

AnaConDaR, "Anatomically Constrained Data-Adaptive Facial Retargeting", 2024, names template meshes of soft tissue and
muscles; the text that we have ends before it says how they are made. This construction is ours. It needs no mesher and
no scan: inner layers are the skin moved inwards by the thickness of the tissue, and each triangle with the one below it
is a prism of three tetrahedra.

Code          Meaning
N, X, M       vertices of the skin; nodes, layer after layer, skin first; tetrahedra
state         (X, 3) where the nodes are in an expression
F_e           gradient of a tetrahedron, (3, 3): what it was turned and stretched by
H             height of the face, root of the nose to chin; what is said in shares is in shares of it
bone          0 for what is free, `SKULL` or `JAW` for what is grown to one

Only the sheet that shapes move is tissue (`face.Face`), with a margin of still skin, whose border is fixed.
Eyes, teeth, tongue, lashes and the lining of the mouth stay outside: see `Rest`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.sparse import coo_array, csr_array, diags_array, eye_array
from scipy.sparse.linalg import SuperLU
from scipy.spatial import cKDTree
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import (
    boundary_edges,
    closest_points_around,
    connected_pieces,
    cotangent_laplacian,
    face_areas,
    farthest_points,
    mesh_edges,
    rigid_fit,
    vertex_areas,
    vertex_normals,
)
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import vertex_pairs
from reenact.retargeting.face import Face
from reenact.retargeting.landmarks import (
    Contact,
    Landmarks,
    along_surface,
    rigid_pose,
    smoothed,
    smoothing_matrix,
)
from reenact.retargeting.rbf import ThinPlate
from reenact.retargeting.tetrahedra import (
    factored,
    first_hits,
    hat_gradients,
    nearest_rotations,
    scatter,
    stiffness_matrix,
    tet_volumes,
    untangle,
)
from reenact.rigs.rig import Rig

SKULL, JAW = 1, 2

_TISSUE = (
    # outwards from the middle in half distances of the eyes, up from the mouth in distances to the eyes, share of H
    (0.0, 1.9, 0.040), (1.0, 1.9, 0.040), (2.0, 1.2, 0.050), (0.0, 1.0, 0.024), (1.0, 1.0, 0.020), (0.0, 0.5, 0.040),
    (1.1, 0.4, 0.130), (1.7, 0.2, 0.130), (0.0, 0.0, 0.080), (0.6, 0.0, 0.090), (0.0, -0.8, 0.080), (1.3, -0.6, 0.100),
    (0.0, -1.7, 0.120),
)  # fmt: skip
"""Thickness at places of an average face: forehead, temple, bridge of the nose, lid, tip of the nose, cheek, lips,
chin, edge of the jaw, neck. A face of 0.125 m has 5 mm on the forehead and 16 mm in the cheek."""
_PLAIN_TISSUE = 0.06
"""Thickness, share of H, where no mouth or eyes are found that say which place is which."""


@dataclass(frozen=True)
class ShellConfig:
    """How the tissue is layered."""

    layers: int = 2
    """Prisms between skin and bone: the outer half of them is fat, the inner is muscle."""
    smoothing: int = 4
    """Steps that smooth thickness and inward directions."""
    own_share: float = 0.45
    """Most of the way to the other side of the same flesh, so that lips and lids do not meet inside."""
    other_share: float = 0.9
    """Most of the way to teeth, eyeballs and the lining of the mouth."""
    slide: float = 1.5
    """Skin that expressions move over the bone by more than this many thicknesses is not grown to it."""
    opening: float = 0.1
    """Distance from lips and lids, share of H, within which there is no bone."""


# ---------------------------------------------------------------------------------------------------------------------
# The shell


@dataclass(frozen=True)
class Shell:
    """Tissue of a face; every tetrahedron has a positive volume at rest.

    Raises:
        ReenactError: One has not.
    """

    rig: Rig
    """Whose vertices move it."""
    landmarks: Landmarks
    """Of that rig."""
    sampler: csr_array
    """(N, V): offsets of the rig's vertices to those of the skin nodes."""
    vertices: Int[Tensor, "N"]
    """Vertices under the skin nodes, of the rig that the shell was built on."""
    skin_faces: Int[ndarray, "F 3"]
    """Triangles between skin nodes."""
    nodes: Float[Tensor, "X 3"]
    """Rest, float64: N skin nodes, then N of each layer below."""
    tets: Int[ndarray, "M 4"]
    layer: Int[ndarray, "M"]
    """Layer of each tetrahedron, 0 under the skin."""
    bone: Int[ndarray, "X"]
    """0 free, `SKULL` or `JAW`."""
    border: Bool[ndarray, "X"]
    """Nodes below the outer border of the face: they move with the skin there."""
    thickness: Float[ndarray, "N"]
    """Metres from skin to bone."""
    jaw_share: Float[ndarray, "N"]
    """How far the tissue follows the jaw."""
    slits: dict[str, Int[ndarray, "P 2"]]
    """Skin nodes above and below each contact, in order; the same in every rig that the shell is carried to."""
    config: ShellConfig

    def __post_init__(self) -> None:
        volumes = tet_volumes(self.nodes.numpy(), self.tets)
        if not (volumes > 0).all():
            raise ReenactError(
                f"{self.rig.name}: expected tissue of positive volume, got {int((volumes <= 0).sum())} of "
                f"{len(volumes)} tetrahedra without; make it thinner there"
            )

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def height(self) -> float:
        """H of the rig, metres."""
        return self.landmarks.height

    @property
    def contacts(self) -> dict[str, Contact]:
        """Skin that touches, as vertices of the rig."""
        return self.landmarks.contacts

    @cached_property
    def muscle(self) -> Bool[ndarray, "M"]:
        """Tetrahedra of the inner layers."""
        return self.layer >= self.config.layers / 2

    @cached_property
    def gradient_vectors(self) -> Float[ndarray, "M 4 3"]:
        """Gradients of the corners' hat functions: F = sum over corners of place x gradient, per metre."""
        return hat_gradients(self.nodes.numpy(), self.tets)

    @cached_property
    def volumes(self) -> Float[ndarray, "M"]:
        """Of each tetrahedron at rest, cubic metres."""
        return tet_volumes(self.nodes.numpy(), self.tets)

    def volume(self, states: Float[Tensor, "T X 3"]) -> Float[Tensor, "T"]:
        """Of all tissue, cubic metres; what is turned inside out counts negative."""
        return torch.tensor([tet_volumes(state, self.tets).sum() for state in states.double().numpy()])

    def gradients(self, states: Float[Tensor, "T X 3"]) -> Float[Tensor, "T M 3 3"]:
        """F_e of every tetrahedron, float64."""
        corners = states.double().numpy()[:, self.tets]  # (T, M, 4, 3)
        return torch.from_numpy(np.einsum("tmci,mcj->tmij", corners, self.gradient_vectors))

    def skin(self, vertices: Float[Tensor, "T V 3"]) -> Float[Tensor, "T N 3"]:
        """Skin nodes for meshes of the rig, float64."""
        self._check(vertices)
        offsets = (vertices.double() - self.rig.neutral.double()).numpy()
        return self.nodes[: len(self)] + torch.from_numpy(np.stack([self.sampler @ offset for offset in offsets]))

    def jaw_pose(self, vertices: Float[Tensor, "T V 3"]) -> tuple[Float[Tensor, "T 3 3"], Float[Tensor, "T 3"]]:
        """Rotation and translation of the jaw from rest, by lower teeth or else the chin; the head is held still."""
        self._check(vertices)
        marks = self.landmarks
        rest = self.rig.neutral.double().numpy()[marks.jaw_vertices]
        poses = [
            rigid_pose(rest, moved, marks.jaw_weights, marks.condyles)
            for moved in vertices.double().numpy()[:, marks.jaw_vertices]
        ]
        return tuple(torch.from_numpy(np.stack(part)) for part in zip(*poses))

    def head_pose(self, vertices: Float[Tensor, "T V 3"]) -> tuple[Float[Tensor, "T 3 3"], Float[Tensor, "T 3"]]:
        """Rotation and translation of the head from rest, by vertices that no shape moves; none where there are none.

        A pose under a millionth of H is none: a still head stays exactly still.
        """
        self._check(vertices)
        motion = self.rig.deltas.norm(dim=-1).amax(0)
        still = (motion <= 1e-3 * motion.max()).nonzero().flatten()
        rotations = torch.eye(3, dtype=torch.float64).repeat(len(vertices), 1, 1)
        translations = torch.zeros(len(vertices), 3, dtype=torch.float64)
        if len(still) < 12:
            return rotations, translations
        rest = self.rig.neutral[still].double()
        for frame, mesh in enumerate(vertices[:, still].double()):
            if float((mesh - rest).norm(dim=-1).max()) > 1e-6 * self.height:
                rotations[frame], translations[frame] = rigid_fit(rest, mesh)
        return rotations, translations

    def bones(self, vertices: Float[Tensor, "T V 3"]) -> Float[Tensor, "T X 3"]:
        """Where nodes are that bone or the border hold; the others at rest, carried with the jaw by their share."""
        rotation, translation = self.jaw_pose(vertices)
        jaw = torch.einsum("tij,xj->txi", rotation, self.nodes) + translation[:, None]
        share = np.where(self.bone == JAW, 1.0, np.where(self.bone == SKULL, 0.0, self._column(self.jaw_share)))
        states = self.nodes + torch.from_numpy(share)[:, None] * (jaw - self.nodes)
        skin = self.skin(vertices) - self.nodes[: len(self)]
        columns = skin.repeat(1, self.config.layers + 1, 1)
        return torch.where(torch.from_numpy(self.border)[:, None], self.nodes + columns, states)

    def fill(self, vertices: Float[Tensor, "T V 3"], iterations: int = 4) -> Float[Tensor, "T X 3"]:
        """States with the skin where the meshes say and bones where they belong: the tissue between stretches least.

        Source: quasi-static elasticity |F - R|^2 by local and global steps (Chao et al. 2010); one factorisation.
        """
        return self.fill_skin(self.skin(vertices), self.bones(vertices), iterations)

    def fill_skin(
        self, skin: Float[Tensor, "T N 3"], bones: Float[Tensor, "T X 3"], iterations: int = 4
    ) -> Float[Tensor, "T X 3"]:
        """As `fill`, from skin nodes and from what `bones` says of the others."""
        held, free, stiffness, factor, cross = self._inside
        vectors = self.gradient_vectors * (self.volumes / self.height**3)[:, None, None]
        states = bones.double().clone()
        skin_held = ~torch.from_numpy(self.border)[: len(self)]
        states[:, : len(self)][:, skin_held] = skin[:, skin_held].double()
        for state in states.numpy():
            if len(free) == 0:
                break
            soft = _FASCIA * stiffness[:, None] * state[free]
            turns = np.tile(np.eye(3), (len(self.tets), 1, 1))
            for _ in range(iterations):
                sides = np.zeros_like(state)
                scatter(sides, self.tets, vectors, turns)
                state[free] = factor.solve(sides[free] + soft - cross @ state[held])
                nearest_rotations(state, self.tets, self.gradient_vectors, turns, 3)
        return states

    @cached_property
    def node_volumes(self) -> Float[ndarray, "X"]:
        """A quarter of the tissue around each node, cubic metres."""
        return np.bincount(self.tets.ravel(), np.repeat(self.volumes / 4, 4), len(self.nodes))

    @cached_property
    def skin_areas(self) -> Float[ndarray, "N"]:
        """A third of the skin around each node, square metres."""
        return vertex_areas(self.nodes[: len(self)].numpy(), self.skin_faces)

    @cached_property
    def colliders(self) -> Int[ndarray, "D"]:
        """Vertices of the teeth: loose pieces near the mouth that move with the jaw or not at all."""
        marks, points = self.landmarks, self.rig.neutral.double().numpy()
        if marks.mouth is None:
            return np.zeros(0, np.int64)
        members = np.concatenate([marks.jaw_pieces, marks.skull_pieces])
        pieces = connected_pieces(self.rig.faces.numpy(), len(points))
        near = [
            piece
            for piece in np.unique(pieces[members])
            if np.linalg.norm(points[pieces == piece].mean(0) - marks.mouth) < 0.6 * marks.height
            and points[pieces == piece, 1].mean() < marks.mouth[1] + 0.3 * marks.height
        ]
        return members[np.isin(pieces[members], near)]

    @cached_property
    def _inside(self) -> tuple[ndarray, ndarray, ndarray, SuperLU, csr_array]:
        """Held nodes, free ones, their stiffness, the factored matrix of the free ones, and its part for held ones."""
        fixed = (self.bone > 0) | self.border
        fixed[: len(self)] = True
        held, free = np.flatnonzero(fixed), np.flatnonzero(~fixed)
        matrix = stiffness_matrix(self.gradient_vectors, self.tets, self.volumes / self.height**3, len(self.nodes))
        stiffness = matrix.diagonal()[free]
        inner = matrix[free][:, free] + diags_array(_FASCIA * stiffness)
        return held, free, stiffness, factored(inner), matrix[free][:, held].tocsr()

    @cached_property
    def rest(self) -> Rest:
        """How the vertices outside the shell follow its skin."""
        return Rest.of(self)

    def _column(self, values: Float[ndarray, "N"]) -> Float[ndarray, "X"]:
        return np.tile(values, self.config.layers + 1)

    def _check(self, vertices: Tensor) -> None:
        if vertices.shape[1] != len(self.rig.neutral):
            raise ReenactError(
                f"{self.rig.name}: expected meshes of {len(self.rig.neutral)} vertices, got {vertices.shape[1]}"
            )


_FASCIA = 1e-3
"""Share of its own stiffness by which tissue without bone holds on to where bones would carry it."""


def default_thickness(rig: Rig) -> Float[Tensor, "V"]:
    """Metres of tissue under each vertex of a rig, from a table of an average face; to edit and give to `build_shell`.

    Vertices outside the face have the value of the nearest one inside.
    """
    return _default_thickness(rig, Landmarks.of(rig))


def _default_thickness(rig: Rig, marks: Landmarks) -> Float[Tensor, "V"]:
    points = rig.neutral.double().numpy()
    if marks.mouth is None or marks.eyes is None:
        return torch.full((len(points),), _PLAIN_TISSUE * marks.height)
    table = np.array(_TISSUE)
    centre = marks.eyes.mean(0)
    across = abs(marks.eyes[0, 0] - marks.eyes[1, 0]) / 2
    places = np.stack(
        [
            np.abs(points[:, 0] - centre[0]) / across,
            (points[:, 1] - marks.mouth[1]) / (centre[1] - marks.mouth[1]),
        ],
        1,
    )
    distances = np.linalg.norm(places[:, None] - table[None, :, :2], axis=2)
    weights = 1 / (distances + 0.1) ** 4
    shares = (weights * table[:, 2]).sum(1) / weights.sum(1)
    return torch.from_numpy(shares * marks.height).float()


def build_shell(rig: Rig, thickness: Float[Tensor, "V"] | None = None, config: ShellConfig | None = None) -> Shell:
    """The tissue of a rig.

    Args:
        rig: Its neutral and faces give the skin, its shapes tell what moves, where the jaw is, and what touches.
        thickness: Metres from skin to bone per vertex; `default_thickness` where None. It is smoothed, and thinned
            where the tissue would meet its other side, teeth or eyes, or turn inside out.
        config: Layers and limits.

    Raises:
        ReenactError: The shapes move no face; a thickness is not positive, or there are too few or too many.
    """
    config = config or ShellConfig()
    marks = Landmarks.of(rig)
    face = marks.face
    if thickness is None:
        thickness = _default_thickness(rig, marks)
    if thickness.shape != (len(rig.neutral),) or not bool((thickness > 0).all() & thickness.isfinite().all()):
        raise ReenactError(
            f"{rig.name}: expected a positive thickness for each of {len(rig.neutral)} vertices, got "
            f"{tuple(thickness.shape)} from {float(thickness.min()):g} to {float(thickness.max()):g}"
        )
    wanted = thickness.double().numpy()[face.vertices]
    numbers = face.vertices
    sampler = coo_array(
        (np.ones(len(numbers)), (np.arange(len(numbers)), numbers)), shape=(len(numbers), len(rig.neutral))
    ).tocsr()
    layers, depth = _layers(rig, marks, face.points, face.faces, wanted, config)
    border = _outer_border(face)
    bone = _bones(marks, border, depth, config)
    slits = {name: np.searchsorted(numbers, contact.pairs.numpy()) for name, contact in marks.contacts.items()}
    return Shell(
        rig=rig,
        landmarks=marks,
        sampler=sampler,
        vertices=torch.from_numpy(numbers),
        skin_faces=face.faces,
        nodes=torch.from_numpy(layers.reshape(-1, 3)),
        tets=prisms(face.faces, len(numbers), config.layers),
        layer=np.repeat(np.arange(config.layers), 3 * len(face.faces)),
        bone=bone,
        border=np.tile(border, config.layers + 1),
        thickness=np.linalg.norm(layers[-1] - layers[0], axis=1),
        jaw_share=marks.jaw_share,
        slits=slits,
        config=config,
    )


def carry_shell(shell: Shell, rig: Rig, correspondence: Correspondence) -> Shell:
    """The same tissue, tetrahedron for tetrahedron, in another rig.

    The skin is bent by a thin-plate map onto the pairs, and what is left is spread by the least bending over the skin.
    Layers are then made as on the first rig, thicker or thinner as the skin is larger or smaller. How the new rig's
    skin moves is sampled at the closest places of its surface.

    Args:
        shell: Of the correspondence's target.
        rig: The correspondence's source.
        correspondence: Pairs; unsure ones count less.

    Raises:
        ReenactError: The shapes of the rig move no face, or the pairs do not spread over it.
    """
    marks = Landmarks.of(rig)
    own, count = shell.nodes[: len(shell)].numpy(), len(shell)
    number = np.full(len(shell.rig.neutral), -1)
    number[shell.vertices.numpy()] = np.arange(count)
    corners, shares = number[correspondence.target.corners.numpy()], correspondence.target.shares.double().numpy()
    confidence = correspondence.confidence.double().numpy()
    used = np.flatnonzero(((corners >= 0) | (shares < 1e-6)).all(1) & (confidence > 0))
    if len(used) < 8:
        raise ReenactError(f"{rig.name}: expected at least 8 pairs on the face of {shell.rig.name}, got {len(used)}")
    corners, shares, confidence = corners[used], shares[used], confidence[used]
    places = coo_array(
        (shares.ravel(), (np.repeat(np.arange(len(used)), 3), corners.clip(min=0).ravel())), shape=(len(used), count)
    ).tocsr()
    # Where tissue was smoothed under folded skin, it is so here.
    eased = own - shell.rig.neutral.double().numpy()[shell.vertices.numpy()]
    starts = places @ own
    aims = correspondence.source.of(rig.neutral.double()).numpy()[used] + places @ eased
    chosen = farthest_points(torch.from_numpy(starts), min(300, len(used)), torch.from_numpy(confidence)).numpy()
    plate = ThinPlate(torch.from_numpy(starts[chosen]), torch.from_numpy(aims[chosen]), stiffness=1e-2)
    warped = plate(torch.from_numpy(own)).numpy()
    for stiffness in _STIFFER:
        bent = _bent(shell, warped, places, aims, confidence, stiffness)
        nodes = _carried_layers(shell, bent)
        if (tet_volumes(nodes, shell.tets) > 0).all():
            break
    followed = vertex_pairs(rig, shell.rig, correspondence, 0.1)[shell.vertices.numpy()].tocsr()
    return replace(
        shell,
        rig=rig,
        landmarks=marks,
        sampler=_surface_sampler(rig, marks.face, bent, followed, places),
        nodes=torch.from_numpy(nodes),
        thickness=np.linalg.norm(nodes[-count:] - bent, axis=1),
    )


_STIFFER = (3e-3, 3e-2, 0.3, 3.0, 30.0, 3e3)
"""Weights of bending against pairs: the next where one leaves tissue that is turned inside out."""


def _bent(
    shell: Shell,
    warped: Float[ndarray, "N 3"],
    places: csr_array,
    aims: Float[ndarray, "P 3"],
    confidence: Float[ndarray, "P"],
    stiffness: float,
) -> Float[ndarray, "N 3"]:
    """Skin nodes that meet the pairs and bend little; pairs that would fold the skin are given up around the fold."""
    faces = shell.skin_faces
    laplacian = cotangent_laplacian(shell.nodes[: len(shell)], torch.from_numpy(faces), low=1e-3)
    bending = laplacian.T @ laplacian
    smoother = smoothing_matrix(faces, len(warped))
    upright = _normals(warped, faces)
    trust = confidence / confidence.max()
    for _ in range(12):
        weighted = places.T @ diags_array(trust)
        system = weighted @ places + stiffness * bending + 1e-9 * eye_array(len(warped))
        bent = warped + factored(system).solve(weighted @ (aims - places @ warped))
        folded = (_normals(bent, faces) * upright).sum(1) < 0.3
        if not folded.any():
            break
        around = np.zeros(len(warped))
        around[faces[folded]] = 1.0
        trust = trust * (1 - 0.9 * (places @ smoothed(smoother, around, 3)).clip(0, 0.3) / 0.3)
    return bent


def _normals(points: ndarray, faces: ndarray) -> Float[ndarray, "F 3"]:
    a, b, c = points[faces].swapaxes(0, 1)
    return unit_vectors(np.cross(b - a, c - a))


def _carried_layers(shell: Shell, bent: Float[ndarray, "N 3"]) -> Float[ndarray, "X 3"]:
    """Nodes under a bent skin: columns turn with the skin around them, and grow with it."""
    own = shell.nodes[: len(shell)].numpy()
    edges = mesh_edges(shell.skin_faces)
    moments = np.zeros((len(own), 3, 3))
    spans = [points[edges[:, 1]] - points[edges[:, 0]] for points in (own, bent)]
    products = np.einsum("ei,ej->eij", spans[1], spans[0])
    for end in (0, 1):
        np.add.at(moments, edges[:, end], products)
    # The thin tissue of a sheet says nothing across it: its normals do.
    normals = [vertex_normals(torch.from_numpy(p), torch.from_numpy(shell.skin_faces)).numpy() for p in (own, bent)]
    moments += np.einsum("n,ni,nj->nij", np.trace(moments, axis1=1, axis2=2).clip(1e-12), normals[1], normals[0])
    left, _, right = np.linalg.svd(moments)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    turns = left @ right
    scale = _local_scale(shell.skin_faces, own, bent)
    columns = shell.nodes.numpy().reshape(-1, len(own), 3) - own
    nodes = bent + scale[:, None] * np.einsum("nij,lnj->lni", turns, columns)
    nodes = nodes.reshape(-1, 3)
    wanted = shell.volumes * scale[shell.tets[:, 0] % len(own)] ** 3
    return _untangled(nodes, shell.tets, 0.05 * wanted, len(own), shell.height)


def _local_scale(faces: ndarray, before: ndarray, after: ndarray) -> Float[ndarray, "N"]:
    """Root of how much larger the skin is around each vertex."""
    sums = [vertex_areas(points, faces) for points in (before, after)]
    ratio = np.sqrt(sums[1] / np.maximum(sums[0], 1e-30))
    return smoothed(smoothing_matrix(faces, len(ratio)), ratio, 4).clip(0.2, 5.0)


def _surface_sampler(
    rig: Rig, face: Face, points: Float[ndarray, "N 3"], followed: csr_array, places: csr_array
) -> csr_array:
    """(N, V) shares of the rig's vertices in the place of its face where each skin node lies.

    A node that is the place of a pair takes its partner. Others take the closest place among the triangles around what
    their neighbours follow: a node of the upper lip is never moved by the lower one, however close.
    """
    numbers = np.full(len(rig.neutral), -1)
    numbers[face.vertices] = np.arange(len(face.vertices))
    local = followed[:, face.vertices]
    rings = smoothing_matrix(face.faces, len(face.vertices))
    near = ((local != 0).astype(float) @ rings @ rings).tocsr()
    width = 24
    candidates = np.zeros((len(points), width), np.int64)
    for row in range(len(points)):
        found = near.indices[near.indptr[row] : near.indptr[row + 1]]
        if len(found) == 0:
            found = np.array([np.linalg.norm(face.points - points[row], axis=1).argmin()])
        if len(found) > width:
            found = found[np.argsort(np.linalg.norm(face.points[found] - points[row], axis=1))[:width]]
        candidates[row] = np.resize(found, width)
    triangle, shares = closest_points_around(
        *(torch.from_numpy(each) for each in (points, face.points, face.faces, candidates))
    )
    columns = face.vertices[face.faces[triangle.numpy()]]
    rows = np.repeat(np.arange(len(points)), 3)
    shape = (len(points), len(rig.neutral))
    closest = coo_array((shares.double().numpy().ravel(), (rows, columns.ravel())), shape=shape).tocsr()
    whole = np.zeros(len(points))
    entries = places.tocoo()
    whole[entries.col[entries.data > 0.999]] = 1.0
    whole *= followed.sum(1) > 0.999
    return (diags_array(1 - whole) @ closest + diags_array(whole) @ followed).tocsr()


# ---- layers ----


def _layers(
    rig: Rig, marks: Landmarks, skin: ndarray, faces: ndarray, thickness: ndarray, config: ShellConfig
) -> tuple[Float[ndarray, "L N 3"], Float[ndarray, "N"]]:
    """Nodes of every layer, and the thickness that was possible."""
    height, smoother, steps = marks.height, smoothing_matrix(faces, len(skin)), config.smoothing
    inward = _inward(skin, faces, smoother, steps)
    depth = smoothed(smoother, thickness, steps)
    limit = float(depth.max() / config.own_share)
    own_reach, other_reach = _reaches(rig, marks.face, skin, faces, inward, limit)
    depth = np.minimum(depth, np.minimum(config.own_share * own_reach, config.other_share * other_reach))
    depth = np.minimum(depth, smoothed(smoother, depth, steps))
    thinnest = 2e-3 * height
    depth = np.maximum(depth, thinnest)
    fractions = np.arange(config.layers + 1) / config.layers
    tets = prisms(faces, len(skin), config.layers)
    owner = np.repeat(np.tile(np.arange(len(faces)), config.layers), 3)
    areas = face_areas(torch.from_numpy(skin), torch.from_numpy(faces)).numpy()
    for _ in range(12):
        layers = skin + fractions[:, None, None] * (depth[:, None] * inward)
        volumes = tet_volumes(layers.reshape(-1, 3), tets)
        # A sixth of what a straight prism would give each of its three.
        least = (areas * depth[faces].min(1) / config.layers / 3 / 6)[owner].clip(min=3e-9 * height**3)
        failed = np.unique(owner[volumes < least])
        if len(failed) == 0:
            break
        around = np.zeros(len(skin))
        around[faces[failed]] = 1.0
        around = np.maximum(around, 2 * (smoother @ around)).clip(0, 1)
        # Thinning helps where columns cross; where one leaves through a face beside it, it must turn.
        depth = np.maximum(depth * (1 - 0.15 * around), thinnest)
        inward = _turned(skin, faces, inward, np.flatnonzero(around))
    # What is still turned inside out lies under skin that is folded itself, as in the corner of a mouth.
    nodes = _untangled(layers.reshape(-1, 3), tets, least / 2, len(skin), height)
    return nodes.reshape(layers.shape), depth


def _untangled(
    nodes: Float[ndarray, "X 3"], tets: ndarray, least: Float[ndarray, "M"], skin: int, height: float
) -> Float[ndarray, "X 3"]:
    """Nodes moved until every tetrahedron has its least volume, or a positive one; skin as little as can be."""
    nodes = np.array(nodes)
    for share, floor, mobility_of_skin in ((1.0, 1e-9, 0.1), (0.1, 1e-9, 0.3), (0.0, 1e-10, 1.0), (0.0, 1e-12, 1.0)):
        goal = (share * least).clip(min=floor * height**3)
        mobility = np.ones(len(nodes))
        mobility[:skin] = mobility_of_skin
        for _ in range(60):
            failed = tet_volumes(nodes, tets) < 0.99 * goal
            if not failed.any():
                return nodes
            near = np.isin(tets, tets[failed]).any(1)
            untangle(nodes, tets[near], goal[near], mobility, 30)
    return nodes


def _inward(skin: ndarray, faces: ndarray, smoother: csr_array, steps: int) -> Float[ndarray, "N 3"]:
    """Smoothed directions into the flesh that stay on the inner side of every face around."""
    normals = vertex_normals(torch.from_numpy(skin), torch.from_numpy(faces)).numpy()
    return _turned(skin, faces, -unit_vectors(smoothed(smoother, normals, steps)), np.arange(len(skin)))


def _turned(skin: ndarray, faces: ndarray, inward: ndarray, chosen: Int[ndarray, "C"]) -> Float[ndarray, "N 3"]:
    """Directions turned, where need be, until they point into every face around by a tenth of a radian and more."""
    flat, owner = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    eligible = np.isin(flat, chosen)
    flat, owner = flat[eligible], owner[eligible]
    a, b, c = skin[faces[owner]].swapaxes(0, 1)
    normals = unit_vectors(np.cross(b - a, c - a))
    inward = inward.copy()
    for _ in range(30):
        into = -(inward[flat] * normals).sum(1)
        wrong = into < 0.1
        if not wrong.any():
            break
        push = np.zeros_like(inward)
        np.add.at(push, flat[wrong], -normals[wrong] * (0.15 - into[wrong])[:, None])
        moved = np.unique(flat[wrong])
        inward[moved] = unit_vectors(inward[moved] + push[moved])
    return inward


def unit_vectors(vectors: ndarray) -> ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)


def _reaches(
    rig: Rig, face: Face, skin: ndarray, faces: ndarray, inward: ndarray, limit: float
) -> tuple[Float[ndarray, "N"], Float[ndarray, "N"]]:
    """How far each column may go before it leaves its own flesh, and before it meets another part of the head."""
    corners = skin[faces]
    own = first_hits(skin, inward, corners, faces, limit, True)
    points = rig.neutral.double().numpy()
    inside = np.zeros(len(points), bool)
    inside[face.vertices] = True
    outside = rig.faces.numpy()
    outside = outside[~inside[outside].any(1)]
    triangles = points[outside] if len(outside) else np.zeros((0, 3, 3))
    return own, first_hits(skin, inward, triangles, np.full((len(outside), 3), -1), limit, False)


def prisms(faces: Int[ndarray, "F 3"], count: int, layers: int) -> Int[ndarray, "M 4"]:
    """Tetrahedra between layers of `count` nodes each, three to a prism, all turned the same way.

    Corners are taken in the order of their numbers, so that prisms with a common side cut it along the same diagonal.
    """
    order = np.sort(faces, axis=1)
    even = np.isin(faces.argmin(1) * 10 + faces.argmax(1), [2, 10, 21])  # a turn of 0, 1, 2 keeps the sense
    blocks = []
    for layer in range(layers):
        a, b, c = (order + layer * count).T
        d, e, f = (order + (layer + 1) * count).T
        # The inner triangle is the lower one: seen from outside, corners of a face turn left.
        block = np.stack([np.stack(each, 1) for each in ((a, c, b, f), (a, e, f, b), (a, d, f, e))], 1)
        block = np.where(even[:, None, None], block, block[:, :, [0, 2, 1, 3]])
        blocks.append(block.reshape(-1, 4))
    return np.ascontiguousarray(np.concatenate(blocks))


# ---- bones ----


def _outer_border(face: Face) -> Bool[ndarray, "N"]:
    """Vertices on the border of the face that no shape moves to speak of: not the lips, not the lids."""
    edge = np.unique(boundary_edges(face.faces))
    motion = np.linalg.norm(face.deltas, axis=-1).max(0)
    border = np.zeros(len(face.points), bool)
    border[edge[motion[edge] < 0.02 * motion.max()]] = True
    return border


def _bones(marks: Landmarks, border: ndarray, depth: ndarray, config: ShellConfig) -> Int[ndarray, "X"]:
    """What the nodes are grown to: all of the innermost layer but under lips, lids and hollow cheeks."""
    face = marks.face
    rotation, translation = marks.jaw_motion
    rigid = face.points @ rotation.T + translation - face.points
    deltas = face.deltas.copy()
    deltas[marks.jaw_shape] -= marks.jaw_share.round()[:, None] * rigid
    slide = np.linalg.norm(deltas, axis=-1).max(0)
    label = np.where(marks.jaw_share > 0.8, JAW, np.where(marks.jaw_share < 0.25, SKULL, 0))
    if marks.mouth is not None:
        # Under the jaw there is throat, not skull: it gives way when the jaw comes down on it.
        label[(label == SKULL) & (face.points[:, 1] < marks.mouth[1])] = 0
    label[slide > config.slide * depth] = 0
    for contact in marks.contacts.values():
        starts = np.flatnonzero(np.isin(face.vertices, torch.cat([contact.upper, contact.lower]).numpy()))
        label[along_surface(face.faces, face.points, starts) < config.opening * marks.height] = 0
    still = face.strength < 0.02
    label[still | border] = SKULL
    bone = np.zeros((config.layers + 1, len(label)), np.int64)
    bone[-1] = label
    return bone.ravel()


# ---------------------------------------------------------------------------------------------------------------------
# What is outside the shell


@dataclass(frozen=True)
class Rest:
    """How vertices outside the shell follow when its skin is moved: the lining of the mouth, lashes, all else.

    What is connected to the skin takes a harmonic share of what happens at their common border. A loose piece rides on
    the skin beside it if it does so on the rig, as lashes do. Eyes, teeth and tongue stay.
    """

    matrix: csr_array
    """(V, N) from offsets of the skin to those of all vertices."""

    @classmethod
    def of(cls, shell: Shell) -> Rest:
        """For a shell on the rig that it was built on."""
        rig, numbers, count = shell.rig, shell.vertices.numpy(), len(shell.rig.neutral)
        faces, points = rig.faces.numpy(), rig.neutral.double().numpy()
        rows, columns, values = [numbers], [np.arange(len(numbers))], [np.ones(len(numbers))]
        pieces = connected_pieces(faces, count)
        _, place = np.unique(points.round(7), axis=0, return_inverse=True)  # vertices at one place are one
        inside = np.zeros(count, bool)
        inside[numbers] = True
        own = np.isin(pieces, pieces[numbers])
        loose = own & ~inside
        if loose.any():
            extension = _harmonic(rig, np.flatnonzero(loose), numbers, place)
            rows.append(extension.row)
            columns.append(extension.col)
            values.append(extension.data)
        tree = cKDTree(points[numbers])
        motion = rig.deltas.double().numpy()
        for piece in np.setdiff1d(np.unique(pieces), pieces[numbers]):
            members = np.flatnonzero(pieces == piece)
            distance, nearest = tree.query(points[members])
            roots = np.argsort(distance, kind="stable")[: max(1, len(members) // 3)]
            there = motion[:, members[roots]], motion[:, numbers[nearest[roots]]]
            led = np.square(there[1]).sum()
            follows = (there[0] * there[1]).sum() / led if led > 0 else 0.0
            agreement = (there[0] * there[1]).sum() / np.sqrt(max(led * np.square(there[0]).sum(), 1e-60))
            if follows > 0.5 and agreement > 0.9 and distance[roots].max() < 0.03 * shell.height:
                rows.append(members)
                columns.append(nearest)
                values.append(np.ones(len(members)))
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return cls(coo_array(entries, shape=(count, len(numbers))).tocsr())

    def __call__(self, offsets: Float[Tensor, "T N 3"]) -> Float[Tensor, "T V 3"]:
        """Offsets of all vertices from offsets of the skin nodes."""
        return torch.from_numpy(np.stack([self.matrix @ offset for offset in offsets.double().numpy()]))


def _harmonic(rig: Rig, unknown: ndarray, numbers: ndarray, place: ndarray) -> coo_array:
    """(V, N) sparse: what vertices connected to the skin take of its border; it fades within a tenth of the head."""
    count = len(rig.neutral)
    laplacian = cotangent_laplacian(rig.neutral.double(), rig.faces, low=1e-3)
    size = np.ptp(rig.neutral.double().numpy()[:, 1])
    areas = vertex_areas(rig.neutral.double().numpy(), rig.faces.numpy())
    screened = laplacian + diags_array(areas / (0.1 * size) ** 2 + 1e-12)
    cross = screened[unknown][:, numbers].tocsc()
    touching = np.flatnonzero(np.diff(cross.indptr))
    solved = factored(screened[unknown][:, unknown]).solve(-cross[:, touching].toarray())
    solved[np.abs(solved) < 1e-3] = 0
    entries = coo_array(solved)
    return coo_array((entries.data, (unknown[entries.row], touching[entries.col])), shape=(count, len(numbers)))
