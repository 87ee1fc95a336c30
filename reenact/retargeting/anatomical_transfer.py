"""Anatomical deformation transfer: the whole tissue of the target deforms like that of the source, on bones of its own.

AnaConDaR, "Anatomically Constrained Data-Adaptive Facial Retargeting", 2024, describes "a fully volumetric deformation
transfer for faces, which respects anatomical and physical constraints"; the text that we have ends before its
equations. These are our reconstruction, after Sumner & Popović 2004 with tetrahedra in place of triangles, which need
no stand-in for the direction along the normal.

Symbol  Code                  Shape
F^S_e   source gradients      (T, M, 3, 3) what the source's tissue did
vol_e   shell.volumes         (M,) of the target's tissue
X       states                (T, X, 3) nodes of the target's tissue

    min_X  sum_e vol_e |F^T_e(X) - F^S_e|^2     with the skull at rest, the jaw where the source's jaw goes, rigidly
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import diags_array
from torch import Tensor

from reenact.errors import ReenactError
from reenact.geometry import rigid_fit, similarity_fit
from reenact.retargeting.anatomy import JAW, Shell, build_shell, carry_shell
from reenact.retargeting.correspondence import Correspondence
from reenact.retargeting.deformation_transfer import DeformationTransfer, densify
from reenact.retargeting.inverse_rig import InverseRig
from reenact.retargeting.retargeter import check_names
from reenact.retargeting.tetrahedra import factored, scatter, stiffness_matrix
from reenact.rigs.clip import Clip
from reenact.rigs.rig import Rig


class AnatomicalTransfer:
    """Transfers meshes of the source to the target through their tissue; one factorisation for all of them."""

    def __init__(
        self,
        source: Rig,
        target: Rig,
        correspondence: Correspondence | None = None,
        training: Clip | None = None,
        *,
        shell: Shell | None = None,
    ) -> None:
        """
        Args:
            source: Where motion comes from.
            target: Where it goes to.
            correspondence: Pairs, see `DeformationTransfer`, which moves what is no tissue.
            training: Not used.
            shell: Tissue of the target; built with the usual thickness where None.

        Raises:
            ReenactError: There is no correspondence, it or the tissue belongs to other rigs, or shapes move no face.
        """
        if shell is not None and len(shell.rig.neutral) != len(target.neutral):
            raise ReenactError(
                f"{target.name}: expected tissue of a rig of {len(target.neutral)} vertices, got that of "
                f"{shell.rig.name} with {len(shell.rig.neutral)}"
            )
        self.source, self.target = source, target
        pairs = densify(source, target, correspondence)
        self.target_shell = build_shell(target) if shell is None else shell
        self.source_shell = carry_shell(self.target_shell, source, pairs)
        self.surface = DeformationTransfer(source, target, pairs)
        """Deformation transfer of surfaces, which moves the vertices outside the tissue."""

        own = self.target_shell
        self.scale = float(similarity_fit(self.source_shell.nodes, own.nodes)[0])
        """Size of the target in units of the source."""
        self._held = np.flatnonzero((own.bone > 0) | own.border)
        self._free = np.flatnonzero((own.bone == 0) & ~own.border)
        weights = own.volumes / own.height**3
        self._vectors = own.gradient_vectors * weights[:, None, None]
        matrix = stiffness_matrix(own.gradient_vectors, own.tets, weights, len(own.nodes))
        self._cross = matrix[self._free][:, self._held].tocsr()
        inner = matrix[self._free][:, self._free]
        # Without any bone the tissue may still be moved as a whole; a millionth of its stiffness holds it.
        self._factor = factored(inner + diags_array(1e-9 * inner.diagonal()))
        self._explanation = InverseRig(target)

    def __call__(self, clip: Clip) -> Clip:
        """The clip on the target: bounded least squares of `vertices(clip)`, weights in [0, 1]."""
        weights = self._explanation(self.vertices(clip))
        return replace(clip, names=self.target.names, weights=weights.float())

    def vertices(self, clip: Clip) -> Float[Tensor, "T V 3"]:
        """Target vertices in metres, outside the span of the target's own shapes."""
        check_names(clip, self.source)
        return self.transfer(self.source.vertices(clip.weights))

    def transfer(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T Vt 3"]:
        """Target vertices for meshes of the source's topology; the pose of the head is carried over.

        Skin is what the tissue makes of it. What is no tissue is moved as surfaces are, and then along with the skin
        that it hangs on; see `anatomy.Rest`.
        """
        still, rotations, translations = self._stilled(vertices)
        states = self._states(still)
        moved = self.surface.transfer(still)
        own = self.target_shell
        skin = states[:, : len(own)] - own.nodes[: len(own)]
        # The difference between both transfers of the skin is handed on to what hangs on it.
        offsets = skin - (moved - self.target.neutral.double())[:, own.vertices]
        moved = moved + own.rest(offsets)
        return self._posed(moved, rotations, translations).to(vertices.dtype)

    def states(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T X 3"]:
        """Nodes of the target's tissue for meshes of the source's topology, float64."""
        still, rotations, translations = self._stilled(vertices)
        return self._posed(self._states(still), rotations, translations)

    def _stilled(self, vertices: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Meshes in double precision with the head at rest, and its pose."""
        rotations, translations = self.source_shell.head_pose(vertices)
        return (vertices.double() - translations[:, None]) @ rotations, rotations, translations

    def _posed(self, points: Tensor, rotations: Tensor, translations: Tensor) -> Tensor:
        return points @ rotations.transpose(1, 2) + self.scale * translations[:, None]

    def _states(self, vertices: Float[Tensor, "T Vs 3"]) -> Float[Tensor, "T X 3"]:
        own = self.target_shell
        source_states = self.source_shell.fill(vertices)
        states = np.empty((len(vertices), len(own.nodes), 3))
        for frame, source_state in enumerate(source_states):
            gradients = np.ascontiguousarray(self.source_shell.gradients(source_state[None])[0].numpy())
            state = states[frame]
            state[self._held] = self._bones(source_state)[self._held]
            sides = np.zeros_like(state)
            scatter(sides, own.tets, self._vectors, gradients)
            state[self._free] = self._factor.solve(sides[self._free] - self._cross @ state[self._held])
        return torch.from_numpy(states)

    def _bones(self, source_state: Float[Tensor, "X 3"]) -> Float[np.ndarray, "X 3"]:
        """Target nodes with the skull at rest, the jaw moved rigidly and the border as on the source."""
        own = self.target_shell
        moved = own.nodes + self.scale * (source_state - self.source_shell.nodes)
        state = own.nodes.clone()
        jaw = torch.from_numpy(own.bone == JAW)
        if int(jaw.sum()) >= 3:
            rotation, translation = rigid_fit(own.nodes[jaw], moved[jaw])
            state[jaw] = own.nodes[jaw] @ rotation.T + translation
        border = torch.from_numpy(own.border)
        state[border] = moved[border]
        return state.numpy()
