"""Space-time cloning: velocities are matched over a whole clip, positions only at its ends and at an animator's keys.

Seol et al. 2012, "Spacetime Expression Cloning for Blendshapes", doi:10.1145/2159516.2159519. Of the paper its abstract
was at hand: the discretisation below is ours. A target whose rest is not quite the source's, or markers that sit a
little off, then change no weight; an edit spreads smoothly over time.

Symbol   Code           Shape
P        carried.guess  (Kt, N, 3) the target's shapes in the source's proportions
H        gram           (Kt, Kt) P P^T
w        weights        (T, Kt)
w*       keys           (B, Kt) weights that some frames are held at
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.linalg import cho_factor, cho_solve
from torch import Tensor

from reenact.errors import ReenactError
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.inverse_rig import nonnegative_least_squares
from reenact.retargeting.priors import pca_prior
from reenact.retargeting.rbf import carry_shapes
from reenact.retargeting.retargeter import check_names
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


class VelocityMatching:
    """Solves one Poisson problem in time for each clip."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        holding: float = 1e3,
        prior: float = 1e-7,
        linearised: bool = False,
    ) -> None:
        """
        Args:
            source: The actor.
            target: The rig.
            correspondence: Pairs of places.
            training: Not used.
            holding: kappa_b and kappa_e, how firmly keys are held, in units of the mean of H's diagonal.
            prior: kappa_p, strength of the PCA prior, with the traces of H and Q made equal. It is centred on the
                neutral, where the published one is centred on the mean shape, so that a still face stays still. Slow
                motion has hardly any velocity to hold against it: 1e-3 already erases a held expression.
            linearised: See `carry_shapes`.

        Raises:
            ReenactError: There is no correspondence, or a strength that is not positive.
        """
        if correspondence is None:
            raise ReenactError(f"{source.name} to {target.name}: velocity matching needs a correspondence, got none")
        if not (holding > 0 and prior >= 0):
            raise ReenactError(f"velocity matching: expected holding > 0 and prior >= 0, got {holding} and {prior}")
        self.source, self.target = source, target
        self.carried = carry_shapes(source, target, correspondence, linearised)
        weighted = self.carried.guess * self.carried.confidence[:, None]
        self.gram = torch.einsum("kni,lni->kl", weighted, self.carried.guess)
        self._projection = torch.einsum("sni,kni->sk", self.carried.source_shapes, weighted)  # (Ks, Kt)
        self._holding = holding * float(self.gram.diagonal().mean())
        quadratic = pca_prior(target)[0]
        self._prior = prior * quadratic * (self.gram.trace() / quadratic.trace())

    def __call__(self, clip: Clip, keys: Mapping[int, Float[Tensor, "Kt"]] | None = None) -> Clip:
        """The clip on the target, weights in [0, 1].

        Args:
            clip: With the source's shapes.
            keys: Weights that an animator wants at some frames. Without a key the first and the last frame are held at
                their own bounded fit, which is the neutral where the clip begins and ends with it.

        Raises:
            ReenactError: The clip has other names; a key lies outside the clip or has the wrong size.
        """
        check_names(clip, self.source)
        projections = clip.weights.to(torch.float64) @ self._projection
        if len(clip) == 0:
            return replace(clip, names=self.target.names, weights=projections.float())
        held = {frame: self._checked(frame, key, len(clip)) for frame, key in (keys or {}).items()}
        for frame in {0, len(clip) - 1} - held.keys():
            held[frame] = nonnegative_least_squares(self.gram, projections[frame : frame + 1], high=1.0)[0]
        free = match_velocities(self.gram, projections, held, self._holding, self._prior)
        # The bounded weights that look most like the free ones, rather than the nearest numbers.
        weights = nonnegative_least_squares(self.gram, free @ self.gram, high=1.0, start=free.clamp(0, 1))
        return replace(clip, names=self.target.names, weights=weights.float())

    def _checked(self, frame: int, key: Tensor, frames: int) -> Tensor:
        if not 0 <= frame < frames or key.shape != (len(self.target.names),):
            raise ReenactError(
                f"key: expected {len(self.target.names)} weights at a frame from 0 to {frames - 1}, got "
                f"{tuple(key.shape)} at {frame}"
            )
        return key.to(torch.float64)


def match_velocities(
    gram: Float[Tensor, "K K"],
    projections: Float[Tensor, "T K"],
    keys: Mapping[int, Float[Tensor, "K"]],
    holding: float,
    prior: Float[Tensor, "K K"] | None = None,
) -> Float[Tensor, "T K"]:
    """Weights, without bounds, whose velocities fit best, held at the keys.

    Minimises sum_f |P (w_f+1 - w_f) - (a_f+1 - a_f)|^2 + holding sum_keys |w - w*|^2 + sum_f w_f^T prior w_f. The
    normal equations are block tridiagonal, with -H beside the diagonal; they are solved by the block Thomas algorithm
    in O(T K^3).

    Args:
        gram: H.
        projections: P a_f of every frame; a constant added to all of them changes nothing.
        keys: w* by frame, at least one.
        holding: kappa.
        prior: kappa_p Q.

    Raises:
        ReenactError: There is no key, without which velocities say nothing of positions.
    """
    if not keys:
        raise ReenactError("velocity matching: expected at least one key, got none")
    matrix = gram.to(torch.float64).numpy()
    frames, count = projections.shape
    pulls = np.zeros((frames, count))
    steps = np.diff(projections.to(torch.float64).numpy(), axis=0)
    pulls[1:] += steps
    pulls[:-1] -= steps
    # Shapes that move nothing would leave the system singular; this keeps them at rest.
    rest = (np.zeros_like(matrix) if prior is None else prior.to(torch.float64).numpy()) + (
        1e-10 * max(np.trace(matrix) / count, 1e-300) * np.eye(count)
    )
    diagonal = [rest + matrix * (min(frame, 1) + min(frames - 1 - frame, 1)) for frame in range(frames)]
    for frame, key in keys.items():
        diagonal[frame] = diagonal[frame] + holding * np.eye(count)
        pulls[frame] += holding * key.to(torch.float64).numpy()
    factors = []
    for frame in range(frames):  # forward: eliminate the block before
        block = diagonal[frame]
        if frame > 0:
            block = block - matrix @ cho_solve(factors[-1], matrix)
            pulls[frame] += matrix @ cho_solve(factors[-1], pulls[frame - 1])
        factors.append(cho_factor((block + block.T) / 2, lower=True))
    weights = np.empty_like(pulls)
    for frame in reversed(range(frames)):
        after = matrix @ weights[frame + 1] if frame + 1 < frames else 0.0
        weights[frame] = cho_solve(factors[frame], pulls[frame] + after)
    return torch.from_numpy(weights)
