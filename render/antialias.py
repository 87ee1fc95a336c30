"""Blending across silhouettes: the gradient of coverage.

Between the centres of two neighbouring pixels one surface may give way to another. Where it does is a number that moves
with the vertices, and it is the only thing in a picture that tells how coverage changes. Three things are ours, each of
them measured (docs/renderer.md):

Edges first. On a face rig triangles are smaller than pixels, so that the edge which separates two pixels rarely belongs
to the triangle that either shows, as the published rules for larger triangles assume (compare Laine et al. 2020,
"Modular Primitives for High-Performance Differentiable Rendering", doi:10.1145/3414685.3417861, section 3.5). We start
from the edges: one is an outline when exactly one of its faces is a front face.

The colour at the crossing. A surface that turns away gets darker or brighter until its last visible point, and it is
the colour there, not the one in the middle of the pixel, that coverage gains or loses. With the colour of the middle
the gradient is 3 to 7 % too long.

Sheets that meet. Lids, lashes and lips pass through one another, and there the outline is no edge of the mesh: two
sheets of front faces reach under both centres, and each is the nearer one at one of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from render.camera import to_pixels
from render.rasterize import front_faces

DEPTH_MARGIN = 1e-4
"""An edge is in front of a pixel's surface if its inverse depth is larger by this share."""
VALLEY = 0.27
"""Two sheets are looked for where the surface has a groove of at least this angle: 15 degrees, seen from the front."""
WALK = 24
"""Faces that a walk over a sheet crosses at most."""


@dataclass(frozen=True)
class Outline:
    """An edge at which a surface ends between two pixels."""

    surface: tuple[int, int]
    """Row and column of the pixel that shows the surface."""
    behind: tuple[int, int]
    """The neighbour that shows what is behind it."""
    ends: tuple[int, int]
    """Vertices of the edge, in the order in which pixel rows (columns) meet them."""
    face: int
    """The edge's front face."""


@dataclass(frozen=True)
class Meeting:
    """Two sheets that pass through one another between two pixels, each seen at one of them."""

    surface: tuple[int, int]
    """Row and column of the upper or left pixel."""
    behind: tuple[int, int]
    """Its neighbour."""
    at_surface: tuple[int, int]
    """The face seen there, and the face of the other sheet below it."""
    at_behind: tuple[int, int]
    """The face seen there, and the face of the other sheet below it."""


Crossing = Outline | Meeting


@torch.no_grad()
def find_crossings(
    face_img: Int[Tensor, "B H W"],
    vertices_clip: Float[Tensor, "B V 4"],
    faces: Int[Tensor, "F 3"],
    focal: float,
) -> list[list[Crossing]]:
    """Of each frame, where something else begins between two pixels; like visibility it has no gradient.

    At most one crossing for each pair of neighbouring pixels: of several outlines the outermost (they all belong to the
    pixel that is nearer), and a meeting rather than an outline. The focal length is in pixels.
    """
    height, width = face_img.shape[1:]
    pixels = to_pixels(vertices_clip, height, width)
    front = front_faces(vertices_clip, faces, height, width)
    edges = edges_of(faces)
    neighbours = neighbours_of(faces, edges).tolist()
    return [
        _Frame(
            face_img[b], pixels[b], 1 / vertices_clip[b, :, 3], faces, front[b].tolist(), neighbours, VALLEY / focal
        ).crossings(edges.tolist())
        for b in range(len(face_img))
    ]


class _Frame:
    """One frame, and the questions about it."""

    def __init__(self, face_img, pixels, inverse, faces, front, neighbours, valley) -> None:
        self.face_img, self.pixels, self.inverse, self.faces = face_img, pixels, inverse, faces
        self.front, self.neighbours, self.valley = front, neighbours, valley
        self.height, self.width = face_img.shape
        self.inverse_img = torch.zeros(self.height, self.width).to(inverse)
        for row, column in (face_img >= 0).nonzero().tolist():
            self.inverse_img[row, column] = self.depth_of(int(face_img[row, column]), column, row)

    def depth_of(self, face: int, x: int | float, y: int | float) -> Float[Tensor, ""]:
        """Inverse depth of a face's plane at a point of the picture."""
        return inverse_depth(self.pixels[self.faces[face]], self.inverse[self.faces[face]], x, y)

    def walk(self, face: int, x: int | float, y: int | float) -> int:
        """The face that shows a point, on the sheet of front faces that `face` belongs to; -1 if it ends before."""
        for _ in range(WALK):
            areas = _areas(self.pixels[self.faces[face]], x, y).tolist()
            if max(areas) <= 0:
                return face
            face = self.neighbours[face][areas.index(max(areas))]
            if face < 0 or not self.front[face]:
                return -1
        return -1

    def crossings(self, edges: list[list[int]]) -> list[Crossing]:
        found: dict[tuple, tuple[float, Crossing]] = {}
        for p, q, *sides in edges:
            fronts = [face for face in sides if face >= 0 and self.front[face]]
            if len(fronts) == 1:
                for pair, distance, crossing in self._along_edge(p, q, fronts[0]):
                    known = found.get(pair)
                    outermost = known is None or (isinstance(known[1], Outline) and distance > known[0])
                    if outermost or isinstance(crossing, Meeting):
                        found[pair] = distance, crossing
        for along in range(2):
            for row in range(self.height - along):
                for column in range(self.width - 1 + along):
                    meeting = self._between(row, column, along)
                    if meeting is not None:
                        found[meeting.surface, meeting.behind] = 0.0, meeting
        return [crossing for _, crossing in found.values()]

    def _along_edge(self, p: int, q: int, face: int):
        """Pair, distance from the surface's centre, and crossing wherever an edge separates two pixels.

        Rows (along == 0) meet a steep edge, columns a shallow one. Below, "t" is the column (row) where row (column)
        "s" meets the edge.
        """
        pixels = self.pixels
        x, y = (pixels[q] - pixels[p]).abs().tolist()
        along, across = (0, 1) if y > x else (1, 0)
        o = int(self.faces[face].sum()) - p - q
        if not pixels[p, across] < pixels[q, across]:
            p, q = q, p
        s0, s1, t0, t1 = (float(pixels[v, axis]) for axis in (across, along) for v in (p, q))
        reach = s1 - s0
        if not reach > 0:
            return
        before = float(pixels[o, along]) < t0 + (t1 - t0) / reach * (float(pixels[o, across]) - s0)
        last_s, last_t = (self.height - 1, self.width - 1) if along == 0 else (self.width - 1, self.height - 1)
        # Without s1: the next edge of the outline takes it.
        for s in range(max(math.ceil(s0), 0), min(math.ceil(s1), last_s + 1)):
            fraction = (s - s0) / reach
            t = t0 + fraction * (t1 - t0)
            if not 0 <= t < last_t:
                continue
            cell = int(t)
            first, second = ((s, cell), (s, cell + 1)) if along == 0 else ((cell, s), (cell + 1, s))
            surface, behind = (first, second) if before else (second, first)
            edge = float(self.inverse[p] + fraction * (self.inverse[q] - self.inverse[p]))
            depth_behind, depth_surface = float(self.inverse_img[behind]), float(self.inverse_img[surface])
            if depth_behind > edge * (1 - DEPTH_MARGIN) or depth_surface < 0.5 * (edge + depth_behind):
                continue
            if depth_behind > 0:
                # What is behind may come before the edge on its way there: then the surface passes under it first.
                x, y = (t, s) if along == 0 else (s, t)
                other = self.walk(int(self.face_img[behind]), x, y)
                if other >= 0 and float(self.depth_of(other, x, y)) > edge:
                    near, far = (face, other) if before else (other, face)
                    meeting = self._meeting(first, second, (near, far), (far, near))
                    if meeting is not None:
                        yield (first, second), 0.0, meeting
                    continue
            distance = t - cell if before else 1 - (t - cell)
            yield (first, second), distance, Outline(surface, behind, (p, q), face)

    def _between(self, row: int, column: int, along: int) -> Meeting | None:
        """Two sheets that both reach under both pixels."""
        first, second = (row, column), ((row, column + 1) if along == 0 else (row + 1, column))
        a, b = self.inverse_img[first], self.inverse_img[second]
        step = (0, 1) if along == 0 else (1, 0)
        ahead = max(row - step[0], 0), max(column - step[1], 0)
        beyond = min(second[0] + step[0], self.height - 1), min(second[1] + step[1], self.width - 1)
        rise = max(self.inverse_img[ahead] - 2 * a + b, a - 2 * b + self.inverse_img[beyond])
        face, other = int(self.face_img[first]), int(self.face_img[second])
        if not (a > 0 and b > 0 and rise > self.valley * a):
            return None
        if set(self.faces[face].tolist()) & set(self.faces[other].tolist()):
            return None
        below_second = self.walk(face, second[1], second[0])
        if below_second < 0 or below_second == other:
            return None
        below_first = self.walk(other, first[1], first[0])
        if below_first < 0 or below_first == face:
            return None
        return self._meeting(first, second, (face, below_first), (other, below_second))

    def _meeting(self, first, second, at_first, at_second) -> Meeting | None:
        gaps = [
            self.depth_of(seen, place[1], place[0]) - self.depth_of(below, place[1], place[0])
            for place, (seen, below) in ((first, at_first), (second, at_second))
        ]
        if not min(gaps) > 0:
            return None
        row, column = first
        slopes = []
        for x, y in ((column + 1, row), (column, row + 1)):
            rises = [
                self.depth_of(face, x, y) - self.depth_of(face, column, row) for face in (at_first[0], at_second[0])
            ]
            slopes.append(float(abs(rises[0] - rises[1])))
        is_in_row = first[0] == second[0]
        return Meeting(first, second, at_first, at_second) if is_in_row == (slopes[0] > slopes[1]) else None


def distances(
    crossings: list[Crossing],
    vertices_clip: Float[Tensor, "V 4"],
    faces: Int[Tensor, "F 3"],
    height: int,
    width: int,
) -> Float[Tensor, "N"]:
    """How far each crossing of a frame lies from the surface's pixel centre towards the other, in pixels."""
    pixels, inverse = to_pixels(vertices_clip, height, width), 1 / vertices_clip[:, 3]
    found = []
    for crossing in crossings:
        (row, column), (row_behind, column_behind) = crossing.surface, crossing.behind
        if isinstance(crossing, Outline):
            along, _, _ = _axes(crossing)
            p, q = crossing.ends
            at = column if along == 0 else row
            fraction = _fraction(crossing, pixels)
            t = pixels[p, along] + fraction * (pixels[q, along] - pixels[p, along])
            found.append((t - at) * (column_behind - column + row_behind - row))
        else:
            gaps = [
                inverse_depth(pixels[faces[seen]], inverse[faces[seen]], x, y)
                - inverse_depth(pixels[faces[below]], inverse[faces[below]], x, y)
                for (seen, below), x, y in (
                    (crossing.at_surface, column, row),
                    (crossing.at_behind, column_behind, row_behind),
                )
            ]
            found.append(gaps[0] / (gaps[0] + gaps[1]))
    return torch.stack(found) if found else vertices_clip.new_zeros(0)


def edge_points(
    crossings: list[Crossing], vertices_clip: Float[Tensor, "V 4"], faces: Int[Tensor, "F 3"], height: int, width: int
) -> tuple[Int[Tensor, "N"], Float[Tensor, "N 3"]]:
    """The face of each outline and the barycentric coordinates of the crossing in it; -1 and 0 for meetings."""
    pixels, inverse = to_pixels(vertices_clip, height, width), 1 / vertices_clip[:, 3]
    owners, coordinates = [], []
    for crossing in crossings:
        if isinstance(crossing, Meeting):
            owners.append(-1)
            coordinates.append(vertices_clip.new_zeros(3))
            continue
        p, q = crossing.ends
        fraction = _fraction(crossing, pixels)
        # Inverse depth is what changes evenly over the picture.
        position = fraction * inverse[q] / (inverse[p] + fraction * (inverse[q] - inverse[p]))
        corners = faces[crossing.face]
        owners.append(crossing.face)
        coordinates.append(torch.where(corners == p, 1 - position, torch.where(corners == q, position, 0.0)))
    if not owners:
        return faces.new_zeros(0), vertices_clip.new_zeros(0, 3)
    return torch.tensor(owners), torch.stack(coordinates)


def blend(
    color_img: Float[Tensor, "H W C"],
    edge_colors: Float[Tensor, "N C"],
    distances: Float[Tensor, "N"],
    crossings: list[Crossing],
) -> Float[Tensor, "H W C"]:
    """The picture with each silhouette where it is, not where the pixel grid puts it.

    Let t be the distance of the crossing, and let the colour run evenly from the surface's (s) to that at the crossing
    (e), then be that of what is behind (b). Each of the two pixels gets the integral over its half of the way:
    the surface's pixel t (s + e) / 2 + (1/2 - t) b instead of s / 2 if t < 1/2; else (s / 2 + (e - s) / (8 t)), and the
    other one (t - 1/2) s + (e - s) (t^2 - 1/4) / (2 t) instead of (t - 1/2) b.

    Args:
        color_img: Of pixel centres.
        edge_colors: Of the surface at each crossing.
        distances: From the surface's centre, in pixels.
        crossings: Which pixels they separate.
    """
    blended = color_img.clone()
    for crossing, t, edge in zip(crossings, distances, edge_colors):
        surface, behind = color_img[crossing.surface], color_img[crossing.behind]
        if t < 0.5:
            changes = {crossing.surface: t * (surface + edge) / 2 + (0.5 - t) * behind - surface / 2}
        else:
            ramp = (edge - surface) / t
            changes = {
                crossing.surface: ramp / 8,
                crossing.behind: (t - 0.5) * (surface - behind) + (t**2 / 2 - 1 / 8) * ramp,
            }
        for (row, column), change in changes.items():
            place = torch.tensor(row), torch.tensor(column)
            blended = blended.index_put(place, change, accumulate=True)
    return blended


def inverse_depth(
    corners: Float[Tensor, "3 2"], inverse: Float[Tensor, "3"], x: int | float, y: int | float
) -> Float[Tensor, ""]:
    """1 / depth of a triangle's plane at a point of the picture, in which it is linear."""
    areas = _areas(corners, x, y)
    return (areas * inverse).sum() / areas.sum()


def _areas(corners: Float[Tensor, "3 2"], x: int | float, y: int | float) -> Float[Tensor, "3"]:
    """Twice the areas between a point and the edges opposite each corner, negative inside front faces."""
    offsets = corners - torch.tensor([x, y]).to(corners)
    after, before = offsets.roll(-1, 0), offsets.roll(-2, 0)
    return after[:, 0] * before[:, 1] - before[:, 0] * after[:, 1]


def _axes(crossing: Outline) -> tuple[int, int, int]:
    """The axis (0 columns, 1 rows) along which the pair lies, the other one, and the row (column) it lies in."""
    along = 0 if crossing.surface[0] == crossing.behind[0] else 1
    return along, 1 - along, crossing.surface[along]


def _fraction(crossing: Outline, pixels: Float[Tensor, "V 2"]) -> Float[Tensor, ""]:
    """How far from one end of the edge's picture to the other the pair's row (column) meets it."""
    _, across, s = _axes(crossing)
    p, q = crossing.ends
    return (s - pixels[p, across]) / (pixels[q, across] - pixels[p, across])


def edges_of(faces: Int[Tensor, "F 3"]) -> Int[Tensor, "E 4"]:
    """Each edge once: its two vertices, ascending, and its two faces, the second -1 where the mesh ends.

    Where more than two faces share an edge, the third and later ones each get the edge once more to themselves.
    """
    count = len(faces)
    ends = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).sort(1).values  # (3 F, 2)
    owners = torch.arange(count, device=faces.device).repeat_interleave(3)
    order = torch.argsort(ends[:, 0] * (int(faces.max()) + 1) + ends[:, 1], stable=True)
    ends, owners = ends[order], owners[order]
    starts = torch.ones(3 * count, dtype=torch.bool, device=faces.device)
    starts[1:] = (ends[1:] != ends[:-1]).any(1)
    positions = torch.arange(3 * count, device=faces.device)
    rank = positions - torch.where(starts, positions, 0).cummax(0).values  # 0, 1, 2, ... within the faces of an edge
    second = torch.full_like(owners, -1)
    second[:-1] = torch.where(rank[1:] == 1, owners[1:], -1)
    kept = rank != 1
    second[rank > 1] = -1
    return torch.cat([ends, owners[:, None], second[:, None]], 1)[kept]


def neighbours_of(faces: Int[Tensor, "F 3"], edges: Int[Tensor, "E 4"]) -> Int[Tensor, "F 3"]:
    """The face across the edge opposite each corner, -1 where the mesh ends."""
    neighbours = torch.full_like(faces, -1)
    shared = edges[edges[:, 3] >= 0]
    for own, other in ((2, 3), (3, 2)):
        corners = faces[shared[:, own]]  # (N, 3), of which one is not on the edge
        corner = ((corners != shared[:, :1]) & (corners != shared[:, 1:2])).int().argmax(1)
        neighbours[shared[:, own], corner] = shared[:, other]
    return neighbours
