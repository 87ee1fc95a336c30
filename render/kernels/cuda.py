"""The stages of the renderer as Warp kernels for CUDA, in float32, and the torch function around them.

`cpu.py` says the same for the CPU, one frame after another; tests hold both together, because these kernels run on
Warp's CPU device too. Here one thread takes a vertex, a face, a pixel or a pair of neighbouring pixels of one frame.

What many threads decide together is the largest of keys: what counts first (inverse depth, or distance) in the upper
half, then the first face or edge in their order. So a picture does not depend on the order of the threads; gradients,
which many threads add to one number, repeat to rounding only.

The backward pass is written by hand: Warp's own is silently zero in places, such as for a sum in a loop that is
normalised in the same kernel (1.19).

Pair n of a frame lies between pixel n and the next in its row, or if n >= H * W between pixel n - H * W and the next in
its column. A sample is a point of the surface that gets a colour: the H * W pixel centres, then one for each pair.
"""

# Warp needs annotations that are no types, so the checks of our test run leave kernels alone: `no_type_check`.

import sys
from contextlib import contextmanager
from functools import cache, partial
from threading import Timer
from typing import NamedTuple, no_type_check

import torch
import warp as wp
from torch import Tensor

from render.antialias import DEPTH_MARGIN, VALLEY, WALK
from render.kernels import function
from render.rasterize import NEAR

# Two faces must agree to the last bit on their edge, so products and sums are not fused.
wp.set_module_options({"enable_backward": False, "fuse_fp": False})

_NEAR, _MARGIN, _VALLEY = wp.constant(NEAR), wp.constant(DEPTH_MARGIN), wp.constant(VALLEY)
_WALK = wp.constant(WALK)
_LAST = wp.constant(wp.int32(2**31 - 1))
_FARTHEST = wp.constant(2.0)  # more than any distance between two pixel centres
_SLOTS = 1024
"""Sums over all samples are kept in so many parts at first, so that threads do not wait for one another."""
_COUNT = wp.constant(_SLOTS)


# What kernels are given


@wp.struct
@no_type_check
class _Mesh:
    """As `cpu.Mesh`, and the corners of faces at each vertex, `incident[starts[v]:starts[v + 1]]`, as 3 f + corner."""

    faces: wp.array(dtype=wp.vec3i)
    edges: wp.array(dtype=wp.vec4i)
    neighbours: wp.array(dtype=wp.vec3i)
    starts: wp.array(dtype=wp.int32)
    incident: wp.array(dtype=wp.int32)
    uv: wp.array(dtype=wp.vec2)
    uv_faces: wp.array(dtype=wp.vec3i)
    uv_areas: wp.array(dtype=wp.float32)
    levels: wp.array(dtype=wp.vec3i)


@wp.struct
@no_type_check
class _Look:
    """As `cpu.Look`."""

    matrix: wp.array2d(dtype=wp.float32)
    focal: wp.array(dtype=wp.float32)
    light: wp.array(dtype=wp.float32)
    phong: wp.array(dtype=wp.float32)
    colors: wp.array(dtype=wp.vec3)
    texels: wp.array(dtype=wp.vec3)
    background: wp.array(dtype=wp.float32)
    attributes: wp.array3d(dtype=wp.float32)
    axis: wp.vec2
    height: wp.int32
    width: wp.int32
    has_normals: wp.int32


@wp.struct
@no_type_check
class _Frames:
    """What the forward pass leaves for the backward pass; P = H * W."""

    vertices: wp.array2d(dtype=wp.vec3)  # (B, V) camera space
    screen: wp.array2d(dtype=wp.vec3)  # (B, V) column, row, inverse depth; 0 marks what is not before the camera
    normals: wp.array2d(dtype=wp.vec4)  # (B, V) unit normal, length of the sum it was made from
    sides: wp.array2d(dtype=wp.uint8)  # (B, F) 1 for a front face
    face_img: wp.array2d(dtype=wp.int32)  # (B, P)
    inverse_img: wp.array2d(dtype=wp.float32)  # (B, P)
    samples: wp.array3d(dtype=wp.float32)  # (B, 3 P, C) linear colour, coverage, normal if asked for, attributes
    blended: wp.array2d(dtype=wp.vec4)  # (B, P) linear colour and coverage of the picture
    places: wp.array2d(dtype=wp.vec4i)  # (B, 2 P) see `_Crossing`; the first is -1 where there is none
    crossings: wp.array2d(dtype=wp.vec3)  # (B, 2 P)


@wp.struct
@no_type_check
class _Gradients:
    vertices: wp.array2d(dtype=wp.vec3)  # (B, V) camera space
    normals: wp.array2d(dtype=wp.vec3)  # (B, V)
    screen: wp.array2d(dtype=wp.vec3)  # (B, V)
    samples: wp.array3d(dtype=wp.float32)  # (B, 3 P, C)
    colors: wp.array(dtype=wp.vec3)  # empty, as the next two, where it is not asked for
    texels: wp.array(dtype=wp.vec3)
    attributes: wp.array3d(dtype=wp.float32)
    sums: wp.array2d(dtype=wp.float32)  # (_SLOTS, 8) light, Phong coefficients, focal length
    wants_sums: wp.int32


@wp.struct
@no_type_check
class _Edge:
    """An outline as pixel rows (columns) meet it: from p to q; "s" runs over rows (columns), "t" over the others."""

    p: wp.int32
    q: wp.int32
    face: wp.int32
    s0: wp.float32
    s1: wp.float32
    t0: wp.float32
    t1: wp.float32
    is_met: wp.bool  # whether it is an outline, and they are the ones to meet it
    before: wp.int32  # 1 if the surface lies on the side of the smaller t


@wp.struct
@no_type_check
class _Crossing:
    kind: wp.int32  # 0 for none, 1 for an outline, 2 for a meeting of two sheets
    cell: wp.int32  # the smaller t of the two pixels
    places: wp.vec4i  # outline: p, q, face, -1; meeting: face seen and below at the first pixel, below and seen at next
    # Distance from the surface's pixel centre; position from p to q, or the sum of both gaps; 1 if the surface is the
    # second pixel.
    numbers: wp.vec3


@wp.struct
@no_type_check
class _Surface:
    """What light needs to know of a sample."""

    face: wp.int32
    corners: wp.vec3i
    bary: wp.vec3
    point: wp.vec3
    normal: wp.vec3  # not of unit length
    color: wp.vec3  # of the vertices
    texel: wp.vec3
    uv: wp.vec2
    level: wp.float32
    volume: wp.float32


@wp.struct
@no_type_check
class _Lit:
    normal: wp.vec3
    shrink: wp.float32
    to_light: wp.vec3
    reach: wp.float32
    to_eye: wp.vec3
    near: wp.float32
    n_l: wp.float32
    n_v: wp.float32
    r_v: wp.float32
    power: wp.float32
    factor: wp.float32
    highlight: wp.float32


# Vertices


@wp.kernel
@no_type_check
def _project(world: wp.array2d(dtype=wp.vec3), look: _Look, frames: _Frames, bad: wp.array(dtype=wp.int32)):
    b, v = wp.tid()
    w, m = world[b, v], look.matrix
    x = m[0, 0] * w[0] + m[0, 1] * w[1] + m[0, 2] * w[2] + m[0, 3]
    y = m[1, 0] * w[0] + m[1, 1] * w[1] + m[1, 2] * w[2] + m[1, 3]
    z = m[2, 0] * w[0] + m[2, 1] * w[1] + m[2, 2] * w[2] + m[2, 3]
    if not wp.isfinite(x + y + z):
        bad[0] = 1
    inverse = wp.float32(0.0)
    if -z > _NEAR:
        inverse = 1.0 / -z
    frames.vertices[b, v] = wp.vec3(x, y, z)
    focal = look.focal[0]
    frames.screen[b, v] = wp.vec3(look.axis[0] + focal * x * inverse, look.axis[1] - focal * y * inverse, inverse)


@wp.kernel
@no_type_check
def _vertex_normals(mesh: _Mesh, frames: _Frames):
    b, v = wp.tid()
    total = wp.vec3(0.0, 0.0, 0.0)
    for n in range(mesh.starts[v], mesh.starts[v + 1]):
        face = mesh.faces[mesh.incident[n] // 3]
        first = frames.vertices[b, face[0]]
        total += wp.cross(frames.vertices[b, face[1]] - first, frames.vertices[b, face[2]] - first)
    length = wp.sqrt(wp.dot(total, total))
    if length > 0.0:
        total *= 1.0 / length
    frames.normals[b, v] = wp.vec4(total[0], total[1], total[2], length)


# Visibility


@wp.func
@no_type_check
def _ceil(x: wp.float32) -> wp.int32:
    """The first whole number from x >= 0 on."""
    whole = wp.int32(x)
    if wp.float32(whole) < x:
        whole += 1
    return whole


@wp.func
@no_type_check
def _key(first: wp.float32, second: wp.int32) -> wp.int64:
    """Larger where `first` >= 0 is, then where `second` is smaller."""
    return (wp.int64(wp.cast(first, wp.int32)) << wp.int64(32)) | wp.int64(_LAST - second)


@wp.func
@no_type_check
def _first_of(key: wp.int64) -> wp.float32:
    return wp.cast(wp.int32(key >> wp.int64(32)), wp.float32)


@wp.func
@no_type_check
def _second_of(key: wp.int64) -> wp.int32:
    # Shifted up and down again, which leaves the lower half.
    return _LAST - wp.int32((key << wp.int64(32)) >> wp.int64(32))


@wp.kernel
@no_type_check
def _rasterize(mesh: _Mesh, look: _Look, frames: _Frames, nearest: wp.array2d(dtype=wp.int64)):
    """A pixel centre on the edge of two faces goes to exactly one of them: `edge(a, b) == -edge(b, a)` holds to the
    last bit, and of two opposite directions one counts as inside."""
    b, f = wp.tid()
    face = mesh.faces[f]
    # Counter-clockwise seen from outside is clockwise once rows point down: swap two corners.
    i, j, k = frames.screen[b, face[0]], frames.screen[b, face[2]], frames.screen[b, face[1]]
    area = (j[0] - i[0]) * (k[1] - i[1]) - (k[0] - i[0]) * (j[1] - i[1])
    if not (area > 0.0 and wp.min(i[2], wp.min(j[2], k[2])) > 0.0):
        frames.sides[b, f] = wp.uint8(0)
        return
    frames.sides[b, f] = wp.uint8(1)
    first_x = wp.max(wp.min(i[0], wp.min(j[0], k[0])), 0.0)
    last_x = wp.min(wp.max(i[0], wp.max(j[0], k[0])), wp.float32(look.width - 1))
    first_y = wp.max(wp.min(i[1], wp.min(j[1], k[1])), 0.0)
    last_y = wp.min(wp.max(i[1], wp.max(j[1], k[1])), wp.float32(look.height - 1))
    if not (last_x >= first_x and last_y >= first_y):
        return  # beyond a border
    for row in range(_ceil(first_y), wp.int32(last_y) + 1):
        y = wp.float32(row)
        for column in range(_ceil(first_x), wp.int32(last_x) + 1):
            x = wp.float32(column)
            ei = (j[0] - x) * (k[1] - y) - (k[0] - x) * (j[1] - y)
            ej = (k[0] - x) * (i[1] - y) - (i[0] - x) * (k[1] - y)
            ek = (i[0] - x) * (j[1] - y) - (j[0] - x) * (i[1] - y)
            smallest = wp.min(ei, wp.min(ej, ek))
            inside = smallest > 0.0
            if smallest == 0.0:
                inside = (
                    (ei > 0.0 or k[1] > j[1] or (k[1] == j[1] and k[0] < j[0]))
                    and (ej > 0.0 or i[1] > k[1] or (i[1] == k[1] and i[0] < k[0]))
                    and (ek > 0.0 or j[1] > i[1] or (j[1] == i[1] and j[0] < i[0]))
                )
            if inside:
                inverse = (ei * i[2] + ej * j[2] + ek * k[2]) / (ei + ej + ek)
                if inverse > 0.0:
                    wp.atomic_max(nearest, b, row * look.width + column, _key(inverse, f))


# Where something else begins between two pixels


@wp.func
@no_type_check
def _areas_at(mesh: _Mesh, frames: _Frames, b: wp.int32, f: wp.int32, x: wp.float32, y: wp.float32) -> wp.vec3:
    """Twice the areas between a point of the picture and the edges opposite corners 0, 2 and 1; positive inside."""
    face = mesh.faces[f]
    i, j, k = frames.screen[b, face[0]], frames.screen[b, face[2]], frames.screen[b, face[1]]
    return wp.vec3(
        (j[0] - x) * (k[1] - y) - (k[0] - x) * (j[1] - y),
        (k[0] - x) * (i[1] - y) - (i[0] - x) * (k[1] - y),
        (i[0] - x) * (j[1] - y) - (j[0] - x) * (i[1] - y),
    )


@wp.func
@no_type_check
def _inverse_at(mesh: _Mesh, frames: _Frames, b: wp.int32, f: wp.int32, x: wp.float32, y: wp.float32) -> wp.float32:
    """Inverse depth of a face's plane at a point of the picture."""
    e, face = _areas_at(mesh, frames, b, f, x, y), mesh.faces[f]
    i, j, k = frames.screen[b, face[0]][2], frames.screen[b, face[2]][2], frames.screen[b, face[1]][2]
    return (e[0] * i + e[1] * j + e[2] * k) / (e[0] + e[1] + e[2])


@wp.func
@no_type_check
def _walk(mesh: _Mesh, frames: _Frames, b: wp.int32, start: wp.int32, x: wp.float32, y: wp.float32) -> wp.int32:
    """The face that shows a point, on the sheet of front faces that `start` belongs to; -1 if it ends before."""
    f = wp.int32(start)
    found = wp.int32(-1)
    steps = wp.int32(0)
    while steps < _WALK:
        steps += 1
        e = _areas_at(mesh, frames, b, f, x, y)
        if e[0] >= 0.0 and e[1] >= 0.0 and e[2] >= 0.0:
            found = f
            steps = _WALK
        else:
            corner = wp.int32(1)
            if e[0] <= e[1] and e[0] <= e[2]:
                corner = 0
            elif e[1] <= e[2]:
                corner = 2
            f = mesh.neighbours[f][corner]
            if f < 0 or frames.sides[b, f] == wp.uint8(0):
                steps = _WALK
    return found


@wp.func
@no_type_check
def _is_met(x: wp.float32, y: wp.float32, along: wp.int32) -> wp.bool:
    """Whether rows (columns, along == 1) are the ones to meet a line whose normal has these sizes along x and y."""
    return (x > y and along == 0) or (y >= x and along == 1)


@wp.func
@no_type_check
def _meeting(
    mesh: _Mesh, frames: _Frames, b: wp.int32, f: wp.int32, g_before: wp.int32, f_after: wp.int32, g: wp.int32,
    row: wp.int32, column: wp.int32, along: wp.int32,
) -> _Crossing:  # fmt: skip
    """Where sheet f, seen at a pixel, passes under sheet g, seen at the next one."""
    made = _Crossing()
    made.kind = 0
    x, y = wp.float32(column), wp.float32(row)
    x_after, y_after = wp.float32(column + 1 - along), wp.float32(row + along)
    at_f, at_g = _inverse_at(mesh, frames, b, f, x, y), _inverse_at(mesh, frames, b, g, x, y)
    before = at_f - _inverse_at(mesh, frames, b, g_before, x, y)
    after = _inverse_at(mesh, frames, b, g, x_after, y_after) - _inverse_at(mesh, frames, b, f_after, x_after, y_after)
    if before > 0.0 and after > 0.0:
        slope_x = _inverse_at(mesh, frames, b, f, x + 1.0, y) - at_f
        slope_x -= _inverse_at(mesh, frames, b, g, x + 1.0, y) - at_g
        slope_y = _inverse_at(mesh, frames, b, f, x, y + 1.0) - at_f
        slope_y -= _inverse_at(mesh, frames, b, g, x, y + 1.0) - at_g
        if _is_met(wp.abs(slope_x), wp.abs(slope_y), along):
            made.kind = 2
            made.cell = column
            if along == 1:
                made.cell = row
            made.places = wp.vec4i(f, g_before, f_after, g)
            made.numbers = wp.vec3(before / (before + after), before + after, 0.0)
    return made


@wp.func
@no_type_check
def _edge(mesh: _Mesh, frames: _Frames, b: wp.int32, e: wp.int32, along: wp.int32) -> _Edge:
    made = _Edge()
    made.is_met = False
    edge = mesh.edges[e]
    f = edge[2]
    f_front = frames.sides[b, f] != wp.uint8(0)
    g_front = edge[3] >= 0 and frames.sides[b, edge[3]] != wp.uint8(0)
    if f_front == g_front:
        return made
    if g_front:
        f = edge[3]
    face, across = mesh.faces[f], 1 - along
    p, q = edge[0], edge[1]
    o = face[0] + face[1] + face[2] - p - q
    if not frames.screen[b, p][across] < frames.screen[b, q][across]:
        p, q = edge[1], edge[0]
    first, second, third = frames.screen[b, p], frames.screen[b, q], frames.screen[b, o]
    made.p = p
    made.q = q
    made.face = f
    made.s0 = first[across]
    made.s1 = second[across]
    made.t0 = first[along]
    made.t1 = second[along]
    reach = made.s1 - made.s0
    drift = wp.abs(made.t1 - made.t0)
    made.is_met = (_is_met(reach, drift, 0) and along == 0) or (_is_met(drift, reach, 1) and along == 1)
    slope = (made.t1 - made.t0) / reach
    made.before = 0
    if third[along] < made.t0 + slope * (third[across] - made.s0):
        made.before = 1
    return made


@wp.func
@no_type_check
def _crossing(
    mesh: _Mesh, look: _Look, frames: _Frames, b: wp.int32, edge: _Edge, along: wp.int32, step: wp.int32
) -> _Crossing:
    """What happens where an outline meets row (column) `step`."""
    made = _Crossing()
    made.kind = 0
    last_t = look.width - 1
    if along == 1:
        last_t = look.height - 1
    fraction = (wp.float32(step) - edge.s0) / (edge.s1 - edge.s0)
    t = edge.t0 + fraction * (edge.t1 - edge.t0)
    if not (t >= 0.0 and t < wp.float32(last_t)):
        return made
    cell = wp.int32(t)
    near, far = frames.screen[b, edge.p][2], frames.screen[b, edge.q][2]
    inverse_edge = near + fraction * (far - near)
    row, column = step, cell
    pixel = row * look.width + column
    after = pixel + 1
    x, y = t, wp.float32(row)
    if along == 1:
        row, column = cell, step
        pixel = row * look.width + column
        after = pixel + look.width
        x, y = wp.float32(column), t
    seen, hidden = pixel, after
    distance, side = t - wp.float32(cell), wp.float32(0.0)
    if edge.before == 0:
        seen, hidden = after, pixel
        distance, side = 1.0 - distance, 1.0
    surface, behind = frames.inverse_img[b, seen], frames.inverse_img[b, hidden]
    if behind > inverse_edge * (1.0 - _MARGIN) or surface < 0.5 * (inverse_edge + behind):
        return made
    if behind > 0.0:
        # What is behind may come before the edge on its way there: then the surface passes under it first.
        g = _walk(mesh, frames, b, frames.face_img[b, hidden], x, y)
        if g >= 0 and _inverse_at(mesh, frames, b, g, x, y) > inverse_edge:
            if edge.before == 1:
                return _meeting(mesh, frames, b, edge.face, g, edge.face, g, row, column, along)
            return _meeting(mesh, frames, b, g, edge.face, g, edge.face, row, column, along)
    made.kind = 1
    made.cell = cell
    made.places = wp.vec4i(edge.p, edge.q, edge.face, -1)
    made.numbers = wp.vec3(distance, fraction, side)
    return made


@wp.kernel
@no_type_check
def _silhouettes(mesh: _Mesh, look: _Look, frames: _Frames, outermost: wp.array2d(dtype=wp.int64)):
    """Of each pair: the outermost outline, the first of equals; before all of these the last edge where a surface
    passes under another first. The surfaces of a pair's outlines are at the same pixel, the one that is nearer."""
    b, e = wp.tid()
    pixels = look.height * look.width
    for along in range(2):
        edge = _edge(mesh, frames, b, e, along)
        if edge.is_met:
            last_s = look.height - 1
            if along == 1:
                last_s = look.width - 1
            if edge.s1 >= 0.0 and edge.s0 <= wp.float32(last_s):
                # The last one is not included: the next edge of the outline takes it.
                for step in range(_ceil(wp.max(edge.s0, 0.0)), _ceil(wp.min(edge.s1, wp.float32(last_s + 1)))):
                    crossing = _crossing(mesh, look, frames, b, edge, along, step)
                    pair = step * look.width + crossing.cell
                    if along == 1:
                        pair = pixels + crossing.cell * look.width + step
                    if crossing.kind == 1:
                        wp.atomic_max(outermost, b, pair, _key(crossing.numbers[0], e))
                    if crossing.kind == 2:
                        wp.atomic_max(outermost, b, pair, _key(_FARTHEST, _LAST - e))


@wp.func
@no_type_check
def _is_valley(look: _Look, frames: _Frames, b: wp.int32, row: wp.int32, column: wp.int32, along: wp.int32) -> wp.bool:
    """Where the surface may be a groove between a pixel and the next: its slope rises by a step there."""
    width = look.width
    before, left = wp.max(row - along, 0), wp.max(column - 1 + along, 0)
    after, right = wp.min(row + 2 * along, look.height - 1), wp.min(column + 2 * (1 - along), width - 1)
    a = frames.inverse_img[b, row * width + column]
    c = frames.inverse_img[b, (row + along) * width + column + 1 - along]
    first = frames.inverse_img[b, before * width + left] - 2.0 * a + c
    second = a - 2.0 * c + frames.inverse_img[b, after * width + right]
    return a > 0.0 and c > 0.0 and wp.max(first, second) > _VALLEY / look.focal[0] * a


@wp.kernel
@no_type_check
def _crossings(mesh: _Mesh, look: _Look, frames: _Frames, outermost: wp.array2d(dtype=wp.int64)):
    """The crossing of each pair, if there is one, and the colour there: two sheets that both reach under both pixels
    and pass through one another, or else what an edge tells."""
    b, n = wp.tid()
    pixels = look.height * look.width
    along, pixel = n // pixels, n % pixels
    row, column = pixel // look.width, pixel % look.width
    frames.places[b, n] = wp.vec4i(-1, -1, -1, -1)
    if (along == 0 and column == look.width - 1) or (along == 1 and row == look.height - 1):
        return
    found = _Crossing()
    found.kind = 0
    key = outermost[b, n]
    if key >= wp.int64(0):
        e = _second_of(key)
        if _first_of(key) == _FARTHEST:
            e = _LAST - e
        step = row
        if along == 1:
            step = column
        found = _crossing(mesh, look, frames, b, _edge(mesh, frames, b, e, along), along, step)
    if _is_valley(look, frames, b, row, column, along):
        row_after, column_after = row + along, column + 1 - along
        f, g = frames.face_img[b, pixel], frames.face_img[b, row_after * look.width + column_after]
        if f != g:
            f_after = _walk(mesh, frames, b, f, wp.float32(column_after), wp.float32(row_after))
            if f_after >= 0 and f_after != g:
                g_before = _walk(mesh, frames, b, g, wp.float32(column), wp.float32(row))
                if g_before >= 0 and g_before != f:
                    meeting = _meeting(mesh, frames, b, f, g_before, f_after, g, row, column, along)
                    if meeting.kind == 2:
                        found = meeting
    if found.kind == 0:
        return
    frames.places[b, n] = found.places
    frames.crossings[b, n] = found.numbers
    if found.kind == 2:
        for c in range(frames.samples.shape[2]):
            frames.samples[b, pixels + n, c] = frames.samples[b, pixel, c]
        return
    bary = _on_edge(mesh, frames, b, found.places, found.numbers[1])
    _shade(mesh, look, frames, b, found.places[2], bary, pixels + n)


# Barycentric coordinates of a sample


@wp.func
@no_type_check
def _ray(look: _Look, pixel: wp.int32) -> wp.vec2:
    """Where the ray through a pixel centre meets the plane z = -1."""
    inverse = 1.0 / look.focal[0]
    column, row = wp.float32(pixel % look.width), wp.float32(pixel // look.width)
    return wp.vec2((column - look.axis[0]) * inverse, (look.axis[1] - row) * inverse)


@wp.func
@no_type_check
def _sheared(point: wp.vec3, ray: wp.vec2) -> wp.vec2:
    """Shearing a face until the ray is the viewing axis leaves plain areas in two dimensions."""
    return wp.vec2(point[0] + ray[0] * point[2], point[1] + ray[1] * point[2])


@wp.func
@no_type_check
def _cross2(a: wp.vec2, b: wp.vec2) -> wp.float32:
    return a[0] * b[1] - a[1] * b[0]


@wp.func
@no_type_check
def _bary_and_area(frames: _Frames, b: wp.int32, corners: wp.vec3i, ray: wp.vec2) -> wp.vec4:
    """Perspective-correct barycentric coordinates where a ray meets a face, and twice its area seen there."""
    i = _sheared(frames.vertices[b, corners[0]], ray)
    j = _sheared(frames.vertices[b, corners[1]], ray)
    k = _sheared(frames.vertices[b, corners[2]], ray)
    ei, ej, ek = _cross2(j, k), _cross2(k, i), _cross2(i, j)
    area = ei + ej + ek
    inverse = 1.0 / area
    return wp.vec4(ei * inverse, ej * inverse, ek * inverse, area)


@wp.func
@no_type_check
def _on_edge(mesh: _Mesh, frames: _Frames, b: wp.int32, places: wp.vec4i, fraction: wp.float32) -> wp.vec3:
    """Barycentric coordinates of the point seen at a fraction of a face's edge from p to q."""
    near, far = frames.screen[b, places[0]][2], frames.screen[b, places[1]][2]
    position = fraction * far / (near + fraction * (far - near))
    corners = mesh.faces[places[2]]
    bary = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        if corners[c] == places[0]:
            bary[c] = 1.0 - position
        elif corners[c] == places[1]:
            bary[c] = position
    return bary


# Texture


@wp.func
@no_type_check
def _texel_at(level: wp.vec3i, uv: wp.vec2) -> wp.vec2:
    """Column and row of a point, in texels, clamped at the border."""
    return wp.vec2(
        wp.clamp(uv[0] * wp.float32(level[2]) - 0.5, 0.0, wp.float32(level[2] - 1)),
        wp.clamp(uv[1] * wp.float32(level[1]) - 0.5, 0.0, wp.float32(level[1] - 1)),
    )


@wp.func
@no_type_check
def _texels_around(level: wp.vec3i, at: wp.vec2) -> wp.vec4i:
    # Clamped again for a number that is not finite, which is reported later.
    left, top = wp.clamp(wp.int32(at[0]), 0, level[2] - 1), wp.clamp(wp.int32(at[1]), 0, level[1] - 1)
    right = wp.min(left + 1, level[2] - 1)
    upper, lower = level[0] + top * level[2], level[0] + wp.min(top + 1, level[1] - 1) * level[2]
    return wp.vec4i(upper + left, upper + right, lower + left, lower + right)


@wp.func
@no_type_check
def _sample_level(mesh: _Mesh, look: _Look, number: wp.int32, uv: wp.vec2) -> wp.vec3:
    at = _texel_at(mesh.levels[number], uv)
    around = _texels_around(mesh.levels[number], at)
    s, t = at[0] - wp.floor(at[0]), at[1] - wp.floor(at[1])
    upper = (1.0 - s) * look.texels[around[0]] + s * look.texels[around[1]]
    lower = (1.0 - s) * look.texels[around[2]] + s * look.texels[around[3]]
    return (1.0 - t) * upper + t * lower


@wp.func
@no_type_check
def _sample_texture(mesh: _Mesh, look: _Look, uv: wp.vec2, level: wp.float32) -> wp.vec3:
    """Between four texels of each of two levels."""
    number = wp.int32(level)
    between = level - wp.float32(number)
    texel = _sample_level(mesh, look, number, uv)
    if between > 0.0:
        texel += between * (_sample_level(mesh, look, number + 1, uv) - texel)
    return texel


@wp.func
@no_type_check
def _sample_level_backward(
    mesh: _Mesh, look: _Look, number: wp.int32, uv: wp.vec2, gain: wp.float32, g_texel: wp.vec3, g: _Gradients
) -> wp.vec3:
    """Of `gain` times the texel: its value along the gradient, and the gradients for u and v."""
    level = mesh.levels[number]
    at = _texel_at(level, uv)
    around = _texels_around(level, at)
    s, t = at[0] - wp.floor(at[0]), at[1] - wp.floor(at[1])
    columns, rows = wp.float32(level[2]), wp.float32(level[1])
    # Beyond the outer texel centres the texture is constant.
    u_scale, v_scale = wp.float32(0.0), wp.float32(0.0)
    if uv[0] * columns > 0.5 and uv[0] * columns < columns - 0.5:
        u_scale = columns
    if uv[1] * rows > 0.5 and uv[1] * rows < rows - 0.5:
        v_scale = rows
    a, b = wp.dot(g_texel, look.texels[around[0]]), wp.dot(g_texel, look.texels[around[1]])
    c, d = wp.dot(g_texel, look.texels[around[2]]), wp.dot(g_texel, look.texels[around[3]])
    if g.texels.shape[0] > 0:
        wp.atomic_add(g.texels, around[0], gain * (1.0 - s) * (1.0 - t) * g_texel)
        wp.atomic_add(g.texels, around[1], gain * s * (1.0 - t) * g_texel)
        wp.atomic_add(g.texels, around[2], gain * (1.0 - s) * t * g_texel)
        wp.atomic_add(g.texels, around[3], gain * s * t * g_texel)
    return wp.vec3(
        (1.0 - t) * ((1.0 - s) * a + s * b) + t * ((1.0 - s) * c + s * d),
        gain * u_scale * ((1.0 - t) * (b - a) + t * (d - c)),
        gain * v_scale * ((1.0 - s) * (c - a) + s * (d - b)),
    )


# Colour of samples


@wp.func
@no_type_check
def _eye_to(frames: _Frames, b: wp.int32, v: wp.int32) -> wp.vec3:
    point = frames.vertices[b, v]
    return wp.vec3(point[0], point[1], -point[2])


@wp.func
@no_type_check
def _surface(mesh: _Mesh, look: _Look, frames: _Frames, b: wp.int32, f: wp.int32, bary: wp.vec3) -> _Surface:
    made = _Surface()
    corners = mesh.faces[f]
    i, j, k = corners[0], corners[1], corners[2]
    made.face = f
    made.corners = corners
    made.bary = bary
    ni, nj, nk = frames.normals[b, i], frames.normals[b, j], frames.normals[b, k]
    normal = bary[0] * ni + bary[1] * nj + bary[2] * nk
    made.normal = wp.vec3(normal[0], normal[1], normal[2])
    made.point = bary[0] * frames.vertices[b, i] + bary[1] * frames.vertices[b, j] + bary[2] * frames.vertices[b, k]
    made.color = bary[0] * look.colors[i] + bary[1] * look.colors[j] + bary[2] * look.colors[k]
    made.texel = wp.vec3(1.0, 1.0, 1.0)
    if mesh.levels.shape[0] > 0:
        at = mesh.uv_faces[f]
        made.uv = bary[0] * mesh.uv[at[0]] + bary[1] * mesh.uv[at[1]] + bary[2] * mesh.uv[at[2]]
        made.volume = wp.dot(_eye_to(frames, b, i), wp.cross(_eye_to(frames, b, j), _eye_to(frames, b, k)))
        depth = -made.point[2]
        # The level whose texels are as large as the pixel, in area: 0 is the finest.
        texels = mesh.uv_areas[f] * depth * depth * depth / (made.volume * look.focal[0] * look.focal[0])
        made.level = 0.0
        if texels > 1.0:
            made.level = wp.min(0.5 * wp.log2(texels), wp.float32(mesh.levels.shape[0] - 1))
        made.texel = _sample_texture(mesh, look, made.uv, made.level)
    return made


@wp.func
@no_type_check
def _light(look: _Look, surface: _Surface) -> _Lit:
    """Phong: the factor of the albedo and the highlight, and on the way all that the backward pass needs."""
    made = _Lit()
    made.shrink = 0.0
    squared = wp.dot(surface.normal, surface.normal)
    if squared > 0.0:
        made.shrink = 1.0 / wp.sqrt(squared)
    made.normal = made.shrink * surface.normal
    to_light = wp.vec3(look.light[0], look.light[1], look.light[2]) - surface.point
    made.reach = 1.0 / wp.sqrt(wp.dot(to_light, to_light))
    made.to_light = made.reach * to_light
    made.near = 1.0 / wp.sqrt(wp.dot(surface.point, surface.point))
    made.to_eye = -made.near * surface.point
    made.n_l = wp.dot(made.normal, made.to_light)
    made.n_v = wp.dot(made.normal, made.to_eye)
    made.r_v = 2.0 * made.n_l * made.n_v - wp.dot(made.to_light, made.to_eye)
    if not made.n_l > 0.0:
        made.n_l = 0.0
        made.r_v = 0.0
    made.power = 0.0  # (r . v) ^ (shininess - 1), 0 where the highlight is not seen
    if made.r_v > 0.0:
        made.power = wp.pow(made.r_v, look.phong[3] - 1.0)
    else:
        made.r_v = 0.0
    made.factor = look.phong[0] + look.phong[1] * made.n_l
    made.highlight = look.phong[2] * made.power * made.r_v
    return made


@wp.func
@no_type_check
def _shade(mesh: _Mesh, look: _Look, frames: _Frames, b: wp.int32, f: wp.int32, bary: wp.vec3, sample: wp.int32):
    """Linear colour, coverage, camera-space normal if asked for, and attributes."""
    surface = _surface(mesh, look, frames, b, f, bary)
    lit = _light(look, surface)
    color = lit.factor * wp.cw_mul(surface.color, surface.texel)
    for c in range(3):
        frames.samples[b, sample, c] = color[c] + lit.highlight
    frames.samples[b, sample, 3] = 1.0
    if look.has_normals == 1:
        for c in range(3):
            frames.samples[b, sample, 4 + c] = lit.normal[c]
    first = 4 + 3 * look.has_normals
    i, j, k = surface.corners[0], surface.corners[1], surface.corners[2]
    for a in range(look.attributes.shape[2]):
        frames.samples[b, sample, first + a] = (
            bary[0] * look.attributes[b, i, a] + bary[1] * look.attributes[b, j, a] + bary[2] * look.attributes[b, k, a]
        )


@wp.kernel
@no_type_check
def _shade_pixels(mesh: _Mesh, look: _Look, frames: _Frames, nearest: wp.array2d(dtype=wp.int64)):
    b, pixel = wp.tid()
    key = nearest[b, pixel]
    if key < wp.int64(0):
        frames.face_img[b, pixel] = -1
        frames.inverse_img[b, pixel] = 0.0
        for c in range(frames.samples.shape[2]):
            frames.samples[b, pixel, c] = 0.0
        for c in range(3):
            frames.samples[b, pixel, c] = look.background[c]
        return
    f = _second_of(key)
    frames.face_img[b, pixel] = f
    frames.inverse_img[b, pixel] = _first_of(key)
    bary = _bary_and_area(frames, b, mesh.faces[f], _ray(look, pixel))
    _shade(mesh, look, frames, b, f, wp.vec3(bary[0], bary[1], bary[2]), pixel)


@wp.kernel
@no_type_check
def _parts_at_pixels(
    mesh: _Mesh, look: _Look, frames: _Frames, parts: wp.array(dtype=wp.int64), part_img: wp.array2d(dtype=wp.int64)
):
    """Label of the nearest corner (by barycentric coordinate) of the face in each pixel; -1 on the background."""
    b, pixel = wp.tid()
    f = frames.face_img[b, pixel]
    if f < 0:
        part_img[b, pixel] = wp.int64(-1)
        return
    corners = mesh.faces[f]
    bary = _bary_and_area(frames, b, corners, _ray(look, pixel))
    nearest = corners[2]
    if bary[0] >= bary[1] and bary[0] >= bary[2]:
        nearest = corners[0]
    elif bary[1] >= bary[2]:
        nearest = corners[1]
    part_img[b, pixel] = parts[nearest]


# Blending across silhouettes, and encoding


@wp.func
@no_type_check
def _weights(t: wp.float32, is_surface: wp.bool) -> wp.vec3:
    """What surface, what is behind and colour at the crossing add to one of the two pixels: see `antialias.blend`."""
    if t < 0.5:
        if is_surface:
            return wp.vec3(0.5 * (t - 1.0), 0.5 - t, 0.5 * t)
        return wp.vec3(0.0, 0.0, 0.0)
    if is_surface:
        ramp = 0.125 / t
        return wp.vec3(-ramp, 0.0, ramp)
    gain, ramp = t - 0.5, (0.5 * t * t - 0.125) / t
    return wp.vec3(gain - ramp, -gain, ramp)


@wp.func
@no_type_check
def _first_pixel(look: _Look, n: wp.int32) -> wp.int32:
    return n % (look.height * look.width)


@wp.func
@no_type_check
def _second_pixel(look: _Look, n: wp.int32) -> wp.int32:
    pixels = look.height * look.width
    if n < pixels:
        return n + 1
    return n - pixels + look.width


@wp.func
@no_type_check
def _srgb(linear: wp.float32) -> wp.float32:
    x = wp.clamp(linear, 0.0, 1.0)
    if x <= 0.0031308:
        return 12.92 * x
    return 1.055 * wp.pow(x, 1.0 / 2.4) - 0.055


@wp.kernel
@no_type_check
def _encode(
    look: _Look, frames: _Frames, color: wp.array3d(dtype=wp.float32), mask: wp.array2d(dtype=wp.float32),
    extras: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """Each pixel of a pair gets the mean over its half of the way between the two centres."""
    b, pixel = wp.tid()
    pixels = look.height * look.width
    row, column = pixel // look.width, pixel % look.width
    channels = frames.samples.shape[2]
    blended = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for c in range(4):
        blended[c] = frames.samples[b, pixel, c]
    for c in range(4, channels):
        extras[b, c - 4, pixel] = frames.samples[b, pixel, c]
    for side in range(4):
        # The pairs to the right, to the left, below and above.
        n = wp.int32(-1)
        if side == 0:
            n = pixel
        elif side == 1 and column > 0:
            n = pixel - 1
        elif side == 2:
            n = pixels + pixel
        elif side == 3 and row > 0:
            n = pixels + pixel - look.width
        if n >= 0 and frames.places[b, n][0] >= 0:
            crossing = frames.crossings[b, n]
            surface, behind = _first_pixel(look, n), _second_pixel(look, n)
            if crossing[2] == 1.0:
                surface, behind = behind, surface
            weights = _weights(crossing[0], surface == pixel)
            for c in range(channels):
                change = weights[0] * frames.samples[b, surface, c] + weights[1] * frames.samples[b, behind, c]
                change += weights[2] * frames.samples[b, pixels + n, c]
                if c < 4:
                    blended[c] = blended[c] + change
                else:
                    extras[b, c - 4, pixel] = extras[b, c - 4, pixel] + change
    frames.blended[b, pixel] = blended
    for c in range(3):
        color[b, c, pixel] = _srgb(blended[c])
    mask[b, pixel] = wp.clamp(blended[3], 0.0, 1.0)


# Backward


@wp.kernel
@no_type_check
def _encode_backward(
    look: _Look, frames: _Frames, color: wp.array3d(dtype=wp.float32), g_color: wp.array3d(dtype=wp.float32),
    g_mask: wp.array2d(dtype=wp.float32), g_extras: wp.array3d(dtype=wp.float32), g: _Gradients,
    g_blended: wp.array3d(dtype=wp.float32),
):  # fmt: skip
    """A gradient of a picture without frames is zero."""
    b, pixel = wp.tid()
    blended = frames.blended[b, pixel]
    for c in range(frames.samples.shape[2]):
        gradient = wp.float32(0.0)
        if c < 3:
            if g_color.shape[0] > 0:
                x = blended[c]
                if x > 0.0 and x < 1.0:
                    slope = wp.float32(12.92)
                    if x > 0.0031308:
                        slope = (color[b, c, pixel] + 0.055) / (2.4 * x)
                    gradient = slope * g_color[b, c, pixel]
        elif c == 3:
            if g_mask.shape[0] > 0 and blended[3] >= 0.0 and blended[3] <= 1.0:
                gradient = g_mask[b, pixel]
        elif g_extras.shape[0] > 0:
            gradient = g_extras[b, c - 4, pixel]
        g_blended[b, pixel, c] = gradient
        g.samples[b, pixel, c] = gradient


@wp.func
@no_type_check
def _inverse_at_backward(
    mesh: _Mesh, frames: _Frames, b: wp.int32, f: wp.int32, x: wp.float32, y: wp.float32, g_inverse: wp.float32,
    g: _Gradients,
):  # fmt: skip
    e, face = _areas_at(mesh, frames, b, f, x, y), mesh.faces[f]
    i, j, k = frames.screen[b, face[0]], frames.screen[b, face[2]], frames.screen[b, face[1]]
    area = e[0] + e[1] + e[2]
    # Slopes of the plane: it moves along with its corners.
    slope_x = ((k[1] - j[1]) * i[2] + (i[1] - k[1]) * j[2] + (j[1] - i[1]) * k[2]) / -area
    slope_y = ((j[0] - k[0]) * i[2] + (k[0] - i[0]) * j[2] + (i[0] - j[0]) * k[2]) / -area
    change = g_inverse / area * wp.vec3(-slope_x, -slope_y, 1.0)
    wp.atomic_add(g.screen, b, face[0], e[0] * change)
    wp.atomic_add(g.screen, b, face[2], e[1] * change)
    wp.atomic_add(g.screen, b, face[1], e[2] * change)


@wp.func
@no_type_check
def _in_picture(along: wp.int32, on_along: wp.float32, on_across: wp.float32, inverse: wp.float32) -> wp.vec3:
    if along == 0:
        return wp.vec3(on_along, on_across, inverse)
    return wp.vec3(on_across, on_along, inverse)


@wp.kernel
@no_type_check
def _blend_backward(mesh: _Mesh, look: _Look, frames: _Frames, g_blended: wp.array3d(dtype=wp.float32), g: _Gradients):
    """Gradient of the samples before they were blended, and of the vertices of silhouettes as these move."""
    b, n = wp.tid()
    places, crossing = frames.places[b, n], frames.crossings[b, n]
    if places[0] < 0:
        return
    pixels = look.height * look.width
    edge = pixels + n
    pixel, other = _first_pixel(look, n), _second_pixel(look, n)
    if crossing[2] == 1.0:
        pixel, other = other, pixel
    t, fraction = crossing[0], crossing[1]
    at_pixel, at_other = _weights(t, True), _weights(t, False)
    g_t = wp.float32(0.0)
    for c in range(frames.samples.shape[2]):
        surface, behind, ending = frames.samples[b, pixel, c], frames.samples[b, other, c], frames.samples[b, edge, c]
        g_pixel, g_other = g_blended[b, pixel, c], g_blended[b, other, c]
        g_surface = at_pixel[0] * g_pixel + at_other[0] * g_other
        g_behind = at_pixel[1] * g_pixel + at_other[1] * g_other
        g_edge = at_pixel[2] * g_pixel + at_other[2] * g_other
        if t < 0.5:
            g_t += g_pixel * (0.5 * (surface + ending) - behind)
        else:
            ramp = (ending - surface) / t
            g_t += g_other * (surface - behind + t * ramp) - g_edge * ramp
        g.samples[b, edge, c] = g_edge
        if places[3] >= 0:
            g_surface += g_edge
        wp.atomic_add(g.samples, b, pixel, c, g_surface)
        wp.atomic_add(g.samples, b, other, c, g_behind)
    if places[3] >= 0:
        x, y = wp.float32(pixel % look.width), wp.float32(pixel // look.width)
        x_after, y_after = wp.float32(other % look.width), wp.float32(other // look.width)
        g_before, g_after = (1.0 - t) / fraction * g_t, -t / fraction * g_t
        _inverse_at_backward(mesh, frames, b, places[0], x, y, g_before, g)
        _inverse_at_backward(mesh, frames, b, places[1], x, y, -g_before, g)
        _inverse_at_backward(mesh, frames, b, places[3], x_after, y_after, g_after, g)
        _inverse_at_backward(mesh, frames, b, places[2], x_after, y_after, -g_after, g)
        return
    along = n // pixels
    g_crossing = g_t
    if crossing[2] == 1.0:
        g_crossing = -g_t
    first, second = frames.screen[b, places[0]], frames.screen[b, places[1]]
    slope = (second[along] - first[along]) / (second[1 - along] - first[1 - along])
    change = _in_picture(along, g_crossing, -slope * g_crossing, 0.0)
    wp.atomic_add(g.screen, b, places[0], (1.0 - fraction) * change)
    wp.atomic_add(g.screen, b, places[1], fraction * change)


@wp.func
@no_type_check
def _light_backward(
    look: _Look, surface: _Surface, lit: _Lit, g_color: wp.vec3, g_unit: wp.vec3, slot: wp.int32, g: _Gradients
) -> tuple[wp.vec3, wp.vec3, wp.vec3]:
    """Gradients of point, normal (not of unit length) and albedo from those of the colour and of the unit normal."""
    diffuse, specular, shininess = look.phong[1], look.phong[2], look.phong[3]
    g_highlight = g_color[0] + g_color[1] + g_color[2]
    g_factor = wp.dot(g_color, wp.cw_mul(surface.color, surface.texel))
    # factor = ambient + diffuse n.l, highlight = specular (r.v) ^ shininess, r.v = 2 n.l n.v - l.v.
    g_r_v, g_n_l = wp.float32(0.0), wp.float32(0.0)
    if lit.r_v > 0.0:
        g_r_v = g_highlight * specular * shininess * lit.power
    if lit.n_l > 0.0:
        g_n_l = diffuse * g_factor + 2.0 * lit.n_v * g_r_v
    g_n_v = 2.0 * lit.n_l * g_r_v
    g_to_light = g_n_l * lit.normal - g_r_v * lit.to_eye
    g_to_eye = g_n_v * lit.normal - g_r_v * lit.to_light
    g_normal = g_unit + g_n_l * lit.to_light + g_n_v * lit.to_eye
    # Unit vectors: what points along them changes nothing.
    g_to_light = lit.reach * (g_to_light - wp.dot(lit.to_light, g_to_light) * lit.to_light)
    g_to_eye = lit.near * (g_to_eye - wp.dot(lit.to_eye, g_to_eye) * lit.to_eye)
    g_normal = lit.shrink * (g_normal - wp.dot(lit.normal, g_normal) * lit.normal)
    if g.wants_sums == 1:
        for c in range(3):
            wp.atomic_add(g.sums, slot, c, g_to_light[c])
        wp.atomic_add(g.sums, slot, 3, g_factor)
        wp.atomic_add(g.sums, slot, 4, g_factor * lit.n_l)
        wp.atomic_add(g.sums, slot, 5, g_highlight * lit.power * lit.r_v)
        if lit.r_v > 0.0:
            wp.atomic_add(g.sums, slot, 6, g_highlight * lit.highlight * wp.log(lit.r_v))
    return -(g_to_light + g_to_eye), g_normal, lit.factor * g_color


@wp.func
@no_type_check
def _texture_backward(
    mesh: _Mesh, look: _Look, frames: _Frames, b: wp.int32, surface: _Surface, g_texel: wp.vec3, slot: wp.int32,
    g: _Gradients,
) -> wp.vec4:  # fmt: skip
    """Gradients for the barycentric coordinates and for the z of the point."""
    number = wp.int32(surface.level)
    between = surface.level - wp.float32(number)
    found = _sample_level_backward(mesh, look, number, surface.uv, 1.0 - between, g_texel, g)
    g_uv = wp.vec2(found[1], found[2])
    g_z = wp.float32(0.0)
    if between > 0.0:
        coarser = _sample_level_backward(mesh, look, number + 1, surface.uv, between, g_texel, g)
        g_uv += wp.vec2(coarser[1], coarser[2])
        # Between the ends, where the level is not clamped; d log2(x) = dx / (x ln 2).
        g_level = 1.4426950408889634 * (coarser[0] - found[0])
        g_z = 1.5 * g_level / surface.point[2]
        g_volume = -0.5 * g_level / surface.volume
        for c in range(3):
            v, after, last = surface.corners[c], surface.corners[(c + 1) % 3], surface.corners[(c + 2) % 3]
            normal = g_volume * wp.cross(_eye_to(frames, b, after), _eye_to(frames, b, last))
            wp.atomic_add(g.vertices, b, v, wp.vec3(normal[0], normal[1], -normal[2]))
        if g.wants_sums == 1:
            wp.atomic_add(g.sums, slot, 7, -g_level / look.focal[0])
    at = mesh.uv_faces[surface.face]
    return wp.vec4(wp.dot(g_uv, mesh.uv[at[0]]), wp.dot(g_uv, mesh.uv[at[1]]), wp.dot(g_uv, mesh.uv[at[2]]), g_z)


@wp.kernel
@no_type_check
def _shade_backward(mesh: _Mesh, look: _Look, frames: _Frames, g_inverse: wp.array2d(dtype=wp.float32), g: _Gradients):
    """From the gradients of samples, pixels and outlines alike, to those of what they were made from."""
    b, sample = wp.tid()
    pixels = look.height * look.width
    is_pixel = sample < pixels
    f = wp.int32(-1)
    ray, places, fraction = wp.vec2(0.0, 0.0), wp.vec4i(0, 0, 0, 0), wp.float32(0.0)
    bary_and_area = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if is_pixel:
        f = frames.face_img[b, sample]
        if f >= 0:
            ray = _ray(look, sample)
            bary_and_area = _bary_and_area(frames, b, mesh.faces[f], ray)
    else:
        places = frames.places[b, sample - pixels]
        if places[0] >= 0 and places[3] < 0:
            f = places[2]
            fraction = frames.crossings[b, sample - pixels][1]
            on_edge = _on_edge(mesh, frames, b, places, fraction)
            bary_and_area = wp.vec4(on_edge[0], on_edge[1], on_edge[2], 1.0)
    if f < 0:
        return
    # The forward pass again: recomputing is cheaper than storing.
    bary = wp.vec3(bary_and_area[0], bary_and_area[1], bary_and_area[2])
    surface = _surface(mesh, look, frames, b, f, bary)
    lit = _light(look, surface)
    slot = (b + sample) % _COUNT
    g_color = wp.vec3(g.samples[b, sample, 0], g.samples[b, sample, 1], g.samples[b, sample, 2])
    g_unit = wp.vec3(0.0, 0.0, 0.0)
    if look.has_normals == 1:
        g_unit = wp.vec3(g.samples[b, sample, 4], g.samples[b, sample, 5], g.samples[b, sample, 6])
    g_point, g_normal, g_albedo = _light_backward(look, surface, lit, g_color, g_unit, slot, g)
    if is_pixel and g_inverse.shape[0] > 0:
        g_point[2] += g_inverse[b, sample] / (surface.point[2] * surface.point[2])
    g_bary = wp.vec3(0.0, 0.0, 0.0)
    corners, first = surface.corners, 4 + 3 * look.has_normals
    for a in range(look.attributes.shape[2]):
        gradient = g.samples[b, sample, first + a]
        for c in range(3):
            g_bary[c] += gradient * look.attributes[b, corners[c], a]
            if g.attributes.shape[0] > 0:
                wp.atomic_add(g.attributes, b, corners[c], a, gradient * bary[c])
    if mesh.levels.shape[0] > 0:
        found = _texture_backward(mesh, look, frames, b, surface, wp.cw_mul(g_albedo, surface.color), slot, g)
        g_bary += wp.vec3(found[0], found[1], found[2])
        g_point[2] += found[3]
        g_albedo = wp.cw_mul(g_albedo, surface.texel)
    for c in range(3):
        v = corners[c]
        normal = frames.normals[b, v]
        g_bary[c] += wp.dot(g_albedo, look.colors[v]) + wp.dot(g_point, frames.vertices[b, v])
        g_bary[c] += g_normal[0] * normal[0] + g_normal[1] * normal[1] + g_normal[2] * normal[2]
        wp.atomic_add(g.normals, b, v, bary[c] * g_normal)
        if g.colors.shape[0] > 0:
            wp.atomic_add(g.colors, v, bary[c] * g_albedo)
    if not is_pixel:
        for c in range(3):
            wp.atomic_add(g.vertices, b, corners[c], bary[c] * g_point)
        g_position = wp.float32(0.0)
        for c in range(3):
            if corners[c] == places[0]:
                g_position -= g_bary[c]
            elif corners[c] == places[1]:
                g_position += g_bary[c]
        _edge_position_backward(frames, b, places, (sample - pixels) // pixels, fraction, g_position, g)
        return
    # Areas and their sum, see `_bary_and_area`.
    i = _sheared(frames.vertices[b, corners[0]], ray)
    j = _sheared(frames.vertices[b, corners[1]], ray)
    k = _sheared(frames.vertices[b, corners[2]], ray)
    g_e = (g_bary - wp.vec3(1.0, 1.0, 1.0) * wp.dot(bary, g_bary)) / bary_and_area[3]
    g_i = wp.vec2(j[1] * g_e[2] - k[1] * g_e[1], k[0] * g_e[1] - j[0] * g_e[2])
    g_j = wp.vec2(k[1] * g_e[0] - i[1] * g_e[2], i[0] * g_e[2] - k[0] * g_e[0])
    g_k = wp.vec2(i[1] * g_e[1] - j[1] * g_e[0], j[0] * g_e[0] - i[0] * g_e[1])
    wp.atomic_add(g.vertices, b, corners[0], wp.vec3(g_i[0], g_i[1], wp.dot(ray, g_i)) + bary[0] * g_point)
    wp.atomic_add(g.vertices, b, corners[1], wp.vec3(g_j[0], g_j[1], wp.dot(ray, g_j)) + bary[1] * g_point)
    wp.atomic_add(g.vertices, b, corners[2], wp.vec3(g_k[0], g_k[1], wp.dot(ray, g_k)) + bary[2] * g_point)
    if g.wants_sums == 1:
        g_ray = frames.vertices[b, corners[0]][2] * g_i + frames.vertices[b, corners[1]][2] * g_j
        g_ray += frames.vertices[b, corners[2]][2] * g_k
        wp.atomic_add(g.sums, slot, 7, -wp.dot(g_ray, ray) / look.focal[0])


@wp.func
@no_type_check
def _edge_position_backward(
    frames: _Frames, b: wp.int32, places: wp.vec4i, along: wp.int32, fraction: wp.float32, g_position: wp.float32,
    g: _Gradients,
):  # fmt: skip
    """See `_on_edge`."""
    p, q = frames.screen[b, places[0]], frames.screen[b, places[1]]
    inverse = 1.0 / (p[2] + fraction * (q[2] - p[2]))
    scale = g_position * inverse * inverse
    g_fraction = p[2] * q[2] * scale / (q[1 - along] - p[1 - along])
    change = fraction * (1.0 - fraction) * scale
    on_p = _in_picture(along, 0.0, -(1.0 - fraction) * g_fraction, -q[2] * change)
    on_q = _in_picture(along, 0.0, -fraction * g_fraction, p[2] * change)
    wp.atomic_add(g.screen, b, places[0], on_p)
    wp.atomic_add(g.screen, b, places[1], on_q)


@wp.kernel
@no_type_check
def _unit_backward(frames: _Frames, g: _Gradients):
    """From the gradient of each unit normal to that of the sum it was made from."""
    b, v = wp.tid()
    normal, gradient = frames.normals[b, v], g.normals[b, v]
    if not normal[3] > 0.0:
        g.normals[b, v] = wp.vec3(0.0, 0.0, 0.0)
        return
    direction = wp.vec3(normal[0], normal[1], normal[2])
    g.normals[b, v] = (gradient - wp.dot(direction, gradient) * direction) / normal[3]


@wp.kernel
@no_type_check
def _vertices_backward(
    mesh: _Mesh, look: _Look, frames: _Frames, g: _Gradients, g_camera: wp.array2d(dtype=wp.vec3),
    g_focal: wp.array2d(dtype=wp.float32), g_world: wp.array2d(dtype=wp.vec3),
):  # fmt: skip
    """Of each vertex: gradients in camera space and in world space, and its part of that of the focal length."""
    b, v = wp.tid()
    total = g.vertices[b, v]
    for n in range(mesh.starts[v], mesh.starts[v + 1]):
        face, corner = mesh.faces[mesh.incident[n] // 3], mesh.incident[n] % 3
        gradient = g.normals[b, face[0]] + g.normals[b, face[1]] + g.normals[b, face[2]]
        # The sum of (j - i) x (k - i) = j x k + k x i + i x j: each corner by the edge that it does not lie on.
        after, last = frames.vertices[b, face[(corner + 1) % 3]], frames.vertices[b, face[(corner + 2) % 3]]
        total += wp.cross(after - last, gradient)
    point, inverse, focal, on_screen = frames.vertices[b, v], frames.screen[b, v][2], look.focal[0], g.screen[b, v]
    g_x, g_y = inverse * on_screen[0], -inverse * on_screen[1]
    along = point[0] * g_x + point[1] * g_y
    total += wp.vec3(focal * g_x, focal * g_y, (focal * along + inverse * on_screen[2]) * inverse)
    g_camera[b, v] = total
    g_focal[b, v] = along
    m = look.matrix
    g_world[b, v] = wp.vec3(
        m[0, 0] * total[0] + m[1, 0] * total[1] + m[2, 0] * total[2],
        m[0, 1] * total[0] + m[1, 1] * total[1] + m[2, 1] * total[2],
        m[0, 2] * total[0] + m[1, 2] * total[1] + m[2, 2] * total[2],
    )


# The torch function


class Mesh(NamedTuple):
    """As `cpu.Mesh`, of tensors on the device."""

    faces: Tensor
    edges: Tensor
    neighbours: Tensor
    starts: Tensor  # (V + 1,) int32, see `_Mesh`
    incident: Tensor  # (3 F,) int32
    uv: Tensor
    uv_faces: Tensor
    uv_areas: Tensor
    levels: Tensor


class Kept(NamedTuple):
    """The tensors of `_Frames`."""

    vertices: Tensor
    screen: Tensor
    normals: Tensor
    sides: Tensor
    face_img: Tensor
    inverse_img: Tensor
    samples: Tensor
    blended: Tensor
    places: Tensor
    crossings: Tensor


_MESH_KINDS = Mesh(wp.vec3i, wp.vec4i, wp.vec3i, wp.int32, wp.int32, wp.vec2, wp.vec3i, wp.float32, wp.vec3i)
_KEPT_KINDS = Kept(
    wp.vec3, wp.vec3, wp.vec4, wp.uint8, wp.int32, wp.float32, wp.float32, wp.vec4, wp.vec4i, wp.vec3
)  # fmt: skip


class Fused(torch.autograd.Function):
    """As `function.Fused`: the same arguments and results, on the device of the vertices, float32.

    Nothing passes through the CPU but one number, which says whether all vertices are finite.
    """

    @staticmethod
    def forward(
        ctx,
        world: Tensor,
        matrix: Tensor,
        focal: Tensor,
        colors: Tensor,
        texels: Tensor,
        attributes: Tensor,
        light: Tensor,
        phong: Tensor,
        scene: function.Scene,
    ) -> tuple[Tensor | None, ...]:
        batch, count = world.shape[:2]
        height, width, pixels = scene.height, scene.width, scene.height * scene.width
        extra_channels = (3 if scene.with_normals else 0) + attributes.shape[-1]
        inputs = [
            tensor.detach().contiguous() for tensor in (world, matrix, focal, colors, texels, attributes, light, phong)
        ]
        numbers, integers = world.new_empty, partial(world.new_empty, dtype=torch.int32)
        kept = Kept(
            vertices=numbers(batch, count, 3),
            screen=numbers(batch, count, 3),
            normals=numbers(batch, count, 4),
            sides=world.new_empty(batch, len(scene.mesh.faces), dtype=torch.uint8),
            face_img=integers((batch, pixels)),
            inverse_img=numbers(batch, pixels),
            samples=numbers(batch, 3 * pixels, 4 + extra_channels),
            blended=numbers(batch, pixels, 4),
            places=integers((batch, 2 * pixels, 4)),
            crossings=numbers(batch, 2 * pixels, 3),
        )
        mesh, look, frames = _structs(inputs, scene, kept)
        launch = _launcher(world)
        bad = world.new_zeros(1, dtype=torch.int32)
        launch(_project, (batch, count), [_array(inputs[0], wp.vec3), look, frames, _array(bad)])
        launch(_vertex_normals, (batch, count), [mesh, frames])
        nearest = _array(world.new_full((batch, pixels), -1, dtype=torch.int64))
        launch(_rasterize, (batch, len(scene.mesh.faces)), [mesh, look, frames, nearest])
        launch(_shade_pixels, (batch, pixels), [mesh, look, frames, nearest])
        outermost = _array(world.new_full((batch, 2 * pixels), -1, dtype=torch.int64))
        launch(_silhouettes, (batch, len(scene.mesh.edges)), [mesh, look, frames, outermost])
        launch(_crossings, (batch, 2 * pixels), [mesh, look, frames, outermost])
        color, mask = numbers(batch, 3, pixels), numbers(batch, pixels)
        extras = numbers(batch, extra_channels, pixels)
        launch(_encode, (batch, pixels), [look, frames, _array(color), _array(mask), _array(extras)])
        part_img = None
        if scene.parts is not None:
            part_img = world.new_empty(batch, pixels, dtype=torch.int64)
            launch(_parts_at_pixels, (batch, pixels), [mesh, look, frames, _array(scene.parts), _array(part_img)])
            part_img = part_img.view(batch, 1, height, width)
            ctx.mark_non_differentiable(part_img)
        # Waits for the device, so it comes last; until here numbers that are not finite do no harm.
        if bad.item():
            function._report_not_finite(inputs[0])
        color = color.view(batch, 3, height, width)
        if any(ctx.needs_input_grad):
            ctx.scene = scene
            ctx.save_for_backward(*inputs, *kept, color)
            ctx.set_materialize_grads(False)
        return (
            color,
            mask.view(batch, 1, height, width),
            extras.view(batch, extra_channels, height, width),
            kept.inverse_img.clone().view(batch, 1, height, width) if scene.with_depth else None,
            part_img,
        )

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *g_pictures: Tensor | None) -> tuple:
        *saved, color = ctx.saved_tensors
        inputs, kept = saved[: -len(Kept._fields)], Kept(*saved[-len(Kept._fields) :])
        world, _, _, colors, texels, attributes, _, _ = inputs
        _, wants_matrix, wants_focal, wants_colors, wants_texels, wants_attributes, wants_light, wants_phong, _ = (
            ctx.needs_input_grad
        )
        scene = ctx.scene
        batch, count = world.shape[:2]
        pixels = scene.height * scene.width
        mesh, look, frames = _structs(inputs, scene, kept)
        launch = _launcher(world)
        g_colors = torch.zeros_like(colors) if wants_colors else colors.new_zeros(0, 3)
        g_texels = torch.zeros_like(texels) if wants_texels else texels.new_zeros(0, 3)
        g_attributes = torch.zeros_like(attributes) if wants_attributes else attributes.new_zeros(0, 0, 0)
        sums, g_samples = world.new_zeros(_SLOTS, 8), torch.empty_like(kept.samples)
        g = _Gradients()
        g.vertices, g.normals, g.screen = (_array(torch.zeros_like(kept.vertices), wp.vec3) for _ in range(3))
        g.colors, g.texels, g.attributes = _array(g_colors, wp.vec3), _array(g_texels, wp.vec3), _array(g_attributes)
        g.samples, g.sums = _array(g_samples), _array(sums)
        g.wants_sums = int(wants_focal or wants_light or wants_phong)
        channels = kept.samples.shape[2]
        shapes = (batch, 3, pixels), (batch, pixels), (batch, channels - 4, pixels), (batch, pixels)
        g_color, g_mask, g_extras, g_inverse = (
            _array(world.new_zeros([0] * len(shape)) if gradient is None else gradient.contiguous().view(shape))
            for gradient, shape in zip(g_pictures[:4], shapes)
        )
        g_blended = _array(world.new_empty(batch, pixels, channels))
        launch(
            _encode_backward, (batch, pixels),
            [look, frames, _array(color.view(batch, 3, pixels)), g_color, g_mask, g_extras, g, g_blended],
        )  # fmt: skip
        launch(_blend_backward, (batch, 2 * pixels), [mesh, look, frames, g_blended, g])
        launch(_shade_backward, (batch, 3 * pixels), [mesh, look, frames, g_inverse, g])
        launch(_unit_backward, (batch, count), [frames, g])
        g_world, g_camera, g_focal = torch.empty_like(world), torch.empty_like(world), world.new_empty(batch, count)
        launch(
            _vertices_backward, (batch, count),
            [mesh, look, frames, g, _array(g_camera, wp.vec3), _array(g_focal), _array(g_world, wp.vec3)],
        )  # fmt: skip
        g_matrix, total = None, sums.sum(0)
        if wants_matrix:
            turned = (g_camera[..., :, None] * world[..., None, :]).sum((0, 1))
            g_matrix = torch.cat([turned, g_camera.sum((0, 1))[:, None]], 1)
        return (
            g_world,
            g_matrix,
            total[7] + g_focal.sum() if wants_focal else None,
            g_colors if wants_colors else None,
            g_texels if wants_texels else None,
            g_attributes if wants_attributes else None,
            total[:3] if wants_light else None,
            total[3:7] if wants_phong else None,
            None,
        )


def array(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """As the kernels want what takes no gradient."""
    return tensor.detach().to(dtype).contiguous()


def topology(faces: Tensor, vertex_count: int) -> tuple[Tensor, ...]:
    """The first five fields of `Mesh`; remembered for the last few `faces` tensors.

    Raises:
        ValueError: A face names a vertex that is not there.
    """
    return function.topology(faces, vertex_count, _topology)


def _topology(faces: Tensor, edges: Tensor, neighbours: Tensor, vertex_count: int) -> tuple[Tensor, ...]:
    corners = faces.flatten()
    counts = torch.bincount(corners, minlength=vertex_count)
    starts = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
    incident = torch.argsort(corners, stable=True)
    return tuple(array(tensor, torch.int32) for tensor in (faces, edges, neighbours, starts, incident))


def _array(tensor: Tensor, kind: type | None = None) -> wp.array:
    """The same memory, as Warp wants it."""
    return wp.from_torch(tensor, dtype=kind, requires_grad=False)


def _launcher(tensor: Tensor):
    """wp.launch on the device of a tensor, there in the order of what torch does."""
    if tensor.is_cuda:
        stream = wp.stream_from_torch(torch.cuda.current_stream(tensor.device))
        _load(str(stream.device))
        return partial(wp.launch, stream=stream, record_tape=False)
    _load("cpu")
    return partial(wp.launch, device="cpu", record_tape=False)


@contextmanager
def _quiet():
    """Warp reports on standard output, where results go."""
    level = wp.config.log_level
    wp.config.log_level = max(level, wp.LOG_WARNING)
    try:
        yield
    finally:
        wp.config.log_level = level


@cache
def _load(device: str) -> None:
    """Compiles the kernels for a device, or finds them in Warp's cache; says so if it takes more than a moment."""
    text = f"render: compiling for {device}, once; later starts take under a second"
    notice = Timer(1.0, print, [text], {"file": sys.stderr})
    notice.daemon = True
    notice.start()
    try:
        with _quiet():
            wp.load_module(sys.modules[__name__], device=device)
    finally:
        notice.cancel()


def _structs(inputs: list[Tensor], scene: function.Scene, kept: Kept) -> tuple:
    mesh, look, frames = _Mesh(), _Look(), _Frames()
    arrays = scene.mesh._replace(levels=scene.mesh.levels.int())
    for struct, tensors, kinds in ((mesh, arrays, _MESH_KINDS), (frames, kept, _KEPT_KINDS)):
        for name, tensor, kind in zip(tensors._fields, tensors, kinds):
            setattr(struct, name, _array(tensor, kind))
    _, matrix, focal, colors, texels, attributes, light, phong = inputs
    look.matrix, look.focal, look.light, look.phong = map(_array, (matrix, focal.view(1), light, phong))
    look.colors, look.texels, look.attributes = _array(colors, wp.vec3), _array(texels, wp.vec3), _array(attributes)
    look.background, look.axis = _array(scene.background), wp.vec2(*scene.axis)
    look.height, look.width, look.has_normals = scene.height, scene.width, int(scene.with_normals)
    return mesh, look, frames


with _quiet():
    wp.init()
