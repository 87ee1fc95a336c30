"""Faces at rest under elasticity, volume, muscles, contact and force: a quasi-static solve for every frame.

AnaConDaR, "Anatomically Constrained Data-Adaptive Facial Retargeting", 2024, ends in "a quasi-static physics-based
simulation", which "enables artistic interventions on material properties, can incorporate external forces, and
preserves expression-specific characteristics"; the text that we have does not tell its energies. These are our
reconstruction, in the form of Bouaziz et al. 2014, "Projective Dynamics: Fusing Constraint Projections for Fast
Simulation", doi:10.1145/2601097.2601116: each term draws to a projection of where the nodes are, and the
sum is solved with one matrix that never changes.

    min_X  sum_e elasticity vol_e |F_e - Q_e|^2                  Q_e the rotation closest to F_e
         + sum_e volume vol_e |F_e - P_e|^2                      P_e the closest with a determinant in 1 +- band
         + sum_e in muscle  muscle vol_e |F_e - Q_e A_e|^2       A_e the stretch that the transfer asks for
         + sum_v skin area_v |x_v - target_v|^2
         + characteristics |slits, widths and contours - those of the source in the target's size|^2
         + contact |x_v - surface|^2 where v is inside the other lip, the other lid or a tooth
         - force . X,    skull, jaw and the border of the face held
    subject to    volume of all tissue in 1 +- whole

Lengths are in heights of the face, so that weights are numbers and size does not matter. What contact is left after the
last step is taken out by moving both sides apart.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import coo_array, diags_array
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.anatomy import Shell
from reenact.retargeting.contact import Side
from reenact.retargeting.tetrahedra import (
    compiled,
    factored,
    gradient_of,
    nearest_rotations,
    stiffness_matrix,
    tet_volumes,
    turn_towards,
    volume_gradient,
)

_GRAVITY = 0.125
"""Half of density x gravity x height of the face / shear modulus: 1,000 kg/m^3, 9.8 m/s^2, 0.125 m, 5 kPa."""
_TEETH = 0.06
"""Share of H that a lip may lie behind the surface of a tooth and still be pushed out in front."""


@dataclass(frozen=True)
class PhysicsConfig:
    """Weights of the terms, 0 leaves one out; elasticity 1 is the unit."""

    elasticity: float = 1.0
    """Tissue keeps its shape."""
    volume: float = 10.0
    """Tissue keeps its volume."""
    band: float = 0.005
    """Share by which the volume of a tetrahedron may change for nothing."""
    whole: float = 0.01
    """Share by which the volume of all tissue may change at most."""
    muscle: float = 1.0
    """Muscle has the stretch that the transfer asks for."""
    skin: float = 6400.0
    """Skin lies where data and transfer put it, unless contact or the volume of all tissue object; a layer of 0.08 H
    pulls with 12. Sculpted expressions stretch a fifth of the tissue by more than a fifth, so a skin that yields to
    elasticity and volume leaves them. With 400 it yields by 0.01 of VER; with 1 to 20 tissue hangs, and forces show."""
    characteristics: float = 0.1
    """Slits, widths and contours are the source's, in shares of what holds the skin there. With 0.5 examples that know
    better lose by 0.001 of VER."""
    contact: float = 20.0
    """Lips, lids and teeth do not pass through each other, in shares of what holds the skin there."""
    iterations: int = 15
    """Local and global steps."""
    contact_every: int = 3
    """Steps between two searches for contact."""
    clean: int = 30
    """Most rounds that take out what contact is left."""

    def __post_init__(self) -> None:
        weights = (self.elasticity, self.volume, self.muscle, self.skin, self.characteristics, self.contact)
        if min(weights) < 0 or self.band < 0 or self.whole < 0 or self.iterations < 1 or self.contact_every < 1:
            raise ReenactError("physics: expected weights that are not negative and at least one iteration")
        if max(self.elasticity, self.volume, self.muscle) == 0 or self.skin == 0:
            raise ReenactError("physics: expected a weight for the skin and one for tissue, got 0; drop the physics")


class FacePhysics:
    """Puts expressions of one rig to rest; set up once for a material, then called for any frames."""

    def __init__(
        self,
        shell: Shell,
        config: PhysicsConfig | None = None,
        *,
        stiffness: Float[Tensor, "V"] | None = None,
        trust: Float[Tensor, "V"] | None = None,
    ) -> None:
        """
        Args:
            shell: Tissue of the rig.
            config: Weights.
            stiffness: Factor of elasticity and muscle under each vertex of the rig; 1 where None. Stiff tissue follows
                its bone and keeps its shape, soft tissue follows the skin and sags.
            trust: Factor of the skin's hold on its target at each vertex of the rig; 1 where None.

        Raises:
            ReenactError: A stiffness or trust is not positive, or there are too few or too many.
        """
        self.shell, self.config = shell, config or PhysicsConfig()
        factors = {
            name: _per_node(shell, name, values) for name, values in (("stiffness", stiffness), ("trust", trust))
        }
        self.seconds: dict[str, float] = {}
        """What each part of the last call took, seconds a frame."""
        self._assemble(**factors)
        self._prepare_contact()

    def _assemble(self, stiffness: Float[ndarray, "N"], trust: Float[ndarray, "N"]) -> None:
        """The one matrix and its factors."""
        shell, config = self.shell, self.config
        count, nodes = len(shell), len(shell.nodes)
        factor = stiffness[shell.tets % count].mean(1)
        unit = shell.volumes / shell.height**3
        self._weights = np.stack(
            [
                config.elasticity * unit * factor,
                config.volume * unit,
                np.where(shell.muscle, config.muscle * unit * factor, 0.0),
            ],
            1,
        )  # (M, 3)
        matrix = stiffness_matrix(shell.gradient_vectors, shell.tets, self._weights.sum(1), nodes)
        self._fascia = 1e-3 * matrix.diagonal()
        self._skin = config.skin * trust * shell.skin_areas / shell.height**4
        diagonal = self._fascia.copy()
        diagonal[:count] += self._skin
        # Contact weighs on lips and lids only; where nothing touches it draws a node to where it is.
        touching = np.zeros(count, bool)
        number = np.full(len(shell.rig.neutral), -1)
        number[shell.vertices.numpy()] = np.arange(count)
        for contact in shell.contacts.values():
            touching[number[torch.cat([contact.upper, contact.lower]).numpy()]] = True
        self._number, self._touching = number, np.flatnonzero(touching)
        self._contact = config.contact * self._skin[self._touching]
        diagonal[self._touching] += self._contact

        self._edges = feature_nodes(shell)
        self._edge_weights = config.characteristics * self._skin[self._edges].mean(1)
        ends, weights = self._edges, self._edge_weights
        rows = np.concatenate([ends[:, 0], ends[:, 1], ends[:, 0], ends[:, 1]])
        columns = np.concatenate([ends[:, 0], ends[:, 1], ends[:, 1], ends[:, 0]])
        values = np.concatenate([weights, weights, -weights, -weights])
        matrix = matrix + diags_array(diagonal) + coo_array((values, (rows, columns)), shape=(nodes, nodes))
        held = (shell.bone > 0) | shell.border
        self._held, self._free = np.flatnonzero(held), np.flatnonzero(~held)
        matrix = matrix.tocsr()
        self._factor = factored(matrix[self._free][:, self._free])
        self._cross = matrix[self._free][:, self._held].tocsr()

    def _prepare_contact(self) -> None:
        """Sides that meet, and how deep they lie in each other at rest, which is left so."""
        shell = self.shell
        self._meetings: list[tuple[Side, Side, float, bool]] = []
        for name, contact in shell.contacts.items():
            limit = (0.06 if name == "lips" else 0.03) * shell.height
            upper, lower = (Side.of(shell.rig, side.numpy()) for side in (contact.upper, contact.lower))
            self._meetings += [(upper, lower, limit, True), (lower, upper, limit, True)]
        if "lips" in shell.contacts and len(shell.colliders):
            lips = shell.contacts["lips"]
            skin = Side.of(shell.rig, torch.cat([lips.upper, lips.lower]).numpy())
            self._meetings.append((skin, Side.of(shell.rig, shell.colliders), _TEETH * shell.height, False))
        neutral = shell.rig.neutral.double().numpy()
        self._allowed = []
        for side, other, limit, mutual in self._meetings:
            inside, distance, *_ = side.hits(neutral, other, limit, mutual)
            self._allowed.append(np.where(inside, distance, 0.0))

    def __call__(
        self,
        targets: Float[Tensor, "T V 3"],
        *,
        states: Float[Tensor, "T X 3"] | None = None,
        features: Float[Tensor, "T C 3"] | None = None,
        force: Float[Tensor, "*shape"] | None = None,
    ) -> Float[Tensor, "T V 3"]:
        """Meshes at rest, in metres.

        Args:
            targets: Where data and transfer put the vertices; teeth among them, or the chin, say where the jaw is.
            states: Tissue that the transfer asks for, whose stretch is the activation of the muscles; without it they
                keep their shape.
            features: Of the source, by `features` of its shell; without them those of the targets are kept.
            force: On tissue, as a multiple of its weight: (3,) for all, such as (0, -1, 0) for gravity, which the
                targets do not yet hold; (V, 3) or (T, V, 3) for each vertex, such as wind.

        Raises:
            ReenactError: Something has the wrong shape.
        """
        still, _ = self._solve(targets, states, features, force)
        return still.to(targets.dtype)

    def states(self, targets: Float[Tensor, "T V 3"], **inputs) -> Float[Tensor, "T X 3"]:
        """As the call, but all nodes of the tissue, float64, the head held still."""
        return self._solve(targets, inputs.get("states"), inputs.get("features"), inputs.get("force"))[1]

    def _solve(self, targets, states, features_, force) -> tuple[Tensor, Tensor]:
        shell, rig = self.shell, self.shell.rig
        shell._check(targets)
        frames, count = len(targets), len(shell)
        if states is not None and states.shape != (frames, len(shell.nodes), 3):
            raise ReenactError(
                f"{rig.name}: expected states ({frames}, {len(shell.nodes)}, 3), got {tuple(states.shape)}"
            )
        if features_ is not None and features_.shape != (frames, len(self._edges), 3):
            raise ReenactError(
                f"{rig.name}: expected features ({frames}, {len(self._edges)}, 3), got {tuple(features_.shape)}"
            )
        forces = self._forces(force, frames)
        self.seconds = dict.fromkeys(("set-up", "tissue", "solve", "contact", "rest"), 0.0)
        clock = _Clock(self.seconds, frames)

        rotations, translations = shell.head_pose(targets)
        still = (targets.double() - translations[:, None]) @ rotations
        if states is not None:
            states = (states.double() - translations[:, None]) @ rotations
        skin, bones = shell.skin(still).numpy(), shell.bones(still).numpy()
        wanted = features(shell, still) if features_ is None else features_.double()
        wanted = feature_vectors(shell, wanted).numpy()
        clock("set-up")
        solved = np.empty((frames, len(shell.nodes), 3))
        for frame in range(frames):
            pull = forces[frame] @ rotations[frame].numpy()  # of the world, seen from the head
            state = None if states is None else states[frame].numpy()
            mesh = still[frame].numpy()
            solved[frame] = self._rest(mesh, skin[frame], bones[frame], state, wanted[frame], pull, clock)
        offsets = torch.from_numpy(solved[:, :count] - skin)
        moved = still + shell.rest(offsets)
        moved = moved @ rotations.transpose(1, 2) + translations[:, None]
        clock("rest")
        return moved, torch.from_numpy(solved)

    def _forces(self, force: Tensor | None, frames: int) -> Float[ndarray, "T X 3"]:
        shell, count = self.shell, len(self.shell.rig.neutral)
        if force is None:
            return np.zeros((frames, len(shell.nodes), 3))
        if force.shape not in ((3,), (count, 3), (frames, count, 3)):
            raise ReenactError(
                f"{shell.rig.name}: expected a force (3,), ({count}, 3) or ({frames}, {count}, 3), got "
                f"{tuple(force.shape)}"
            )
        per_vertex = force.double().expand(frames, count, 3)[:, shell.vertices].numpy()
        columns = np.tile(per_vertex, (1, shell.config.layers + 1, 1))
        return _GRAVITY * columns * (shell.node_volumes / shell.height**4)[:, None]

    def _rest(
        self,
        mesh: Float[ndarray, "V 3"],
        skin: Float[ndarray, "N 3"],
        bones: Float[ndarray, "X 3"],
        asked: Float[ndarray, "X 3"] | None,
        wanted: Float[ndarray, "C 3"],
        force: Float[ndarray, "X 3"],
        clock: _Clock,
    ) -> Float[ndarray, "X 3"]:
        """Nodes of one frame."""
        shell, config, count = self.shell, self.config, len(self.shell)
        vectors = shell.gradient_vectors
        unit = np.tile(np.eye(3), (len(shell.tets), 1, 1))
        turns, muscle_turns, stretches = unit.copy(), unit.copy(), unit.copy()
        guess = bones if asked is None else asked
        fall = np.repeat(1 - np.arange(shell.config.layers + 1) / shell.config.layers, count)[:, None]
        state = guess + fall * np.tile(skin - guess[:count], (shell.config.layers + 1, 1))
        state[self._held] = bones[self._held]
        if asked is not None and config.muscle > 0:
            nearest_rotations(asked, shell.tets, vectors, turns, 12)
            _stretches(asked, shell.tets, vectors, turns, stretches)
            muscle_turns = turns.copy()
        fixed = self._fascia[:, None] * bones + force
        fixed[:count] += self._skin[:, None] * skin
        for sign, end in ((1, 0), (-1, 1)):
            np.add.at(fixed, self._edges[:, end], sign * self._edge_weights[:, None] * wanted)
        fixed = fixed[self._free] - self._cross @ state[self._held]
        clock("set-up")
        self._skin_of_targets = skin
        pushed = np.zeros((count, 3))
        for iteration in range(config.iterations):
            if config.contact > 0 and iteration % config.contact_every == 0:
                pushed = self._pushes(self._posed(mesh, state, skin))
                goals = state[self._touching] + pushed[self._touching]
                active = np.abs(pushed[self._touching]).max(1) > 0
                clock("contact")
            sides = np.zeros_like(state)
            _project(state, shell.tets, vectors, self._weights, config.band, turns, muscle_turns, stretches, sides)
            if config.contact > 0:
                points = np.where(active[:, None], goals, state[self._touching])
                sides[self._touching] += self._contact[:, None] * points
            else:
                sides[self._touching] += self._contact[:, None] * state[self._touching]
            clock("tissue")
            state[self._free] = self._factor.solve(fixed + sides[self._free])
            clock("solve")
        self._keep_whole(state)
        clock("solve")
        if config.contact > 0:
            loose = ~shell.border[:count]
            for _ in range(config.clean):
                pushed = self._pushes(self._posed(mesh, state, skin))
                if np.abs(pushed).max() < 1e-4 * shell.height:
                    break
                state[:count][loose] += pushed[loose]
            clock("contact")
        return state

    def _keep_whole(self, state: Float[ndarray, "X 3"]) -> None:
        """Bring the volume of all tissue into its band, in place, where that costs the other terms least.

        Newton's steps on the volume along K^-1 dV/dX, the direction of a Lagrange multiplier; K is the matrix of the
        solve. Source: ours.
        """
        shell, count = self.shell, len(state)
        whole = shell.volumes.sum()
        for _ in range(3):
            ratio = tet_volumes(state, shell.tets).sum() / whole
            missing = np.clip(ratio, 1 - self.config.whole, 1 + self.config.whole) - ratio
            if abs(missing) < 1e-5:
                return
            slopes = volume_gradient(state, shell.tets, count)[self._free]
            direction = self._factor.solve(slopes)
            state[self._free] += missing * whole / (slopes * direction).sum() * direction

    def _posed(self, mesh: ndarray, state: ndarray, skin: ndarray) -> Float[ndarray, "V 3"]:
        """The mesh of the rig with its skin where the nodes are, and what hangs on it moved along."""
        return mesh + self.shell.rest.matrix @ (state[: len(skin)] - skin)

    def _pushes(self, mesh: Float[ndarray, "V 3"]) -> Float[ndarray, "N 3"]:
        """Offsets of skin nodes that take lips, lids and teeth out of each other; both sides give way, teeth do not."""
        total, weight = np.zeros((len(self.shell), 3)), np.zeros(len(self.shell))
        for (side, other, limit, mutual), allowed in zip(self._meetings, self._allowed):
            inside, distance, corners, shares, normals = side.hits(mesh, other, limit, mutual)
            deep = np.flatnonzero(inside & (distance > allowed))
            if len(deep) == 0:
                continue
            push = (distance - allowed)[deep, None] * normals[deep]
            give = 0.5 if mutual else 1.0
            own = self._number[side.vertices[deep]]
            np.add.at(total, own, give * push)
            np.add.at(weight, own, 1.0)
            if mutual:
                there = self._number[corners[deep]]
                there_shares = np.where(there >= 0, shares[deep], 0.0)
                for corner in range(3):
                    known = there_shares[:, corner] > 0
                    np.add.at(total, there[known, corner], -give * push[known] * there_shares[known, corner, None])
                    np.add.at(weight, there[known, corner], there_shares[known, corner])
        return total / np.maximum(weight, 1e-9)[:, None] * (weight > 0)[:, None]


def _per_node(shell: Shell, name: str, values: Float[Tensor, "V"] | None) -> Float[ndarray, "N"]:
    rig = shell.rig
    if values is None:
        return np.ones(len(shell))
    if values.shape != (len(rig.neutral),) or not bool((values > 0).all() & values.isfinite().all()):
        raise ReenactError(
            f"{rig.name}: expected a positive {name} for each of {len(rig.neutral)} vertices, got "
            f"{tuple(values.shape)} from {float(values.min()):g} to {float(values.max()):g}"
        )
    return values.double().numpy()[shell.vertices.numpy()]


class _Clock:
    """Adds the seconds since its last call to a part."""

    def __init__(self, seconds: dict[str, float], frames: int) -> None:
        self.seconds, self.frames, self.last = seconds, max(frames, 1), time.perf_counter()

    def __call__(self, part: str) -> None:
        now = time.perf_counter()
        self.seconds[part] += (now - self.last) / self.frames
        self.last = now


# ---------------------------------------------------------------------------------------------------------------------
# Characteristics of an expression


def feature_nodes(shell: Shell) -> ndarray:
    """(C, 2) pairs of skin nodes whose differences are the characteristics: slits, the width of each, contours."""
    pairs = []
    for slit in shell.slits.values():
        pairs += [slit, slit[[0, -1], 0][None]]
        pairs += [np.stack([slit[:-1, side], slit[1:, side]], 1) for side in (0, 1)]
    return np.concatenate(pairs) if pairs else np.zeros((0, 2), np.int64)


def _feature_sizes(shell: Shell) -> Float[ndarray, "C"]:
    """What each difference is measured by: the width of a mouth; the opening of an eye for its slit, else its width."""
    skin, sizes = shell.nodes[: len(shell)].numpy(), []
    for name, slit in shell.slits.items():
        width = np.linalg.norm(skin[slit[-1, 0]] - skin[slit[0, 0]])
        opening = np.linalg.norm(skin[slit[:, 0]] - skin[slit[:, 1]], axis=1)
        across = np.full(len(slit), width) if name == "lips" else np.maximum(opening, 0.3 * opening.mean() + 1e-9)
        sizes.append(np.concatenate([across, np.full(2 * len(slit) - 1, width)]))
    return np.concatenate(sizes) if sizes else np.zeros(0)


def features(shell: Shell, vertices: Float[Tensor, "T V 3"]) -> Float[Tensor, "T C 3"]:
    """How far lips and lids are open, how wide, and how their contours run, less the same at rest; free of units.

    Shells that were carried from rig to rig have the same features in the same order. Source: ours; the paper names
    "facial features that aim to retain not only contours but also other facial proportions".
    """
    ends, sizes = feature_nodes(shell), torch.from_numpy(_feature_sizes(shell))
    offsets = shell.skin(vertices) - shell.nodes[: len(shell)]
    return (offsets[:, ends[:, 0]] - offsets[:, ends[:, 1]]) / sizes[:, None]


def feature_vectors(shell: Shell, values: Float[Tensor, "T C 3"]) -> Float[Tensor, "T C 3"]:
    """Differences of nodes, metres, that have the features."""
    ends, sizes = feature_nodes(shell), torch.from_numpy(_feature_sizes(shell))
    rest = shell.nodes[ends[:, 0]] - shell.nodes[ends[:, 1]]
    return rest + sizes[:, None] * values.double()


# ---------------------------------------------------------------------------------------------------------------------
# Local steps


@compiled
def _stretches(points, tets, vectors, turns, stretches):
    """S = R^T F of each tetrahedron, made symmetric, in place."""
    f, s = np.empty((3, 3)), np.empty((3, 3))
    for e in range(len(tets)):
        gradient_of(points, tets[e], vectors[e], f)
        for i in range(3):
            for j in range(3):
                s[i, j] = turns[e, 0, i] * f[0, j] + turns[e, 1, i] * f[1, j] + turns[e, 2, i] * f[2, j]
        for i in range(3):
            for j in range(3):
                stretches[e, i, j] = 0.5 * (s[i, j] + s[j, i])


@compiled
def _project(points, tets, vectors, weights, band, turns, muscle_turns, stretches, sides):
    """Adds what elasticity, volume and muscles ask for to the right side; turns go on from the last step."""
    f, r, p, cofactor = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    g = np.empty((3, 3))
    for e in range(len(tets)):
        gradient_of(points, tets[e], vectors[e], f)
        p[:] = 0.0
        if weights[e, 0] > 0:
            for i in range(3):
                for j in range(3):
                    r[i, j] = turns[e, i, j]
            for _ in range(2):
                if turn_towards(f, r) < 1e-5:
                    break
            for i in range(3):
                for j in range(3):
                    turns[e, i, j] = r[i, j]
                    p[i, j] += weights[e, 0] * r[i, j]
        if weights[e, 1] > 0:
            # The closest matrix of a determinant, to first order, twice.
            for i in range(3):
                for j in range(3):
                    g[i, j] = f[i, j]
            for _ in range(2):
                square = 0.0
                for i in range(3):
                    a, b = (i + 1) % 3, (i + 2) % 3
                    for j in range(3):
                        k, m = (j + 1) % 3, (j + 2) % 3
                        cofactor[i, j] = g[a, k] * g[b, m] - g[a, m] * g[b, k]
                        square += cofactor[i, j] ** 2
                size = g[0, 0] * cofactor[0, 0] + g[0, 1] * cofactor[0, 1] + g[0, 2] * cofactor[0, 2]
                step = 0.0
                if size < 1.0 - band:
                    step = (1.0 - band - size) / max(square, 0.1)
                elif size > 1.0 + band:
                    step = (1.0 + band - size) / max(square, 0.1)
                if step == 0.0:
                    break
                for i in range(3):
                    for j in range(3):
                        g[i, j] += step * cofactor[i, j]
            for i in range(3):
                for j in range(3):
                    p[i, j] += weights[e, 1] * g[i, j]
        if weights[e, 2] > 0:
            for i in range(3):
                for j in range(3):
                    g[i, j] = f[i, 0] * stretches[e, 0, j] + f[i, 1] * stretches[e, 1, j] + f[i, 2] * stretches[e, 2, j]
                    r[i, j] = muscle_turns[e, i, j]
            for _ in range(2):
                if turn_towards(g, r) < 1e-5:
                    break
            for i in range(3):
                for j in range(3):
                    muscle_turns[e, i, j] = r[i, j]
                    p[i, j] += weights[e, 2] * (
                        r[i, 0] * stretches[e, 0, j] + r[i, 1] * stretches[e, 1, j] + r[i, 2] * stretches[e, 2, j]
                    )
        for c in range(4):
            node = tets[e, c]
            for i in range(3):
                sides[node, i] += p[i, 0] * vectors[e, c, 0] + p[i, 1] * vectors[e, c, 1] + p[i, 2] * vectors[e, c, 2]
