"""Weights of a rig that come closest to given vertices: bounded least squares, exact and fast.

Chuang & Bregler 2002, "Performance Driven Facial Animation using Blendshape Interpolation", Eq. 4, asks for weights
that are not negative; an upper bound of 1 is as natural for sculpted shapes. Lawson & Hanson 1974, "Solving Least
Squares Problems", and Stark & Parker 1995, "Bounded-Variable Least-Squares", give the active-set method. All frames of
a clip share one Gram matrix, so a frame costs its K projections and one small factorisation, whatever the number of
vertices.

Symbol  Code         Shape
P       deltas       (K, 3 N) offsets of each shape at N points, as rows
H       gram         (K, K) P P^T
b       projections  (T, K) displacements of each frame times P^T
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numba
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Places
from reenact.rigs.rig import Rig

_CHUNK = 256  # frames at a time: bounds memory, not results
_BLOCK = 256
"""Frames in a row that one thread solves, the first of them from rest."""


def nonnegative_least_squares(
    gram: Float[Tensor, "K K"],
    projections: Float[Tensor, "T K"],
    low: float = 0.0,
    high: float = math.inf,
    start: Float[Tensor, "T K"] | None = None,
    ridge: float = 1e-8,
    smoothness: float = 0.0,
) -> Float[Tensor, "T K"]:
    """Weights w of each frame that minimise w^T H w - 2 b^T w between the bounds, in float64.

    The result meets the optimality conditions to rounding: no gradient where a weight is inside its bounds, and none
    that points inward where it rests on one. Sweeps over single coordinates, warm from the frame before, find which
    weights rest on a bound; an active-set method then ends exactly.

    Args:
        gram: Symmetric, positive semidefinite.
        projections: Right-hand sides, one a frame.
        low: Smallest weight; -inf for plain least squares.
        high: Largest weight.
        start: Weights to start each frame from, instead of those of the frame before; changes the time, not the result.
        ridge: Share of the mean of H's diagonal that is added to it where H is not definite by as much. Among weights
            that fit alike it prefers small ones; a second solve pulls towards the first instead of to 0, so that it
            biases nothing else.
        smoothness: Weight of the squared change between frames, in the units of H; 0 makes frames independent. The
            optimum is then joint, over the whole clip.

    Source: CB02, Eq. 4; Stark & Parker 1995. The bounds, ridge and smoothness are ours.
    """
    if not low < high:
        raise ReenactError(f"least squares: expected low < high, got {low} and {high}")
    matrix = gram.detach().cpu().to(torch.float64).numpy()
    wanted = np.ascontiguousarray(projections.detach().cpu().to(torch.float64).numpy())
    if not (np.isfinite(matrix).all() and np.isfinite(wanted).all()):
        raise ReenactError("least squares: expected finite numbers, got NaN or infinity")
    matrix = (matrix + matrix.T) / 2
    extra = ridge * float(np.trace(matrix)) / max(len(matrix), 1)
    if _definite(matrix, extra):
        extra = 0.0  # one solution, well told apart
    # The tiny constant keeps shapes that move nothing solvable: they get 0, or the bound that is nearest to 0.
    matrix = np.ascontiguousarray(matrix + (extra + 1e-300) * np.eye(len(matrix)))
    rest = min(max(0.0, low), high)
    weights = np.full(wanted.shape, rest) if start is None else start.detach().cpu().to(torch.float64).numpy().copy()

    def solve(wanted: np.ndarray, chained: bool) -> None:
        by_blocks(lambda block: _solve(matrix, wanted[block], low, high, weights[block], chained), len(wanted))

    solve(wanted, start is None)
    if extra > 0:
        solve(wanted + extra * weights, False)
    if smoothness > 0 and len(weights) > 1:
        _smooth(matrix, wanted + extra * weights, low, high, smoothness, weights)
    return torch.from_numpy(weights)


def _definite(matrix: np.ndarray, margin: float) -> bool:
    """Whether the smallest eigenvalue exceeds the margin."""
    try:
        np.linalg.cholesky(matrix - margin * np.eye(len(matrix)))
    except np.linalg.LinAlgError:
        return False
    return bool(margin > 0)


class InverseRig:
    """Explains vertices as weights of a rig; the Gram matrix is made once."""

    def __init__(self, rig: Rig, places: Places | None = None, importance: Float[Tensor, "N"] | None = None) -> None:
        """
        Args:
            rig: Its shapes explain the vertices.
            places: Only these points of the surface count; all vertices where None.
            importance: How much the squared error of each point counts; 1 where None.
        """
        self.rig, self.places = rig, places
        deltas = rig.deltas if places is None else places.of(rig.deltas)  # (K, N, 3)
        self._deltas = deltas.to(torch.float64)
        if importance is not None and len(importance) != deltas.shape[1]:
            raise ReenactError(f"{rig.name}: expected {deltas.shape[1]} importances, got {len(importance)}")
        weighted = self._deltas if importance is None else self._deltas * importance.to(self._deltas)[None, :, None]
        self._weighted = weighted.flatten(1)
        self.gram = self._weighted @ self._deltas.flatten(1).T

    @property
    def condition(self) -> float:
        """How much an error in the vertices may grow in the weights, squared: the condition number of H.

        Infinite where shapes depend on each other linearly; their weights cannot be told apart.
        """
        values = torch.linalg.eigvalsh(self.gram)
        if values[0] <= len(values) * torch.finfo(torch.float64).eps * values[-1]:
            return math.inf
        return float(values[-1] / values[0])

    def projections(self, vertices: Float[Tensor, "T V 3"]) -> Float[Tensor, "T K"]:
        """b: what every shape has in common with the displacement of each frame."""
        if vertices.shape[1] != len(self.rig.neutral):
            raise ReenactError(
                f"{self.rig.name}: expected {len(self.rig.neutral)} vertices a frame, got {vertices.shape[1]}; give "
                "meshes of the rig's own topology"
            )
        rows = []
        for chunk in vertices.split(_CHUNK):
            moved = chunk.to(torch.float64) - self.rig.neutral.to(torch.float64)
            moved = moved if self.places is None else self.places.of(moved)
            rows.append(moved.flatten(1) @ self._weighted.T)
        return torch.cat(rows) if rows else self.gram.new_zeros(0, len(self.gram))

    def __call__(
        self,
        vertices: Float[Tensor, "T V 3"],
        ridge: float = 1e-8,
        smoothness: float = 0.0,
        low: float = 0.0,
        high: float = 1.0,
    ) -> Float[Tensor, "T K"]:
        """See `fit_weights`."""
        weights = nonnegative_least_squares(
            self.gram, self.projections(vertices), low, high, ridge=ridge, smoothness=smoothness
        )
        return weights.to(self.rig.deltas.dtype)


def fit_weights(
    rig: Rig,
    vertices: Float[Tensor, "T V 3"],
    places: Places | None = None,
    ridge: float = 1e-8,
    smoothness: float = 0.0,
    low: float = 0.0,
    high: float = 1.0,
) -> Float[Tensor, "T K"]:
    """Blendshape weights whose expressions lie closest to the given vertices.

    Args:
        rig: Explains the vertices; same topology, head pose removed.
        vertices: Positions in metres, in the rig's own frame.
        places: Only these points of the surface count; all vertices where None.
        ridge: See `nonnegative_least_squares`.
        smoothness: Penalty on change between frames, square metres; 0 makes frames independent.
        low: Smallest weight.
        high: Largest weight.

    Raises:
        ReenactError: `vertices` has a different vertex count from `rig`.

    Source: the least squares problem of CB02, Eq. 4, on offsets from the neutral; we add the upper bound.
    """
    return InverseRig(rig, places)(vertices, ridge, smoothness, low, high)


def by_blocks(work: Callable[[slice], object], count: int) -> None:
    """Does work on some hundred frames at a time, on as many threads as torch has.

    Blocks do not depend on the number of threads, and neither do results. Ours.

    Args:
        work: Solves the frames of a slice, in place; it must let go of Python's lock to gain anything.
        count: Frames in all.
    """
    blocks = [slice(start, start + _BLOCK) for start in range(0, count, _BLOCK)]
    workers = min(torch.get_num_threads(), len(blocks))
    if workers < 2:
        for block in blocks:
            work(block)
        return
    with ThreadPoolExecutor(workers) as pool:
        list(pool.map(work, blocks))


# The loops, on numpy arrays -------------------------------------------------------------------------------------------


def _compiled(function):
    # An import hook that checks types, as in our tests, wraps every function; the compiler needs the bare one.
    return numba.njit(cache=True, nogil=True, error_model="numpy")(inspect.unwrap(function))


@_compiled
def _solve(gram, projections, low, high, weights, chained):
    """Solves every frame in place; `chained` starts each from the result of the one before."""
    for frame in range(len(weights)):
        if chained and frame > 0:
            weights[frame] = weights[frame - 1]
        _solve_one(gram, projections[frame], low, high, weights[frame])


@_compiled
def _smooth(gram, projections, low, high, smoothness, weights):
    """Gauss-Seidel over frames, to and fro: each is solved exactly given its neighbours, until none moves."""
    frames, count = weights.shape
    inner, outer = gram.copy(), gram.copy()
    for k in range(count):
        inner[k, k] += 2 * smoothness
        outer[k, k] += smoothness
    for _ in range(2000):
        moved = 0.0
        for turn in range(2 * frames):
            frame = turn if turn < frames else 2 * frames - 1 - turn
            wanted = projections[frame].copy()
            if frame > 0:
                wanted += smoothness * weights[frame - 1]
            if frame < frames - 1:
                wanted += smoothness * weights[frame + 1]
            before = weights[frame].copy()
            end = frame in (0, frames - 1)
            _solve_one(outer if end else inner, wanted, low, high, weights[frame])
            moved = max(moved, np.abs(weights[frame] - before).max())
        if moved < 1e-9:
            break


@_compiled
def _solve_one(gram, wanted, low, high, weights):
    """One frame in place: a few coordinate sweeps to guess the free set, then Stark & Parker's active set."""
    count = len(weights)
    # Moves of a weight by less than 1e-8 of the largest weights that such a right-hand side asks for are rounding.
    tolerance = 1e-8 * np.sqrt((wanted * wanted).sum()) / np.diag(gram).max()
    free = np.empty(count, np.bool_)
    for k in range(count):
        weights[k] = min(max(weights[k], low), high)
    gradient = gram @ weights - wanted
    for sweep in range(4):
        settled = sweep > 1
        for k in range(count):
            value = min(max(weights[k] - gradient[k] / gram[k, k], low), high)
            change = value - weights[k]
            if change != 0.0:
                weights[k] = value
                for j in range(count):
                    gradient[j] += change * gram[k, j]
            inside = low < value < high
            settled = settled and inside == free[k]
            free[k] = inside
        if settled:
            break
    factor = np.empty((count, count))
    chosen = np.empty(count, np.int64)
    step = np.empty(count)
    pulls = np.empty(count)
    fewest = count + 1
    barred = np.zeros(count, np.bool_)  # freed, and found unable to move: rounding
    for _ in range(20 * count + 20):
        # Move to the minimum over the free weights, as far as the bounds allow; what meets a bound stays there.
        while True:
            size = 0
            for k in range(count):
                if free[k]:
                    chosen[size] = k
                    size += 1
            if size == 0:
                break
            for row in range(size):  # the Newton step of the free block
                step[row] = -_gradient(gram, wanted, weights, chosen[row])
            _cholesky_solve(gram, chosen, size, factor, step)
            share, blocking = 1.0, -1
            for row in range(size):
                k = chosen[row]
                end = weights[k] + step[row]
                if end < low:
                    reach = (low - weights[k]) / step[row]
                elif end > high:
                    reach = (high - weights[k]) / step[row]
                else:
                    continue
                if reach < share:
                    share, blocking = reach, row
            if blocking >= 0 and _clipped_falls(gram, wanted, weights, chosen, size, step, low, high):
                # All that would pass a bound stop there at once: still downhill, and many rounds fewer.
                for row in range(size):
                    k = chosen[row]
                    end = weights[k] + step[row]
                    weights[k] = min(max(end, low), high)
                    free[k] = low <= end <= high
                barred[:] = False
                continue
            for row in range(size):
                k = chosen[row]
                weights[k] = min(max(weights[k] + share * step[row], low), high)
            if share > 0:
                barred[:] = False
            if blocking < 0:
                break
            k = chosen[blocking]
            weights[k] = low if step[blocking] < 0 else high
            free[k], barred[k] = False, share <= 0
        # Free what its bound holds back: all of it while that keeps getting less, then one at a time, which must end.
        held, worst, worst_pull = 0, -1, tolerance
        for k in range(count):
            pulls[k] = 0.0
            if not free[k] and not barred[k]:
                slope = _gradient(gram, wanted, weights, k)
                pulls[k] = (-slope if weights[k] <= low else slope) / gram[k, k]
                if pulls[k] > tolerance:
                    held += 1
                if pulls[k] > worst_pull:
                    worst, worst_pull = k, pulls[k]
        if worst < 0:
            break
        if held < fewest:
            fewest = held
            for k in range(count):
                free[k] = free[k] or pulls[k] > tolerance
        free[worst] = True


@_compiled
def _clipped_falls(gram, wanted, weights, chosen, size, step, low, high):
    """Whether the whole step, each weight stopped at its bounds, lowers the objective."""
    change = np.zeros(len(weights))
    for row in range(size):
        k = chosen[row]
        change[k] = min(max(weights[k] + step[row], low), high) - weights[k]
    fall = 0.0
    for row in range(size):
        k = chosen[row]
        if change[k] != 0.0:
            slope = _gradient(gram, wanted, weights, k)
            for j in range(len(weights)):
                slope += 0.5 * gram[k, j] * change[j]
            fall += change[k] * slope
    return fall < 0


@_compiled
def _gradient(gram, wanted, weights, k):
    slope = -wanted[k]
    for j in range(len(weights)):
        slope += gram[k, j] * weights[j]
    return slope


@_compiled
def _cholesky_solve(gram, chosen, size, factor, vector):
    """Replaces the first `size` entries of the vector by the solution of the chosen block of the Gram matrix."""
    for i in range(size):
        for j in range(i + 1):
            value = gram[chosen[i], chosen[j]]
            for m in range(j):
                value -= factor[i, m] * factor[j, m]
            if i == j:
                # Rounding may push the pivot of a dependent shape below 0; it then keeps still.
                factor[i, i] = np.sqrt(value) if value > 1e-14 * gram[chosen[i], chosen[i]] else 1e150
            else:
                factor[i, j] = value / factor[j, j]
    for i in range(size):
        for m in range(i):
            vector[i] -= factor[i, m] * vector[m]
        vector[i] /= factor[i, i]
    for i in range(size - 1, -1, -1):
        for m in range(i + 1, size):
            vector[i] -= factor[m, i] * vector[m]
        vector[i] /= factor[i, i]
