"""Geometric methods of retargeting, by name."""

from collections.abc import Callable
from functools import partial

from reenact.retargeting.anacondar import Anacondar
from reenact.retargeting.consensus import Consensus
from reenact.retargeting.cross_mapping import CrossMapping, KernelCCA
from reenact.retargeting.deformation_transfer import DeformationTransfer
from reenact.retargeting.delta_transfer import DeltaTransfer
from reenact.retargeting.facial_rigging import FacialRigging
from reenact.retargeting.key_shapes import KeyShapes
from reenact.retargeting.manifold_alignment import ManifoldAlignment
from reenact.retargeting.penalised_matching import PenalisedMatching
from reenact.retargeting.rbf import ProportionMatching
from reenact.retargeting.retargeter import Retargeter
from reenact.retargeting.shape_matching import ShapeMatching
from reenact.retargeting.spacetime import VelocityMatching
from reenact.retargeting.trivial import CopyNames, Neutral

METHODS: dict[str, Callable[..., Retargeter]] = {
    "neutral": Neutral,
    "copy": CopyNames,
    "key-shapes": KeyShapes,
    "delta-transfer": DeltaTransfer,
    "deformation-transfer": DeformationTransfer,
    "facial-rigging": FacialRigging,
    "anacondar": Anacondar,
    "cross-mapping": CrossMapping,
    "kernel-cca": KernelCCA,
    "velocity": VelocityMatching,
    "rbf": ProportionMatching,
    "rbf-l2": partial(PenalisedMatching, prior="l2"),
    "rbf-elastic-net": partial(PenalisedMatching, prior="elastic-net"),
    "rbf-pca": partial(PenalisedMatching, prior="pca"),
    "ribera-paper": partial(ManifoldAlignment, preset="paper"),
    "ribera-robust": partial(ManifoldAlignment, preset="robust"),
    "quantile": partial(ManifoldAlignment, preset="quantile"),
    "residual": partial(ManifoldAlignment, preset="residual"),
    "shape-matching": ShapeMatching,
    "consensus": Consensus,
}
"""What makes a retargeter, called with source, target, correspondence and optional training clip."""

__all__ = ["METHODS", "Retargeter"]
