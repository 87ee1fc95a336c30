"""Example-based facial rigging: the target's shapes, personalised to the source from a few of its expressions.

Li, Weise & Pauly 2010, "Example-Based Facial Rigging", doi:10.1145/1778765.1778769, used for retargeting as Ribera et
al. 2017, "Facial Retargeting with Automatic Range of Motion Alignment", doi:10.1145/3072959.3073674, do to compare with
it: examples are chosen from a clip of the actor, and their weights are guessed first. The actor is our source.

Symbol   Code                        Shape
A_i      target                      the generic rig
B_0, B_i source.neutral, personal    (V, 3), (K, V, 3) the actor's neutral, and what is wanted: the same shapes on it
M_i^A*   generic                     (F, K, 6) edges of each face of the generic rig's shapes, carried to the actor
M_i^B    edges                       (F, K, 6) the same of the personalised shapes; offsets from the neutral
S_j      examples                    (J, V, 3)
alpha_ij weights                     (J, K)
omega_i  trust                       (F, K)
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.cluster.vq import kmeans2
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import face_frames, farthest_points
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer, densify
from reenact.retargeting.inverse_rig import InverseRig, nonnegative_least_squares
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.retargeter import check_names
from reenact.rigs import motion
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


@dataclass(frozen=True)
class RiggingConfig:
    """How far examples may change a generic rig."""

    examples: int = 15
    """Expressions chosen from the training clip."""
    iterations: int = 10
    """Rounds of shapes, then weights."""
    beta: tuple[float, float] = (0.5, 0.1)
    """Pull towards the generic shapes, first and last round."""
    gamma: tuple[float, float] = (2.0, 0.2)
    """Pull towards the guessed weights, first and last round, in mean squared sizes of a personalised shape.

    The paper's 1000 and 100 hold for meshes of some unit and number of vertices that it does not tell.
    """
    kappa: float = 0.1
    """Faces that a shape deforms by less than this share of their size hardly change."""
    theta: float = 2.0
    """How sharply that is so."""
    markers: int = 100
    """Places of the correspondence that the first guess of the weights rests on."""
    seed: int = 0
    """Of the clustering that chooses the examples."""


class FacialRigging:
    """Bounded least squares of the source's motion in the target's shapes, personalised to the source from examples."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        config: RiggingConfig | None = None,
        examples: Float[Tensor, "J V 3"] | None = None,
        weights: Float[Tensor, "N K"] | None = None,
    ) -> None:
        """
        Args:
            source: The actor.
            target: The generic rig.
            correspondence: Pairs; see `densify`.
            training: Source clip that examples are chosen from; a minute of synthetic motion where None.
            config: How far the examples may change the rig.
            examples: Meshes of the source to use instead.
            weights: Target weights that the examples stand for, about; guessed by proportion matching where None.

        Raises:
            ReenactError: There is no correspondence, the clip has other shapes than the source, or examples and weights
                do not fit the rigs or each other.

        Source: the protocol of Ribera et al. 2017, who took the guess from their own alignment; ours is proportion
        matching.
        """
        self.source, self.target = source, target
        config = config or RiggingConfig()
        correspondence = densify(source, target, correspondence)
        if examples is None:
            if training is None:
                training = motion.synthesize(source.names, 60.0, seed=0)
            check_names(training, source)
            examples = source.vertices(training.weights[choose_examples(source, training, config)])
        if examples.shape[1] != len(source.neutral):
            raise ReenactError(
                f"{source.name}: expected examples of {len(source.neutral)} vertices, got {examples.shape[1]}"
            )
        if weights is None:
            weights = _guess(source, target, correspondence, examples, config)
        if weights.shape != (len(examples), len(target.names)):
            raise ReenactError(
                f"{target.name}: expected weights ({len(examples)}, {len(target.names)}) for {len(examples)} examples, "
                f"got {tuple(weights.shape)}"
            )
        carried = DeformationTransfer(target, source, correspondence.reversed())
        self.rigging = Rigging(carried, examples.double(), weights.double(), config)
        personal = self.rigging.deltas
        self.personalised = Rig(
            f"{target.name} as {source.name}", source.neutral, personal.float(), target.names, source.faces
        )
        """The target's shapes on the source's mesh."""
        self._inverse = InverseRig(self.personalised, importance=carried.covered)
        self._projection = self._inverse.projections(source.vertices(torch.eye(len(source.names))))  # (Ks, Kt)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target, weights in [0, 1]."""
        check_names(clip, self.source)
        weights = nonnegative_least_squares(self._inverse.gram, clip.weights.double() @ self._projection, high=1.0)
        return replace(clip, names=self.target.names, weights=weights.float())


def choose_examples(rig: Rig, clip: Clip, config: RiggingConfig) -> Int[Tensor, "J"]:
    """Frames that lie closest to the centres of a clip's clusters, by the distance between their vertices.

    Source: Ribera et al. 2017: k-means, the frame nearest to each centre.
    """
    flat = rig.deltas.double().flatten(1)
    values, axes = torch.linalg.eigh(flat @ flat.T)
    # Distances between these points are distances between the expressions.
    points = (clip.weights.double() @ axes * values.clamp_min(0).sqrt()).numpy()
    count = min(config.examples, len(np.unique(points.round(9), axis=0)))
    centres, _ = kmeans2(points, count, minit="++", rng=config.seed, missing="warn")
    nearest = np.linalg.norm(points[None] - centres[:, None], axis=2).argmin(1)
    return torch.from_numpy(np.unique(nearest))


def _guess(source: Rig, target: Rig, correspondence: Correspondence, examples: Tensor, config: RiggingConfig) -> Tensor:
    """alpha*: bounded least squares of the examples in the target's shapes, carried over by a thin-plate map."""
    places = correspondence.source.of(source.neutral)
    motion = correspondence.source.of(source.deltas).norm(dim=-1).amax(0)
    importance = correspondence.confidence * (motion + 0.1 * motion.max())
    count = min(config.markers, int((importance > 0).sum()))
    markers = correspondence[farthest_points(places, count, importance)]
    guess = carry_shapes(source, target, markers).guess.flatten(1)  # (K, 3 N)
    offsets = markers.source.of((examples - source.neutral).double()).flatten(1)
    return nonnegative_least_squares(guess @ guess.T, offsets @ guess.T, high=1.0)


class Rigging:
    """Shapes and example weights, each fitted in turn with the other held, while both come free of their guesses."""

    def __init__(
        self,
        carried: DeformationTransfer,
        examples: Float[Tensor, "J V 3"],
        weights: Float[Tensor, "J K"],
        config: RiggingConfig,
    ) -> None:
        """
        Args:
            carried: Transfer from the generic rig to the actor.
            examples: Meshes of the actor.
            weights: Weights of the generic rig that they stand for, about.
            config: How far both may change.

        Source: Li et al. 2010, the alternating optimization. Their frames have the normal as a third column, which
        never reaches the vertices: the solve sees only what lies in the plane of a face. Ours leave it out.
        """
        generic_rig, actor = carried.source, carried.target
        neutral = actor.neutral.double()
        frames = face_frames(neutral, actor.faces)[..., :2]  # (F, 3, 2) M_0^B
        size = frames.flatten(1).norm(dim=1).clamp_min(1e-12)
        shapes = generic_rig.vertices(torch.eye(len(generic_rig.names))).double()
        # M_i^A* = (M_0^A + M_i^A) (M_0^A)^-1 M_0^B - M_0^B: deformation transfer, before it is put together.
        generic = torch.cat([_rows(carried.gradients(part) @ frames) for part in shapes.split(8)], 1)  # (F, K, 6)
        wanted = _rows(face_frames(examples, actor.faces)[..., :2] - frames)  # (F, J, 6) M_j^S - M_0^B
        # Most of a head never moves; what is left are the F faces of all that follows.
        self._moving = torch.cat([generic, wanted], 1).abs().amax((1, 2)) > 1e-6 * size
        self._carried, self._inverse = carried, torch.linalg.pinv(frames[self._moving])  # (F, 2, 3)
        self.generic, self._wanted = generic[self._moving], wanted[self._moving]
        moved = self.generic.norm(dim=2) / size[self._moving, None]
        self.trust = ((1 + moved) / (config.kappa + moved)) ** config.theta  # (F, K) omega
        # Where nothing is known of the generic rig, an example says nothing about its weights.
        self._scale = carried.covered.sqrt()[:, None]
        self._offsets = ((examples - neutral) * self._scale).flatten(1)  # (J, 3 V)
        self.guess = self.weights = weights
        self.edges = self.generic
        self.deltas = self._integrate()
        """Personalised shapes, (K, V, 3)."""
        self.energies: list[tuple[float, float, float, float]] = []
        """Of each round: energy of the shapes before and after they were fitted, then of the weights."""
        for round in range(config.iterations):
            share = round / max(config.iterations - 1, 1)
            beta, gamma = ((1 - share) * first + share * last for first, last in (config.beta, config.gamma))
            before = self.shape_energy(beta)
            self.fit_shapes(beta)
            energies = before, self.shape_energy(beta), self.weight_energy(gamma)
            self.fit_weights(gamma)
            self.energies.append((*energies, self.weight_energy(gamma)))

    def fit_shapes(self, beta: float) -> None:
        """Step A: the edges of each face that fit the examples best without leaving the generic ones, then vertices.

        A K x K system for each face, solved through the smaller J x J one: with W = 1 / omega,
        M = M* + W alpha (beta I + alpha^T W alpha)^-1 (M^S - M_0 - alpha^T M*). As beta grows, M goes to M*.
        """
        alpha, slack = self.weights, 1 / self.trust  # (J, K), (F, K)
        products = torch.einsum("ik,jk->kij", alpha, alpha).flatten(1)  # (K, J J)
        systems = (slack @ products).unflatten(1, (len(alpha),) * 2)  # (F, J, J)
        systems = systems + beta * torch.eye(len(alpha), dtype=alpha.dtype)
        missing = self._wanted - alpha @ self.generic  # (F, J, 6)
        shares = torch.linalg.solve(systems, missing)  # (F, J, 6)
        self.edges = torch.addcmul(self.generic, slack[..., None], alpha.T @ shares)
        self.deltas = self._integrate()

    def fit_weights(self, gamma: float) -> None:
        """Step B: the weights of each example in [0, 1] that show it best without leaving the guess."""
        flat = (self.deltas * self._scale).flatten(1)
        gram = flat @ flat.T
        pull = gamma * float(gram.diagonal().mean())
        system = gram + pull * torch.eye(len(gram), dtype=gram.dtype)
        self.weights = nonnegative_least_squares(system, self._offsets @ flat.T + pull * self.guess, high=1.0)

    def shape_energy(self, beta: float) -> float:
        """What step A minimises: the examples' edges missed, and the way from the generic ones."""
        missed = self._wanted - self.weights @ self.edges
        strayed = self.trust * (self.edges - self.generic).norm(dim=2) ** 2
        return float(missed.norm() ** 2 + beta * strayed.sum())

    def weight_energy(self, gamma: float) -> float:
        """What step B minimises: the examples' vertices missed, and the way from the guessed weights."""
        flat = (self.deltas * self._scale).flatten(1)
        missed = self._offsets - self.weights @ flat
        pull = gamma * float(flat.square().sum(1).mean())
        return float(missed.square().sum() + pull * (self.weights - self.guess).square().sum())

    def _integrate(self) -> Tensor:
        """Vertices of the shapes from their edges, by one solve."""
        parts = []
        for edges, offsets in zip(self.edges.split(8, dim=1), self._carried.source.deltas.double().split(8)):
            gradients = edges.new_zeros(len(offsets), len(self._moving), 3, 3)
            gradients[:, self._moving] = edges.transpose(0, 1).unflatten(2, (3, 2)) @ self._inverse
            parts.append(self._carried.settle(gradients, offsets))
        return torch.cat(parts)


def _rows(frames: Float[Tensor, "N F 3 2"]) -> Float[Tensor, "F N 6"]:
    return frames.flatten(2).transpose(0, 1)
