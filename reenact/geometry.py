"""Operators on triangle meshes."""

from __future__ import annotations

import inspect

import numba
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from torch import Tensor

from reenact.errors import ReenactError


def vertex_normals(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "V 3"]:
    """Unit sums of the adjoining faces' area-weighted normals; 0 where a vertex has no area around it."""
    first, second, third = vertices[faces].unbind(1)
    face_normals = torch.linalg.cross(second - first, third - first)  # (F, 3), twice the area long
    sums = torch.zeros_like(vertices).index_add(0, faces.flatten(), face_normals.repeat_interleave(3, dim=0))
    lengths = sums.norm(dim=-1, keepdim=True)
    return torch.where(lengths > 0, sums / lengths.clamp_min(torch.finfo(sums.dtype).tiny), 0)


def face_areas(vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*batch F"]:
    """Area of each face, in square units of the vertices."""
    first, second, third = vertices[..., faces, :].unbind(-2)
    return torch.linalg.cross(second - first, third - first).norm(dim=-1) / 2


def vertex_areas(points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Float[np.ndarray, "V"]:
    """A third of the faces around each vertex, in square units of the points."""
    areas = face_areas(torch.from_numpy(points), torch.from_numpy(faces)).numpy()
    return np.bincount(faces.ravel(), weights=np.repeat(areas / 3, 3), minlength=len(points))


def face_frames(vertices: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]) -> Float[Tensor, "*batch F 3 3"]:
    """Two edges and the scaled normal of each face, as columns; without area, the normal is 0.

    Source: Sumner & Popović 2004, "Deformation Transfer for Triangle Meshes", doi:10.1145/1015706.1015736, Eqs. 1, 3.
    """
    v1, v2, v3 = vertices[..., faces, :].unbind(-2)
    normal = torch.linalg.cross(v2 - v1, v3 - v1)
    length = normal.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(vertices.dtype).tiny)
    # Over the root of its length the normal grows like an edge, so a frame scales as one piece.
    v4 = v1 + normal / length.sqrt()
    return torch.stack([v2 - v1, v3 - v1, v4 - v1], dim=-1)


def sound_faces(vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]) -> Bool[Tensor, "F"]:
    """Faces with enough area to say how they deform: a millionth of the square of the longest edge or more."""
    corners = vertices[faces].double()
    longest = (corners - corners.roll(1, dims=1)).square().sum(-1).amax(1)
    return face_areas(vertices.double(), faces) > 1e-6 * longest


def deformation_gradients(
    neutral: Float[Tensor, "V 3"], deformed: Float[Tensor, "*batch V 3"], faces: Int[Tensor, "F 3"]
) -> Float[Tensor, "*batch F 3 3"]:
    """The matrix that each face of the neutral was turned, stretched and sheared by; identity on faces without area.

    Along the normal a triangle tells nothing: the scaled normal stands in for that direction, so a face that grows by
    a factor in its plane is taken to grow by it in thickness too.

    Source: Sumner & Popović 2004, Eq. 4: Q = V~ V^-1, with V of the neutral and V~ of the deformed face.
    """
    sound = sound_faces(neutral, faces)
    unit = torch.eye(3, dtype=neutral.dtype, device=neutral.device)
    frames = torch.where(sound[:, None, None], face_frames(neutral, faces), unit)
    gradients = face_frames(deformed, faces) @ torch.linalg.inv(frames)
    return torch.where(sound[:, None, None], gradients, unit)


def cotangent_laplacian(
    vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"], low: float = -5.0, high: float = 5.0
) -> sparse.csr_array:
    """The operator (L x)_i = sum_j w_ij (x_i - x_j), w_ij half the cotangents of the two angles that face an edge.

    Symmetric, rows sum to 0; free of units, since it is not divided by areas. In float64.

    Args:
        vertices: Where the angles are taken.
        faces: Triangles.
        low: Smallest weight of an edge; wide angles make weights negative. Without bounds the operator is positive
            semidefinite; with an upper one that is certain only where low >= 0.
        high: Largest weight of an edge, which slivers would make huge.

    Source: Pinkall & Polthier 1993, "Computing Discrete Minimal Surfaces and Their Conjugates"; the bounds are ours.
    """
    points = vertices.detach().cpu().to(torch.float64).numpy()
    corners = faces.detach().cpu().numpy()
    rows, columns, halves = [], [], []
    for apex in range(3):
        tip, left, right = (corners[:, (apex + turn) % 3] for turn in range(3))
        to_left, to_right = points[left] - points[tip], points[right] - points[tip]
        cross = np.linalg.norm(np.cross(to_left, to_right), axis=1)
        squares = (to_left**2).sum(1) + (to_right**2).sum(1)
        halves.append(0.5 * (to_left * to_right).sum(1) / np.maximum(cross, 1e-12 * squares + 1e-300))
        rows.append(np.minimum(left, right))
        columns.append(np.maximum(left, right))
    count = len(points)
    shape, ends = (count, count), (np.concatenate(rows), np.concatenate(columns))
    edges = sparse.coo_array((np.concatenate(halves), ends), shape).tocsr()  # sums what faces share
    # A weight that cancels to 0 is still an edge, and `low` may raise it; tocsr keeps it.
    edges.data = edges.data.clip(low, high)
    edges = edges + edges.T
    return (sparse.diags_array(edges.sum(axis=1)) - edges).tocsr()


def mesh_edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    """Pairs of different vertices that a face joins, the lower index first, each once and in order."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    return edges[edges[:, 0] != edges[:, 1]]


def boundary_edges(faces: Int[np.ndarray, "F 3"]) -> Int[np.ndarray, "E 2"]:
    """Edges with one face only."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return unique[count == 1]


def connected_pieces(faces: Int[np.ndarray, "F 3"], count: int) -> Int[np.ndarray, "V"]:
    """The number of the connected piece that each of `count` vertices belongs to; those without a face are alone."""
    pairs = faces[:, [0, 1, 1, 2]].reshape(-1, 2)
    graph = sparse.coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def outward_faces(
    points: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], open_share: float = 0.05
) -> Bool[np.ndarray, "F"]:
    """Faces whose backs nobody sees from outside: of connected surfaces that enclose a volume and are wound outwards.

    Args:
        points: Positions.
        faces: Of any number of surfaces.
        open_share: Of a surface's edges, as many may lie at a hole (a head ends at the neck) or be wound wrongly.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    graph = sparse.coo_array((np.ones(len(edges)), edges.T), shape=(len(points), len(points)))
    count, surface = connected_components(graph, directed=False)  # by vertex
    forth, back = edges @ [len(points), 1], edges @ [1, len(points)]
    known, times = np.unique(forth, return_counts=True)
    place = np.searchsorted(known, back).clip(max=len(known) - 1)
    paired = (known[place] == back) & (times[place] == 1)  # exactly one neighbour runs along it the other way
    of_edge, of_face = surface[edges[:, 0]], surface[faces[:, 0]]
    gaps = np.bincount(of_edge, ~paired, count) / np.bincount(of_edge, minlength=count).clip(min=1)
    middle = np.stack([np.bincount(surface, points[:, axis], count) for axis in range(3)], axis=1)
    middle /= np.bincount(surface, minlength=count)[:, None]
    corners = points[faces] - middle[of_face, None]  # (F, 3, 3)
    volume = np.bincount(of_face, np.linalg.det(corners), count)  # six times that of tetrahedra around the middle
    return ((gaps <= open_share) & (volume > 0))[of_face]


def edge_graph(points: Float[np.ndarray, "V 3"], edges: Int[np.ndarray, "E 2"]) -> sparse.csr_array:
    """(V, V) lengths of edges in the unit of the points, once each; those without length have next to none."""
    lengths = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    lengths = np.maximum(lengths, 1e-9 * lengths.max(initial=1e-12))  # an edge of length 0 would be no edge
    return sparse.coo_array((lengths, (edges[:, 0], edges[:, 1])), shape=(len(points),) * 2).tocsr()


def nearest_along(
    graph: sparse.csr_array, starts: Int[np.ndarray, "N"], limit: float = np.inf
) -> tuple[Int[np.ndarray, "V"], Float[np.ndarray, "V"]]:
    """For each vertex the nearest start along edges, as an index into `starts`, and its distance.

    Args:
        graph: Lengths, as of `edge_graph`.
        starts: Vertices.
        limit: What is farther counts as out of reach: index -1, distance infinite, as for pieces without a start.
    """
    distance, _, origin = dijkstra(
        graph, directed=False, indices=starts, return_predecessors=True, min_only=True, limit=limit
    )
    number = np.full(graph.shape[0] + 1, -1)
    number[starts] = np.arange(len(starts))
    return number[np.maximum(origin, -1)], distance  # the origin of what no start reaches is negative


def farthest_points(
    points: Float[Tensor, "N 3"], count: int, weights: Float[Tensor, "N"] | None = None, first: int | None = None
) -> Int[Tensor, "count"]:
    """Indices of points that lie far from each other, in the order of choice.

    Each next point is the one with the largest product of its weight and its distance from those chosen before. A
    weight thus divides the spacing: where it is doubled, points stand half as far apart.

    Args:
        points: In any unit.
        count: How many; at most N.
        weights: Not negative; equal ones where None.
        first: Index to begin with; where None, the point with the largest product of its weight and its distance from
            the weighted mean.

    Raises:
        ReenactError: More points are asked for than there are, or have weight.

    Source: Gonzalez 1985, "Clustering to minimize the maximum intercluster distance",
    doi:10.1016/0304-3975(85)90224-5; we add the weights.
    """
    scale = np.ones(len(points)) if weights is None else weights.detach().cpu().double().numpy()
    weighty = np.flatnonzero(scale > 0)
    if not 0 < count <= len(weighty):
        raise ReenactError(f"farthest points: expected 1 to {len(weighty)} of the points that have weight, got {count}")
    places, scale = points.detach().cpu().double().numpy()[weighty], scale[weighty]
    if first is None:
        chosen = [int((scale * _distances(places, np.average(places, axis=0, weights=scale))).argmax())]
    else:
        chosen = [int(np.searchsorted(weighty, first))]
    priority = np.full(len(places), np.inf)
    for _ in range(count - 1):
        chosen.append(_next_farthest(places, scale, priority, chosen[-1]))
    return torch.from_numpy(weighty[chosen]).to(points.device)


def _distances(points, place):
    return np.linalg.norm(points - place, axis=1)


def rigid_fit(
    source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"], weights: Float[Tensor, "N"] | None = None
) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Rotation and translation that bring points closest to others, by weighted squares; never a reflection.

    `source @ rotation.T + translation` lies on `target`.

    Source: Kabsch 1976, "A solution for the best rotation to relate two sets of vectors",
    doi:10.1107/S0567739476001873, with the sign of Umeyama 1991, doi:10.1109/34.88573.
    """
    _, rotation, translation = _procrustes(source, target, weights, scaled=False)
    return rotation, translation


def similarity_fit(
    source: Float[Tensor, "N 3"], target: Float[Tensor, "N 3"], weights: Float[Tensor, "N"] | None = None
) -> tuple[Float[Tensor, ""], Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Scale, rotation and translation that bring points closest to others, by weighted squares; never a reflection.

    `scale * source @ rotation.T + translation` lies on `target`.

    Source: Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns",
    doi:10.1109/34.88573, Eqs. 40 to 43.
    """
    return _procrustes(source, target, weights, scaled=True)


def _procrustes(source: Tensor, target: Tensor, weights: Tensor | None, scaled: bool) -> tuple[Tensor, Tensor, Tensor]:
    if len(source) != len(target) or len(source) < 3:
        raise ReenactError(f"fit: expected two sets of as many points, 3 or more, got {len(source)} and {len(target)}")
    shares = torch.ones(len(source), dtype=torch.float64) if weights is None else weights.double()
    if not bool((shares >= 0).all() & (shares.sum() > 0)):
        raise ReenactError("fit: expected weights that are not negative and not all 0")
    shares = (shares / shares.sum())[:, None].to(source.device)
    source_mean, target_mean = (shares * source.double()).sum(0), (shares * target.double()).sum(0)
    centred, wanted = source.double() - source_mean, target.double() - target_mean
    left, strengths, right = torch.linalg.svd(wanted.T @ (shares * centred))
    signs = torch.ones_like(strengths)
    signs[2] = torch.linalg.det(left @ right).sign()  # A mirror image would fit better: turn its weakest axis back.
    rotation = (left * signs) @ right
    spread = (shares * centred.square()).sum()
    scale = (strengths * signs).sum() / spread.clamp_min(1e-300) if scaled else torch.ones_like(spread)
    translation = target_mean - scale * rotation @ source_mean
    return scale.to(source.dtype), rotation.to(source.dtype), translation.to(source.dtype)


def closest_points(
    points: Float[Tensor, "N 3"], vertices: Float[Tensor, "V 3"], faces: Int[Tensor, "F 3"]
) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
    """The point of a surface that lies closest to each point: its face, and its barycentric coordinates in it.

    Exact. Faces stand in a tree of boxes, split at the median centre along the longest side, eight to a leaf.

    Source: Ericson 2005, "Real-Time Collision Detection", section 5.1.5 for the closest point of a triangle.
    """
    queries, corners = points.detach().cpu().double().numpy(), vertices.detach().cpu().double().numpy()
    triangles = np.ascontiguousarray(corners[faces.cpu().numpy()])  # (F, 3, 3)
    low, high = triangles.min(1), triangles.max(1)
    order = np.arange(len(triangles))
    nodes, node_low, node_high = _box_tree(low, high, order)
    found, shares = _nearest(queries, triangles, order, nodes, node_low, node_high)
    return (
        torch.from_numpy(found).to(points.device),
        torch.from_numpy(shares).to(dtype=points.dtype, device=points.device),
    )


def closest_points_around(
    points: Float[Tensor, "N D"],
    vertices: Float[Tensor, "V D"],
    faces: Int[Tensor, "F 3"],
    candidates: Int[Tensor, "N k"],
) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
    """As `closest_points` in a space of any dimension, among the faces that touch the candidate vertices of a point.

    A vertex without faces is passed over; where no candidate has one, the answer is the first face.
    """
    corners = np.ascontiguousarray(faces.cpu().numpy())
    touching = np.argsort(corners.ravel(), kind="stable") // 3
    starts = np.concatenate([[0], np.cumsum(np.bincount(corners.ravel(), minlength=len(vertices)))])
    found, shares = _nearest_around(
        np.ascontiguousarray(points.detach().cpu().double().numpy()),
        np.ascontiguousarray(vertices.detach().cpu().double().numpy()),
        corners,
        np.ascontiguousarray(candidates.cpu().numpy()),
        touching,
        starts,
    )
    return (
        torch.from_numpy(found).to(points.device),
        torch.from_numpy(shares).to(dtype=points.dtype, device=points.device),
    )


_LEAF = 8
"""Faces in a leaf of the tree of boxes."""


def _compiled(function):
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


@_compiled
def _next_farthest(places, scale, priority, last):
    """The index of the highest priority, once the last chosen point has lowered those around it, in place.

    A chosen point has -1: it is never chosen again, even where several coincide.
    """
    priority[last] = -1.0
    best, highest = 0, -np.inf
    for n in range(len(places)):
        if priority[n] >= 0:
            x, y, z = places[n, 0] - places[last, 0], places[n, 1] - places[last, 1], places[n, 2] - places[last, 2]
            priority[n] = min(priority[n], scale[n] * np.sqrt(x * x + y * y + z * z))
        if priority[n] > highest:
            best, highest = n, priority[n]
    return best


@_compiled
def _box_tree(low, high, order):
    """Nodes (first face, end, child): child 0 marks a leaf, else the children are `child` and `child + 1`.

    `order` is permuted so that the faces of a node are neighbours.
    """
    size = 2 * (2 * len(order) // _LEAF + 2)
    nodes = np.zeros((size, 3), np.int64)
    node_low, node_high = np.empty((size, 3)), np.empty((size, 3))
    nodes[0, 1] = len(order)
    count, node = 1, 0
    while node < count:  # breadth first: children stand behind their parent
        first, end = nodes[node, 0], nodes[node, 1]
        for axis in range(3):
            lowest, highest = np.inf, -np.inf
            for place in range(first, end):
                lowest = min(lowest, low[order[place], axis])
                highest = max(highest, high[order[place], axis])
            node_low[node, axis], node_high[node, axis] = lowest, highest
        if end - first > _LEAF:
            axis = np.argmax(node_high[node] - node_low[node])
            members = order[first:end].copy()
            order[first:end] = members[np.argsort(low[members, axis] + high[members, axis])]
            middle = (first + end) // 2
            nodes[node, 2] = count
            nodes[count, 0], nodes[count, 1] = first, middle
            nodes[count + 1, 0], nodes[count + 1, 1] = middle, end
            count += 2
        node += 1
    return nodes[:count], node_low[:count], node_high[:count]


@_compiled
def _nearest(points, triangles, order, nodes, node_low, node_high):
    found = np.zeros(len(points), np.int64)
    shares = np.zeros((len(points), 3))
    stack = np.empty(128, np.int64)
    for index in range(len(points)):
        point = points[index]
        best = np.inf
        stack[0], depth = 0, 1
        while depth > 0:
            depth -= 1
            node = stack[depth]
            if _box_square(point, node_low[node], node_high[node]) >= best:
                continue
            child = nodes[node, 2]
            if child > 0:  # the nearer child is looked at first
                near, far = child, child + 1
                if _box_square(point, node_low[far], node_high[far]) < _box_square(
                    point, node_low[near], node_high[near]
                ):
                    near, far = far, near
                stack[depth], stack[depth + 1] = far, near
                depth += 2
                continue
            for place in range(nodes[node, 0], nodes[node, 1]):
                corners = triangles[order[place]]
                v, w = _closest_in_triangle(point, corners[0], corners[1], corners[2])
                square = 0.0
                for axis in range(3):
                    on = (1 - v - w) * corners[0, axis] + v * corners[1, axis] + w * corners[2, axis]
                    square += (on - point[axis]) ** 2
                if square < best:
                    best = square
                    found[index] = order[place]
                    shares[index, 0], shares[index, 1], shares[index, 2] = 1 - v - w, v, w
    return found, shares


@_compiled
def _nearest_around(points, vertices, faces, candidates, touching, starts):
    found = np.zeros(len(points), np.int64)
    shares = np.zeros((len(points), 3))
    for index in range(len(points)):
        point = points[index]
        best = np.inf
        for vertex in candidates[index]:
            for place in range(starts[vertex], starts[vertex + 1]):
                face = touching[place]
                a, b, c = vertices[faces[face, 0]], vertices[faces[face, 1]], vertices[faces[face, 2]]
                v, w = _closest_in_triangle(point, a, b, c)
                offset = (1 - v - w) * a + v * b + w * c - point
                square = _dot(offset, offset)
                if square < best:
                    best = square
                    found[index] = face
                    shares[index, 0], shares[index, 1], shares[index, 2] = 1 - v - w, v, w
    return found, shares


@_compiled
def _box_square(point, low, high):
    square = 0.0
    for axis in range(3):
        outside = max(low[axis] - point[axis], point[axis] - high[axis], 0.0)
        square += outside * outside
    return square


@_compiled
def _closest_in_triangle(p, a, b, c):
    """Shares of b and c, in any dimension. Source: Ericson 2005, section 5.1.5."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = _dot(ab, ap), _dot(ac, ap)
    if d1 <= 0 and d2 <= 0:
        return 0.0, 0.0
    bp = p - b
    d3, d4 = _dot(ab, bp), _dot(ac, bp)
    if d3 >= 0 and d4 <= d3:
        return 1.0, 0.0
    vc = d1 * d4 - d3 * d2
    if vc <= 0 and d1 >= 0 and d3 <= 0 and d1 - d3 > 0:
        return d1 / (d1 - d3), 0.0
    cp = p - c
    d5, d6 = _dot(ab, cp), _dot(ac, cp)
    if d6 >= 0 and d5 <= d6:
        return 0.0, 1.0
    vb = d5 * d2 - d1 * d6
    if vb <= 0 and d2 >= 0 and d6 <= 0 and d2 - d6 > 0:
        return 0.0, d2 / (d2 - d6)
    va = d3 * d6 - d5 * d4
    if va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0 and (d4 - d3) + (d5 - d6) > 0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w
    total = va + vb + vc
    if total <= 0:
        return 0.0, 0.0
    return vb / total, vc / total


@_compiled
def _dot(a, b):
    total = 0.0
    for axis in range(len(a)):
        total += a[axis] * b[axis]
    return total
