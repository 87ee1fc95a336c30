"""Tetrahedra: volumes, gradients, stiffness; and kernels that turn, untangle and hit them."""

from __future__ import annotations

import inspect
from collections.abc import Callable

import numba
import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import coo_array, csr_array
from scipy.sparse.linalg import SuperLU, splu


def tet_volumes(points: Float[ndarray, "X 3"], tets: Int[ndarray, "M 4"]) -> Float[ndarray, "M"]:
    """Signed volume of each."""
    a, b, c, d = points[tets].swapaxes(0, 1)
    return np.einsum("mi,mi->m", np.cross(b - a, c - a), d - a) / 6


def volume_gradient(points: Float[ndarray, "X 3"], tets: Int[ndarray, "M 4"], count: int) -> Float[ndarray, "X 3"]:
    """How the sum of all volumes grows as each of `count` points moves, in square units of the points."""
    a, b, c, d = points[tets].swapaxes(0, 1)
    slopes = np.stack([np.cross(c - d, b - d), np.cross(a - d, c - d), np.cross(b - d, a - d)], 1) / 6
    slopes = np.concatenate([slopes, -slopes.sum(1, keepdims=True)], 1)
    return np.stack([np.bincount(tets.ravel(), slopes[..., i].ravel(), count) for i in range(3)], 1)


def hat_gradients(points: Float[ndarray, "X 3"], tets: Int[ndarray, "M 4"]) -> Float[ndarray, "M 4 3"]:
    """Gradient of each corner's hat function."""
    corners = points[tets]
    edges = (corners[:, 1:] - corners[:, :1]).swapaxes(1, 2)  # as columns
    slopes = np.linalg.inv(edges)  # rows are gradients of the second to fourth corner
    return np.ascontiguousarray(np.concatenate([-slopes.sum(1, keepdims=True), slopes], 1))


def stiffness_matrix(
    vectors: Float[ndarray, "M 4 3"], tets: Int[ndarray, "M 4"], weights: Float[ndarray, "M"], count: int
) -> csr_array:
    """Matrix K with x K x = sum of weight |F|^2 for each coordinate x of the nodes."""
    blocks = np.einsum("mai,mbi->mab", vectors, vectors) * weights[:, None, None]
    rows, columns = np.repeat(tets, 4, axis=1).ravel(), np.tile(tets, (1, 4)).ravel()
    return coo_array((blocks.ravel(), (rows, columns)), shape=(count, count)).tocsr()


def factored(matrix) -> SuperLU:
    """Factors of a symmetric, positive definite matrix, without pivoting."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def compiled(function: Callable) -> Callable:
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=True)(inspect.unwrap(function))


@compiled
def scatter(sides, tets, vectors, matrices):
    """Adds matrix x vector of each corner to its node's row: the right side for wanted gradients."""
    for e in range(len(tets)):
        for c in range(4):
            node = tets[e, c]
            for i in range(3):
                total = 0.0
                for j in range(3):
                    total += matrices[e, i, j] * vectors[e, c, j]
                sides[node, i] += total


@compiled
def gradient_of(points, tet, vectors, f):
    """The gradient of one tetrahedron, in place: sum over its corners of place x gradient of the hat function."""
    for i in range(3):
        for j in range(3):
            total = 0.0
            for c in range(4):
                total += points[tet[c], i] * vectors[c, j]
            f[i, j] = total


@compiled
def nearest_rotations(points, tets, vectors, turns, steps):
    """Rotations closest to the gradients, from those of the last time, in place; a few steps of a safe iteration.

    Source: Müller et al. 2016, "A robust method to extract the rotational part of deformations",
    doi:10.1145/2994258.2994269; it is never a reflection, even where a tetrahedron is turned inside out.
    """
    f, r = np.empty((3, 3)), np.empty((3, 3))
    for e in range(len(tets)):
        gradient_of(points, tets[e], vectors[e], f)
        r[:] = turns[e]
        for _ in range(steps):
            if turn_towards(f, r) < 1e-6:
                break
        turns[e] = r


@compiled
def turn_towards(f, r):
    """One step of a rotation, in place, towards the matrix; returns the square of its angle."""
    x = y = z = 0.0
    along = 0.0
    for j in range(3):
        x += r[1, j] * f[2, j] - r[2, j] * f[1, j]
        y += r[2, j] * f[0, j] - r[0, j] * f[2, j]
        z += r[0, j] * f[1, j] - r[1, j] * f[0, j]
        along += r[0, j] * f[0, j] + r[1, j] * f[1, j] + r[2, j] * f[2, j]
    scale = 1.0 / (abs(along) + 1e-9)
    x, y, z = x * scale, y * scale, z * scale
    square = x * x + y * y + z * z
    # Rotation by Rodrigues with half the tangent: (1 - w^2/4 ...) is the exact Cayley map of the vector.
    k = 2.0 / (4.0 + square)
    for j in range(3):
        a, b, c = r[0, j], r[1, j], r[2, j]
        u, v, w = y * c - z * b, z * a - x * c, x * b - y * a
        r[0, j] = a + k * (2.0 * u + (y * w - z * v))
        r[1, j] = b + k * (2.0 * v + (z * u - x * w))
        r[2, j] = c + k * (2.0 * w + (x * v - y * u))
    return square


@compiled
def untangle(nodes, tets, least, mobility, sweeps):
    """Moves nodes, in place, until each tetrahedron has its least volume; whether they all have.

    Source: the projection of position-based dynamics (Müller et al. 2007) on the volume of one after another.
    """
    for _ in range(sweeps):
        done = True
        for e in range(len(tets)):
            a, b, c, d = nodes[tets[e, 0]], nodes[tets[e, 1]], nodes[tets[e, 2]], nodes[tets[e, 3]]
            slopes = np.empty((4, 3))
            for corner in range(3):
                u, v = (c - a, d - a) if corner == 0 else ((d - a, b - a) if corner == 1 else (b - a, c - a))
                slopes[corner + 1, 0] = (u[1] * v[2] - u[2] * v[1]) / 6
                slopes[corner + 1, 1] = (u[2] * v[0] - u[0] * v[2]) / 6
                slopes[corner + 1, 2] = (u[0] * v[1] - u[1] * v[0]) / 6
            slopes[0] = -(slopes[1] + slopes[2] + slopes[3])
            volume = 0.0
            for i in range(3):
                volume += (b[i] - a[i]) * slopes[1, i]
            if volume >= least[e]:
                continue
            done = False
            total = 1e-300
            for corner in range(4):
                for i in range(3):
                    total += mobility[tets[e, corner]] * slopes[corner, i] ** 2
            step = (1.1 * least[e] - volume) / total
            for corner in range(4):
                for i in range(3):
                    nodes[tets[e, corner], i] += step * mobility[tets[e, corner]] * slopes[corner, i]
        if done:
            return True
    return False


@compiled
def first_hits(origins, directions, triangles, corners, limit, own):
    """Distance along each ray to the first triangle; own ones count from inside only, and not around the origin."""
    reach = np.full(len(origins), np.inf)
    centres = np.empty((len(triangles), 3))
    radii = np.empty(len(triangles))
    for f in range(len(triangles)):
        for i in range(3):
            centres[f, i] = (triangles[f, 0, i] + triangles[f, 1, i] + triangles[f, 2, i]) / 3
        radius = 0.0
        for c in range(3):
            square = 0.0
            for i in range(3):
                square += (triangles[f, c, i] - centres[f, i]) ** 2
            radius = max(radius, square)
        radii[f] = np.sqrt(radius)
    for n in range(len(origins)):
        ox, oy, oz = origins[n, 0], origins[n, 1], origins[n, 2]
        dx, dy, dz = directions[n, 0], directions[n, 1], directions[n, 2]
        mx, my, mz = ox + dx * limit / 2, oy + dy * limit / 2, oz + dz * limit / 2
        for f in range(len(triangles)):
            gap = limit / 2 + radii[f]
            if (centres[f, 0] - mx) ** 2 + (centres[f, 1] - my) ** 2 + (centres[f, 2] - mz) ** 2 > gap * gap:
                continue
            if corners[f, 0] == n or corners[f, 1] == n or corners[f, 2] == n:
                continue
            t = triangles[f]
            ax, ay, az = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
            bx, by, bz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
            nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
            facing = nx * dx + ny * dy + nz * dz
            if own and facing <= 0:
                continue
            if abs(facing) < 1e-300:
                continue
            px, py, pz = ox - t[0, 0], oy - t[0, 1], oz - t[0, 2]
            along = -(nx * px + ny * py + nz * pz) / facing
            if along <= 0 or along >= min(limit, reach[n]):
                continue
            hx, hy, hz = px + along * dx, py + along * dy, pz + along * dz
            aa, ab, bb = ax * ax + ay * ay + az * az, ax * bx + ay * by + az * bz, bx * bx + by * by + bz * bz
            ha, hb = hx * ax + hy * ay + hz * az, hx * bx + hy * by + hz * bz
            area = aa * bb - ab * ab
            v, w = (bb * ha - ab * hb) / area, (aa * hb - ab * ha) / area
            if v >= 0 and w >= 0 and v + w <= 1:
                reach[n] = along
    return reach
