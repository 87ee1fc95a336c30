"""The stages of the renderer compiled for the CPU: fused over the pixels of a frame, one frame at a time.

`rasterize.py`, `interpolate.py`, `shade.py` and `antialias.py` say the same in plain torch; tests hold both together.
Every function works in place on arrays that the caller allocated, keeps the dtype of its arguments (float32, float64)
and lets go of the interpreter lock, so that threads of one pool each take some frames. A frame belongs to one thread:
sums have one order, and the result does not depend on the number of threads.

Numbers are cast by `dtype.type` because a Python float would silently turn float32 arithmetic into float64.

Space       Axes
camera      right, up, towards the viewer; w = -z is the depth in metres
pixel       column, row, of which the centre of pixel (0, 0) is the origin
"""

from __future__ import annotations

import math

import numba
import numpy as np

BACKGROUND = -1
LEFT_OR_ABOVE, RIGHT_OR_BELOW = 0, 1  # where the silhouette's own surface lies within a pair of pixels

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy")
_inlined = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"nnan", "ninf", "nsz", "arcp", "contract"})


@_compiled
def _project(vertices, lens, near, screen):
    """Column, row and inverse depth of each vertex; inverse depth 0 marks what is not in front of the camera."""
    focal, column, row = lens[0], lens[1], lens[2]
    one = vertices.dtype.type(1)
    for v in range(vertices.shape[0]):
        depth = -vertices[v, 2]
        if depth > near:
            inverse = one / depth
            screen[v, 0] = column + focal * vertices[v, 0] * inverse
            screen[v, 1] = row - focal * vertices[v, 1] * inverse
            screen[v, 2] = inverse
        else:
            screen[v, :] = vertices.dtype.type(0)


@_compiled
def _vertex_normals(vertices, faces, normals):
    """Unit sums of the adjoining faces' area-weighted normals; 0 where a vertex has no area around it."""
    normals[:] = vertices.dtype.type(0)
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
        bx, by, bz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            normals[v, 0] += nx
            normals[v, 1] += ny
            normals[v, 2] += nz
    for v in range(vertices.shape[0]):
        squared = normals[v, 0] * normals[v, 0] + normals[v, 1] * normals[v, 1] + normals[v, 2] * normals[v, 2]
        if squared > vertices.dtype.type(0):
            length = math.sqrt(squared)
            normals[v, 0] /= length
            normals[v, 1] /= length
            normals[v, 2] /= length


@_compiled
def _rasterize(screen, faces, front, face_img, inverse_img):
    """Which front face lies nearest in each pixel, its inverse depth, and which faces are front faces.

    A pixel centre on the edge of two faces goes to exactly one of them: `edge(a, b) == -edge(b, a)` holds to the last
    bit, and of two opposite directions one counts as inside.
    """
    zero, one = screen.dtype.type(0), screen.dtype.type(1)
    height, width = face_img.shape
    right, bottom = screen.dtype.type(width - 1), screen.dtype.type(height - 1)
    face_img[:] = BACKGROUND
    inverse_img[:] = zero
    for f in range(faces.shape[0]):
        # Counter-clockwise seen from outside is clockwise once rows point down: swap two corners.
        i, j, k = faces[f, 0], faces[f, 2], faces[f, 1]
        xi, yi, xj, yj, xk, yk = screen[i, 0], screen[i, 1], screen[j, 0], screen[j, 1], screen[k, 0], screen[k, 1]
        area = (xj - xi) * (yk - yi) - (xk - xi) * (yj - yi)
        zi, zj, zk = screen[i, 2], screen[j, 2], screen[k, 2]
        is_front = area > zero and zi > zero and zj > zero and zk > zero
        front[f] = is_front
        if not is_front:
            continue
        first_x, last_x = max(min(xi, xj, xk), zero), min(max(xi, xj, xk), right)
        first_y, last_y = max(min(yi, yj, yk), zero), min(max(yi, yj, yk), bottom)
        if first_x > last_x or first_y > last_y:
            continue
        for row in range(math.ceil(first_y), math.floor(last_y) + 1):
            y = screen.dtype.type(row)
            for column in range(math.ceil(first_x), math.floor(last_x) + 1):
                x = screen.dtype.type(column)
                ei = (xj - x) * (yk - y) - (xk - x) * (yj - y)
                ej = (xk - x) * (yi - y) - (xi - x) * (yk - y)
                ek = (xi - x) * (yj - y) - (xj - x) * (yi - y)
                if ei < zero or ej < zero or ek < zero:
                    continue
                if ei == zero and not (yk > yj or (yk == yj and xk < xj)):
                    continue
                if ej == zero and not (yi > yk or (yi == yk and xi < xk)):
                    continue
                if ek == zero and not (yj > yi or (yj == yi and xj < xi)):
                    continue
                inverse = (ei * zi + ej * zj + ek * zk) * (one / (ei + ej + ek))
                if inverse > inverse_img[row, column]:
                    inverse_img[row, column] = inverse
                    face_img[row, column] = f


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
def _texel(texture, u, v):
    """The four texels around (u, v), clamped at the border, and how far (u, v) lies between them."""
    half, zero, one = texture.dtype.type(0.5), texture.dtype.type(0), texture.dtype.type(1)
    rows, columns = texture.shape[0], texture.shape[1]
    x = min(max(u * texture.dtype.type(columns) - half, zero), texture.dtype.type(columns) - one)
    y = min(max(v * texture.dtype.type(rows) - half, zero), texture.dtype.type(rows) - one)
    left, top = int(x), int(y)
    right, bottom = min(left + 1, columns - 1), min(top + 1, rows - 1)
    return left, right, top, bottom, x - texture.dtype.type(left), y - texture.dtype.type(top)


@_inlined
def _mix(texture, channel, left, right, top, bottom, s, t):
    one = texture.dtype.type(1)
    upper = (one - s) * texture[top, left, channel] + s * texture[top, right, channel]
    lower = (one - s) * texture[bottom, left, channel] + s * texture[bottom, right, channel]
    return (one - t) * upper + t * lower


@_inlined
def _phong(nx, ny, nz, px, py, pz, light, phong):
    """Factor of the albedo, highlight, and what the backward pass needs: unit light vector l, its length, view v, dots."""
    zero, one, two = light.dtype.type(0), light.dtype.type(1), light.dtype.type(2)
    lx, ly, lz = light[0] - px, light[1] - py, light[2] - pz
    reach = math.sqrt(lx * lx + ly * ly + lz * lz)
    inverse = one / reach
    lx, ly, lz = lx * inverse, ly * inverse, lz * inverse
    inverse = -one / math.sqrt(px * px + py * py + pz * pz)
    vx, vy, vz = px * inverse, py * inverse, pz * inverse
    n_l = nx * lx + ny * ly + nz * lz
    factor, highlight, n_v, r_v = phong[0], zero, zero, zero
    if n_l > zero:
        factor += phong[1] * n_l
        n_v = nx * vx + ny * vy + nz * vz
        r_v = two * n_l * n_v - (lx * vx + ly * vy + lz * vz)
        if r_v > zero and phong[2] > zero:
            highlight = phong[2] * r_v ** phong[3]
    return factor, highlight, lx, ly, lz, reach, vx, vy, vz, n_l, n_v, r_v


@_compiled
def _shade(vertices, faces, colors, uv, uv_faces, texture, light, phong, lens, background, normals, face_img, image):
    """Linear colour, coverage and, where `image` has room, the camera-space normal of each pixel."""
    zero, one = vertices.dtype.type(0), vertices.dtype.type(1)
    height, width, channels = image.shape
    focal = one / lens[0]
    for row in range(height):
        y = (lens[2] - vertices.dtype.type(row)) * focal
        for column in range(width):
            f = face_img[row, column]
            if f == BACKGROUND:
                for c in range(3):
                    image[row, column, c] = background[c]
                for c in range(3, channels):
                    image[row, column, c] = zero
                continue
            x = (vertices.dtype.type(column) - lens[1]) * focal
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            bi, bj, bk, _ = _barycentrics(vertices, i, j, k, x, y)
            nx = bi * normals[i, 0] + bj * normals[j, 0] + bk * normals[k, 0]
            ny = bi * normals[i, 1] + bj * normals[j, 1] + bk * normals[k, 1]
            nz = bi * normals[i, 2] + bj * normals[j, 2] + bk * normals[k, 2]
            squared = nx * nx + ny * ny + nz * nz
            inverse = one / math.sqrt(squared) if squared > zero else zero
            nx, ny, nz = nx * inverse, ny * inverse, nz * inverse
            depth = -(bi * vertices[i, 2] + bj * vertices[j, 2] + bk * vertices[k, 2])
            factor, highlight, _, _, _, _, _, _, _, _, _, _ = _phong(
                nx, ny, nz, depth * x, depth * y, -depth, light, phong
            )
            red = bi * colors[i, 0] + bj * colors[j, 0] + bk * colors[k, 0]
            green = bi * colors[i, 1] + bj * colors[j, 1] + bk * colors[k, 1]
            blue = bi * colors[i, 2] + bj * colors[j, 2] + bk * colors[k, 2]
            if texture.shape[0] > 0:
                ui, uj, uk = uv_faces[f, 0], uv_faces[f, 1], uv_faces[f, 2]
                u = bi * uv[ui, 0] + bj * uv[uj, 0] + bk * uv[uk, 0]
                v = bi * uv[ui, 1] + bj * uv[uj, 1] + bk * uv[uk, 1]
                left, right, top, bottom, s, t = _texel(texture, u, v)
                red *= _mix(texture, 0, left, right, top, bottom, s, t)
                green *= _mix(texture, 1, left, right, top, bottom, s, t)
                blue *= _mix(texture, 2, left, right, top, bottom, s, t)
            image[row, column, 0] = factor * red + highlight
            image[row, column, 1] = factor * green + highlight
            image[row, column, 2] = factor * blue + highlight
            image[row, column, 3] = one
            if channels > 4:
                image[row, column, 4] = nx
                image[row, column, 5] = ny
                image[row, column, 6] = nz


@_compiled
def _silhouettes(screen, faces, edges, front, inverse_img, margin, pair_img, crossing_img):
    """For each pair of neighbouring pixels the silhouette edge that separates them.

    Pair [0, r, c] is (r, c), (r, c + 1); pair [1, r, c] is (r, c), (r + 1, c). `pair_img` gets twice the edge plus the
    side of the surface that ends there, -1 where there is none; `crossing_img` where between the two centres it ends.
    """
    half = screen.dtype.type(0.5)
    zero, one = screen.dtype.type(0), screen.dtype.type(1)
    height, width = inverse_img.shape
    pair_img[:] = -1
    for e in range(edges.shape[0]):
        f, g = edges[e, 2], edges[e, 3]
        f_front = front[f] != 0
        g_front = g >= 0 and front[g] != 0
        if f_front == g_front:
            continue
        if g_front:
            f = g
        p, q = edges[e, 0], edges[e, 1]
        o = faces[f, 0] + faces[f, 1] + faces[f, 2] - p - q
        along = 0 if abs(screen[q, 1] - screen[p, 1]) > abs(screen[q, 0] - screen[p, 0]) else 1
        across = 1 - along
        # A steep edge (along == 0) is met by every pixel row, a shallow one by every column. Below, "s" runs over the
        # rows (columns) and "t" is the column (row) of the crossing.
        if screen[p, across] > screen[q, across]:
            p, q = q, p
        s0, s1, t0, t1 = screen[p, across], screen[q, across], screen[p, along], screen[q, along]
        slope = (t1 - t0) / (s1 - s0)
        surface_before = screen[o, along] < t0 + slope * (screen[o, across] - s0)
        last_s, last_t = (height - 1, width - 1) if along == 0 else (width - 1, height - 1)
        if s1 < zero or s0 > screen.dtype.type(last_s) or not s1 > s0:
            continue
        first = math.ceil(max(s0, zero))
        last = math.ceil(min(s1, screen.dtype.type(last_s + 1)))  # not included: the next edge of the outline takes it
        for step in range(first, last):
            fraction = (screen.dtype.type(step) - s0) / (s1 - s0)
            t = t0 + fraction * (t1 - t0)
            if not (t >= zero and t < screen.dtype.type(last_t)):
                continue
            cell = int(t)
            inverse_edge = screen[p, 2] + fraction * (screen[q, 2] - screen[p, 2])
            row, column = (step, cell) if along == 0 else (cell, step)
            before = inverse_img[row, column]
            after = inverse_img[row, column + 1] if along == 0 else inverse_img[row + 1, column]
            surface, behind = (before, after) if surface_before else (after, before)
            if behind > inverse_edge * (one - margin) or surface < half * (inverse_edge + behind):
                continue
            crossing = t - screen.dtype.type(cell)
            side = LEFT_OR_ABOVE if surface_before else RIGHT_OR_BELOW
            known = pair_img[along, row, column]
            if known >= 0:
                if known % 2 != side:
                    continue
                outermost = crossing_img[along, row, column]
                if (crossing <= outermost) if surface_before else (crossing >= outermost):
                    continue
            pair_img[along, row, column] = 2 * e + side
            crossing_img[along, row, column] = crossing


@_compiled
def _blend(image, pair_img, crossing_img, blended):
    """Each pixel of a pair keeps the share that its half of the way between the centres leaves to it."""
    half = image.dtype.type(0.5)
    height, width, channels = image.shape
    blended[:] = image
    for along in range(2):
        for row in range(height):
            for column in range(width):
                if pair_img[along, row, column] < 0:
                    continue
                row_after, column_after = (row, column + 1) if along == 0 else (row + 1, column)
                excess = crossing_img[along, row, column] - half  # > 0: what is before reaches into the pixel after
                for c in range(channels):
                    change = excess * (image[row, column, c] - image[row_after, column_after, c])
                    if excess > image.dtype.type(0):
                        blended[row_after, column_after, c] += change
                    else:
                        blended[row, column, c] += change


# Chebyshev fit of 1.055 s^(5/3) - 0.055 over [0.0031308 ** 0.25, 1]; off by 6e-7 in float32.
_SRGB = (
    -0.0585134138, 0.124537033, 1.45586885, -1.13820809, 1.17733616, -0.865389785, 0.376334839, -0.0719658426,
)  # fmt: skip


@_compiled
def _encode(blended, color, mask, normals):
    """Channels-first buffers, the colour in sRGB and clamped.

    x ** (1 / 2.4) = s ** (5 / 3) with s = x ** (1 / 4), which is nearly a polynomial. Roots and polynomials are vector
    instructions, powers are not: 0.1 instead of 1 ms for 128 x 128 pixels.
    """
    number = blended.dtype.type
    zero, one = number(0), number(1)
    height, width, channels = blended.shape
    for row in range(height):
        for c in range(3):
            for column in range(width):
                x = min(max(blended[row, column, c], zero), one)
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
        for column in range(width):
            mask[0, row, column] = min(max(blended[row, column, 3], zero), one)
        for c in range(4, channels):
            for column in range(width):
                normals[c - 4, row, column] = blended[row, column, c]


@_compiled
def forward(
    first, last, vertices, faces, edges, colors, uv, uv_faces, texture, light, phong, lens, limits, background,
    screen, vertex_normals, front, face_img, inverse_img, image, pair_img, crossing_img, blended, color, mask, normals,
):  # fmt: skip
    """Render frames `first` to `last`; `limits` is the near plane and the relative depth margin of silhouettes."""
    for b in range(first, last):
        _project(vertices[b], lens, limits[0], screen[b])
        _vertex_normals(vertices[b], faces, vertex_normals[b])
        _rasterize(screen[b], faces, front[b], face_img[b], inverse_img[b])
        _shade(
            vertices[b], faces, colors, uv, uv_faces, texture, light, phong, lens, background, vertex_normals[b],
            face_img[b], image[b],
        )  # fmt: skip
        _silhouettes(screen[b], faces, edges, front[b], inverse_img[b], limits[1], pair_img[b], crossing_img[b])
        _blend(image[b], pair_img[b], crossing_img[b], blended[b])
        _encode(blended[b], color[b], mask[b], normals[b])
