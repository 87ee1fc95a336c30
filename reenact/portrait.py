"""Portrait: the camera, light and framing that photograph a rig.

Kim et al. 2021, "Deep Learning-Based Unsupervised Human Facial Retargeting", doi:10.1111/cgf.14400
(KI21), render every rig with 19 numbers: a 3 x 4 camera matrix, the model's position (3) and scale (1), and the
position of a point light (3). Camera and light are the same for all rigs; position and scale put each rig's eye line
and mouth line on the same rows of the picture, the only alignment that the published method has.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from reenact.errors import ReenactError
from reenact.rigs import arkit
from reenact.rigs.rig import Rig
from render import Camera, Light, render

EYE_HEIGHT = 0.38
"""Height of the eye line above the middle of the picture, in halves of its height."""
MOUTH_HEIGHT = -0.26
"""Height of the mouth line; the lower lip of a wide open jaw still lies inside the picture."""
CAMERA_DISTANCE = 0.60
"""Metres from the camera to the plane of the face."""
HALF_HEIGHT = 0.112
"""Half the height of the picture at the plane of the face, in metres: an adult fills it at scale 1."""
BACKGROUND = (0.36, 0.38, 0.41)
"""sRGB behind the head."""

MAKEUP = {
    "skin": (0.80, 0.62, 0.52),
    "lips": (0.60, 0.22, 0.22),
    "brows": (0.22, 0.14, 0.10),
    "lashes": (0.10, 0.08, 0.08),
    "teeth": (0.90, 0.88, 0.82),
    "tongue": (0.70, 0.35, 0.35),
    "mouth": (0.25, 0.08, 0.08),
}
"""sRGB of the parts that `made_up` paints."""

_LID_SHAPES = ("eyeBlinkLeft", "eyeBlinkRight")
_LID_WORDS = re.compile(
    r"blink|wink|eyes?[ _.-]?clos|clos\w*[ _.-]?eyes?|eye[ _.-]?lid|squint|まばたき|ウィンク|^笑い$|瞬"
)
_MOUTH_WORDS = re.compile(
    r"mouth|lips?([^a-z]|$)|mth|viseme|vrc\.v|pucker|smile|pout|phoneme|口|^[あいうえおんワω∧▲]$"
    r"|^(aa|ih|ou|ee|oh|a|i|u|e|o)$|^v[ _.](aa|ih|ou|ee|oh)$"
)
"""Words of rigs that do not speak ARKit: VRM, VRoid, VRChat, MMD, game engines."""
_MOUTH_SHAPES = ("mouthPucker", "mouthFunnel", "mouthClose", "mouthSmileLeft", "mouthSmileRight")


@dataclass(frozen=True)
class Portrait:
    """How one rig is photographed."""

    rig: Rig
    camera: Camera
    light: Light
    position: Float[Tensor, "3"]
    """Added to the scaled vertices, metres."""
    scale: float
    """Multiplies the vertices."""

    @classmethod
    def of(cls, rig: Rig) -> Portrait:
        """The portrait in which the rig's eyes and mouth lie on the rows that all rigs share.

        Raises:
            ReenactError: The rig's eyes and mouth cannot be told apart.
        """
        eyes, mouth = face_lines(rig)
        span = float(eyes[1] - mouth[1])
        if not span > 0:
            raise ReenactError(f"{rig.name}: expected the eyes above the mouth (+Y up), got the reverse; turn the mesh")
        scale = (EYE_HEIGHT - MOUTH_HEIGHT) * HALF_HEIGHT / span
        middle = (eyes + mouth) / 2
        anchor = torch.stack([middle[0], eyes[1], middle[2]])
        position = torch.tensor([0.0, EYE_HEIGHT * HALF_HEIGHT, 0.0]) - scale * anchor
        world_to_camera = torch.eye(4)[:3].clone()
        world_to_camera[2, 3] = -CAMERA_DISTANCE
        light = Light(position=torch.tensor([0.15, 0.35, 0.55]))
        return cls(rig, Camera(world_to_camera, CAMERA_DISTANCE / HALF_HEIGHT), light, position, scale)

    def to(self, device: torch.device | str) -> Portrait:
        """The same portrait with its rig on a device, where it then renders; camera and light may be elsewhere."""
        return replace(self, rig=self.rig.to(device), position=self.position.to(device))

    @property
    def parameters(self) -> Float[Tensor, "19"]:
        """Camera matrix (12), model position (3), model scale (1), light position (3). Source: KI21, section 3."""
        scale = torch.tensor([self.scale])
        return torch.cat([self.camera.world_to_camera.flatten(), self.position, scale, self.light.position])

    def render(
        self, vertices: Float[Tensor, "B V 3"], resolution: int, buffers: tuple[str, ...] = ("color",)
    ) -> dict[str, Tensor]:
        """Square pictures of expressions of the rig.

        Args:
            vertices: In the rig's own frame, metres.
            resolution: Height and width in pixels.
            buffers: Any of "color", "mask", "normals", "depth", "parts", as `render.render` makes them; and "motion",
                how far each visible point is from where it rests, (x, y, z) in metres of an adult's face, 0 outside.

        Returns:
            Buffer name to (B, C, resolution, resolution).
        """
        rig = self.rig
        made = render(
            self.scale * vertices + self.position,
            rig.faces,
            self.camera,
            self.light,
            height=resolution,
            width=resolution,
            colors=rig.colors,
            texture=rig.texture,
            uv=rig.uv,
            uv_faces=rig.uv_faces,
            parts=rig.parts,
            attributes=self.scale * (vertices - rig.neutral) if "motion" in buffers else None,
            background=BACKGROUND,
            buffers=["attributes" if name == "motion" else name for name in buffers],
        )
        return {name: made["attributes" if name == "motion" else name] for name in buffers}

    def project(self, vertices: Float[Tensor, "*batch V 3"], resolution: int) -> Float[Tensor, "*batch V 2"]:
        """Pixel coordinates (x, y) of vertices; (0, 0) is the top left corner of the top left pixel."""
        world = self.scale * vertices + self.position
        matrix = self.camera.world_to_camera
        seen = world @ matrix[:, :3].T + matrix[:, 3]
        on_plane = seen[..., :2] / -seen[..., 2:] * self.camera.focal
        return torch.stack([1 + on_plane[..., 0], 1 - on_plane[..., 1]], dim=-1) * (resolution / 2)


def fit_weights(
    portrait: Portrait,
    picture: Float[Tensor, "1 3 R R"],
    steps: int = 450,
    learning_rate: float = 0.03,
    watch: Callable[[int, Tensor], None] | None = None,
) -> Float[Tensor, "1 K"]:
    """Weights with which the rig looks like a picture of it, by gradient descent through the renderer.

    Of 10 random expressions of anny:man at 128 pixels, 9 end within 0.1 % of the motion, in 2.5 s on two cores; the
    other one ends in another expression that looks nearly alike (ours). Absolute differences do it; with squared ones
    none of three arrived.

    Args:
        portrait: Took the picture.
        picture: sRGB in [0, 1].
        steps: Of Adam, from the neutral; the rate falls to a fiftieth.
        learning_rate: Of the first step.
        watch: Called with the number and the weights before each step.

    Returns:
        Weights in [0, 1].
    """
    rig, resolution = portrait.rig, picture.shape[-1]
    weights = torch.zeros(1, len(rig.names)).requires_grad_()
    optimizer = torch.optim.Adam([weights], lr=learning_rate, betas=(0.9, 0.99))
    for step in range(steps):
        if watch is not None:
            watch(step, weights.detach().clone())
        for group in optimizer.param_groups:
            group["lr"] = learning_rate * 0.02 ** (step / steps)
        drawn = portrait.render(rig.vertices(weights), resolution)["color"]
        optimizer.zero_grad()
        (drawn - picture).abs().mean().backward()
        optimizer.step()
        with torch.no_grad():
            weights.clamp_(0, 1)
    return weights.detach()


def made_up(rig: Rig) -> Rig:
    """The rig painted like every other: skin, lips, brows, teeth and the rest in `MAKEUP`, eyes as they are.

    A network then cannot tell faces by their colours, and lips darken where they meet skin on every one of them. A rig
    whose lips are not marked stays as it is. Ours.
    """
    if len(rig.part("lips")) == 0:
        return rig
    colors = torch.ones_like(rig.neutral) if rig.colors is None else rig.colors.clone()
    for part, color in MAKEUP.items():
        colors[rig.part(part)] = torch.tensor(color, dtype=colors.dtype)
    return replace(rig, colors=colors, texture=None)


def face_lines(rig: Rig) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Middle of the eyes and middle of the mouth of the neutral, in the rig's frame.

    Each from the part labels where the rig has them; else from what shapes with names of lids and lips move, ARKit's or
    words such as "wink" or "viseme"; else from what any shapes move: motion lies in two heights, around the eyes and
    around the mouth. Shapes that move the whole body say nothing about the face.

    Raises:
        ReenactError: Eyes or mouth have no part and no name, and fewer than two shapes move anything, or all of them at
            one place.
    """
    motion = rig.deltas.norm(dim=-1)  # (K, V)
    local = _local(rig, motion)
    known = [arkit.canonical(name) if moves else None for name, moves in zip(rig.names, local)]
    eyes = _part_middle(rig, "eyes")
    if eyes is None:
        eyes = _named_middle(rig, motion, known, local, _LID_SHAPES, _LID_WORDS)
    mouth = _part_middle(rig, "lips")
    if mouth is None:
        mouth = _named_middle(rig, motion, known, local, _MOUTH_SHAPES, _MOUTH_WORDS)
    if eyes is not None and mouth is not None:
        return _apart(rig, eyes, mouth)
    heights = (motion * rig.neutral[:, 1]).sum(1) / motion.sum(1).clamp_min(1e-12)  # (K,)
    if int(local.sum()) < 2:
        raise ReenactError(
            f"{rig.name}: expected blendshapes that move eyes and mouth, got {int(local.sum())} that move anything; "
            "check that the export kept the deltas"
        )
    ordered = heights[local].sort().values
    border = ordered[:-1] + ordered.diff() / 2
    split = border[ordered.diff().argmax()]
    upper, lower = local & (heights > split), local & (heights <= split)
    eyes = _motion_middle(rig, motion[upper].sum(0)) if eyes is None else eyes
    return _apart(rig, eyes, _motion_middle(rig, motion[lower].sum(0)) if mouth is None else mouth)


def _apart(rig: Rig, eyes: Tensor, mouth: Tensor) -> tuple[Tensor, Tensor]:
    if not float((eyes - mouth).norm()) > 0:  # nor where one of them was not found
        raise ReenactError(
            f"{rig.name}: expected shapes that move eyes, and others that move a mouth, got all at one place; "
            "check the names of the shapes and the mesh"
        )
    return eyes, mouth


def _local(rig: Rig, motion: Float[Tensor, "K V"]) -> Bool[Tensor, "K"]:
    """Which shapes move something, and not three times as far around as most others do: not the whole body."""
    total = motion.sum(1)
    moving = total > 1e-6 * total.max().clamp_min(1e-12)
    share = motion / total.clamp_min(1e-12)[:, None]
    middle = share @ rig.neutral  # (K, 3)
    spread = (share @ rig.neutral.square() - middle.square()).sum(1).clamp_min(0).sqrt()
    usual = spread[moving].median() if bool(moving.any()) else spread.new_zeros(())
    return moving & (spread <= 3 * usual)


def _part_middle(rig: Rig, part: str) -> Tensor | None:
    vertices = rig.part(part)
    return _box_middle(rig, vertices) if len(vertices) else None


def _named_middle(
    rig: Rig, motion: Tensor, known: list[str | None], local: Tensor, shapes: tuple[str, ...], words: re.Pattern
) -> Tensor | None:
    """Middle of what the shapes move that are ARKit's, or else whose names hold such words; None without any."""
    chosen = [index for index, name in enumerate(known) if name in shapes]
    if not chosen:
        chosen = [index for index, name in enumerate(rig.names) if local[index] and words.search(name.lower())]
    return _motion_middle(rig, motion[chosen].sum(0)) if chosen else None


def _box_middle(rig: Rig, vertices: Tensor) -> Tensor:
    """Middle of the bounding box: unlike the mean it does not follow where a sculptor put more vertices."""
    box = rig.neutral[vertices]
    return (box.amin(0) + box.amax(0)) / 2


def _motion_middle(rig: Rig, motion: Tensor) -> Tensor:
    return (motion[:, None] * rig.neutral).sum(0) / motion.sum()
