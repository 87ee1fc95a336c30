"""The head that all built-in characters share: cut out of MakeHuman's body, refined where paint needs it.

Every vertex of the cut skin is a linear combination of base vertices (`Head.operator`), so neutrals, offsets and masks
all pass through one sparse matrix, and the neck ends in a plane instead of a torn row of quads. Eyeballs and lashes are
built here from rings and strips, because MakeHuman's helper eyes have 72 vertices and its lashes are loose cards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Float, Int
from scipy import sparse
from scipy.interpolate import PchipInterpolator

from reenact.geometry import boundary_edges
from reenact.rigs import makehuman

REFERENCE = {
    f"mpfb2/targets/macrodetails/{origin}-{gender}-young": 1 / 6
    for origin in ("african", "asian", "caucasian")
    for gender in ("female", "male")
}
"""MakeHuman's default human, on which its face units close the eyes."""

NECK_HEIGHT, NECK_SLOPE = 0.588, -0.28
"""The neck is cut by the plane y = height + slope z, metres in the base mesh: lower under the chin than at the nape."""


@dataclass(frozen=True)
class Head:
    """Topology and regions of the shared head."""

    coarse: Int[np.ndarray, "C"]
    """Base vertices near the head."""
    coarse_faces: Int[np.ndarray, "Fc 3"]
    """Triangles over the coarse vertices; one row of quads longer than the cut."""
    coarse_rim: Int[np.ndarray, "R"]
    """Coarse vertices on the open border below the cut; they never move."""
    operator: sparse.csr_matrix
    """(V, C): coarse to skin vertices."""
    faces: Int[np.ndarray, "F 3"]
    """Triangles over the skin vertices."""
    reference: Float[np.ndarray, "V 3"]
    """Skin of the reference head; every region is described on it."""
    masks: dict[str, Float[np.ndarray, "V"]]
    """Soft regions: lips, eyelids, ears, mouth (its lining), sockets (behind the lids)."""
    lids: dict[str, Int[np.ndarray, "Nd 2"]]
    """Coarse vertices (upper, lower) that meet in a blink, inner to outer corner, for `left` and `right`."""
    lips: Int[np.ndarray, "Np 2"]
    """Coarse vertices (upper, lower) that touch in the neutral, from the right corner to the left."""

    def skin_index(self, coarse: Int[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
        """Skin vertices that copy the given coarse ones."""
        copies = self.operator.tocoo()
        lookup = np.full(len(self.coarse), -1)
        exact = copies.data == 1
        lookup[copies.col[exact]] = copies.row[exact]
        return lookup[coarse]


@cache
def reference_vertices() -> Float[np.ndarray, "V 3"]:
    """The base mesh in the shape on which the units were sculpted."""
    return makehuman.read_base_mesh().vertices + sum(
        weight * makehuman.read_target(name) for name, weight in REFERENCE.items()
    )


@cache
def load_head() -> Head:
    """The shared head."""
    mesh = makehuman.read_base_mesh()
    body = makehuman.triangles(mesh, "body")
    height = mesh.vertices[:, 1] - NECK_HEIGHT - NECK_SLOPE * mesh.vertices[:, 2]  # above the cut
    quads = np.concatenate([body[: len(body) // 2], body[len(body) // 2 :, 2:]], axis=1)
    near = (height[quads] > 0).any(1)
    ring = np.isin(np.arange(len(mesh.vertices)), quads[near])
    near = np.tile(ring[quads].any(1), 2)  # one more row to hold on to
    coarse = np.unique(body[near])
    lookup = np.full(len(mesh.vertices), -1)
    lookup[coarse] = np.arange(len(coarse))
    coarse_faces = lookup[body[near]]
    coarse_rim = np.unique(boundary_edges(coarse_faces))

    masks = {
        "lips": makehuman.read_mask("lips"),
        "eyelids": makehuman.read_mask("eyelids"),
        "ears": makehuman.read_mask("ears"),
        "mouth": makehuman.read_mask("inside-mouth"),
        "sockets": makehuman.read_segment("eye_cavity.L") + makehuman.read_segment("eye_cavity.R"),
    }
    masks = {name: mask[coarse] for name, mask in masks.items()}
    reference = reference_vertices()[coarse]

    operator, faces = _cut(coarse_faces, height[coarse])
    for wanted in (_on_any_edge_of_paint, _on_sharp_edge_of_paint):
        operator, faces = _split(operator, faces, wanted(operator @ reference, operator @ masks["lips"], faces))
    eyes = {side: fit_eyeball(reference_vertices(), side) for side in ("left", "right")}
    lids = {side: _lid_pairs(reference, coarse_faces, masks["sockets"], eyes[side][0]) for side in eyes}
    return Head(
        coarse=coarse,
        coarse_faces=coarse_faces,
        coarse_rim=coarse_rim,
        operator=operator,
        faces=faces,
        reference=operator @ reference,
        masks={name: operator @ mask for name, mask in masks.items()},
        lids=lids,
        lips=_lip_pairs(reference, makehuman.read_target("faceunits01/targets/faceunits/jawOpen")[coarse]),
    )


def fit_eyeball(vertices: Float[np.ndarray, "V 3"], side: str) -> tuple[Float[np.ndarray, "3"], float]:
    """Centre and radius of MakeHuman's helper eye in some state of the base mesh, by least squares."""
    points = vertices[makehuman.group_vertices(f"helper-{side[0]}-eye")]
    system = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
    *center, rest = np.linalg.lstsq(system, (points**2).sum(1), rcond=None)[0]
    center = np.array(center)
    return center, float(np.sqrt(rest + center @ center))


# ---- cutting and refining: both return a sparse operator from coarse vertices and new triangles ----


def _cut(faces: np.ndarray, height: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Clips triangles where `height` changes sign; cut edges get a vertex on the plane."""
    above = height > 0
    new_vertex: dict[tuple[int, int], int] = {}
    rows, cols, weights, triangles = [], [], [], []

    def crossing(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in new_vertex:
            new_vertex[key] = len(height) + len(new_vertex)
            low, high = key
            t = height[low] / (height[low] - height[high])
            rows.extend([new_vertex[key]] * 2)
            cols.extend([low, high])
            weights.extend([1 - t, t])
        return new_vertex[key]

    for face in faces:
        inside = above[face]
        if inside.all():
            triangles.append(face)
        elif inside.sum() == 1:
            a, b, c = np.roll(face, -int(inside.argmax())).tolist()
            triangles.append([a, crossing(a, b), crossing(a, c)])
        elif inside.sum() == 2:
            c, a, b = np.roll(face, -int(inside.argmin())).tolist()
            triangles += [[a, b, crossing(b, c)], [a, crossing(b, c), crossing(a, c)]]
    count = len(height) + len(new_vertex)
    identity = np.arange(len(height))
    operator = sparse.csr_matrix(
        (np.r_[np.ones(len(height)), weights], (np.r_[identity, rows], np.r_[identity, cols])), (count, len(height))
    )
    return _drop_unused(operator, np.array(triangles))


def _split(operator: sparse.csr_matrix, faces: np.ndarray, wanted: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    """Halves all edges of the wanted triangles, and splits their neighbours so that no crack opens.

    Args:
        wanted: (F,) triangles.
    """
    corner_edges = np.sort(
        np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1), axis=2
    )  # (F, 3, 2)
    edges, edge_of = np.unique(corner_edges.reshape(-1, 2), axis=0, return_inverse=True)
    edge_of = edge_of.reshape(-1, 3)  # edge opposite each corner
    halved = np.zeros(len(edges), dtype=bool)
    halved[edge_of[wanted]] = True
    midpoint = np.full(len(edges), -1)
    midpoint[halved] = operator.shape[0] + np.arange(halved.sum())
    middle = (operator[edges[halved, 0]] + operator[edges[halved, 1]]) * 0.5
    triangles = []
    for face, opposite in zip(faces, edge_of):
        split = halved[opposite]
        count = split.sum()
        if count == 0:
            triangles.append(face)
            continue
        turn = int(split.argmax() if count == 1 else split.argmin())  # the one edge that differs is opposite corner a
        a, b, c = np.roll(face, -turn)
        bc, ca, ab = midpoint[np.roll(opposite, -turn)]
        if count == 1:
            triangles += [[a, b, bc], [a, bc, c]]
        elif count == 2:
            triangles += [[a, ab, ca], [ab, b, c], [ab, c, ca]]
        else:
            triangles += [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    return _drop_unused(sparse.vstack([operator, middle]).tocsr(), np.array(triangles))


def _drop_unused(operator: sparse.csr_matrix, faces: np.ndarray) -> tuple[sparse.csr_matrix, np.ndarray]:
    used, compact = np.unique(faces, return_inverse=True)
    return operator[used], compact.reshape(-1, 3)


def _on_any_edge_of_paint(points: np.ndarray, lips: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Triangles that touch the brows, or that the hairline or the edge of the lips crosses."""
    lips = lips[faces]
    on_lips_edge = (lips.max(1) > 0.2) & (lips.min(1) < 0.8) & (lips.max(1) - lips.min(1) > 0.1)
    near_brows = np.abs(above_brows(points))[faces].min(1) < 0.006
    return near_brows | on_lips_edge | _crosses_hairline(points, faces)


def _on_sharp_edge_of_paint(points: np.ndarray, lips: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Brows, and the hairline as far as it is seen from the front."""
    forehead = points[faces][:, :, 2].mean(1) > 0.045
    return (np.abs(above_brows(points))[faces].min(1) < 0.004) | (_crosses_hairline(points, faces) & forehead)


def _crosses_hairline(points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    hair = above_hairline(points)[faces]
    return (hair.min(1) < 0.003) & (hair.max(1) > -0.002)


# ---- lines on the reference head, which paint and refinement share ----

HAIRLINE = (
    # degrees from straight ahead, height above the eyes in metres
    (0, 0.068), (25, 0.068), (45, 0.062), (60, 0.046), (70, 0.016), (78, -0.002), (88, -0.006), (100, 0.004),
    (115, -0.026), (140, -0.056), (180, -0.062),
)  # fmt: skip
BROW_LINE = (
    # distance from the middle of the face, height above the eyes, metres
    (0.008, 0.0190), (0.014, 0.0196), (0.022, 0.0214), (0.032, 0.0232), (0.038, 0.0228), (0.046, 0.0196),
    (0.052, 0.0160),
)  # fmt: skip


def above_hairline(points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
    """Height over the hairline, metres; negative on the face and the nape."""
    eye, _ = fit_eyeball(reference_vertices(), "left")
    degrees = np.degrees(np.abs(np.arctan2(points[:, 0], points[:, 2] - 0.02)))
    return points[:, 1] - eye[1] - _curve(degrees, HAIRLINE)


def above_brows(points: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "V"]:
    """Height over the middle of the eyebrows, metres; infinite beside and behind them."""
    eye, radius = fit_eyeball(reference_vertices(), "left")
    outward = np.abs(points[:, 0])
    beside = (
        (outward < BROW_LINE[0][0] - 0.003) | (outward > BROW_LINE[-1][0] + 0.003) | (points[:, 2] < eye[2] - radius)
    )
    return np.where(beside, np.inf, points[:, 1] - eye[1] - _curve(outward, BROW_LINE))


def _curve(values: np.ndarray, table: tuple) -> np.ndarray:
    return PchipInterpolator(*np.array(table).T)(np.clip(values, table[0][0], table[-1][0]))


# ---- contacts ----


def _lid_pairs(points: np.ndarray, faces: np.ndarray, sockets: np.ndarray, center: np.ndarray) -> np.ndarray:
    """The edge of the lids is the second loop around the socket's lining; its opposite vertices meet in a blink.

    The two loop vertices farthest from each other that leave equally many above and below are the corners of the eye.
    """
    region = (sockets > 0.5) & (points[:, 0] * center[0] > 0)
    region[_ring_around(faces, region)] = True
    loop = _ring_around(faces, region)
    outward = (points[loop, 0] - center[0]) * np.sign(center[0])
    loop = loop[np.argsort(np.arctan2(points[loop, 1] - center[1], outward))]
    half = len(loop) // 2
    corner = int(np.linalg.norm(points[loop] - points[np.roll(loop, -half)], axis=1)[:half].argmax())
    loop = np.roll(loop, -corner)
    first, second = loop[1:half], loop[:half:-1]
    upper, lower = (first, second) if points[first, 1].mean() > points[second, 1].mean() else (second, first)
    pairs = np.stack([upper, lower], axis=1)
    return pairs if abs(points[upper[0], 0]) < abs(points[upper[-1], 0]) else pairs[::-1]


def _lip_pairs(points: np.ndarray, jaw_open: np.ndarray) -> np.ndarray:
    """Vertices that touch while the mouth is shut and part when the jaw drops: mutual nearest neighbours."""
    moving = np.linalg.norm(jaw_open, axis=1)
    near = np.flatnonzero((moving > 0) & (points[:, 2] > points[moving.argmax(), 2] - 0.02))
    distance = np.linalg.norm(points[near, None] - points[None, near], axis=2)
    parting = np.linalg.norm(jaw_open[near, None] - jaw_open[None, near], axis=2)
    distance[(parting < 0.004) | (distance > 0.0015)] = np.inf  # 4 mm apart when open, 1.5 mm when shut
    nearest = distance.argmin(1)
    mutual = np.flatnonzero((nearest[nearest] == np.arange(len(near))) & np.isfinite(distance.min(1)))
    first, second = near[mutual], near[nearest[mutual]]
    upper_first = moving[first] < moving[second]
    pairs = np.stack([first, second], axis=1)[upper_first]
    return pairs[np.argsort(points[pairs[:, 0], 0])]


def _ring_around(faces: np.ndarray, region: np.ndarray) -> np.ndarray:
    """Vertices outside a region that share a mesh edge with it, quad diagonals left out."""
    edges = _quad_edges(faces)
    crossing = edges[region[edges[:, 0]] != region[edges[:, 1]]]
    ends = crossing[~region[crossing]]
    return np.unique(ends)


def _quad_edges(faces: np.ndarray) -> np.ndarray:
    """Edges of the quads whose two triangles stand half the list apart: (a, b, c) and (a, c, d)."""
    first, second = faces[: len(faces) // 2], faces[len(faces) // 2 :]
    return np.concatenate([first[:, [0, 1]], first[:, [1, 2]], second[:, [1, 2]], second[:, [2, 0]]])
