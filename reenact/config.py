"""Every setting of a training run, with its default; strict reading and writing of TOML."""

from __future__ import annotations

import difflib
import json
import math
import tomllib
import types
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

from reenact.atomic import write_atomically
from reenact.errors import MissingError, ReenactError


@dataclass(frozen=True)
class ImageConfig:
    """The pictures that the networks see."""

    resolution: int = 64
    """Height and width in pixels; a multiple of 16."""
    supersample: int = 2
    """Render this many times larger and average: smoother colours, at the square of the cost."""
    makeup: bool = True
    """Paint lips, brows, skin and teeth of every rig alike for the networks, where the rig tells its parts."""
    motion: bool = True
    """Add a motion pass, how far each visible point is from where it rests, and read from that. Colours are drawn
    beside it for people to look at; without it, colours are all that networks have."""
    residual: bool = True
    """Show each network the picture minus the rig's own neutral picture, so that identity, texture and light cancel."""


@dataclass(frozen=True)
class LayoutConfig:
    """One 2-D warp per rig that puts its eyes, mouth and outline on the pixels of the source's."""

    method: Literal["found", "pictures", "none"] = "found"
    """`pictures` registers neutral pictures, part maps and motion energy; `found` does so where no correspondence
    between the surfaces is known (see `pairs.method`), and follows that otherwise; `none` leaves the pictures as
    framed."""
    grid: int = 9
    """Control points along each side of the displacement grid."""
    steps: int = 120
    """Optimizer steps at each of the scales, coarse to fine."""
    bending: float = 0.02
    """Penalty on the second differences of the displacement grid."""
    samples: int = 256
    """Random expressions per rig from which motion energy is measured."""


@dataclass(frozen=True)
class PairsConfig:
    """What is known of expressions of one rig on the other before any training; see `reenact.pairs`."""

    method: Literal["geometry", "pictures", "none"] = "geometry"
    """`geometry` finds places of the two surfaces that belong together and lets geometric methods label expressions,
    with the help of pictures; `pictures` compares the motion passes of single shapes, and needs no meshes beyond the
    renderer; `none` leaves the networks to what they share by themselves."""
    correspondence: str | None = None
    """A file of pairs of places, source and target; None finds them."""
    markers: int = 300
    """Pairs of places that are found."""
    similarity: float = 0.3
    """Least correlation of the motion passes of two shapes that count as one in pictures."""
    margin: float = 0.05
    """By how much the next best shape must correlate less."""
    partners: int = 8
    """Rigs of a cast that each rig is compared with, at most: the first, and those that follow it in the cast. All
    rigs share a code, so that any two understand each other all the same, and the costs grow with the rigs and not with
    their pairs."""
    shown: int = 4
    """Partners that each expression of a rig is shown on, at most; all of them have their turns. With one, rigs of a
    cast learn too little of each other to be as good as pairs."""
    nudges: str | None = None
    """A file of corrections made in the viewer, such as another run's nudges.json: the networks are taught expressions
    near a corrected frame as it was left."""


@dataclass(frozen=True)
class ReenactNetConfig:
    """Shape of ReenactNet: one shared encoder, one decoder per rig."""

    network: Literal["components", "convolutional"] = "components"
    """`components` works between the principal components of each rig's pictures; `convolutional` is the published
    family."""
    code: int = 256
    """Size of the bottleneck. Far larger ones let identity leak into the code."""
    components: int = 768
    """Principal components of what is read from a rig's pictures."""
    color_components: int = 128
    """Principal components of the colours that are drawn beside the motion pass."""
    width: int = 512
    """Hidden layers of a network on components."""
    encoder_channels: int = 16
    """Convolutional: channels after the first convolution; doubled at each of the next three."""
    seed_channels: int = 96
    """Convolutional: channels of the small picture that the code is unfolded to."""
    decoder_channels: int = 16
    """Convolutional: half the channels of the decoder's last block; doubled at each earlier one."""
    decoder_blocks: int = 2
    """Convolutional: doublings of the decoder, of three, with a block of their own; the third takes two thirds of the
    time."""
    kernel: int = 3
    """Convolutional: width of the encoder's kernels."""
    normalize: bool = True
    """Convolutional: GroupNorm and SiLU; without it plain leaky ReLU, as the published description suggests."""


@dataclass(frozen=True)
class BPNetConfig:
    """Shape and training of BPNet, which reads blendshape weights from a picture. Its kind is ReenactNet's."""

    channels: int = 24
    """Convolutional: channels after the first convolution."""
    hidden: int = 512
    """Width of the hidden dense layers; 0 reads by a straight map."""
    bounded: bool = True
    """Answers beyond [0, 1] hardly count, so that any number below zero says that a shape rests. Without it they are
    clamped only at inference, as published."""
    epochs: float | None = None
    """Passes over the `training.frames` pictures, where they are never refreshed; None counts in `steps`."""
    steps: int = 3000
    """Optimizer steps per rig."""
    batch_size: int = 64
    """Pictures per step."""
    learning_rate: float = 2e-3
    """Peak of the schedule."""
    weight_loss: float = 1.0
    """Factor of L_w, the mean absolute error of the weights."""
    image_loss: float = 0.3
    """Factor of L_r, the distance between the picture and the render of the predicted weights."""
    image_from: float = 0.8
    """Share of the steps before L_r joins: far from the right weights its gradient misleads, and it costs a render."""
    vertex_loss: float = 1.0
    """Factor of the root mean square vertex error of the predicted weights, relative to the motion (ours)."""
    decoded_fraction: float = 0.5
    """Share of the pictures that ReenactNet draws first, as it will at inference: from the other rig's pictures where
    there are pairs, else from the rig's own."""
    image_fraction: float = 0.0625
    """Share of the pictures whose predicted weights are rendered again for L_r, which costs more than all the rest."""
    steady: float = 0.02
    """Seconds of a clip over which small differences between what is read of its frames are smoothed at inference:
    errors of reading tremble, blinks stay sharp. 0 leaves each frame as it was read; a frame alone always is."""


@dataclass(frozen=True)
class TrainingConfig:
    """Optimization of ReenactNet, and what both networks share."""

    steps: int = 5000
    """Optimizer steps; of ReenactNet alone where it is trained first."""
    epochs: float | None = None
    """Passes over the `frames` pictures, where they are never refreshed; None counts in `steps`."""
    batch_size: int = 64
    """Pictures of each rig per step."""
    learning_rate: float = 2e-3
    """Peak of the schedule."""
    loss: Literal["l1", "l1+l2"] = "l1+l2"
    """Convolutional: distance of redrawn pictures, the published L1, or L1 plus squares. Residuals are nearly all
    zeros, and L1 alone takes thousands of steps to leave the zero picture."""
    together: bool = True
    """Train ReenactNet and every BPNet in one stage; the published method trains them one after the other."""
    pair_loss: float = 1.0
    """Factor of the distance between what is drawn of the other rig's paired picture and the pair."""
    read_loss: float = 1.0
    """Together: factor of the error of the weights that BPNet reads from what ReenactNet draws of the other rig's
    picture. It reaches back into ReenactNet, which learns to draw what is read right."""
    align_loss: float = 0.0
    """Together: factor of the distance between the codes of both rigs' pictures, in mean and covariance."""
    cycle_loss: float = 0.0
    """Together: factor of the distance between a picture and what comes back of it when the other rig is drawn, read,
    rendered, and drawn back; on the pictures and from the step that `bpnet.image_fraction` and `image_from` say."""
    schedule: Literal["one-cycle", "constant"] = "one-cycle"
    """How the learning rate changes over the steps."""
    optimizer: Literal["adamw", "adam"] = "adamw"
    """AdamW with weight decay, or plain Adam."""
    weight_decay: float = 0.01
    """Decoupled weight decay of AdamW."""
    elastic: float = 0.0
    """Elastic jitter of the encoder's input: standard deviation of a 4 x 4 grid, in halves of the picture's width.
    Helps where no pairs teach it to overlook how faces differ."""
    motion_weighting: bool = True
    """Convolutional: weight the reconstruction by where each rig's pictures move."""
    crowded: float = 0.6
    """Share of random expressions that move any number of shapes, up to all, more weakly, as recorded faces do."""
    uneven: float = 0.5
    """Share of those in which most shapes move hardly and a few as far as they can."""
    frames: int = 6144
    """Rendered expressions of each rig that are in memory at a time."""
    refresh: int = 2500
    """Steps after which fresh expressions replace them; 0 keeps the first."""
    seed: int = 0
    """Seed of every random number in the run."""
    save_every: int = 1000
    """Steps between checkpoints; each writes a preview picture."""
    keep: int = 3
    """Newest checkpoints that are kept, besides the best and milestones."""
    milestones: int = 0
    """Steps, over all stages, between checkpoints that are kept for ever; 0 keeps none."""
    threads: int | None = None
    """CPU threads; None takes all cores."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where pictures are rendered and networks learn; `cuda` needs an NVIDIA GPU and Warp. Labels are made by the
    CPU."""
    tensorboard: bool = False
    """Write losses and previews to RUN/tensorboard as well; needs `reenact[tensorboard]`."""


@dataclass(frozen=True)
class PostConfig:
    """What is done to a clip after retargeting; nothing, unless asked for. Names may be patterns with `*` and `?`."""

    gain: dict[str, float] = field(default_factory=dict)
    """Factor of each shape."""
    offset: dict[str, float] = field(default_factory=dict)
    """Added to each shape."""
    low: dict[str, float] = field(default_factory=dict)
    """Least weight of each shape."""
    high: dict[str, float] = field(default_factory=dict)
    """Greatest weight of each shape."""
    lock: dict[str, float] = field(default_factory=dict)
    """Weight that a shape has in every frame."""
    rest: float | None = None
    """Second of the clip at which the face begins to rest: its weights there become 0. None leaves them."""
    rest_seconds: float = 0.5
    """How long it rests."""
    smooth: float = 0.0
    """Seconds over which noise is averaged; blinks and other large changes stay sharp. 0 leaves it."""
    smooth_range: float = 0.08
    """Change of a weight that counts as motion and not as noise."""


@dataclass(frozen=True)
class Config:
    """Train networks that move expressions between rigs."""

    source: str = "anny:man"
    """Rig that the motion comes from: a built-in name (see `reenact rigs`) or a file."""
    target: str = "anny:toon"
    """Rig that the motion goes to."""
    source_parts: tuple[str, ...] = ()
    """Meshes of the source's file that make the rig, as names or patterns; none takes what belongs to the face."""
    source_shapes: tuple[str, ...] = ()
    """Blendshapes of the source to use, as names or patterns; none takes all."""
    target_parts: tuple[str, ...] = ()
    """As `source_parts`, of the target."""
    target_shapes: tuple[str, ...] = ()
    """As `source_shapes`, of the target."""
    source_clip: str | None = None
    """Training motion of the source: a file or `synthetic:SEED[:SECONDS]`; None samples random valid expressions."""
    target_clip: str | None = None
    """Training motion of the target, never the same as the source's."""
    cast: tuple[str, ...] = ()
    """Rigs to train together, any to any, instead of a source and a target; all others take the layout of the first."""
    base: str | None = None
    """Run whose networks are kept as they are: only what belongs to the rigs of the cast that it lacks is trained."""
    run: str | None = None
    """Folder to create for the run; None makes a new one below `runs/`."""
    images: ImageConfig = field(default_factory=ImageConfig)
    layout: LayoutConfig = field(default_factory=LayoutConfig)
    pairs: PairsConfig = field(default_factory=PairsConfig)
    reenactnet: ReenactNetConfig = field(default_factory=ReenactNetConfig)
    bpnet: BPNetConfig = field(default_factory=BPNetConfig)
    training: TrainingConfig = field(default_factory=TrainingConfig)
    post: PostConfig = field(default_factory=PostConfig)

    @property
    def rigs(self) -> tuple[str, ...]:
        """Where the rigs of the run come from, in order: the cast, or the source and the target."""
        return self.cast or (self.source, self.target)


def load_config(path: Path | str) -> Config:
    """The settings in a TOML file; keys that it leaves out have their defaults.

    Raises:
        MissingError: There is no such file.
        ReenactError: Not TOML, an unknown key, a value of the wrong type or out of range.
    """
    config = config_from_dict(read_table(path), origin=str(path))
    check_config(config, origin=str(path))
    return config


def read_table(path: Path | str) -> dict[str, Any]:
    """What a TOML file says, unchecked.

    Raises:
        MissingError: There is no such file.
        ReenactError: It is not TOML.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingError(f"{path}: there is no such settings file; see configs/ for examples")
    try:
        return tomllib.loads(path.read_bytes().decode())
    except (ValueError, RecursionError) as error:  # not TOML, not UTF-8, numbers of thousands of digits
        raise ReenactError(
            f"{path}: expected TOML, got something else ({error}); compare with the files in configs/"
        ) from error


def save_config(config: Config, path: Path | str) -> None:
    """Write every setting with its value, so that it can be read back whatever the defaults become."""
    write_atomically(path, "\n".join(_toml_lines(config)).encode())


def config_to_dict(config: Config) -> dict[str, Any]:
    """The settings as nested dictionaries of plain values, ready for JSON."""
    return asdict(config)


def config_from_dict(table: dict[str, Any], origin: str = "settings") -> Config:
    """The inverse of `config_to_dict`, as strict as `load_config`, but for the ranges (see `check_config`).

    Args:
        table: Sections and keys; what it leaves out has its default.
        origin: Name of the file or place, to begin messages with.

    Raises:
        ReenactError: An unknown key or a value of the wrong type.
    """
    return _build(Config, table, origin, prefix="")


def changed_settings(old: Config, new: Config) -> dict[str, Any]:
    """Dotted names of the settings whose values differ, with the new values."""
    return {key: other for (key, value), (_, other) in zip(_leaves(old), _leaves(new), strict=True) if value != other}


def check_config(config: Config, origin: str = "settings") -> None:
    """Refuse values that cannot work, before any work is done.

    Raises:
        ReenactError: Names the setting, what it allows and its value.
    """
    for key, value in _leaves(config):
        if isinstance(value, float) and not math.isfinite(value):
            raise ReenactError(f"{origin}: {key}: expected a finite number, got {value}")
        if isinstance(value, str) and not (value and _is_unicode(value)):
            raise ReenactError(f"{origin}: {key}: expected a name or path in Unicode, got {value!r}")
        if isinstance(value, tuple) and not all(each and _is_unicode(each) for each in value):
            raise ReenactError(f"{origin}: {key}: expected names or patterns, got an empty one in {list(value)}")
        if isinstance(value, dict):
            for name, number in value.items():
                if not (name and _is_unicode(name) and math.isfinite(number)):
                    raise ReenactError(f"{origin}: {key}: expected names with finite numbers, got {name!r} = {number}")
        allowed = _ALLOWED.get(key)
        if allowed is not None and value is not None and not allowed[1](value):
            raise ReenactError(f"{origin}: {key}: expected {allowed[0]}, got {value}")
    for section, epochs in (("training", config.training.epochs), ("bpnet", config.bpnet.epochs)):
        if epochs is not None and config.training.refresh:
            raise ReenactError(
                f"{origin}: {section}.epochs: expected training.refresh = 0 beside it, got {config.training.refresh}; "
                "epochs are passes over pictures that stay the same"
            )
    if config.pairs.method == "pictures" and not config.images.motion:
        raise ReenactError(
            f'{origin}: pairs.method: expected images.motion beside "pictures", got none; colours alone pair the wrong '
            'shapes, set pairs.method to "geometry" or "none"'
        )
    if config.pairs.nudges is not None and config.pairs.method == "none":
        raise ReenactError(
            f'{origin}: pairs.nudges: expected a pairs.method to correct, got "none"; set "geometry" or "pictures"'
        )
    if len(config.cast) == 1:
        raise ReenactError(f"{origin}: cast: expected two rigs or more, got {config.cast[0]} alone; name another")
    if config.cast:
        _check_cast(config, origin)
    if config.base is not None and not config.cast:
        raise ReenactError(f"{origin}: base: expected the cast that it grows to beside it, got none; set cast")
    if config.base is not None and not config.training.together:
        raise ReenactError(
            f"{origin}: base: expected training.together beside it, got stages; a rig that is added has one"
        )
    if config.images.motion and not config.images.residual:
        raise ReenactError(
            f"{origin}: images.motion: expected images.residual beside it, got none; motion is a residual by nature"
        )
    if config.bpnet.weight_loss == config.bpnet.image_loss == config.bpnet.vertex_loss == 0:
        raise ReenactError(
            f"{origin}: bpnet: expected a loss above 0, got weight_loss, image_loss and vertex_loss of 0"
        )


def _check_cast(config: Config, origin: str) -> None:
    """Refuse what belongs to a pair."""
    alone = {
        "source_parts": config.source_parts,
        "source_shapes": config.source_shapes,
        "target_parts": config.target_parts,
        "target_shapes": config.target_shapes,
        "source_clip": config.source_clip,
        "target_clip": config.target_clip,
        "pairs.correspondence": config.pairs.correspondence,
    }
    for key, value in alone.items():
        if value:
            raise ReenactError(
                f"{origin}: {key}: expected a source and a target beside it, got a cast of {len(config.cast)}; leave "
                "it out, and give the cast rigs that `reenact convert` made as they should be"
            )


_Rule = tuple[str, Callable[[Any], bool]]
_ONE_OR_MORE: _Rule = ("a whole number of at least 1", lambda value: value >= 1)
_EIGHTS: _Rule = ("a multiple of 8", lambda value: value >= 8 and value % 8 == 0)  # normalized in 8 groups
_POSITIVE: _Rule = ("a number above 0", lambda value: value > 0)
_SHORT: _Rule = ("a number of seconds from 0 to 2", lambda value: 0 <= value <= 2)
_NOT_NEGATIVE: _Rule = ("a number of at least 0", lambda value: value >= 0)
_FRACTION: _Rule = ("a number from 0 to 1", lambda value: 0 <= value <= 1)
_ALLOWED: dict[str, _Rule] = {
    "images.resolution": ("a multiple of 16, from 16 to 1024", lambda value: 16 <= value <= 1024 and value % 16 == 0),
    "layout.grid": ("a whole number from 3 to 64", lambda value: 3 <= value <= 64),
    "layout.steps": _ONE_OR_MORE,
    "layout.bending": _NOT_NEGATIVE,
    "layout.samples": _ONE_OR_MORE,
    "pairs.markers": ("a whole number from 50 to 5,000", lambda value: 50 <= value <= 5000),
    "pairs.partners": _ONE_OR_MORE,
    "pairs.shown": _ONE_OR_MORE,
    "pairs.similarity": _FRACTION,
    "pairs.margin": _FRACTION,
    "reenactnet.code": _ONE_OR_MORE,
    "reenactnet.components": _ONE_OR_MORE,
    "reenactnet.color_components": _ONE_OR_MORE,
    "reenactnet.width": _ONE_OR_MORE,
    "reenactnet.encoder_channels": _EIGHTS,
    "reenactnet.seed_channels": _EIGHTS,
    "reenactnet.decoder_channels": _EIGHTS,
    "reenactnet.kernel": ("an odd number from 3 to 15", lambda value: 3 <= value <= 15 and value % 2 == 1),
    "bpnet.channels": _EIGHTS,
    "bpnet.hidden": ("a whole number of at least 0", lambda value: value >= 0),
    "bpnet.epochs": _POSITIVE,
    "bpnet.steps": _ONE_OR_MORE,
    "bpnet.batch_size": _ONE_OR_MORE,
    "bpnet.learning_rate": _POSITIVE,
    "bpnet.weight_loss": _NOT_NEGATIVE,
    "bpnet.image_loss": _NOT_NEGATIVE,
    "bpnet.vertex_loss": _NOT_NEGATIVE,
    "bpnet.decoded_fraction": _FRACTION,
    "bpnet.steady": _SHORT,
    "training.steps": _ONE_OR_MORE,
    "training.epochs": _POSITIVE,
    "training.batch_size": _ONE_OR_MORE,
    "training.learning_rate": _POSITIVE,
    "training.weight_decay": _NOT_NEGATIVE,
    "training.elastic": _FRACTION,
    "training.pair_loss": _NOT_NEGATIVE,
    "training.read_loss": _NOT_NEGATIVE,
    "training.align_loss": _NOT_NEGATIVE,
    "training.cycle_loss": _NOT_NEGATIVE,
    "training.crowded": _FRACTION,
    "training.uneven": _FRACTION,
    "training.frames": ("a whole number from 8 to 1,000,000", lambda value: 8 <= value <= 1_000_000),
    "training.refresh": ("a whole number of at least 0", lambda value: value >= 0),
    "training.seed": ("a whole number from 0 to 2^63 - 1", lambda value: 0 <= value < 2**63),
    "training.save_every": _ONE_OR_MORE,
    "training.keep": _ONE_OR_MORE,
    "training.milestones": ("a whole number of at least 0", lambda value: value >= 0),
    "training.threads": _ONE_OR_MORE,
    "post.rest": _NOT_NEGATIVE,
    "post.rest_seconds": _POSITIVE,
    "post.smooth": _SHORT,
    "post.smooth_range": _POSITIVE,
}
"""What the numbers allow, in words and as a test; None always passes where the type has it."""


def _build(kind: type, table: dict[str, Any], origin: str, prefix: str) -> Any:
    types_of = get_type_hints(kind)
    for key in table:
        if key not in types_of:
            raise ReenactError(f"{origin}: unknown key {prefix}{key}{_suggestion(prefix + key)}")
    return kind(**{key: _convert(types_of[key], value, origin, prefix + key) for key, value in table.items()})


def _convert(kind: Any, value: Any, origin: str, key: str) -> Any:
    """The value as the type of its field; a whole number may stand where a fraction is expected."""
    if is_dataclass(kind):
        if not isinstance(value, dict):
            raise ReenactError(f"{origin}: {key}: expected a section [{key}], got {_words(value)}")
        return _build(kind, value, origin, prefix=f"{key}.")
    options = get_args(kind) if get_origin(kind) in (Union, types.UnionType) else (kind,)
    for option in options:
        if get_origin(option) is Literal:
            if value in get_args(option):
                return value
        elif get_origin(option) is tuple:
            if isinstance(value, (list, tuple)) and all(type(each) is str for each in value):
                return tuple(value)
        elif get_origin(option) is dict:
            if isinstance(value, dict) and all(type(each) in (int, float) for each in value.values()):
                return {name: float(each) for name, each in value.items()}
        elif type(value) is option:  # not isinstance: True is an int to Python
            return value
        elif option is float and type(value) is int and abs(value) <= 2**53:  # beyond, floats skip numbers
            return float(value)
    expected = " or ".join(text for option in options for text in _expected(option))
    raise ReenactError(f"{origin}: {key}: expected {expected}, got {_words(value)}")


_TYPE_WORDS = {
    int: "a whole number",
    float: "a number",
    str: "text",
    bool: "true or false",
    dict: "a section",
    list: "a list",
}


def _expected(option: Any) -> list[str]:
    if get_origin(option) is Literal:
        return [json.dumps(choice) for choice in get_args(option)]
    if get_origin(option) in (tuple, dict):
        return ["a list of texts" if get_origin(option) is tuple else "a table of numbers by name"]
    return [] if option is types.NoneType else [_TYPE_WORDS[option]]  # TOML has no null: a key is left out


def _words(value: Any) -> str:
    shown = json.dumps(value, ensure_ascii=False, default=str)
    shown = shown if len(shown) <= 40 else shown[:37] + "..."
    kind = _TYPE_WORDS.get(type(value), type(value).__name__).removeprefix("a ")
    return shown if isinstance(value, bool) else f"the {kind} {shown}"


def _suggestion(key: str) -> str:
    known = [name for name, _ in _leaves(Config())] + [f.name for f in fields(Config) if "." not in f.name]
    same_name = [name for name in known if name.rpartition(".")[2] == key.rpartition(".")[2]]
    nearest = sorted(set(same_name)) or difflib.get_close_matches(key, known, n=1, cutoff=0.5)
    return f"; did you mean {' or '.join(nearest)}?" if nearest else "; see `reenact train --help` for all keys"


def _leaves(section: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Dotted name and value of every setting, in order."""
    leaves = []
    for setting in fields(section):
        value = getattr(section, setting.name)
        key = f"{prefix}{setting.name}"
        leaves += _leaves(value, f"{key}.") if is_dataclass(value) else [(key, value)]
    return leaves


def _is_unicode(text: str) -> bool:
    return not any("\ud800" <= character <= "\udfff" for character in text)  # bytes of a path that no encoding explains


def _toml_lines(section: Any, prefix: str = "") -> list[str]:
    values = {setting.name: getattr(section, setting.name) for setting in fields(section)}
    lines = [f"[{prefix}]"] if prefix else []
    lines += [_toml_line(key, value) for key, value in values.items() if not is_dataclass(value)]
    for key, value in values.items():  # sections last: keys after one would belong to it
        if is_dataclass(value):
            lines += ["", *_toml_lines(value, f"{prefix}.{key}" if prefix else key)]
    return lines if prefix else [*lines, ""]


def _toml_line(key: str, value: Any) -> str:
    if value is None:
        return f"# {key} is not set"
    if isinstance(value, bool):
        return f"{key} = {str(value).lower()}"
    if isinstance(value, tuple):
        return f"{key} = [{', '.join(_toml_text(each) for each in value)}]"
    if isinstance(value, dict):
        return f"{key} = {{{', '.join(f'{_toml_text(name)} = {each!r}' for name, each in value.items())}}}"
    return f"{key} = {_toml_text(value) if isinstance(value, str) else repr(value)}"


def _toml_text(text: str) -> str:
    """TOML's strings are JSON's, but for one character that must be escaped."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
