"""The stages of the renderer compiled for the CPU: fused over the samples of a frame, one frame at a time.

`rasterize.py`, `interpolate.py`, `shade.py` and `antialias.py` say the same in plain torch; tests hold both together.
Every function works in place on arrays that the caller allocated, keeps the dtype of its arguments (float32, float64)
and lets go of the interpreter lock, so that threads of one pool each take some frames, or some rows of one frame. Every
sum has one order, so the result does not depend on the number of threads.

A sample is a point of the surface that gets a colour: first the H * W pixel centres, row by row, then the crossings of
silhouettes. Samples are shaded in blocks of `LANES`: their numbers are gathered one by one, then lit all at once, by
loops that the compiler turns into vector instructions.

Numbers are cast by `dtype.type` because a Python float would silently turn float32 arithmetic into float64.

Space       Axes
world       of the rig, metres
camera      right, up, towards the viewer; w = -z is the depth in metres
pixel       column, row, of which the centre of pixel (0, 0) is the origin
"""

from __future__ import annotations

import inspect
import math
from typing import NamedTuple

import numba
import numpy as np

BACKGROUND = -1


class Mesh(NamedTuple):
    """What all frames share and no gradient reaches."""

    faces: np.ndarray  # (F, 3) int32
    edges: np.ndarray  # (E, 4) int32: two vertices, two faces, the second -1 where the mesh ends
    neighbours: np.ndarray  # (F, 3) int32: the face across the edge opposite each corner, -1 where the mesh ends
    uv: np.ndarray  # (U, 2), empty without a texture
    uv_faces: np.ndarray  # (F, 3) int32
    uv_areas: np.ndarray  # (F,) area of each face in the texture, in texels of its finest level
    levels: np.ndarray  # (L, 3) int64: first texel, rows, columns of each level of the texture


class Look(NamedTuple):
    """What all frames share and a gradient may reach."""

    matrix: np.ndarray  # (3, 4) world -> camera
    lens: np.ndarray  # (3,) focal length, column and row of the optical axis, in pixels
    light: np.ndarray  # (3,) camera space
    phong: np.ndarray  # (4,) ambient, diffuse, specular, shininess
    colors: np.ndarray  # (V, 3) linear
    texels: np.ndarray  # (texels of all levels, 3) linear
    background: np.ndarray  # (3,) linear


class Kept(NamedTuple):
    """What the forward pass leaves for the backward pass, of each frame."""

    finite: np.ndarray  # (B,) bool
    vertices: np.ndarray  # (B, V, 3) camera space
    screen: np.ndarray  # (B, V, 3) column, row, inverse depth; inverse depth 0 marks what is not before the camera
    normals: np.ndarray  # (B, V, 4) unit normal in camera space, length of the sum it was made from
    sides: np.ndarray  # (B, F) uint8: 1 for a front face, 3 for one that may cover a pixel centre
    face_img: np.ndarray  # (B, H, W) int32
    inverse_img: np.ndarray  # (B, H, W) inverse depth, 0 is the background
    samples: np.ndarray  # (B, H * W + N, C) linear colour, coverage, normal if asked for, attributes
    pair_img: np.ndarray  # (B, 2, H, W) int32: the crossing between a pixel and the next in its row, in its column
    places: np.ndarray  # (B, N, 6) int32: see `_silhouettes` and `_cross_sheets`
    crossings: np.ndarray  # (B, N, 2) the same
    mixed: np.ndarray  # (B, N, 2, C) what the two pixels were before they were blended
    counts: np.ndarray  # (B,) crossings


# Promises of finite numbers only. No arithmetic is reordered or contracted: which of several compiled copies of a
# function a kernel is linked to depends on what was loaded first, and all copies have to agree to the last bit.
_FAST = {"nnan", "ninf", "nsz"}


def _compiled(function):
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


def _inlined(function):
    """For inner loops on finite numbers."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)(inspect.unwrap(function))


@_inlined
def _corners(faces, f):
    """The vertices of a face, as the index type that needs no test for a negative number."""
    return np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2])


# Vertices


@_compiled
def _to_camera(world, matrix, vertices):
    """World points in camera space; False if one is not finite."""
    total = vertices.dtype.type(0)
    for v in range(world.shape[0]):
        x, y, z = world[v, 0], world[v, 1], world[v, 2]
        vertices[v, 0] = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + matrix[0, 3]
        vertices[v, 1] = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + matrix[1, 3]
        vertices[v, 2] = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + matrix[2, 3]
        total += vertices[v, 0] + vertices[v, 1] + vertices[v, 2]  # NaN and infinity survive every sum
    return math.isfinite(total)


@_compiled
def _project(vertices, lens, near, screen):
    """Column, row and inverse depth of each vertex; inverse depth 0 marks what is not in front of the camera."""
    focal, column, row = lens[0], lens[1], lens[2]
    zero, one = vertices.dtype.type(0), vertices.dtype.type(1)
    for v in range(vertices.shape[0]):
        depth = -vertices[v, 2]
        inverse = one / depth if depth > near else zero
        screen[v, 0] = column + focal * vertices[v, 0] * inverse
        screen[v, 1] = row - focal * vertices[v, 1] * inverse
        screen[v, 2] = inverse


@_compiled
def _vertex_normals(vertices, faces, normals):
    """Unit sums of the adjoining faces' area-weighted normals, 0 where there is no area, and the length of the sums."""
    zero, one = vertices.dtype.type(0), vertices.dtype.type(1)
    normals[:] = zero
    for f in range(faces.shape[0]):
        i, j, k = _corners(faces, f)
        ax, ay, az = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
        bx, by, bz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(vertices.shape[0]):
        squared = normals[v, 0] * normals[v, 0] + normals[v, 1] * normals[v, 1] + normals[v, 2] * normals[v, 2]
        if squared > zero:
            length = math.sqrt(squared)
            inverse = one / length
            normals[v, 0] *= inverse
            normals[v, 1] *= inverse
            normals[v, 2] *= inverse
            normals[v, 3] = length


# Visibility


@_inlined
def _ceil(x):
    """The first whole number from x >= 0 on; `math.ceil` would be a call into the C library."""
    whole = np.int32(x)
    return whole + np.int32(whole < x)


@_inlined
def _classify(screen, faces, height, width, sides):
    """Which faces look this way, and which of them have a pixel centre between their outermost columns and rows.

    On a face rig these are few. Without branches, which would be mispredicted once a face.
    """
    zero = screen.dtype.type(0)
    right, bottom = screen.dtype.type(width - 1), screen.dtype.type(height - 1)
    for f in range(faces.shape[0]):
        # Counter-clockwise seen from outside is clockwise once rows point down: swap two corners.
        i, k, j = _corners(faces, f)
        xi, yi, xj, yj, xk, yk = screen[i, 0], screen[i, 1], screen[j, 0], screen[j, 1], screen[k, 0], screen[k, 1]
        area = (xj - xi) * (yk - yi) - (xk - xi) * (yj - yi)
        is_front = (area > zero) & (min(screen[i, 2], min(screen[j, 2], screen[k, 2])) > zero)
        first_x, last_x = max(min(xi, min(xj, xk)), zero), min(max(xi, max(xj, xk)), right)
        first_y, last_y = max(min(yi, min(yj, yk)), zero), min(max(yi, max(yj, yk)), bottom)
        # The last whole number up to `last` is not before `first`; a face beyond a border fails for its sign.
        has_column = screen.dtype.type(np.int32(last_x)) >= first_x
        has_row = screen.dtype.type(np.int32(last_y)) >= first_y
        on_screen = (last_x >= zero) & (last_y >= zero)
        sides[f] = np.uint8(is_front) + np.uint8(2) * np.uint8(is_front & has_column & has_row & on_screen)


_HITS = 1024  # pixels that lie inside a face are noted, and their depths compared so many at a time


@_inlined
def _nearest(pixels, owners, inverses, areas, count, inverse_img, face_img):
    for hit in range(count):
        inverses[hit] /= areas[hit]
    for hit in range(count):
        pixel = pixels[hit]
        if inverses[hit] > inverse_img[pixel]:
            inverse_img[pixel] = inverses[hit]
            face_img[pixel] = owners[hit]


@_inlined
def _rasterize(screen, faces, sides, candidates, first_row, last_row, face_img, inverse_img):
    """Which front face lies nearest in each pixel of some rows, and its inverse depth.

    A pixel centre on the edge of two faces goes to exactly one of them: `edge(a, b) == -edge(b, a)` holds to the last
    bit, and of two opposite directions one counts as inside.
    """
    zero = screen.dtype.type(0)
    width = face_img.shape[1]
    top, bottom, right = screen.dtype.type(first_row), screen.dtype.type(last_row - 1), screen.dtype.type(width - 1)
    face_img[first_row:last_row] = BACKGROUND
    inverse_img[first_row:last_row] = zero
    flat_faces, flat_inverses = face_img.reshape(-1), inverse_img.reshape(-1)
    pixels, owners = np.empty(_HITS + width, np.uint32), np.empty(_HITS + width, np.int32)
    inverses, areas = np.empty(_HITS + width, screen.dtype), np.empty(_HITS + width, screen.dtype)
    count = 0
    for f in range(faces.shape[0]):
        candidates[count] = f
        count += sides[f] >> 1
    hits = np.uintp(0)
    for candidate in range(count):
        f = candidates[candidate]
        i, k, j = _corners(faces, f)
        xi, yi, xj, yj, xk, yk = screen[i, 0], screen[i, 1], screen[j, 0], screen[j, 1], screen[k, 0], screen[k, 1]
        zi, zj, zk = screen[i, 2], screen[j, 2], screen[k, 2]
        first_x, last_x = max(min(xi, min(xj, xk)), zero), min(max(xi, max(xj, xk)), right)
        first_y, last_y = max(min(yi, min(yj, yk)), top), min(max(yi, max(yj, yk)), bottom)
        if last_y < top:
            continue
        first_column, last_column = _ceil(first_x), np.int32(last_x)
        for row in range(_ceil(first_y), np.int32(last_y) + 1):
            y = screen.dtype.type(row)
            start = row * width
            for column in range(first_column, last_column + 1):
                x = screen.dtype.type(column)
                ei = (xj - x) * (yk - y) - (xk - x) * (yj - y)
                ej = (xk - x) * (yi - y) - (xi - x) * (yk - y)
                ek = (xi - x) * (yj - y) - (xj - x) * (yi - y)
                smallest = min(ei, min(ej, ek))
                inside = smallest > zero
                if smallest == zero:
                    inside = (
                        (ei > zero or yk > yj or (yk == yj and xk < xj))
                        and (ej > zero or yi > yk or (yi == yk and xi < xk))
                        and (ek > zero or yj > yi or (yj == yi and xj < xi))
                    )
                pixels[hits] = start + column
                owners[hits] = f
                inverses[hits] = ei * zi + ej * zj + ek * zk
                areas[hits] = ei + ej + ek
                hits += np.uintp(inside)  # without a branch: the next one overwrites it
            if hits >= np.uintp(_HITS):
                _nearest(pixels, owners, inverses, areas, hits, flat_inverses, flat_faces)
                hits = np.uintp(0)
    _nearest(pixels, owners, inverses, areas, hits, flat_inverses, flat_faces)


@_compiled
def _areas_at(screen, faces, f, x, y):
    """Twice the areas between each edge of a face and a point of the picture, positive inside a front face."""
    i, k, j = _corners(faces, f)
    ei = (screen[j, 0] - x) * (screen[k, 1] - y) - (screen[k, 0] - x) * (screen[j, 1] - y)
    ej = (screen[k, 0] - x) * (screen[i, 1] - y) - (screen[i, 0] - x) * (screen[k, 1] - y)
    ek = (screen[i, 0] - x) * (screen[j, 1] - y) - (screen[j, 0] - x) * (screen[i, 1] - y)
    return i, j, k, ei, ej, ek


@_compiled
def _inverse_at(screen, faces, f, x, y):
    """Inverse depth of a face's plane at a point of the picture."""
    i, j, k, ei, ej, ek = _areas_at(screen, faces, f, x, y)
    return (ei * screen[i, 2] + ej * screen[j, 2] + ek * screen[k, 2]) / (ei + ej + ek)


@_compiled
def _walk(screen, mesh, sides, f, x, y):
    """The face that shows a point, on the sheet of front faces that f belongs to; -1 if it ends before."""
    zero = screen.dtype.type(0)
    for _ in range(24):
        _, _, _, ei, ej, ek = _areas_at(screen, mesh.faces, f, x, y)
        if ei >= zero and ej >= zero and ek >= zero:
            return f
        # _areas_at swaps the last two corners; neighbours are opposite corners in the face's own order.
        corner = 0 if ei <= ej and ei <= ek else (2 if ej <= ek else 1)
        f = mesh.neighbours[f, corner]
        if f < 0 or sides[f] == 0:
            return -1
    return -1


@_compiled
def _cross_sheets(
    screen, faces, f, g_before, f_after, g, row, column, along, width, pair_img, places, crossings, count
):  # fmt: skip
    """Notes where sheet f, seen at a pixel, passes under sheet g, seen at the next one; how many crossings now.

    Its place is the face seen at the pixel, that of g below it, that of f below the next pixel, both pixels, and the
    face seen at the next one; its numbers are the distance from the pixel's centre and the sum of both gaps.
    """
    zero, one = screen.dtype.type(0), screen.dtype.type(1)
    row_after, column_after = (row, column + 1) if along == 0 else (row + 1, column)
    x, y = screen.dtype.type(column), screen.dtype.type(row)
    x_after, y_after = screen.dtype.type(column_after), screen.dtype.type(row_after)
    before = _inverse_at(screen, faces, f, x, y) - _inverse_at(screen, faces, g_before, x, y)
    after = _inverse_at(screen, faces, g, x_after, y_after) - _inverse_at(screen, faces, f_after, x_after, y_after)
    if not (before > zero and after > zero):
        return count
    slope_x = _inverse_at(screen, faces, f, x + one, y) - _inverse_at(screen, faces, f, x, y)
    slope_x -= _inverse_at(screen, faces, g, x + one, y) - _inverse_at(screen, faces, g, x, y)
    slope_y = _inverse_at(screen, faces, f, x, y + one) - _inverse_at(screen, faces, f, x, y)
    slope_y -= _inverse_at(screen, faces, g, x, y + one) - _inverse_at(screen, faces, g, x, y)
    if along != (0 if abs(slope_x) > abs(slope_y) else 1):
        return count
    index = pair_img[along, row, column]
    if index < 0:
        index = count
        count += 1
        pair_img[along, row, column] = index
    places[index, 0] = f
    places[index, 1] = g_before
    places[index, 2] = f_after
    places[index, 3] = row * width + column
    places[index, 4] = row_after * width + column_after
    places[index, 5] = g
    crossings[index, 0] = before / (before + after)
    crossings[index, 1] = before + after
    return count


@_compiled
def _silhouettes(screen, mesh, sides, face_img, inverse_img, margin, pair_img, places, crossings):
    """Where the outline of a surface passes between the centres of two neighbouring pixels; returns how often.

    Of several crossings between two centres the outermost is kept. Its place is the vertices p and q of the edge, its
    face, the pixel of the surface, the one behind it, and -1; its numbers are the distance from the surface's centre
    and the position from p to q.
    """
    half, zero, one = screen.dtype.type(0.5), screen.dtype.type(0), screen.dtype.type(1)
    height, width = inverse_img.shape
    pair_img[:] = -1
    count = 0
    for e in range(mesh.edges.shape[0]):
        f, g = mesh.edges[e, 2], mesh.edges[e, 3]
        f_front = sides[f] != 0
        g_front = g >= 0 and sides[g] != 0
        if f_front == g_front:
            continue
        if g_front:
            f = g
        a, b = mesh.edges[e, 0], mesh.edges[e, 1]
        o = mesh.faces[f, 0] + mesh.faces[f, 1] + mesh.faces[f, 2] - a - b
        # Rows (along == 0) meet a steep edge, columns a shallow one. Below, "s" runs over the rows (columns) and "t" is
        # the column (row) of the crossing.
        along = 0 if abs(screen[b, 1] - screen[a, 1]) > abs(screen[b, 0] - screen[a, 0]) else 1
        across = 1 - along
        p, q = (a, b) if screen[a, across] < screen[b, across] else (b, a)
        s0, s1, t0, t1 = screen[p, across], screen[q, across], screen[p, along], screen[q, along]
        if not s1 > s0:
            continue
        reach = s1 - s0
        slope = (t1 - t0) / reach
        surface_before = screen[o, along] < t0 + slope * (screen[o, across] - s0)
        last_s, last_t = (height - 1, width - 1) if along == 0 else (width - 1, height - 1)
        if s1 < zero or s0 > screen.dtype.type(last_s):
            continue
        first = _ceil(max(s0, zero))
        last = _ceil(min(s1, screen.dtype.type(last_s + 1)))  # not included: the next edge of the outline takes it
        for step in range(first, last):
            fraction = (screen.dtype.type(step) - s0) / reach
            t = t0 + fraction * (t1 - t0)
            if not (t >= zero and t < screen.dtype.type(last_t)):
                continue
            cell = int(t)
            inverse_edge = screen[p, 2] + fraction * (screen[q, 2] - screen[p, 2])
            row, column = (step, cell) if along == 0 else (cell, step)
            row_after, column_after = (row, column + 1) if along == 0 else (row + 1, column)
            before, after = inverse_img[row, column], inverse_img[row_after, column_after]
            surface, behind = (before, after) if surface_before else (after, before)
            if behind > inverse_edge * (one - margin) or surface < half * (inverse_edge + behind):
                continue
            if behind > zero:
                # What is behind may come before the edge on its way there: then the surface passes under it first.
                other = face_img[row_after, column_after] if surface_before else face_img[row, column]
                x, y = (t, screen.dtype.type(row)) if along == 0 else (screen.dtype.type(column), t)
                g = _walk(screen, mesh, sides, other, x, y)
                if g >= 0 and _inverse_at(screen, mesh.faces, g, x, y) > inverse_edge:
                    near, far = (f, g) if surface_before else (g, f)
                    count = _cross_sheets(
                        screen, mesh.faces, near, far, near, far, row, column, along, width, pair_img, places,
                        crossings, count,
                    )  # fmt: skip
                    continue
            distance = t - screen.dtype.type(cell)
            pixel, other = row * width + column, row_after * width + column_after
            if not surface_before:
                distance, pixel, other = one - distance, other, pixel
            index = pair_img[along, row, column]
            if index < 0:
                index = count
                count += 1
                pair_img[along, row, column] = index
            elif places[index, 5] >= 0 or distance <= crossings[index, 0]:
                continue
            places[index, 0] = p
            places[index, 1] = q
            places[index, 2] = f
            places[index, 3] = pixel
            places[index, 4] = other
            places[index, 5] = -1
            crossings[index, 0] = distance
            crossings[index, 1] = fraction
    return count


@_inlined
def _valleys(inverse_img, row, along, step, valleys):
    """Where the surface seen in a row may be a groove between a pixel and the next: its slope rises by `step` there.

    A place between smooth parts of one sheet seldom is one, and the place where two sheets meet always is.
    """
    height, width = inverse_img.shape
    two = inverse_img.dtype.type(2)
    before, after = max(row - along, 0), min(row + 2 * along, height - 1)
    last = width - 1 + along
    for column in range(last):
        left, right = (max(column - 1, 0), min(column + 2, width - 1)) if along == 0 else (column, column)
        a = inverse_img[row, column]
        b = inverse_img[row, column + 1] if along == 0 else inverse_img[row + 1, column]
        first = inverse_img[before, left] - two * a + b
        second = a - two * b + inverse_img[after, right]
        valleys[column] = (a > 0) & (b > 0) & (max(first, second) > step * a)


@_inlined
def _touch(faces, f, g):
    """Whether two faces share a corner."""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a, b, c = faces[g, 0], faces[g, 1], faces[g, 2]
    return (
        (i == a) | (i == b) | (i == c) | (j == a) | (j == b) | (j == c) | (k == a) | (k == b) | (k == c)
    )  # fmt: skip


@_compiled
def _intersections(screen, mesh, sides, face_img, inverse_img, step, pair_img, places, crossings, count):
    """Where two sheets pass through one another between the centres of two neighbouring pixels; how many crossings now.

    Both sheets reach under both centres, and each is the nearer one at one of them.
    """
    faces = mesh.faces
    height, width = face_img.shape
    valleys = np.zeros(width, np.bool_)
    for along in range(2):
        for row in range(height - along):
            _valleys(inverse_img, row, along, step, valleys)
            for column in range(width - 1 + along):
                if not valleys[column]:
                    continue
                row_after, column_after = (row, column + 1) if along == 0 else (row + 1, column)
                f, g = face_img[row, column], face_img[row_after, column_after]
                if _touch(faces, f, g):
                    continue
                x, y = screen.dtype.type(column), screen.dtype.type(row)
                x_after, y_after = screen.dtype.type(column_after), screen.dtype.type(row_after)
                f_after = _walk(screen, mesh, sides, f, x_after, y_after)
                if f_after < 0 or f_after == g:
                    continue
                g_before = _walk(screen, mesh, sides, g, x, y)
                if g_before < 0 or g_before == f:
                    continue
                count = _cross_sheets(
                    screen, faces, f, g_before, f_after, g, row, column, along, width, pair_img, places, crossings,
                    count,
                )  # fmt: skip
    return count


@_compiled
def _inverse_at_backward(screen, faces, f, x, y, g_inverse, g_screen):
    i, j, k, ei, ej, ek = _areas_at(screen, faces, f, x, y)
    area = ei + ej + ek
    # Slopes of the plane: it moves along with its corners.
    slope_x = (
        (screen[k, 1] - screen[j, 1]) * screen[i, 2] + (screen[i, 1] - screen[k, 1]) * screen[j, 2]
        + (screen[j, 1] - screen[i, 1]) * screen[k, 2]
    ) / -area  # fmt: skip
    slope_y = (
        (screen[j, 0] - screen[k, 0]) * screen[i, 2] + (screen[k, 0] - screen[i, 0]) * screen[j, 2]
        + (screen[i, 0] - screen[j, 0]) * screen[k, 2]
    ) / -area  # fmt: skip
    for v, e in ((i, ei), (j, ej), (k, ek)):
        share = e / area * g_inverse
        g_screen[v, 0] -= share * slope_x
        g_screen[v, 1] -= share * slope_y
        g_screen[v, 2] += share


# Barycentric coordinates of a sample


@_inlined
def _barycentrics(vertices, i, j, k, x, y):
    """Perspective-correct barycentric coordinates where the ray (x, y, -1) meets a face, and twice its area seen there.

    Shearing the face until the ray is the viewing axis leaves plain areas in two dimensions.
    """
    wi, wj, wk = -vertices[i, 2], -vertices[j, 2], -vertices[k, 2]
    xi, yi = vertices[i, 0] - x * wi, vertices[i, 1] - y * wi
    xj, yj = vertices[j, 0] - x * wj, vertices[j, 1] - y * wj
    xk, yk = vertices[k, 0] - x * wk, vertices[k, 1] - y * wk
    ei, ej, ek = xj * yk - xk * yj, xk * yi - xi * yk, xi * yj - xj * yi
    area = ei + ej + ek
    inverse = vertices.dtype.type(1) / area
    return ei * inverse, ej * inverse, ek * inverse, area


@_inlined
def _barycentrics_backward(vertices, i, j, k, x, y, area, block, m, g_bi, g_bj, g_bk, g_vertices):
    """Adds the gradients through coordinates and point to the vertices'; returns those of the ray's x and y."""
    bi, bj, bk = block[_BI + m], block[_BJ + m], block[_BK + m]
    g_px, g_py, g_pz = block[_G_PX + m], block[_G_PY + m], block[_G_PZ + m]
    mean = bi * g_bi + bj * g_bj + bk * g_bk
    inverse = vertices.dtype.type(1) / area
    g_ei, g_ej, g_ek = (g_bi - mean) * inverse, (g_bj - mean) * inverse, (g_bk - mean) * inverse
    wi, wj, wk = -vertices[i, 2], -vertices[j, 2], -vertices[k, 2]
    xi, yi = vertices[i, 0] - x * wi, vertices[i, 1] - y * wi
    xj, yj = vertices[j, 0] - x * wj, vertices[j, 1] - y * wj
    xk, yk = vertices[k, 0] - x * wk, vertices[k, 1] - y * wk
    g_xi, g_yi = yj * g_ek - yk * g_ej, xk * g_ej - xj * g_ek
    g_xj, g_yj = yk * g_ei - yi * g_ek, xi * g_ek - xk * g_ei
    g_xk, g_yk = yi * g_ej - yj * g_ei, xj * g_ei - xi * g_ej
    g_vertices[i, 0] += g_xi + bi * g_px
    g_vertices[i, 1] += g_yi + bi * g_py
    g_vertices[i, 2] += x * g_xi + y * g_yi + bi * g_pz
    g_vertices[j, 0] += g_xj + bj * g_px
    g_vertices[j, 1] += g_yj + bj * g_py
    g_vertices[j, 2] += x * g_xj + y * g_yj + bj * g_pz
    g_vertices[k, 0] += g_xk + bk * g_px
    g_vertices[k, 1] += g_yk + bk * g_py
    g_vertices[k, 2] += x * g_xk + y * g_yk + bk * g_pz
    return -(wi * g_xi + wj * g_xj + wk * g_xk), -(wi * g_yi + wj * g_yj + wk * g_yk)


@_inlined
def _edge_position(screen, p, q, fraction):
    """How far from p to q the point lies that is seen at a fraction of the way between their pictures."""
    return fraction * screen[q, 2] / (screen[p, 2] + fraction * (screen[q, 2] - screen[p, 2]))


@_inlined
def _edge_position_backward(screen, p, q, across, fraction, g_position, g_screen):
    one = screen.dtype.type(1)
    near, far = screen[p, 2], screen[q, 2]
    inverse = one / (near + fraction * (far - near))
    scale = g_position * inverse * inverse
    g_screen[p, 2] -= fraction * (one - fraction) * far * scale
    g_screen[q, 2] += fraction * (one - fraction) * near * scale
    g_fraction = near * far * scale / (screen[q, across] - screen[p, across])
    g_screen[p, across] -= (one - fraction) * g_fraction
    g_screen[q, across] -= fraction * g_fraction


# Texture


@_inlined
def _level_of_detail(lens, levels, area, depth, volume):
    """The level whose texels are as large as the pixel, in area: 0 is the finest, fractions lie between two levels."""
    number = lens.dtype.type
    texels = area * depth * depth * depth / (volume * lens[0] * lens[0])
    if not texels > number(1):
        return number(0)
    return min(number(0.5) * number(math.log2(texels)), number(levels.shape[0] - 1))


@_inlined
def _volume(vertices, i, j, k):
    """Six times the volume between the eye and a face: its area at any ray, times the depth there."""
    ax, ay, az = vertices[i, 0], vertices[i, 1], -vertices[i, 2]
    bx, by, bz = vertices[j, 0], vertices[j, 1], -vertices[j, 2]
    cx, cy, cz = vertices[k, 0], vertices[k, 1], -vertices[k, 2]
    return ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)


@_inlined
def _volume_backward(vertices, i, j, k, g_volume, g_vertices):
    for v, a, b in ((i, j, k), (j, k, i), (k, i, j)):
        ax, ay, az = vertices[a, 0], vertices[a, 1], -vertices[a, 2]
        bx, by, bz = vertices[b, 0], vertices[b, 1], -vertices[b, 2]
        g_vertices[v, 0] += g_volume * (ay * bz - az * by)
        g_vertices[v, 1] += g_volume * (az * bx - ax * bz)
        g_vertices[v, 2] -= g_volume * (ax * by - ay * bx)


@_inlined
def _texel(levels, level, u, v, number):
    """The four texels of a level around (u, v), clamped at the border, and how far (u, v) lies between them."""
    half, zero, one = number(0.5), number(0), number(1)
    start, rows, columns = levels[level, 0], levels[level, 1], levels[level, 2]
    x = min(max(u * number(columns) - half, zero), number(columns) - one)
    y = min(max(v * number(rows) - half, zero), number(rows) - one)
    left, top = int(x), int(y)
    right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
    upper, lower = start + top * columns, start + bottom * columns
    return upper + left, upper + right, lower + left, lower + right, x - number(left), y - number(top)


@_inlined
def _mix(texels, channel, a, b, c, d, s, t):
    one = texels.dtype.type(1)
    upper = (one - s) * texels[a, channel] + s * texels[b, channel]
    lower = (one - s) * texels[c, channel] + s * texels[d, channel]
    return (one - t) * upper + t * lower


@_inlined
def _sample_texture(texels, levels, u, v, level_of_detail):
    """Between four texels of each of two levels."""
    number = texels.dtype.type
    level = int(level_of_detail)
    between = level_of_detail - number(level)
    a, b, c, d, s, t = _texel(levels, level, u, v, number)
    red, green, blue = (
        _mix(texels, 0, a, b, c, d, s, t), _mix(texels, 1, a, b, c, d, s, t), _mix(texels, 2, a, b, c, d, s, t)
    )  # fmt: skip
    if between > number(0):
        a, b, c, d, s, t = _texel(levels, level + 1, u, v, number)
        red += between * (_mix(texels, 0, a, b, c, d, s, t) - red)
        green += between * (_mix(texels, 1, a, b, c, d, s, t) - green)
        blue += between * (_mix(texels, 2, a, b, c, d, s, t) - blue)
    return red, green, blue


@_inlined
def _sample_level_backward(texels, levels, level, u, v, gain, g_red, g_green, g_blue, g_texels):
    """Of `gain` times the sum of the three channels, each by its gradient: value, and gradients for u and v."""
    number = texels.dtype.type
    zero, half, one = number(0), number(0.5), number(1)
    rows, columns = number(levels[level, 1]), number(levels[level, 2])
    a, b, c, d, s, t = _texel(levels, level, u, v, number)
    # Beyond the outer texel centres the texture is constant.
    u_scale = columns if u * columns > half and u * columns < columns - half else zero
    v_scale = rows if v * rows > half and v * rows < rows - half else zero
    value, g_u, g_v = zero, zero, zero
    for channel in range(3):
        g = g_red if channel == 0 else (g_green if channel == 1 else g_blue)
        value += g * _mix(texels, channel, a, b, c, d, s, t)
        upper, lower = texels[b, channel] - texels[a, channel], texels[d, channel] - texels[c, channel]
        g_u += g * ((one - t) * upper + t * lower)
        left, right = texels[c, channel] - texels[a, channel], texels[d, channel] - texels[b, channel]
        g_v += g * ((one - s) * left + s * right)
        if g_texels.shape[0] > 0:
            g_texels[a, channel] += gain * g * (one - s) * (one - t)
            g_texels[b, channel] += gain * g * s * (one - t)
            g_texels[c, channel] += gain * g * (one - s) * t
            g_texels[d, channel] += gain * g * s * t
    return value, gain * g_u * u_scale, gain * g_v * v_scale


@_inlined
def _sample_texture_backward(texels, levels, u, v, level_of_detail, g_red, g_green, g_blue, g_texels):
    """Gradients for u, v and the level of detail."""
    number = texels.dtype.type
    level = int(level_of_detail)
    between = level_of_detail - number(level)
    finer, g_u, g_v = _sample_level_backward(
        texels, levels, level, u, v, number(1) - between, g_red, g_green, g_blue, g_texels
    )
    if not between > number(0):
        return g_u, g_v, number(0)
    coarser, more_u, more_v = _sample_level_backward(
        texels, levels, level + 1, u, v, between, g_red, g_green, g_blue, g_texels
    )
    return g_u + more_u, g_v + more_v, coarser - finer


# Light: blocks of samples. `_X + m` is the place of number X of sample m. That distances between these places are
# constants, and larger than a vector register, is what lets the compiler use vector instructions.

LANES = 64
(
    _BI, _BJ, _BK, _PX, _PY, _PZ, _NX, _NY, _NZ, _SHRINK, _RED, _GREEN, _BLUE, _FACTOR, _HIGHLIGHT,
    _LX, _LY, _LZ, _REACH, _VX, _VY, _VZ, _NEAR, _N_L, _N_V, _R_V, _POWER,
    _G_RED, _G_GREEN, _G_BLUE, _G_NX, _G_NY, _G_NZ, _G_PX, _G_PY, _G_PZ,
) = range(0, 36 * LANES, LANES)  # fmt: skip
_BLOCK = 36 * LANES


@_inlined
def _gather(vertices, normals, colors, i, j, k, bi, bj, bk, block, m):
    """What light needs to know of a sample at barycentric coordinates of a face: point, normal and albedo."""
    block[_BI + m] = bi
    block[_BJ + m] = bj
    block[_BK + m] = bk
    block[_PX + m] = bi * vertices[i, 0] + bj * vertices[j, 0] + bk * vertices[k, 0]
    block[_PY + m] = bi * vertices[i, 1] + bj * vertices[j, 1] + bk * vertices[k, 1]
    block[_PZ + m] = bi * vertices[i, 2] + bj * vertices[j, 2] + bk * vertices[k, 2]
    block[_NX + m] = bi * normals[i, 0] + bj * normals[j, 0] + bk * normals[k, 0]
    block[_NY + m] = bi * normals[i, 1] + bj * normals[j, 1] + bk * normals[k, 1]
    block[_NZ + m] = bi * normals[i, 2] + bj * normals[j, 2] + bk * normals[k, 2]
    block[_RED + m] = bi * colors[i, 0] + bj * colors[j, 0] + bk * colors[k, 0]
    block[_GREEN + m] = bi * colors[i, 1] + bj * colors[j, 1] + bk * colors[k, 1]
    block[_BLUE + m] = bi * colors[i, 2] + bj * colors[j, 2] + bk * colors[k, 2]


@_inlined
def _paint(vertices, lens, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, m):
    """Multiplies the albedo of a sample by the texture."""
    bi, bj, bk = block[_BI + m], block[_BJ + m], block[_BK + m]
    ui, uj, uk = _corners(uv_faces, f)
    u = bi * uv[ui, 0] + bj * uv[uj, 0] + bk * uv[uk, 0]
    v = bi * uv[ui, 1] + bj * uv[uj, 1] + bk * uv[uk, 1]
    level_of_detail = _level_of_detail(lens, levels, uv_areas[f], -block[_PZ + m], _volume(vertices, i, j, k))
    red, green, blue = _sample_texture(texels, levels, u, v, level_of_detail)
    block[_RED + m] *= red
    block[_GREEN + m] *= green
    block[_BLUE + m] *= blue


@_inlined
def _light(light, phong, block, count):
    """Phong: the factor of the albedo and the highlight, and on the way all that the backward pass needs."""
    number = block.dtype.type
    zero, one, two = number(0), number(1), number(2)
    x, y, z, ambient, diffuse, specular = light[0], light[1], light[2], phong[0], phong[1], phong[2]
    for m in range(count):
        nx, ny, nz = block[_NX + m], block[_NY + m], block[_NZ + m]
        px, py, pz = block[_PX + m], block[_PY + m], block[_PZ + m]
        squared = nx * nx + ny * ny + nz * nz
        shrink = one / math.sqrt(squared if squared > zero else one)
        shrink = shrink if squared > zero else zero
        nx, ny, nz = nx * shrink, ny * shrink, nz * shrink
        lx, ly, lz = x - px, y - py, z - pz
        reach = one / math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx * reach, ly * reach, lz * reach
        near = one / math.sqrt(px * px + py * py + pz * pz)
        vx, vy, vz = -px * near, -py * near, -pz * near
        n_l = nx * lx + ny * ly + nz * lz
        n_v = nx * vx + ny * vy + nz * vz
        r_v = two * n_l * n_v - (lx * vx + ly * vy + lz * vz)
        lit = n_l > zero
        block[_SHRINK + m] = shrink
        block[_NX + m] = nx
        block[_NY + m] = ny
        block[_NZ + m] = nz
        block[_LX + m] = lx
        block[_LY + m] = ly
        block[_LZ + m] = lz
        block[_REACH + m] = reach
        block[_VX + m] = vx
        block[_VY + m] = vy
        block[_VZ + m] = vz
        block[_NEAR + m] = near
        block[_N_L + m] = n_l if lit else zero
        block[_N_V + m] = n_v
        block[_R_V + m] = r_v if lit and r_v > zero else zero
        block[_FACTOR + m] = ambient + diffuse * (n_l if lit else zero)
    _power(block, count, phong[3])
    for m in range(count):
        block[_HIGHLIGHT + m] = specular * block[_POWER + m] * block[_R_V + m]


@_inlined
def _power(block, count, shininess):
    """(r . v) ** (shininess - 1), 0 where the highlight is not seen; whole exponents by repeated squares."""
    number = block.dtype.type
    zero, one = number(0), number(1)
    whole = int(shininess) - 1
    if number(whole + 1) == shininess and whole >= 0:
        for m in range(count):
            block[_POWER + m] = one
            block[_G_PX + m] = block[_R_V + m]  # the squares
        while whole > 0:
            if whole & 1:
                for m in range(count):
                    block[_POWER + m] *= block[_G_PX + m]
            whole >>= 1
            if whole > 0:
                for m in range(count):
                    block[_G_PX + m] *= block[_G_PX + m]
    else:
        for m in range(count):
            r_v = block[_R_V + m]
            block[_POWER + m] = r_v ** (shininess - one) if r_v > zero else zero


@_inlined
def _light_backward(phong, block, count):
    """Gradients of point, normal (not of unit length) and albedo from those of the colour and of the unit normal.

    Leaves what each sample adds to the gradients of the light in the places of what is not needed any more.
    """
    number = block.dtype.type
    zero, two = number(0), number(2)
    diffuse, specular, shininess = phong[1], phong[2], phong[3]
    for m in range(count):
        g_red, g_green, g_blue = block[_G_RED + m], block[_G_GREEN + m], block[_G_BLUE + m]
        g_highlight = g_red + g_green + g_blue
        g_factor = g_red * block[_RED + m] + g_green * block[_GREEN + m] + g_blue * block[_BLUE + m]
        n_l, n_v, r_v, power = block[_N_L + m], block[_N_V + m], block[_R_V + m], block[_POWER + m]
        factor = block[_FACTOR + m]
        block[_G_RED + m] = g_red * factor
        block[_G_GREEN + m] = g_green * factor
        block[_G_BLUE + m] = g_blue * factor
        block[_FACTOR + m] = g_factor
        block[_N_L + m] = g_factor * n_l
        block[_POWER + m] = g_highlight * power * r_v
        # factor = ambient + diffuse n.l, highlight = specular (r.v) ^ shininess, r.v = 2 n.l n.v - l.v.
        nx, ny, nz = block[_NX + m], block[_NY + m], block[_NZ + m]
        lx, ly, lz = block[_LX + m], block[_LY + m], block[_LZ + m]
        vx, vy, vz = block[_VX + m], block[_VY + m], block[_VZ + m]
        g_r_v = g_highlight * specular * shininess * power if r_v > zero else zero
        g_n_l = diffuse * g_factor + two * n_v * g_r_v if n_l > zero else zero
        g_n_v, g_l_v = two * n_l * g_r_v, -g_r_v
        g_lx, g_ly, g_lz = g_n_l * nx + g_l_v * vx, g_n_l * ny + g_l_v * vy, g_n_l * nz + g_l_v * vz
        g_vx, g_vy, g_vz = g_n_v * nx + g_l_v * lx, g_n_v * ny + g_l_v * ly, g_n_v * nz + g_l_v * lz
        g_nx = block[_G_NX + m] + g_n_l * lx + g_n_v * vx
        g_ny = block[_G_NY + m] + g_n_l * ly + g_n_v * vy
        g_nz = block[_G_NZ + m] + g_n_l * lz + g_n_v * vz
        # Unit vectors: what points along them changes nothing.
        radial, reach = lx * g_lx + ly * g_ly + lz * g_lz, block[_REACH + m]
        g_lx, g_ly, g_lz = (g_lx - lx * radial) * reach, (g_ly - ly * radial) * reach, (g_lz - lz * radial) * reach
        radial, near = vx * g_vx + vy * g_vy + vz * g_vz, block[_NEAR + m]
        g_vx, g_vy, g_vz = (g_vx - vx * radial) * near, (g_vy - vy * radial) * near, (g_vz - vz * radial) * near
        radial, shrink = nx * g_nx + ny * g_ny + nz * g_nz, block[_SHRINK + m]
        block[_G_NX + m] = (g_nx - nx * radial) * shrink
        block[_G_NY + m] = (g_ny - ny * radial) * shrink
        block[_G_NZ + m] = (g_nz - nz * radial) * shrink
        block[_G_PX + m] = -(g_lx + g_vx)
        block[_G_PY + m] = -(g_ly + g_vy)
        block[_G_PZ + m] = -(g_lz + g_vz)
        block[_LX + m] = g_lx
        block[_LY + m] = g_ly
        block[_LZ + m] = g_lz


@_inlined
def _sum_light(block, count, g_light, g_phong):
    """After `_light_backward`."""
    for m in range(count):
        g_light[0] += block[_LX + m]
        g_light[1] += block[_LY + m]
        g_light[2] += block[_LZ + m]
        g_phong[0] += block[_FACTOR + m]
        g_phong[1] += block[_N_L + m]
        g_phong[2] += block[_POWER + m]


@_inlined
def _shininess_backward(block, count, g_phong):
    """Before `_light_backward`, which overwrites the gradient of the colour."""
    zero = block.dtype.type(0)
    for m in range(count):
        r_v = block[_R_V + m]
        if r_v > zero:
            g_highlight = block[_G_RED + m] + block[_G_GREEN + m] + block[_G_BLUE + m]
            g_phong[3] += g_highlight * block[_HIGHLIGHT + m] * math.log(r_v)


# Colour of samples


@_inlined
def _store(block, targets, count, first_attribute, samples):
    one = samples.dtype.type(1)
    for m in range(count):
        sample = np.uintp(targets[m])
        factor, highlight = block[_FACTOR + m], block[_HIGHLIGHT + m]
        samples[sample, 0] = factor * block[_RED + m] + highlight
        samples[sample, 1] = factor * block[_GREEN + m] + highlight
        samples[sample, 2] = factor * block[_BLUE + m] + highlight
        samples[sample, 3] = one
        if first_attribute > 4:
            samples[sample, 4] = block[_NX + m]
            samples[sample, 5] = block[_NY + m]
            samples[sample, 6] = block[_NZ + m]


@_inlined
def _interpolate(attributes, i, j, k, bi, bj, bk, samples, sample):
    """The attributes of a sample, into its last channels."""
    first = samples.shape[1] - attributes.shape[1]
    for a in range(attributes.shape[1]):
        samples[sample, first + a] = bi * attributes[i, a] + bj * attributes[j, a] + bk * attributes[k, a]


@_compiled
def _shade_pixels(mesh, look, vertices, normals, attributes, face_img, first_row, last_row, samples):
    """Linear colour, coverage, camera-space normal where `samples` has room, and attributes of each pixel of rows."""
    faces, uv, uv_faces, uv_areas, levels = mesh.faces, mesh.uv, mesh.uv_faces, mesh.uv_areas, mesh.levels
    lens, light, phong, colors, texels = look.lens, look.light, look.phong, look.colors, look.texels
    background = look.background
    number = vertices.dtype.type
    zero, one = number(0), number(1)
    width, channels = face_img.shape[1], samples.shape[1]
    first_attribute, textured = channels - attributes.shape[1], levels.shape[0] > 0
    block, targets = np.empty(_BLOCK, vertices.dtype), np.empty(LANES, np.int32)
    focal, middle = one / lens[0], lens[1]
    m = 0
    for row in range(first_row, last_row):
        y = (lens[2] - number(row)) * focal
        for column in range(width):
            f = face_img[row, column]
            sample = row * width + column
            if f == BACKGROUND:
                for c in range(3):
                    samples[sample, c] = background[c]
                for c in range(3, channels):
                    samples[sample, c] = zero
                continue
            x = (number(column) - middle) * focal
            i, j, k = _corners(faces, f)
            bi, bj, bk, _ = _barycentrics(vertices, i, j, k, x, y)
            _gather(vertices, normals, colors, i, j, k, bi, bj, bk, block, m)
            if textured:
                _paint(vertices, lens, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, m)
            _interpolate(attributes, i, j, k, bi, bj, bk, samples, sample)
            targets[m] = sample
            m += 1
            if m == LANES:
                _light(light, phong, block, m)
                _store(block, targets, m, first_attribute, samples)
                m = 0
    _light(light, phong, block, m)
    _store(block, targets, m, first_attribute, samples)


@_inlined
def _on_edge(screen, faces, f, p, q, fraction):
    """Barycentric coordinates in face f of the point seen at a fraction of its edge from p to q."""
    zero, one = screen.dtype.type(0), screen.dtype.type(1)
    position = _edge_position(screen, p, q, fraction)
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    bi = one - position if i == p else (position if i == q else zero)
    bj = one - position if j == p else (position if j == q else zero)
    bk = one - position if k == p else (position if k == q else zero)
    return bi, bj, bk


@_compiled
def _shade_crossings(mesh, look, vertices, screen, normals, attributes, places, crossings, count, first, samples):
    """The same for the points where silhouettes cross between pixels; sample `first` is the first of them."""
    faces, uv, uv_faces, uv_areas, levels = mesh.faces, mesh.uv, mesh.uv_faces, mesh.uv_areas, mesh.levels
    lens, light, phong, colors, texels = look.lens, look.light, look.phong, look.colors, look.texels
    channels = samples.shape[1]
    first_attribute, textured = channels - attributes.shape[1], levels.shape[0] > 0
    block, targets = np.empty(_BLOCK, vertices.dtype), np.empty(LANES, np.int32)
    m = 0
    for n in range(count):
        if places[n, 5] >= 0:
            for c in range(channels):
                samples[first + n, c] = samples[places[n, 3], c]
            continue
        f = places[n, 2]
        i, j, k = _corners(faces, f)
        bi, bj, bk = _on_edge(screen, faces, f, places[n, 0], places[n, 1], crossings[n, 1])
        _gather(vertices, normals, colors, i, j, k, bi, bj, bk, block, m)
        if textured:
            _paint(vertices, lens, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, m)
        _interpolate(attributes, i, j, k, bi, bj, bk, samples, first + n)
        targets[m] = first + n
        m += 1
        if m == LANES:
            _light(light, phong, block, m)
            _store(block, targets, m, first_attribute, samples)
            m = 0
    _light(light, phong, block, m)
    _store(block, targets, m, first_attribute, samples)


class Gradients(NamedTuple):
    """What the backward pass adds to, for one frame or some rows of it."""

    vertices: np.ndarray  # (V, 3) camera space
    normals: np.ndarray  # (V, 3)
    screen: np.ndarray  # (V, 3)
    colors: np.ndarray  # (V, 3), empty where it is not asked for
    texels: np.ndarray  # as look.texels, empty where it is not asked for
    attributes: np.ndarray  # (V, A), empty where it is not asked for
    light: np.ndarray  # (3,)
    phong: np.ndarray  # (4,)
    lens: np.ndarray  # (3,)


@_inlined
def _paint_backward(
    vertices, lens, colors, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, m, g_texels, g_vertices, g_lens
):  # fmt: skip
    """Turns the gradient of the albedo into that of the vertex colour; gradients for the barycentric coordinates."""
    number = vertices.dtype.type
    zero = number(0)
    bi, bj, bk = block[_BI + m], block[_BJ + m], block[_BK + m]
    g_red, g_green, g_blue = block[_G_RED + m], block[_G_GREEN + m], block[_G_BLUE + m]
    red = bi * colors[i, 0] + bj * colors[j, 0] + bk * colors[k, 0]
    green = bi * colors[i, 1] + bj * colors[j, 1] + bk * colors[k, 1]
    blue = bi * colors[i, 2] + bj * colors[j, 2] + bk * colors[k, 2]
    ui, uj, uk = _corners(uv_faces, f)
    u = bi * uv[ui, 0] + bj * uv[uj, 0] + bk * uv[uk, 0]
    v = bi * uv[ui, 1] + bj * uv[uj, 1] + bk * uv[uk, 1]
    depth, volume = -block[_PZ + m], _volume(vertices, i, j, k)
    level_of_detail = _level_of_detail(lens, levels, uv_areas[f], depth, volume)
    texel_red, texel_green, texel_blue = _sample_texture(texels, levels, u, v, level_of_detail)
    g_u, g_v, g_level = _sample_texture_backward(
        texels, levels, u, v, level_of_detail, g_red * red, g_green * green, g_blue * blue, g_texels
    )
    block[_G_RED + m] = g_red * texel_red
    block[_G_GREEN + m] = g_green * texel_green
    block[_G_BLUE + m] = g_blue * texel_blue
    if level_of_detail > zero and level_of_detail < number(levels.shape[0] - 1):
        g_level *= number(1.4426950408889634)  # d log2(x) = dx / (x ln 2)
        block[_G_PZ + m] -= number(1.5) * g_level / depth
        _volume_backward(vertices, i, j, k, -number(0.5) * g_level / volume, g_vertices)
        g_lens[0] -= g_level / lens[0]
    return (
        g_u * uv[ui, 0] + g_v * uv[ui, 1], g_u * uv[uj, 0] + g_v * uv[uj, 1], g_u * uv[uk, 0] + g_v * uv[uk, 1]
    )  # fmt: skip


@_inlined
def _scatter(vertices, normals, colors, i, j, k, block, m, g_normals, g_colors):
    """From the gradients of point, normal and albedo to those of normals, colours and barycentric coordinates."""
    bi, bj, bk = block[_BI + m], block[_BJ + m], block[_BK + m]
    g_red, g_green, g_blue = block[_G_RED + m], block[_G_GREEN + m], block[_G_BLUE + m]
    g_nx, g_ny, g_nz = block[_G_NX + m], block[_G_NY + m], block[_G_NZ + m]
    g_px, g_py, g_pz = block[_G_PX + m], block[_G_PY + m], block[_G_PZ + m]
    g_bi = g_red * colors[i, 0] + g_green * colors[i, 1] + g_blue * colors[i, 2]
    g_bj = g_red * colors[j, 0] + g_green * colors[j, 1] + g_blue * colors[j, 2]
    g_bk = g_red * colors[k, 0] + g_green * colors[k, 1] + g_blue * colors[k, 2]
    g_bi += g_nx * normals[i, 0] + g_ny * normals[i, 1] + g_nz * normals[i, 2]
    g_bj += g_nx * normals[j, 0] + g_ny * normals[j, 1] + g_nz * normals[j, 2]
    g_bk += g_nx * normals[k, 0] + g_ny * normals[k, 1] + g_nz * normals[k, 2]
    g_bi += g_px * vertices[i, 0] + g_py * vertices[i, 1] + g_pz * vertices[i, 2]
    g_bj += g_px * vertices[j, 0] + g_py * vertices[j, 1] + g_pz * vertices[j, 2]
    g_bk += g_px * vertices[k, 0] + g_py * vertices[k, 1] + g_pz * vertices[k, 2]
    wants_colors = g_colors.shape[0] > 0
    for v, b in ((i, bi), (j, bj), (k, bk)):
        g_normals[v, 0] += b * g_nx
        g_normals[v, 1] += b * g_ny
        g_normals[v, 2] += b * g_nz
        if wants_colors:
            g_colors[v, 0] += b * g_red
            g_colors[v, 1] += b * g_green
            g_colors[v, 2] += b * g_blue
    return g_bi, g_bj, g_bk


@_inlined
def _interpolate_backward(attributes, i, j, k, bi, bj, bk, g_samples, sample, g_attributes):
    """Gradients for the barycentric coordinates."""
    first = g_samples.shape[1] - attributes.shape[1]
    g_bi, g_bj, g_bk = attributes.dtype.type(0), attributes.dtype.type(0), attributes.dtype.type(0)
    for a in range(attributes.shape[1]):
        g = g_samples[sample, first + a]
        g_bi += g * attributes[i, a]
        g_bj += g * attributes[j, a]
        g_bk += g * attributes[k, a]
        if g_attributes.shape[0] > 0:
            g_attributes[i, a] += g * bi
            g_attributes[j, a] += g * bj
            g_attributes[k, a] += g * bk
    return g_bi, g_bj, g_bk


@_inlined
def _take_gradient(g_samples, sample, has_normals, block, m):
    zero = block.dtype.type(0)
    block[_G_RED + m] = g_samples[sample, 0]
    block[_G_GREEN + m] = g_samples[sample, 1]
    block[_G_BLUE + m] = g_samples[sample, 2]
    block[_G_NX + m] = g_samples[sample, 4] if has_normals else zero
    block[_G_NY + m] = g_samples[sample, 5] if has_normals else zero
    block[_G_NZ + m] = g_samples[sample, 6] if has_normals else zero


@_compiled
def _shade_pixels_backward(
    mesh, look, vertices, normals, attributes, face_img, first_row, last_row, wants_light, g_samples, g_inverse, g
):  # fmt: skip
    faces, uv, uv_faces, uv_areas, levels = mesh.faces, mesh.uv, mesh.uv_faces, mesh.uv_areas, mesh.levels
    lens, light, phong, colors, texels = look.lens, look.light, look.phong, look.colors, look.texels
    g_vertices, g_normals, g_colors, g_texels = g.vertices, g.normals, g.colors, g.texels
    g_attributes, g_light, g_phong, g_lens = g.attributes, g.light, g.phong, g.lens
    number = vertices.dtype.type
    zero, one = number(0), number(1)
    width, channels = face_img.shape[1], g_samples.shape[1]
    has_normals, textured, has_inverse = channels - attributes.shape[1] > 4, levels.shape[0] > 0, g_inverse.shape[0] > 0
    block = np.empty(_BLOCK, vertices.dtype)
    rays, areas, targets = (
        np.empty((LANES, 2), vertices.dtype),
        np.empty(LANES, vertices.dtype),
        np.empty(LANES, np.int32),
    )
    focal, middle = one / lens[0], lens[1]
    g_focal = zero
    m = 0
    for row in range(first_row, last_row):
        y = (lens[2] - number(row)) * focal
        for column in range(width):
            f = face_img[row, column]
            if f != BACKGROUND:
                # The forward pass again: recomputing is cheaper than storing.
                x = (number(column) - middle) * focal
                i, j, k = _corners(faces, f)
                bi, bj, bk, area = _barycentrics(vertices, i, j, k, x, y)
                _gather(vertices, normals, colors, i, j, k, bi, bj, bk, block, m)
                if textured:
                    _paint(vertices, lens, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, m)
                _take_gradient(g_samples, row * width + column, has_normals, block, m)
                rays[m, 0], rays[m, 1], areas[m] = x, y, area
                targets[m] = row * width + column
                m += 1
            if m < LANES and not (row == last_row - 1 and column == width - 1):
                continue
            _light(light, phong, block, m)
            if wants_light:
                _shininess_backward(block, m, g_phong)
            _light_backward(phong, block, m)
            if wants_light:
                _sum_light(block, m, g_light, g_phong)
            for n in range(m):
                sample = targets[n]
                f = face_img[sample // width, sample % width]
                i, j, k = _corners(faces, f)
                bi, bj, bk = block[_BI + n], block[_BJ + n], block[_BK + n]
                g_bi, g_bj, g_bk = _interpolate_backward(
                    attributes, i, j, k, bi, bj, bk, g_samples, sample, g_attributes
                )
                if has_inverse:
                    block[_G_PZ + n] += g_inverse[0, sample // width, sample % width] / block[_PZ + n] ** 2
                if textured:
                    more_i, more_j, more_k = _paint_backward(
                        vertices, lens, colors, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, n, g_texels,
                        g_vertices, g_lens,
                    )  # fmt: skip
                    g_bi, g_bj, g_bk = g_bi + more_i, g_bj + more_j, g_bk + more_k
                more_i, more_j, more_k = _scatter(vertices, normals, colors, i, j, k, block, n, g_normals, g_colors)
                g_bi, g_bj, g_bk = g_bi + more_i, g_bj + more_j, g_bk + more_k
                x, y_ray = rays[n, 0], rays[n, 1]
                g_x, g_y = _barycentrics_backward(
                    vertices, i, j, k, x, y_ray, areas[n], block, n, g_bi, g_bj, g_bk, g_vertices
                )
                g_focal -= g_x * x + g_y * y_ray
            m = 0
    g_lens[0] += g_focal * focal


@_compiled
def _shade_crossings_backward(
    mesh, look, vertices, screen, normals, attributes, places, crossings, count, first, width, wants_light,
    g_samples, g,
):  # fmt: skip
    faces, uv, uv_faces, uv_areas, levels = mesh.faces, mesh.uv, mesh.uv_faces, mesh.uv_areas, mesh.levels
    lens, light, phong, colors, texels = look.lens, look.light, look.phong, look.colors, look.texels
    g_vertices, g_normals, g_colors, g_texels = g.vertices, g.normals, g.colors, g.texels
    g_attributes, g_light, g_phong, g_lens, g_screen = g.attributes, g.light, g.phong, g.lens, g.screen
    has_normals, textured = g_samples.shape[1] - attributes.shape[1] > 4, levels.shape[0] > 0
    block, targets = np.empty(_BLOCK, vertices.dtype), np.empty(LANES, np.int32)
    m = 0
    for n in range(count):
        if places[n, 5] < 0:
            f = places[n, 2]
            i, j, k = _corners(faces, f)
            bi, bj, bk = _on_edge(screen, faces, f, places[n, 0], places[n, 1], crossings[n, 1])
            _gather(vertices, normals, colors, i, j, k, bi, bj, bk, block, m)
            if textured:
                _paint(vertices, lens, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, m)
            _take_gradient(g_samples, first + n, has_normals, block, m)
            targets[m] = n
            m += 1
        if m < LANES and n < count - 1:
            continue
        _light(light, phong, block, m)
        if wants_light:
            _shininess_backward(block, m, g_phong)
        _light_backward(phong, block, m)
        if wants_light:
            _sum_light(block, m, g_light, g_phong)
        for lane in range(m):
            target = targets[lane]
            p, q, f, fraction = places[target, 0], places[target, 1], places[target, 2], crossings[target, 1]
            i, j, k = _corners(faces, f)
            bi, bj, bk = block[_BI + lane], block[_BJ + lane], block[_BK + lane]
            g_bi, g_bj, g_bk = _interpolate_backward(
                attributes, i, j, k, bi, bj, bk, g_samples, first + target, g_attributes
            )
            if textured:
                more_i, more_j, more_k = _paint_backward(
                    vertices, lens, colors, uv, uv_faces, uv_areas, levels, texels, f, i, j, k, block, lane, g_texels,
                    g_vertices, g_lens,
                )  # fmt: skip
                g_bi, g_bj, g_bk = g_bi + more_i, g_bj + more_j, g_bk + more_k
            more_i, more_j, more_k = _scatter(vertices, normals, colors, i, j, k, block, lane, g_normals, g_colors)
            g_bi, g_bj, g_bk = g_bi + more_i, g_bj + more_j, g_bk + more_k
            g_p = g_bi if faces[f, 0] == p else (g_bj if faces[f, 1] == p else g_bk)
            g_q = g_bi if faces[f, 0] == q else (g_bj if faces[f, 1] == q else g_bk)
            for v, b in ((i, bi), (j, bj), (k, bk)):
                g_vertices[v, 0] += b * block[_G_PX + lane]
                g_vertices[v, 1] += b * block[_G_PY + lane]
                g_vertices[v, 2] += b * block[_G_PZ + lane]
            across = 1 if abs(places[target, 4] - places[target, 3]) == 1 and width > 1 else 0
            _edge_position_backward(screen, p, q, across, fraction, g_q - g_p, g_screen)
        m = 0


# Blending across silhouettes


@_compiled
def _blend(places, crossings, count, first, samples, mixed):
    """Each pixel of a pair gets the mean over its half of the way between the two centres."""
    number = samples.dtype.type
    half, eighth = number(0.5), number(0.125)
    channels = samples.shape[1]
    for n in range(count):
        for c in range(channels):
            mixed[n, 0, c] = samples[places[n, 3], c]
            mixed[n, 1, c] = samples[places[n, 4], c]
    for n in range(count):
        t = crossings[n, 0]
        for c in range(channels):
            surface, behind, edge = mixed[n, 0, c], mixed[n, 1, c], samples[first + n, c]
            if t < half:
                samples[places[n, 3], c] += half * t * (surface + edge) + (half - t) * behind - half * surface
            else:
                ramp = (edge - surface) / t
                samples[places[n, 3], c] += eighth * ramp
                samples[places[n, 4], c] += (t - half) * (surface - behind) + (half * t * t - eighth) * ramp


@_compiled
def _blend_backward(
    screen, faces, places, crossings, mixed, count, first, width, samples, g_samples, g_mixed, g_screen
):
    """Gradient of the samples before they were blended, and of the vertices of silhouettes as these move."""
    number = screen.dtype.type
    zero, half, eighth, one = number(0), number(0.5), number(0.125), number(1)
    channels = g_samples.shape[1]
    for n in range(count):
        for c in range(channels):
            g_mixed[n, 0, c] = g_samples[places[n, 3], c]
            g_mixed[n, 1, c] = g_samples[places[n, 4], c]
    for n in range(count):
        p, q, pixel, other = places[n, 0], places[n, 1], places[n, 3], places[n, 4]
        t, fraction = crossings[n, 0], crossings[n, 1]
        g_t = zero
        for c in range(channels):
            surface, behind, edge = mixed[n, 0, c], mixed[n, 1, c], samples[first + n, c]
            g_pixel, g_other = g_mixed[n, 0, c], g_mixed[n, 1, c]
            if t < half:
                g_samples[pixel, c] += half * (t - one) * g_pixel
                g_samples[other, c] += (half - t) * g_pixel
                g_samples[first + n, c] = half * t * g_pixel
                g_t += g_pixel * (half * (surface + edge) - behind)
            else:
                ramp = (edge - surface) / t
                g_ramp = (eighth * g_pixel + (half * t * t - eighth) * g_other) / t
                g_samples[pixel, c] += (t - half) * g_other - g_ramp
                g_samples[other, c] -= (t - half) * g_other
                g_samples[first + n, c] = g_ramp
                g_t += g_other * (surface - behind + t * ramp) - g_ramp * ramp
        along = 0 if abs(other - pixel) == 1 and width > 1 else 1
        across = 1 - along
        if places[n, 5] >= 0:
            for c in range(channels):
                g_samples[pixel, c] += g_samples[first + n, c]
            x, y = number(pixel % width), number(pixel // width)
            x_after, y_after = number(other % width), number(other // width)
            g_before, g_after = (one - t) / fraction * g_t, -t / fraction * g_t
            _inverse_at_backward(screen, faces, p, x, y, g_before, g_screen)
            _inverse_at_backward(screen, faces, q, x, y, -g_before, g_screen)
            _inverse_at_backward(screen, faces, places[n, 5], x_after, y_after, g_after, g_screen)
            _inverse_at_backward(screen, faces, places[n, 2], x_after, y_after, -g_after, g_screen)
            continue
        g_crossing = g_t if pixel < other else -g_t
        slope = (screen[q, along] - screen[p, along]) / (screen[q, across] - screen[p, across])
        g_screen[p, along] += (one - fraction) * g_crossing
        g_screen[q, along] += fraction * g_crossing
        g_screen[p, across] -= (one - fraction) * slope * g_crossing
        g_screen[q, across] -= fraction * slope * g_crossing


# Encoding

# Chebyshev fit of 1.055 s^(5/3) - 0.055 over [0.0031308 ** 0.25, 1]; off by 6e-7 in float32.
_SRGB = (
    -0.0585134138, 0.124537033, 1.45586885, -1.13820809, 1.17733616, -0.865389785, 0.376334839, -0.0719658426,
)  # fmt: skip


@_inlined
def _encode(samples, first_row, last_row, color, mask, extras):
    """Channels-first buffers of some rows, the colour in sRGB and clamped.

    x ** (1 / 2.4) = s ** (5 / 3) with s = x ** (1 / 4), which is nearly a polynomial. Roots and polynomials become
    vector instructions, powers do not.
    """
    number = samples.dtype.type
    zero, one = number(0), number(1)
    width, channels = color.shape[2], samples.shape[1]
    for row in range(first_row, last_row):
        start = row * width
        for column in range(width):
            color[0, row, column] = samples[start + column, 0]
            color[1, row, column] = samples[start + column, 1]
            color[2, row, column] = samples[start + column, 2]
            mask[0, row, column] = min(max(samples[start + column, 3], zero), one)
        for c in range(4, channels):
            for column in range(width):
                extras[c - 4, row, column] = samples[start + column, c]
        for c in range(3):
            for column in range(width):
                x = min(max(color[c, row, column], zero), one)
                s = math.sqrt(math.sqrt(x))
                y = number(_SRGB[7])
                y = y * s + number(_SRGB[6])
                y = y * s + number(_SRGB[5])
                y = y * s + number(_SRGB[4])
                y = y * s + number(_SRGB[3])
                y = y * s + number(_SRGB[2])
                y = y * s + number(_SRGB[1])
                y = y * s + number(_SRGB[0])
                color[c, row, column] = min(y, one) if x > number(0.0031308) else number(12.92) * x


@_inlined
def _encode_backward(samples, first_row, last_row, color, g_color, g_mask, g_extras, g_samples):
    """A gradient of a picture without channels is zero."""
    number = samples.dtype.type
    zero, one = number(0), number(1)
    width, channels = color.shape[2], samples.shape[1]
    has_color, has_mask, has_extras = g_color.shape[0] > 0, g_mask.shape[0] > 0, g_extras.shape[0] > 0
    for row in range(first_row, last_row):
        start = row * width
        for c in range(3):
            for column in range(width):
                x = samples[start + column, c]
                inside = has_color and x > zero and x < one
                linear = x <= number(0.0031308)
                slope = (color[c, row, column] + number(0.055)) / (number(2.4) * (one if linear else x))
                slope = number(12.92) if linear else slope
                g_samples[start + column, c] = slope * g_color[c, row, column] if inside else zero
        for column in range(width):
            x = samples[start + column, 3]
            inside = has_mask and x >= zero and x <= one
            g_samples[start + column, 3] = g_mask[0, row, column] if inside else zero
        for c in range(4, channels):
            for column in range(width):
                g_samples[start + column, c] = g_extras[c - 4, row, column] if has_extras else zero


# Vertices, backward


@_compiled
def _vertex_normals_backward(vertices, faces, normals, g_normals, g_vertices):
    zero, one = vertices.dtype.type(0), vertices.dtype.type(1)
    for v in range(vertices.shape[0]):
        length = normals[v, 3]
        gx, gy, gz = g_normals[v, 0], g_normals[v, 1], g_normals[v, 2]
        inverse = one / length if length > zero else zero
        radial = gx * normals[v, 0] + gy * normals[v, 1] + gz * normals[v, 2]
        g_normals[v, 0] = (gx - normals[v, 0] * radial) * inverse
        g_normals[v, 1] = (gy - normals[v, 1] * radial) * inverse
        g_normals[v, 2] = (gz - normals[v, 2] * radial) * inverse
    for f in range(faces.shape[0]):
        i, j, k = _corners(faces, f)
        gx = g_normals[i, 0] + g_normals[j, 0] + g_normals[k, 0]
        gy = g_normals[i, 1] + g_normals[j, 1] + g_normals[k, 1]
        gz = g_normals[i, 2] + g_normals[j, 2] + g_normals[k, 2]
        if gx == zero and gy == zero and gz == zero:
            continue
        ax, ay, az = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
        bx, by, bz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
        g_ax, g_ay, g_az = by * gz - bz * gy, bz * gx - bx * gz, bx * gy - by * gx
        g_bx, g_by, g_bz = gy * az - gz * ay, gz * ax - gx * az, gx * ay - gy * ax
        g_vertices[i, 0] -= g_ax + g_bx
        g_vertices[i, 1] -= g_ay + g_by
        g_vertices[i, 2] -= g_az + g_bz
        g_vertices[j, 0] += g_ax
        g_vertices[j, 1] += g_ay
        g_vertices[j, 2] += g_az
        g_vertices[k, 0] += g_bx
        g_vertices[k, 1] += g_by
        g_vertices[k, 2] += g_bz


@_compiled
def _project_backward(vertices, lens, screen, g_screen, g_vertices, g_lens):
    focal = lens[0]
    g_focal, g_column, g_row = vertices.dtype.type(0), vertices.dtype.type(0), vertices.dtype.type(0)
    for v in range(vertices.shape[0]):
        inverse = screen[v, 2]
        g_x, g_y = inverse * g_screen[v, 0], -inverse * g_screen[v, 1]
        along = vertices[v, 0] * g_x + vertices[v, 1] * g_y
        g_vertices[v, 0] += focal * g_x
        g_vertices[v, 1] += focal * g_y
        g_vertices[v, 2] += (focal * along + inverse * g_screen[v, 2]) * inverse
        g_focal += along
        g_column += g_screen[v, 0]
        g_row += g_screen[v, 1]
    g_lens[0] += g_focal
    g_lens[1] += g_column
    g_lens[2] += g_row


@_compiled
def _to_camera_backward(world, matrix, g_vertices, g_world, g_matrix):
    if g_matrix.shape[0] > 0:
        for v in range(world.shape[0]):
            for row in range(3):
                for c in range(3):
                    g_matrix[row, c] += g_vertices[v, row] * world[v, c]
                g_matrix[row, 3] += g_vertices[v, row]
    for v in range(world.shape[0]):
        for c in range(3):
            g_world[v, c] = (
                matrix[0, c] * g_vertices[v, 0] + matrix[1, c] * g_vertices[v, 1] + matrix[2, c] * g_vertices[v, 2]
            )


# Frames. Each function does one part of the work for pieces `first` to `last`; `worker` numbers the thread and picks
# its own scratch memory. A piece is a frame, or with `tiles` > 1 one of so many bands of rows of a frame.


@_compiled
def forward_vertices(worker, first, last, world, mesh, look, near, kept):
    for b in range(first, last):
        kept.finite[b] = _to_camera(world[b], look.matrix, kept.vertices[b])
        if not kept.finite[b]:
            continue
        _project(kept.vertices[b], look.lens, near, kept.screen[b])
        _vertex_normals(kept.vertices[b], mesh.faces, kept.normals[b])
        height, width = kept.face_img.shape[1:]
        _classify(kept.screen[b], mesh.faces, height, width, kept.sides[b])


@_compiled
def forward_pixels(worker, first, last, tiles, mesh, look, attributes, kept, candidates):
    height = kept.face_img.shape[1]
    for piece in range(first, last):
        b, tile = piece // tiles, piece % tiles
        if not kept.finite[b]:
            continue
        top, bottom = tile * height // tiles, (tile + 1) * height // tiles
        _rasterize(
            kept.screen[b], mesh.faces, kept.sides[b], candidates[worker], top, bottom, kept.face_img[b],
            kept.inverse_img[b],
        )  # fmt: skip
        _shade_pixels(
            mesh, look, kept.vertices[b], kept.normals[b], attributes[b], kept.face_img[b], top, bottom,
            kept.samples[b],
        )  # fmt: skip


@_compiled
def forward_silhouettes(worker, first, last, mesh, look, attributes, limits, kept):
    pixels = kept.face_img.shape[1] * kept.face_img.shape[2]
    for b in range(first, last):
        if not kept.finite[b]:
            continue
        count = _silhouettes(
            kept.screen[b], mesh, kept.sides[b], kept.face_img[b], kept.inverse_img[b], limits[1], kept.pair_img[b],
            kept.places[b],
            kept.crossings[b],
        )  # fmt: skip
        count = _intersections(
            kept.screen[b], mesh, kept.sides[b], kept.face_img[b], kept.inverse_img[b], limits[2] / look.lens[0],
            kept.pair_img[b], kept.places[b], kept.crossings[b], count,
        )  # fmt: skip
        kept.counts[b] = count
        _shade_crossings(
            mesh, look, kept.vertices[b], kept.screen[b], kept.normals[b], attributes[b], kept.places[b],
            kept.crossings[b], count, pixels, kept.samples[b],
        )  # fmt: skip
        _blend(kept.places[b], kept.crossings[b], count, pixels, kept.samples[b], kept.mixed[b])


@_compiled
def forward_encoding(worker, first, last, tiles, kept, color, mask, extras):
    height = color.shape[2]
    for piece in range(first, last):
        b, tile = piece // tiles, piece % tiles
        if kept.finite[b]:
            top, bottom = tile * height // tiles, (tile + 1) * height // tiles
            _encode(kept.samples[b], top, bottom, color[b], mask[b], extras[b])


@_compiled
def forward(worker, first, last, world, mesh, look, attributes, limits, kept, candidates, color, mask, extras):
    """Whole frames; `limits` is the near plane, and the depth margin and the valley of silhouettes."""
    for b in range(first, last):
        forward_vertices(worker, b, b + 1, world, mesh, look, limits[0], kept)
        forward_pixels(worker, b, b + 1, 1, mesh, look, attributes, kept, candidates)
        forward_silhouettes(worker, b, b + 1, mesh, look, attributes, limits, kept)
        forward_encoding(worker, b, b + 1, 1, kept, color, mask, extras)


class Scratch(NamedTuple):
    """Memory of the backward pass, for each thread."""

    samples: np.ndarray  # (threads, H * W + N, C)
    mixed: np.ndarray  # (threads, N, 2, C)


class Sums(NamedTuple):
    """`Gradients` of every piece."""

    vertices: np.ndarray
    normals: np.ndarray
    screen: np.ndarray
    colors: np.ndarray
    texels: np.ndarray
    attributes: np.ndarray
    light: np.ndarray
    phong: np.ndarray
    lens: np.ndarray


@_inlined
def _gradients(sums, worker, tiles, piece):
    """Whole frames share the scratch memory of their thread; bands of rows have their own."""
    slot = worker if tiles == 1 else piece
    return Gradients(
        sums.vertices[slot], sums.normals[slot], sums.screen[slot], sums.colors[piece], sums.texels[piece],
        sums.attributes[piece], sums.light[piece], sums.phong[piece], sums.lens[piece],
    )  # fmt: skip


@_compiled
def backward_encoding(worker, first, last, tiles, kept, color, g_color, g_mask, g_extras, scratch, sums):
    height = color.shape[2]
    zero = color.dtype.type(0)
    for piece in range(first, last):
        b, tile = piece // tiles, piece % tiles
        g = _gradients(sums, worker, tiles, piece)
        g.vertices[:] = zero
        g.normals[:] = zero
        g.screen[:] = zero
        top, bottom = tile * height // tiles, (tile + 1) * height // tiles
        g_samples = scratch.samples[worker if tiles == 1 else b]
        _encode_backward(kept.samples[b], top, bottom, color[b], g_color[b], g_mask[b], g_extras[b], g_samples)


@_compiled
def backward_silhouettes(worker, first, last, tiles, mesh, look, attributes, wants_light, kept, scratch, sums):
    pixels, width = kept.face_img.shape[1] * kept.face_img.shape[2], kept.face_img.shape[2]
    for b in range(first, last):
        g = _gradients(sums, worker, tiles, b * tiles)
        slot = worker if tiles == 1 else b
        _blend_backward(
            kept.screen[b], mesh.faces, kept.places[b], kept.crossings[b], kept.mixed[b], kept.counts[b], pixels, width,
            kept.samples[b], scratch.samples[slot], scratch.mixed[slot], g.screen,
        )  # fmt: skip
        _shade_crossings_backward(
            mesh, look, kept.vertices[b], kept.screen[b], kept.normals[b], attributes[b], kept.places[b],
            kept.crossings[b], kept.counts[b], pixels, width, wants_light, scratch.samples[slot], g,
        )  # fmt: skip


@_compiled
def backward_pixels(worker, first, last, tiles, mesh, look, attributes, wants_light, kept, g_inverse, scratch, sums):
    height = kept.face_img.shape[1]
    for piece in range(first, last):
        b, tile = piece // tiles, piece % tiles
        top, bottom = tile * height // tiles, (tile + 1) * height // tiles
        _shade_pixels_backward(
            mesh, look, kept.vertices[b], kept.normals[b], attributes[b], kept.face_img[b], top, bottom,
            wants_light, scratch.samples[worker if tiles == 1 else b], g_inverse[b],
            _gradients(sums, worker, tiles, piece),
        )  # fmt: skip


@_compiled
def backward_vertices(worker, first, last, tiles, world, mesh, look, kept, sums, g_world, g_matrix):
    for b in range(first, last):
        g = _gradients(sums, worker, tiles, b * tiles)
        for tile in range(1, tiles):
            more = _gradients(sums, worker, tiles, b * tiles + tile)
            for v in range(world.shape[1]):
                for c in range(3):
                    g.vertices[v, c] += more.vertices[v, c]
                    g.normals[v, c] += more.normals[v, c]
        _vertex_normals_backward(kept.vertices[b], mesh.faces, kept.normals[b], g.normals, g.vertices)
        _project_backward(kept.vertices[b], look.lens, kept.screen[b], g.screen, g.vertices, g.lens)
        _to_camera_backward(world[b], look.matrix, g.vertices, g_world[b], g_matrix[b])


@_compiled
def backward(
    worker, first, last, world, mesh, look, attributes, wants_light, kept, color, g_color, g_mask, g_extras,
    g_inverse, scratch, sums, g_world, g_matrix,
):  # fmt: skip
    """Whole frames; what is not scratch memory starts at 0 in `sums` and `g_matrix`."""
    for b in range(first, last):
        backward_encoding(worker, b, b + 1, 1, kept, color, g_color, g_mask, g_extras, scratch, sums)
        backward_silhouettes(worker, b, b + 1, 1, mesh, look, attributes, wants_light, kept, scratch, sums)
        backward_pixels(worker, b, b + 1, 1, mesh, look, attributes, wants_light, kept, g_inverse, scratch, sums)
        backward_vertices(worker, b, b + 1, 1, world, mesh, look, kept, sums, g_world, g_matrix)


@_compiled
def parts_at_pixels(worker, first, last, vertices, faces, parts, lens, face_img, part_img):
    """Label of the nearest corner (by barycentric coordinate) of the face in each pixel; -1 on the background."""
    focal = vertices.dtype.type(1) / lens[0]
    for b in range(first, last):
        for row in range(face_img.shape[1]):
            y = (lens[2] - vertices.dtype.type(row)) * focal
            for column in range(face_img.shape[2]):
                f = face_img[b, row, column]
                if f == BACKGROUND:
                    part_img[b, 0, row, column] = -1
                    continue
                x = (vertices.dtype.type(column) - lens[1]) * focal
                i, j, k = _corners(faces, f)
                bi, bj, bk, _ = _barycentrics(vertices[b], i, j, k, x, y)
                nearest = i if bi >= bj and bi >= bk else (j if bj >= bk else k)
                part_img[b, 0, row, column] = parts[nearest]
