"""Where the surface of one face lies on another, found from what both look like and from how they move.

Ours, on two known ideas: a non-rigid iterative closest point search in which the deformed source bends as little as it
can (Amberg et al. 2007, "Optimal Step Nonrigid ICP Algorithms for Surface Registration", doi:10.1109/CVPR.2007.383165,
bends by another measure), and descriptors in the search space beside the positions. Every vertex is a point of a space
with four kinds of coordinates: where it rests, where its surface faces, how near the rim of an eye or the mouth it is,
and how each shape moves it. In that space both faces are surfaces of triangles, and the closest point of the target's
surface is the partner.

Motion is what tells a lid's margin from the skin a millimetre above it. It enters as logarithms of how far a shape
moves a point, so that a shape with twice the range is the same descriptor shifted, and a shift that changes slowly over
the face is taken away like the difference in shape. Which shape of one rig is which of the other is read from their
names where these say it, and otherwise found from where and how they move the face. Nothing reads the order of
vertices, texture coordinates or topology.

Code              Meaning
groups            shapes that count as one: `blink` of one rig is `blinkLeft` and `blinkRight` of another
features          (N, D) how the shapes move each vertex, see `_features`
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csc_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from reenact.errors import ReenactError
from reenact.geometry import closest_points_around, cotangent_laplacian, similarity_fit, vertex_areas
from reenact.retargeting.face import MOVING, STILL, Face, surface_normals
from reenact.rigs import arkit
from reenact.rigs.rig import Rig

_FLOOR = 0.003
"""Share of a shape's farthest motion below which its logarithm flattens."""
_DIMENSIONS = 140
"""Principal components that the motion of all shapes is reduced to."""
_NORMAL_WEIGHT = 6.0
"""A turn by 10 degrees counts as much as one standard deviation of the position."""
_RIM_WEIGHT = 3.0
"""Standard deviations of the position that the rim of an eye or the mouth is apart from skin far from it."""
_SCALES = (0.1, 0.2, 0.2, 0.2, 0.15, 0.1, 0.07, 0.05, 0.04, 0.03, 0.03, 0.02, 0.02, 0.015, 0.015)
"""Standard deviation of a partner's position, coarse to fine, in face heights."""
_BELIEF = 1.5
"""What disagreement of motion as large as usual counts, in standard deviations of the position."""
_DISAGREEMENT = 0.02
"""Share of the spread of motion that halves its weight where partners disagree by so much. Between heads of one
sculptor it is 0.002 to 0.006, between heads of two 0.06 to 0.07."""
_BENDING = (1e-1, 5e-3)
"""Weight of the bending energy of the deformation, first and last; the published schemes also loosen as they go."""
_COARSE_SCALES, _COARSE_BENDING = (0.1, 0.2, 0.15, 0.1), (1e-1, 1e-2)
"""The same for the rounds that only ask which shape is which."""
_FEATURE_BENDING = 1e-4
"""The same for the slowly changing difference between both rigs' motion."""
_SETTLING = 1e-7
"""The same for the last step, which lets sure pairs correct unsure ones between them."""
_CONTRADICTION = 0.06
"""Distance in face heights beyond which two answers are not averaged."""
_LEAST = 1e-3
"""Face heights that no pair is expected to be surer than."""
_DRIFT = 0.15
"""By how much a pair is off per distance from the next landmark: 0.06 to 0.25 on the built-in heads."""


@dataclass(frozen=True)
class Registration:
    """Partners on the target's surface of the source's moving vertices."""

    vertices: Int[np.ndarray, "N"]
    """Of the source."""
    corners: Int[np.ndarray, "N 3"]
    """Vertices of the face of the target that the partner lies on."""
    shares: Float[np.ndarray, "N 3"]
    """Barycentric coordinates of the partner."""
    error: Float[np.ndarray, "N"]
    """How far off the partner is expected to lie, in face heights."""
    shape_pairs: tuple[tuple[tuple[int, ...], tuple[int, ...]], ...]
    """Shapes of the source and of the target that were taken for the same."""


# ---- which shape is which ----

Group = tuple[int, ...]
Pairs = tuple[tuple[Group, Group], ...]


def pairs_by_name(source: Sequence[str], target: Sequence[str]) -> Pairs:
    """Groups of shapes whose names stand for the same ARKit shapes.

    A rig that has both sides of a shape in one meets the two of a rig that has them apart.
    """
    by_meaning: list[dict[tuple[str, ...], Group]] = [{}, {}]
    for names, found in zip((source, target), by_meaning):
        for index, name in enumerate(names):
            meaning = arkit.meaning(name)
            if meaning:
                found[meaning] = (*found.get(meaning, ()), index)

    def group(found: dict, meaning: tuple[str, ...]) -> Group | None:
        apart = [found.get((component,)) for component in meaning]
        return found.get(meaning) or (sum(apart, ()) if all(apart) else None)

    pairs = []
    for meaning in dict.fromkeys((*by_meaning[0], *by_meaning[1])):
        groups = [group(found, meaning) for found in by_meaning]
        if all(groups):
            pairs.append((groups[0], groups[1]))
    return tuple(pairs)


def _groups(face: Face) -> list[Group]:
    """Each shape that moves the face, and the two of each mirrored pair together."""
    reach = np.linalg.norm(face.deltas, axis=-1).max(1)
    single = [int(k) for k in np.flatnonzero(reach > STILL * reach.max())]
    middle = np.median(face.points[face.strength > MOVING, 0])
    mirror = np.array([-1.0, 1.0, 1.0])
    partner = cKDTree(face.points).query(face.points * mirror + [2 * middle, 0, 0])[1]
    flat = _unit_rows(face.deltas[single] * np.sqrt(face.areas)[:, None])
    mirrored = _unit_rows(face.deltas[single][:, partner] * mirror * np.sqrt(face.areas)[:, None])
    likeness = flat @ mirrored.T
    best = likeness.argmax(1)
    paired = [(i, int(j)) for i, j in enumerate(best) if i < j and best[j] == i and likeness[i, j] > 0.8]
    return [(k,) for k in single] + [(single[i], single[j]) for i, j in paired]


def _pairs_by_habit(source: Face, target: Face, align: Callable[[np.ndarray], np.ndarray]) -> Pairs:
    """Groups that move much the same place much the same way: each the other's best by centre, extent and direction."""

    def habits(face: Face, groups: list[Group], points: np.ndarray) -> np.ndarray:
        rows = []
        for group in groups:
            delta = face.deltas[list(group)].sum(0)
            mass = face.areas * np.square(delta).sum(1)
            mass = mass / mass.sum()
            centre = mass @ points
            extent = np.sqrt(mass @ np.square(points - centre))
            way = mass @ (delta / np.linalg.norm(delta, axis=1, keepdims=True).clip(1e-12))
            # A tenth of the face between centres weighs as much as a fifth between extents and a turn by 40 degrees.
            rows.append(np.concatenate([centre / target.height / 0.1, extent / target.height / 0.2, way / 0.7]))
        return np.array(rows)

    groups = _groups(source), _groups(target)
    distances = cKDTree(habits(target, groups[1], target.points)).query(
        habits(source, groups[0], align(source.points)), k=len(groups[1])
    )
    costs = np.empty((len(groups[0]), len(groups[1])))
    np.put_along_axis(costs, distances[1].reshape(costs.shape), distances[0].reshape(costs.shape), axis=1)
    return _mutual(groups, -costs, -2.5)


def _pairs_by_motion(source: Face, target: Face, rotation: np.ndarray, match: _Match) -> Pairs:
    """Groups that move registered places alike: each the other's best by the cosine of all their displacements."""
    groups = _groups(source), _groups(target)
    weights = np.sqrt(source.areas * np.minimum(1, source.strength))[:, None]
    fields = []
    for group in groups[0]:
        fields.append(_tamed(source.deltas[list(group)].sum(0) @ rotation.T) * weights)
    partners = []
    for group in groups[1]:
        delta = target.deltas[list(group)].sum(0)
        partners.append(_tamed(match.of(delta)) * weights)
    return _mutual(groups, _unit_rows(np.array(fields)) @ _unit_rows(np.array(partners)).T, 0.5)


def _tamed(delta: np.ndarray) -> np.ndarray:
    """Displacements with the root of their length, so that a peak does not outweigh the field around it."""
    return delta / np.sqrt(np.linalg.norm(delta, axis=1, keepdims=True)).clip(1e-9)


def _mutual(groups: tuple[list[Group], list[Group]], likeness: np.ndarray, least: float) -> Pairs:
    """Pairs that are each the other's best and alike enough, the likeliest first; a shape is used once."""
    rows, columns = np.arange(len(likeness)), likeness.argmax(1)
    good = (likeness.argmax(0)[columns] == rows) & (likeness[rows, columns] > least)
    pairs, used = [], (set(), set())
    for row in sorted(rows[good], key=lambda row: -likeness[row, columns[row]]):
        pair = groups[0][row], groups[1][columns[row]]
        if not any(used[side].intersection(pair[side]) for side in (0, 1)):
            pairs.append(pair)
            for side in (0, 1):
                used[side].update(pair[side])
    return tuple(pairs)


def _unit_rows(values: np.ndarray) -> np.ndarray:
    flat = values.reshape(len(values), -1)
    return flat / np.linalg.norm(flat, axis=1, keepdims=True).clip(1e-12)


# ---- registration ----


@dataclass(frozen=True)
class _Similarity:
    scale: float
    rotation: np.ndarray
    translation: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return self.scale * points @ self.rotation.T + self.translation


def register(source: Rig, target: Rig, use_names: bool = True) -> Registration:
    """Partners on the target of all vertices of the source's moving face.

    Args:
        source: Whose vertices get partners.
        target: On whose surface they lie.
        use_names: Whether names may say which shapes are the same; where fewer than four do, motion says it anyway.

    Raises:
        ReenactError: A rig does not move, or no four shapes of both move the face alike.
    """
    faces = _comparable(source, target)
    pairs = _moving(*faces, pairs_by_name(source.names, target.names)) if use_names else ()
    if len(pairs) < 4:
        pairs = _moving(*faces, _pairs_by_habit(*faces, _boxes_aligned(*faces)))
        for _ in range(2):
            _need(source, target, pairs)
            start = _centres_aligned(*faces, pairs)
            match = _match(*faces, pairs, start, _COARSE_SCALES, _COARSE_BENDING)
            pairs = _moving(*faces, _pairs_by_motion(*faces, start.rotation, match))
    _need(source, target, pairs)
    start = _centres_aligned(*faces, pairs)
    there = _match(*faces, pairs, start, _SCALES, _BENDING)
    swapped = tuple((theirs, ours) for ours, theirs in pairs)
    back = _match(*faces[::-1], swapped, _centres_aligned(*faces[::-1], swapped), _SCALES, _BENDING)
    partners, error = _agreed(*faces, there, back)
    rest = start(faces[0].points)
    trust = np.minimum(np.square(0.01 / error), 10)
    settled = rest + _Smoother(faces[0])(partners - rest, trust, _SETTLING)  # the sure places hold the others
    corners, shares = _onto(faces[1], settled, surface_normals(settled, faces[0].faces))
    moving = np.flatnonzero(faces[0].strength > MOVING)
    return Registration(
        faces[0].vertices[moving], faces[1].vertices[corners[moving]], shares[moving], error[moving], pairs
    )


def _comparable(source: Rig, target: Rig) -> tuple[Face, Face]:
    """Faces of two rigs, without sockets where only one has them: these find no partner, and drag the lids along."""
    faces = Face.of(source), Face.of(target)
    if faces[0].hollow.any() == faces[1].hollow.any():
        return faces
    return faces[0].without_hollows(), faces[1].without_hollows()


def _need(source: Rig, target: Rig, pairs: Pairs) -> None:
    if len(pairs) < 4:
        raise ReenactError(
            f"{source.name} and {target.name}: expected at least four shapes that move both faces alike, found "
            f"{len(pairs)}; give a file of pairs of places (correspondence), or train on pictures alone (pairs.method)"
        )


def _moving(source: Face, target: Face, pairs: Pairs) -> Pairs:
    """Pairs whose shapes move both faces."""

    def moves(face: Face, group: Group) -> bool:
        reach = np.linalg.norm(face.deltas, axis=-1).max()
        return bool(np.linalg.norm(face.deltas[list(group)].sum(0), axis=-1).max() > STILL * reach)

    return tuple(pair for pair in pairs if moves(source, pair[0]) and moves(target, pair[1]))


def _boxes_aligned(source: Face, target: Face) -> _Similarity:
    """Brings the middle and the size of one moving face to those of the other; both face +Z."""
    middles, sizes = [], []
    for face in (source, target):
        mass = face.areas * np.minimum(1, face.strength)
        middle = mass @ face.points / mass.sum()
        middles.append(middle)
        sizes.append(np.sqrt(mass @ np.square(face.points - middle)[:, :2].sum(1) / mass.sum()))
    scale = sizes[1] / sizes[0]
    return _Similarity(scale, np.eye(3), middles[1] - scale * middles[0])


def _centres_aligned(source: Face, target: Face, pairs: Pairs) -> _Similarity:
    """Brings the centres of what paired shapes move together; pairs that disagree with the others lose weight."""

    def centres(face: Face, side: int) -> torch.Tensor:
        mass = np.array([face.areas * np.square(face.deltas[list(pair[side])].sum(0)).sum(1) for pair in pairs])
        return torch.from_numpy(mass @ face.points / mass.sum(1, keepdims=True))

    ours, theirs = centres(source, 0), centres(target, 1)
    weights = torch.ones(len(pairs), dtype=torch.float64)
    for _ in range(10):
        scale, rotation, translation = similarity_fit(ours, theirs, weights)
        miss = (scale * ours @ rotation.T + translation - theirs).norm(dim=1)
        weights = 1 / (1 + (miss / miss.median().clamp_min(1e-9)).square())
    return _Similarity(float(scale), rotation.numpy(), translation.numpy())


def _features(
    source: Face, target: Face, pairs: Pairs, rotation: np.ndarray
) -> tuple[Float[np.ndarray, "N D"], Float[np.ndarray, "M D"]]:
    """How each pair of shapes moves the vertices of both faces, reduced to common principal components.

    For a shape that moves a vertex by d, and its farthest by r: log(1 + |d| / 0.003 r) alone and times the direction of
    d, and twice the logarithm of how the area around the vertex changes at half the shape.
    """

    def describe(face: Face, side: int, turn: np.ndarray) -> np.ndarray:
        columns = []
        for pair in pairs:
            delta = face.deltas[list(pair[side])].sum(0)
            length = np.linalg.norm(delta, axis=1, keepdims=True)
            reach = np.log1p(length / (_FLOOR * length.max()))
            little = 1e-3 * face.areas.mean()
            stretch = (vertex_areas(face.points + delta / 2, face.faces) + little) / (face.areas + little)
            columns += [reach, reach * (delta @ turn.T) / length.clip(1e-12)]
            columns.append(2 * np.log(stretch).clip(-2, 2)[:, None])
        return np.concatenate(columns, 1)

    ours, theirs = describe(source, 0, rotation), describe(target, 1, np.eye(3))
    both = np.concatenate([ours, theirs])
    middle = both.mean(0)
    basis = np.linalg.eigh((both - middle).T @ (both - middle))[1][:, ::-1][:, :_DIMENSIONS]
    return (ours - middle) @ basis, (theirs - middle) @ basis


def confidence(error: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    """The chance that a pair is right to 1 % of a face height, where it is expected to be off by so much.

    Errors are spread about what is expected of them by a factor of 2 or so, hence the slope of the logistic curve. It
    was read off seven pairs of heads whose vertices are known to correspond: man, woman, child, toon and others.
    """
    return 1 / (1 + (error / 0.0115) ** 2)


def complete(
    source: Rig, target: Rig, source_vertices: Int[np.ndarray, "M"], target_vertices: Int[np.ndarray, "M"]
) -> Registration:
    """Partners of all vertices of the source's moving face, and of the landmarks, from given ones.

    Raises:
        ReenactError: A landmark does not lie on the face, or all lie on one line.
    """
    faces = _comparable(source, target)
    own = [
        _own(rig, face, given) for rig, face, given in zip((source, target), faces, (source_vertices, target_vertices))
    ]
    given = [face.points[numbers] for face, numbers in zip(faces, own)]
    spread = np.linalg.svd(given[0] - given[0].mean(0), compute_uv=False)
    if spread[1] <= 0.05 * spread[0]:
        raise ReenactError("landmarks: expected them spread over the face, got them on one line")
    scale, rotation, translation = similarity_fit(*(torch.from_numpy(points) for points in given))
    start = _Similarity(float(scale), rotation.numpy(), translation.numpy())
    rest = start(faces[0].points)
    still = np.zeros((len(rest), 0)), np.zeros((len(faces[1].points), 0))
    smooth, search, metric = _Smoother(faces[0]), _Search(faces[1], still[1]), np.zeros((0, 0))
    # A landmark outweighs what the surfaces say anywhere near it.
    weights, offsets = np.zeros(len(rest)), np.zeros_like(rest)
    weights[own[0]] = 10 * faces[0].areas.sum() / len(own[0]) / faces[0].areas[own[0]].clip(1e-12)
    offsets[own[0]] = given[1] - rest[own[0]]
    points = rest + smooth(offsets, weights, 1e-3 * _BENDING[1])
    for size in (0.1, 0.1, 0.07, 0.05, 0.03):
        normals = surface_normals(points, faces[0].faces)
        match = search(points, _looks(normals, faces[0].rim), still[0], size, metric)
        facing = (match.of(faces[1].normals) * normals).sum(1)
        usual = max(1.5 * float(np.median(match.distance)), 1e-9)
        trust = 0.3 * (facing > 0.5) / (1 + np.square(match.distance / usual))
        pull = np.where(weights[:, None] > 0, offsets, match.of(faces[1].points) - rest)
        points = rest + smooth(pull, np.where(weights > 0, weights, trust), _BENDING[1] * size**2)
    match = search(points, _looks(surface_normals(points, faces[0].faces), faces[0].rim), still[0], 0.03, metric)
    corners, shares = match.corners, match.shares
    corners[own[0]], shares[own[0]] = own[1][:, None], [1.0, 0.0, 0.0]
    slack = np.linalg.norm(match.of(faces[1].points) - points, axis=1) / faces[1].height
    far = cKDTree(given[0]).query(faces[0].points)[0] / faces[0].height
    error = slack + _DRIFT * far
    error[own[0]] = 0
    chosen = np.flatnonzero(faces[0].strength > MOVING)
    chosen = np.union1d(chosen, own[0])
    return Registration(
        faces[0].vertices[chosen], faces[1].vertices[corners[chosen]], shares[chosen], error[chosen], ()
    )


def _own(rig: Rig, face: Face, vertices: np.ndarray) -> np.ndarray:
    """Numbers of the rig's vertices in its face."""
    numbers = np.searchsorted(face.vertices, vertices).clip(max=len(face.vertices) - 1)
    lost = face.vertices[numbers] != vertices
    if lost.any():
        raise ReenactError(
            f"{rig.name}: expected landmarks on the skin of the face that the shapes move, vertex {vertices[lost][0]} "
            "is not; choose one on the skin"
        )
    return numbers


@dataclass(frozen=True)
class _Match:
    """A partner on the target for each vertex of the source's face."""

    corners: Int[np.ndarray, "N 3"]
    shares: Float[np.ndarray, "N 3"]
    distance: Float[np.ndarray, "N"]
    """Between vertex and partner in the common space."""
    slide: Float[np.ndarray, "N"]
    """How far the partner could slide along the target before normals and motion would disagree by as much again as
    they do, face heights."""

    def of(self, values: Float[np.ndarray, "M D"]) -> Float[np.ndarray, "N D"]:
        """Values of the target's vertices at the partners."""
        return np.einsum("nci,nc->ni", values[self.corners], self.shares)


def _match(
    source: Face,
    target: Face,
    pairs: Pairs,
    start: _Similarity,
    scales: tuple[float, ...],
    bending: tuple[float, float],
) -> _Match:
    """Partners by turns: closest points in the common space, then the least bent deformation that follows them."""
    ours, theirs = _features(source, target, pairs, start.rotation)
    original, rest = ours, start(source.points)
    points, normals = rest, source.normals @ start.rotation.T
    smooth, search = _Smoother(source), _Search(target, theirs)
    metric = np.zeros((ours.shape[1], ours.shape[1]))  # of features: what their disagreement between partners teaches
    moved = source.areas * np.minimum(1, source.strength)
    spread = float(moved @ np.square(ours - np.average(ours, axis=0, weights=moved)).sum(1) / moved.sum())
    for step, scale in enumerate(scales):
        match = search(points, _looks(normals, source.rim), ours, scale, metric)
        features = match.of(theirs)
        facing = (match.of(target.normals) * normals).sum(1)
        usual = max(1.5 * float(np.median(match.distance)), 1e-9)
        trust = (facing > 0.2) / (1 + np.square(match.distance / usual))
        stiffness = bending[0] * (bending[1] / bending[0]) ** (step / (len(scales) - 1))
        points = rest + smooth(match.of(target.points) - rest, trust, stiffness * scale**2)
        normals = surface_normals(points, source.faces)
        ours = original + smooth(features - original, trust, _FEATURE_BENDING)
        metric = _metric(ours - features, trust * source.areas, spread)
    match = search(points, _looks(normals, source.rim), ours, scales[-1], metric)
    sharpness = _sharpness(target, np.concatenate([search.looks, theirs @ metric], 1))
    return replace(match, slide=match.distance / match.of(sharpness[:, None])[:, 0].clip(1))


class _Search:
    """Closest points of the target's surface in the space of positions, looks and motion."""

    def __init__(self, target: Face, features: np.ndarray) -> None:
        self.target, self.features, self.looks = target, features, _looks(target.normals, target.rim)

    def __call__(
        self, points: np.ndarray, looks: np.ndarray, features: np.ndarray, scale: float, metric: np.ndarray
    ) -> _Match:
        target, unit = self.target, scale * self.target.height
        places = np.concatenate([target.points / unit, self.looks, self.features @ metric], 1)
        queries = np.concatenate([points / unit, looks, features @ metric], 1)
        corners, shares = _closest(queries, places, target.faces)
        offsets = np.einsum("nci,nc->ni", places[corners], shares) - queries
        return _Match(corners, shares, np.linalg.norm(offsets, axis=1), np.zeros(len(queries)))


def _looks(normals: Float[np.ndarray, "N 3"], rim: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 4"]:
    """What a place looks like at rest, beside where it is."""
    return np.concatenate([_NORMAL_WEIGHT * normals, _RIM_WEIGHT * rim[:, None]], 1)


def _closest(queries: np.ndarray, places: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and shares of the closest points of a surface, among the faces around the three nearest vertices."""
    from_numpy = torch.from_numpy
    near = _nearest(from_numpy(queries), from_numpy(places), 3)
    face, shares = closest_points_around(from_numpy(queries), from_numpy(places), from_numpy(faces), near)
    return faces[face.numpy()], shares.numpy()


def _nearest(queries: torch.Tensor, places: torch.Tensor, count: int) -> torch.Tensor:
    """Indices of the nearest places of each query, by matrix products: in many dimensions a tree is slower."""
    middle = places.mean(0)
    queries, places = (queries - middle).float(), (places - middle).float()
    squares = places.square().sum(1)
    found = [
        (squares - 2 * chunk @ places.T).topk(count, dim=1, largest=False).indices for chunk in queries.split(1024)
    ]
    return torch.cat(found)


class _Smoother:
    """The smoothest values over the source's surface that follow trusted data: least squares with bending energy."""

    def __init__(self, face: Face) -> None:
        laplacian = csc_array(
            cotangent_laplacian(torch.from_numpy(face.points), torch.from_numpy(face.faces), low=0.025, high=2.5)
        )
        self._share = face.areas / face.areas.sum()
        spread = face.areas.clip(1e-4 * face.areas.mean())
        # |L x|^2 over areas is the energy of bending; the square of the height makes it free of units.
        self._bending = laplacian.T @ diags_array(1 / spread) @ laplacian * (face.height**2 / face.areas.sum() * 1e-3)

    def __call__(self, data: np.ndarray, trust: np.ndarray, stiffness: float) -> np.ndarray:
        weights = trust * self._share
        matrix = diags_array(weights) + stiffness * self._bending + 1e-9 * eye_array(len(weights))
        return splu(csc_array(matrix), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
            weights[:, None] * data
        )


def _metric(difference: Float[np.ndarray, "N D"], weights: Float[np.ndarray, "N"], spread: float) -> np.ndarray:
    """Divides features by how much they disagree between partners: the inverse root of their covariance.

    What two sculptors did differently, or two people do, thus counts for less than what they agree on. Where they
    disagree in a large share of all that there is to know (`spread`), motion as a whole counts for less than place.
    """
    covariance = difference.T @ (difference * (weights / weights.sum())[:, None])
    size, unexplained = len(covariance), np.trace(covariance)
    covariance += 0.1 * unexplained / size * np.eye(size)
    values, vectors = np.linalg.eigh(covariance)
    belief = _BELIEF / (1 + (unexplained / spread / _DISAGREEMENT) ** 2)
    return belief / np.sqrt(size) * vectors @ np.diag(values.clip(1e-12) ** -0.5) @ vectors.T


def _agreed(
    source: Face, target: Face, there: _Match, back: _Match
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N"]]:
    """Points between the partners found from the source and those that found their way back to it.

    Each answer counts by how little it can slide: the inverse of its squared uncertainty.

    Returns:
        The points, and how far off they are expected to be, in face heights: the geometric mean of how far both answers
        lie apart and how far they can slide. Either may be small by chance or by mistake.
    """
    ahead = there.of(target.points)
    # Where each target vertex lies on the source; the place whose answer is the source's vertex is its other partner.
    landed = _placed(back.of(source.points), back.of(source.normals), source.height)
    corners, shares = _closest(_placed(source.points, source.normals, source.height), landed, target.faces)
    returned = np.einsum("nci,nc->ni", target.points[corners], shares)
    slide, slide_back = there.slide, (back.slide[corners] * shares).sum(1)
    gap = np.linalg.norm(ahead - returned, axis=1) / target.height
    belief = slide**2 / (slide**2 + slide_back**2)  # in the way back
    # Between answers that contradict each other lies nothing, or the other lid: one of them counts alone.
    belief = np.where(gap < _CONTRADICTION, belief, np.round(belief))[:, None]
    both = slide * slide_back / np.hypot(slide, slide_back)
    return ahead + belief * (returned - ahead), np.sqrt((gap + _LEAST) * (both + _LEAST))


def _onto(face: Face, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners and shares of the closest points of a face."""
    places = _placed(face.points, face.normals, face.height)
    return _closest(_placed(points, normals, face.height), places, face.faces)


def _placed(points: np.ndarray, normals: np.ndarray, height: float) -> np.ndarray:
    """Positions and normals in one space, where a turn by 60 degrees is as far as a tenth of the face's height."""
    return np.concatenate([points / height, 0.1 * normals], 1)


def _sharpness(target: Face, look: Float[np.ndarray, "N D"]) -> Float[np.ndarray, "N"]:
    """How fast the looks of a surface change along it in the direction in which they change least, per face height."""
    points, faces = target.points / target.height, target.faces
    edges = points[faces[:, 1:]] - points[faces[:, :1]]  # (F, 2, 3)
    changes = look[faces[:, 1:]] - look[faces[:, :1]]  # (F, 2, D)
    lengths = edges @ edges.swapaxes(1, 2) + 1e-12 * np.eye(2)
    inverse = np.linalg.inv(np.linalg.cholesky(lengths))
    least = np.linalg.eigvalsh(inverse @ changes @ changes.swapaxes(1, 2) @ inverse.swapaxes(1, 2))[:, 0].clip(0)
    areas = np.sqrt(np.linalg.det(lengths).clip(0))
    sums = [np.bincount(faces.ravel(), weights=np.repeat(w, 3), minlength=len(points)) for w in (areas * least, areas)]
    return np.sqrt(sums[0] / sums[1].clip(1e-30))
