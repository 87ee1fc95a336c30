"""The stages of the renderer compiled for the CPU: fused over the pixels of a frame, one frame at a time.

`rasterize.py`, `interpolate.py`, `shade.py` and `antialias.py` say the same in plain torch; tests hold both together.
Every function works in place on arrays that the caller allocated, keeps the dtype of its arguments (float32, float64)
and lets go of the interpreter lock, so that threads of one pool each take some frames. A frame belongs to one thread:
sums have one order, and the result does not depend on the number of threads.

Numbers are cast by `dtype.type` because a Python float would silently turn float32 arithmetic into float64.

Space       Axes
world       of the rig, metres
camera      right, up, towards the viewer; w = -z is the depth in metres
pixel       column, row, of which the centre of pixel (0, 0) is the origin
"""

from __future__ import annotations

import inspect
import math

import numba
import numpy as np

BACKGROUND = -1
LEFT_OR_ABOVE, RIGHT_OR_BELOW = 0, 1  # where the silhouette's own surface lies within a pair of pixels

_APPROXIMATE = {"nnan", "ninf", "nsz", "arcp", "contract"}


def _compiled(function):
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


def _inlined(function):
    """For arithmetic that may be reordered; not where two faces must agree to the last bit."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=_APPROXIMATE)(inspect.unwrap(function))


@_inlined
def _corners(faces, f):
    """The vertices of a face, as the index type that needs no test for a negative number."""
    return np.uintp(faces[f, 0]), np.uintp(faces[f, 1]), np.uintp(faces[f, 2])


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
    """Unit sums of the adjoining faces' area-weighted normals, 0 where there is no area, and the length of the sums."""
    normals[:] = vertices.dtype.type(0)
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
        if squared > vertices.dtype.type(0):
            length = math.sqrt(squared)
            inverse = vertices.dtype.type(1) / length
            normals[v, 0] *= inverse
            normals[v, 1] *= inverse
            normals[v, 2] *= inverse
            normals[v, 3] = length


@_inlined
def _ceil(x):
    """The first whole number from x >= 0 on; `math.ceil` would be a call into the C library."""
    whole = int(x)
    return whole + int(whole < x)


@_compiled
def _rasterize(screen, faces, candidates, front, face_img, inverse_img):
    """Which front face lies nearest in each pixel, its inverse depth, and which faces are front faces.

    A pixel centre on the edge of two faces goes to exactly one of them: `edge(a, b) == -edge(b, a)` holds to the last
    bit, and of two opposite directions one counts as inside.
    """
    zero, one = screen.dtype.type(0), screen.dtype.type(1)
    height, width = face_img.shape
    right, bottom = screen.dtype.type(width - 1), screen.dtype.type(height - 1)
    face_img[:] = BACKGROUND
    inverse_img[:] = zero
    # First without branches, which would be mispredicted once a face: which faces look this way and have a pixel centre
    # between their outermost columns and rows? On a face rig these are few.
    count = 0
    for f in range(faces.shape[0]):
        # Counter-clockwise seen from outside is clockwise once rows point down: swap two corners.
        i, k, j = _corners(faces, f)
        xi, yi, xj, yj, xk, yk = screen[i, 0], screen[i, 1], screen[j, 0], screen[j, 1], screen[k, 0], screen[k, 1]
        area = (xj - xi) * (yk - yi) - (xk - xi) * (yj - yi)
        is_front = (area > zero) & (min(screen[i, 2], screen[j, 2], screen[k, 2]) > zero)
        last_x, last_y = min(max(xi, xj, xk), right), min(max(yi, yj, yk), bottom)
        columns = int(last_x) - _ceil(max(min(xi, xj, xk), zero))
        rows = int(last_y) - _ceil(max(min(yi, yj, yk), zero))
        front[f] = is_front
        candidates[count] = f
        count += is_front & (last_x >= zero) & (last_y >= zero) & (columns >= 0) & (rows >= 0)
    for candidate in range(count):
        f = candidates[candidate]
        i, k, j = _corners(faces, f)
        xi, yi, xj, yj, xk, yk = screen[i, 0], screen[i, 1], screen[j, 0], screen[j, 1], screen[k, 0], screen[k, 1]
        zi, zj, zk = screen[i, 2], screen[j, 2], screen[k, 2]
        first_x, last_x = max(min(xi, xj, xk), zero), min(max(xi, xj, xk), right)
        first_y, last_y = max(min(yi, yj, yk), zero), min(max(yi, yj, yk), bottom)
        for row in range(_ceil(first_y), int(last_y) + 1):
            y = screen.dtype.type(row)
            for column in range(_ceil(first_x), int(last_x) + 1):
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
    """Factor of the albedo, highlight; then for the backward pass light vector l, its length, view vector v, dots."""
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
def _shade(
    vertices, faces, colors, uv, uv_faces, texture, attributes, light, phong, lens, background, normals, face_img,
    image,
):  # fmt: skip
    """Linear colour, coverage, where `image` has room the camera-space normal, and the attributes of each pixel."""
    zero, one = vertices.dtype.type(0), vertices.dtype.type(1)
    height, width, channels = image.shape
    first_attribute = channels - attributes.shape[1]
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
            i, j, k = _corners(faces, f)
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
                ui, uj, uk = _corners(uv_faces, f)
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
            if first_attribute > 4:
                image[row, column, 4] = nx
                image[row, column, 5] = ny
                image[row, column, 6] = nz
            for a in range(attributes.shape[1]):
                image[row, column, first_attribute + a] = (
                    bi * attributes[i, a] + bj * attributes[j, a] + bk * attributes[k, a]
                )


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
        first = _ceil(max(s0, zero))
        last = _ceil(min(s1, screen.dtype.type(last_s + 1)))  # not included: the next edge of the outline takes it
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


@_inlined
def _encode(blended, color, mask, extras):
    """Channels-first buffers, the colour in sRGB and clamped.

    x ** (1 / 2.4) = s ** (5 / 3) with s = x ** (1 / 4), which is nearly a polynomial. Roots and polynomials become
    vector instructions, powers do not.
    """
    number = blended.dtype.type
    zero, one = number(0), number(1)
    height, width, channels = blended.shape
    for row in range(height):
        for column in range(width):
            color[0, row, column] = blended[row, column, 0]
            color[1, row, column] = blended[row, column, 1]
            color[2, row, column] = blended[row, column, 2]
            mask[0, row, column] = min(max(blended[row, column, 3], zero), one)
        for c in range(4, channels):
            for column in range(width):
                extras[c - 4, row, column] = blended[row, column, c]
    for c in range(3):
        for row in range(height):
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


@_compiled
def forward(
    worker, first, last, world, matrix, faces, edges, colors, uv, uv_faces, texture, attributes, light, phong, lens,
    limits, background, finite, vertices, screen, vertex_normals, front, face_img, inverse_img, image, pair_img,
    crossing_img, blended, color, mask, extras, scratch_faces,
):  # fmt: skip
    """Render frames `first` to `last`; `limits` is the near plane and the relative depth margin of silhouettes.

    `worker` numbers the thread, and picks its own entry of `scratch_...`.
    """
    for b in range(first, last):
        finite[b] = _to_camera(world[b], matrix, vertices[b])
        if not finite[b]:
            continue
        _project(vertices[b], lens, limits[0], screen[b])
        _vertex_normals(vertices[b], faces, vertex_normals[b])
        _rasterize(screen[b], faces, scratch_faces[worker], front[b], face_img[b], inverse_img[b])
        _shade(
            vertices[b], faces, colors, uv, uv_faces, texture, attributes[b], light, phong, lens, background,
            vertex_normals[b], face_img[b], image[b],
        )  # fmt: skip
        _silhouettes(screen[b], faces, edges, front[b], inverse_img[b], limits[1], pair_img[b], crossing_img[b])
        _blend(image[b], pair_img[b], crossing_img[b], blended[b])
        _encode(blended[b], color[b], mask[b], extras[b])


@_compiled
def _encode_backward(blended, color, g_color, g_mask, g_extras, g_blended):
    number = blended.dtype.type
    zero, one = number(0), number(1)
    height, width, channels = blended.shape
    for row in range(height):
        for column in range(width):
            for c in range(3):
                x = blended[row, column, c]
                slope = number(12.92)
                if x > number(0.0031308):
                    slope = (color[c, row, column] + number(0.055)) / (number(2.4) * x)
                inside = g_color.shape[0] > 0 and x > zero and x < one
                g_blended[row, column, c] = slope * g_color[c, row, column] if inside else zero
            x = blended[row, column, 3]
            inside = g_mask.shape[0] > 0 and x >= zero and x <= one
            g_blended[row, column, 3] = g_mask[0, row, column] if inside else zero
            for c in range(4, channels):
                g_blended[row, column, c] = g_extras[c - 4, row, column] if g_extras.shape[0] > 0 else zero


@_compiled
def _blend_backward(image, edges, screen, pair_img, crossing_img, g_blended, g_image, g_screen):
    """Gradient of the unblended picture, and of the vertices of silhouettes as these move over the picture."""
    number = image.dtype.type
    half, zero, one = number(0.5), number(0), number(1)
    height, width, channels = image.shape
    g_image[:] = g_blended
    g_screen[:] = zero
    for along in range(2):
        across = 1 - along
        for row in range(height):
            for column in range(width):
                pair = pair_img[along, row, column]
                if pair < 0:
                    continue
                row_after, column_after = (row, column + 1) if along == 0 else (row + 1, column)
                excess = crossing_img[along, row, column] - half
                row_mixed, column_mixed = (row_after, column_after) if excess > zero else (row, column)
                g_crossing = zero
                for c in range(channels):
                    g = g_blended[row_mixed, column_mixed, c]
                    g_image[row, column, c] += excess * g
                    g_image[row_after, column_after, c] -= excess * g
                    g_crossing += g * (image[row, column, c] - image[row_after, column_after, c])
                p, q = edges[pair // 2, 0], edges[pair // 2, 1]
                span = screen[q, across] - screen[p, across]
                step = number(row if along == 0 else column)
                fraction = (step - screen[p, across]) / span
                slope = (screen[q, along] - screen[p, along]) / span
                g_screen[p, along] += (one - fraction) * g_crossing
                g_screen[q, along] += fraction * g_crossing
                g_screen[p, across] -= (one - fraction) * slope * g_crossing
                g_screen[q, across] -= fraction * slope * g_crossing


@_compiled
def _shade_backward(
    vertices, faces, colors, uv, uv_faces, texture, attributes, light, phong, lens, normals, face_img, g_image,
    g_inverse, g_vertices, g_colors, g_texture, g_attributes, g_light, g_normals,
):  # fmt: skip
    """Gradient through colour, normal, attributes and depth of each pixel to its face's vertices, and to the light."""
    number = vertices.dtype.type
    zero, one, two = number(0), number(1), number(2)
    height, width, channels = g_image.shape
    first_attribute = channels - attributes.shape[1]
    focal = one / lens[0]
    textured = texture.shape[0] > 0
    g_albedo = np.zeros(3, vertices.dtype)
    base = np.zeros(3, vertices.dtype)
    for row in range(height):
        y = (lens[2] - number(row)) * focal
        for column in range(width):
            f = face_img[row, column]
            if f == BACKGROUND:
                continue
            x = (number(column) - lens[1]) * focal
            i, j, k = _corners(faces, f)
            # The forward pass again: recomputing is cheaper than storing.
            bi, bj, bk, area = _barycentrics(vertices, i, j, k, x, y)
            nx = bi * normals[i, 0] + bj * normals[j, 0] + bk * normals[k, 0]
            ny = bi * normals[i, 1] + bj * normals[j, 1] + bk * normals[k, 1]
            nz = bi * normals[i, 2] + bj * normals[j, 2] + bk * normals[k, 2]
            squared = nx * nx + ny * ny + nz * nz
            shrink = one / math.sqrt(squared) if squared > zero else zero
            nx, ny, nz = nx * shrink, ny * shrink, nz * shrink
            wi, wj, wk = -vertices[i, 2], -vertices[j, 2], -vertices[k, 2]
            depth = bi * wi + bj * wj + bk * wk
            factor, _, lx, ly, lz, reach, vx, vy, vz, n_l, n_v, r_v = _phong(
                nx, ny, nz, depth * x, depth * y, -depth, light, phong
            )

            # Colour = factor * albedo + highlight; albedo = vertex colour * texel.
            g_factor, g_highlight, g_u, g_v = zero, zero, zero, zero
            for c in range(3):
                g = g_image[row, column, c]
                base[c] = bi * colors[i, c] + bj * colors[j, c] + bk * colors[k, c]
                g_albedo[c] = g * factor
                g_factor += g * base[c]
                g_highlight += g
            if textured:
                ui, uj, uk = _corners(uv_faces, f)
                u = bi * uv[ui, 0] + bj * uv[uj, 0] + bk * uv[uk, 0]
                v = bi * uv[ui, 1] + bj * uv[uj, 1] + bk * uv[uk, 1]
                left, right, top, bottom, s, t = _texel(texture, u, v)
                columns, rows = number(texture.shape[1]), number(texture.shape[0])
                # Beyond the outer texel centres the texture is constant.
                u_scale = columns if u * columns > number(0.5) and u * columns < columns - number(0.5) else zero
                v_scale = rows if v * rows > number(0.5) and v * rows < rows - number(0.5) else zero
                g_factor = zero
                for c in range(3):
                    texel = _mix(texture, c, left, right, top, bottom, s, t)
                    g_factor += g_image[row, column, c] * base[c] * texel
                    g_texel = g_albedo[c] * base[c]
                    g_albedo[c] *= texel
                    upper = texture[top, right, c] - texture[top, left, c]
                    lower = texture[bottom, right, c] - texture[bottom, left, c]
                    g_u += g_texel * ((one - t) * upper + t * lower) * u_scale
                    before = (one - s) * texture[top, left, c] + s * texture[top, right, c]
                    after = (one - s) * texture[bottom, left, c] + s * texture[bottom, right, c]
                    g_v += g_texel * (after - before) * v_scale
                    if g_texture.shape[0] > 0:
                        g_texture[top, left, c] += g_texel * (one - s) * (one - t)
                        g_texture[top, right, c] += g_texel * s * (one - t)
                        g_texture[bottom, left, c] += g_texel * (one - s) * t
                        g_texture[bottom, right, c] += g_texel * s * t
            g_bi, g_bj, g_bk = zero, zero, zero
            for c in range(3):
                g_bi += g_albedo[c] * colors[i, c]
                g_bj += g_albedo[c] * colors[j, c]
                g_bk += g_albedo[c] * colors[k, c]
                if g_colors.shape[0] > 0:
                    g_colors[i, c] += g_albedo[c] * bi
                    g_colors[j, c] += g_albedo[c] * bj
                    g_colors[k, c] += g_albedo[c] * bk
            if textured:
                g_bi += g_u * uv[ui, 0] + g_v * uv[ui, 1]
                g_bj += g_u * uv[uj, 0] + g_v * uv[uj, 1]
                g_bk += g_u * uv[uk, 0] + g_v * uv[uk, 1]

            for a in range(attributes.shape[1]):
                g = g_image[row, column, first_attribute + a]
                g_bi += g * attributes[i, a]
                g_bj += g * attributes[j, a]
                g_bk += g * attributes[k, a]
                if g_attributes.shape[0] > 0:
                    g_attributes[i, a] += g * bi
                    g_attributes[j, a] += g * bj
                    g_attributes[k, a] += g * bk

            # Phong: factor = ambient + diffuse n.l, highlight = specular (r.v) ^ shininess, r.v = 2 n.l n.v - l.v.
            g_nx, g_ny, g_nz, g_w = zero, zero, zero, zero
            if g_inverse.shape[0] > 0:
                g_w = -g_inverse[0, row, column] / (depth * depth)
            if n_l > zero:
                g_n_l, g_n_v, g_l_v = phong[1] * g_factor, zero, zero
                if r_v > zero and phong[2] > zero:
                    g_r_v = g_highlight * phong[2] * phong[3] * r_v ** (phong[3] - one)
                    g_n_l += two * n_v * g_r_v
                    g_n_v, g_l_v = two * n_l * g_r_v, -g_r_v
                g_nx, g_ny, g_nz = g_n_l * lx + g_n_v * vx, g_n_l * ly + g_n_v * vy, g_n_l * lz + g_n_v * vz
                g_lx, g_ly, g_lz = g_n_l * nx + g_l_v * vx, g_n_l * ny + g_l_v * vy, g_n_l * nz + g_l_v * vz
                radial = lx * g_lx + ly * g_ly + lz * g_lz
                shorten = one / reach
                g_lx = (g_lx - lx * radial) * shorten
                g_ly = (g_ly - ly * radial) * shorten
                g_lz = (g_lz - lz * radial) * shorten
                g_light[0] += g_lx
                g_light[1] += g_ly
                g_light[2] += g_lz
                # The point moves along its ray only, so the view vector does not turn.
                g_w -= x * g_lx + y * g_ly - g_lz
            if first_attribute > 4:
                g_nx += g_image[row, column, 4]
                g_ny += g_image[row, column, 5]
                g_nz += g_image[row, column, 6]
            radial = nx * g_nx + ny * g_ny + nz * g_nz
            g_nx, g_ny, g_nz = (
                (g_nx - nx * radial) * shrink,
                (g_ny - ny * radial) * shrink,
                (g_nz - nz * radial) * shrink,
            )
            g_bi += g_nx * normals[i, 0] + g_ny * normals[i, 1] + g_nz * normals[i, 2] + g_w * wi
            g_bj += g_nx * normals[j, 0] + g_ny * normals[j, 1] + g_nz * normals[j, 2] + g_w * wj
            g_bk += g_nx * normals[k, 0] + g_ny * normals[k, 1] + g_nz * normals[k, 2] + g_w * wk
            for v, b in ((i, bi), (j, bj), (k, bk)):
                g_normals[v, 0] += g_nx * b
                g_normals[v, 1] += g_ny * b
                g_normals[v, 2] += g_nz * b

            # Barycentric coordinates: areas of the sheared face over their sum.
            mean = bi * g_bi + bj * g_bj + bk * g_bk
            inverse = one / area
            g_ei, g_ej, g_ek = (g_bi - mean) * inverse, (g_bj - mean) * inverse, (g_bk - mean) * inverse
            xi, yi = vertices[i, 0] - x * wi, vertices[i, 1] - y * wi
            xj, yj = vertices[j, 0] - x * wj, vertices[j, 1] - y * wj
            xk, yk = vertices[k, 0] - x * wk, vertices[k, 1] - y * wk
            g_xi, g_yi = yj * g_ek - yk * g_ej, xk * g_ej - xj * g_ek
            g_xj, g_yj = yk * g_ei - yi * g_ek, xi * g_ek - xk * g_ei
            g_xk, g_yk = yi * g_ej - yj * g_ei, xj * g_ei - xi * g_ej
            g_vertices[i, 0] += g_xi
            g_vertices[i, 1] += g_yi
            g_vertices[i, 2] += x * g_xi + y * g_yi - g_w * bi
            g_vertices[j, 0] += g_xj
            g_vertices[j, 1] += g_yj
            g_vertices[j, 2] += x * g_xj + y * g_yj - g_w * bj
            g_vertices[k, 0] += g_xk
            g_vertices[k, 1] += g_yk
            g_vertices[k, 2] += x * g_xk + y * g_yk - g_w * bk


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
def _project_backward(vertices, lens, screen, g_screen, g_vertices):
    for v in range(vertices.shape[0]):
        scale = lens[0] * screen[v, 2]
        g_x, g_y = scale * g_screen[v, 0], -scale * g_screen[v, 1]
        g_vertices[v, 0] += g_x
        g_vertices[v, 1] += g_y
        g_vertices[v, 2] += (vertices[v, 0] * g_x + vertices[v, 1] * g_y) * screen[v, 2]


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


@_compiled
def backward(
    worker, first, last, world, matrix, faces, edges, colors, uv, uv_faces, texture, attributes, light, phong, lens,
    vertices, screen, vertex_normals, face_img, image, pair_img, crossing_img, blended, color,
    g_color, g_mask, g_extras, g_inverse, g_world, g_matrix, g_colors, g_texture, g_attributes, g_light,
    scratch_blended, scratch_image, scratch_screen, scratch_vertex_normals, scratch_vertices,
):  # fmt: skip
    """Gradients of frames `first` to `last`; all but `g_world` start at 0, and `scratch_...` has one entry a thread.

    A gradient of a picture without channels is zero.
    """
    g_blended, g_image, g_screen = scratch_blended[worker], scratch_image[worker], scratch_screen[worker]
    g_vertex_normals, g_vertices = scratch_vertex_normals[worker], scratch_vertices[worker]
    for b in range(first, last):
        _encode_backward(blended[b], color[b], g_color[b], g_mask[b], g_extras[b], g_blended)
        _blend_backward(image[b], edges, screen[b], pair_img[b], crossing_img[b], g_blended, g_image, g_screen)
        g_vertices[:] = vertices.dtype.type(0)
        g_vertex_normals[:] = vertices.dtype.type(0)
        _shade_backward(
            vertices[b], faces, colors, uv, uv_faces, texture, attributes[b], light, phong, lens, vertex_normals[b],
            face_img[b], g_image, g_inverse[b], g_vertices, g_colors[b], g_texture[b], g_attributes[b], g_light[b],
            g_vertex_normals,
        )  # fmt: skip
        _vertex_normals_backward(vertices[b], faces, vertex_normals[b], g_vertex_normals, g_vertices)
        _project_backward(vertices[b], lens, screen[b], g_screen, g_vertices)
        _to_camera_backward(world[b], matrix, g_vertices, g_world[b], g_matrix[b])


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
