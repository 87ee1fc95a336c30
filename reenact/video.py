"""Video: a clip on one or more rigs as .mp4, .gif or pictures, drawn by our renderer or through OpenGL.

Every rig is photographed as its `Portrait` frames it, and stands in a square of its own, side by side. A file is there
whole or not at all.
"""

from __future__ import annotations

import tempfile
import wave
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from reenact.atomic import replacing
from reenact.errors import MissingError, ReenactError
from reenact.portrait import BACKGROUND, Portrait
from reenact.rigs.clip import Clip
from reenact.rigs.files import load_clip, load_rig
from reenact.rigs.rig import Rig
from reenact.rigs.timeline import resampled
from reenact.viewer.session import DEFAULT_CLIP, TRAINED, Session
from render.opengl import render_opengl

SUFFIXES = (".mp4", ".gif", "")
"""Of what `save_video` writes; none for a folder of PNGs."""

_CHUNK = 8
"""Frames that are drawn at once."""
GIF_RATE = 50
"""Frames per second that browsers still play as they are told; they slow down what is faster."""
_COLORS_FROM = 12
"""Frames that the colours of a .gif are chosen from."""


@dataclass(frozen=True)
class Performance:
    """A rig and what it plays."""

    rig: Rig
    clip: Clip
    older: int | None = None
    """Step of the networks that moved it, where they are not the newest of their run."""


def performances(
    inputs: Sequence[str],
    rigs: Sequence[str] = (),
    method: str | None = None,
    fps: float | None = None,
    checkpoint: str = "newest",
    device: str = "cpu",
) -> list[Performance]:
    """Who plays what, frame by frame together.

    Args:
        inputs: A clip; or a run, or a run and a clip of its source.
        rigs: With a clip alone: names or files. Each plays the clip by the names of its shapes. None: the rig in the
            clip's own file.
        method: Retargets the clip from the first rig to the others instead; of a run, what takes the networks' place.
        fps: Frames per second; the clip's unless said.
        checkpoint: Of the run; see `load_checkpoint`.
        device: Where the run's networks look at pictures.

    Raises:
        ReenactError: Something is missing, too much, or cannot be read.
        FileNotFoundError: The run is none.
    """
    is_run = len(inputs) == 2 or (len(inputs) == 1 and Path(inputs[0]).is_dir() and not rigs)
    if not 1 <= len(inputs) <= 2 or (is_run and rigs):
        raise ReenactError(
            f"render: expected CLIP and --rig, or RUN and CLIP, got {len(inputs)} arguments and {len(rigs)} rigs"
        )
    if checkpoint != "newest" and (not is_run or method not in (None, *TRAINED)):
        raise ReenactError(
            f"render: expected the networks of a run beside --checkpoint, got "
            f"{'no run' if not is_run else f'--method {method}'}; leave one of them out"
        )
    if is_run:
        clip = inputs[1] if len(inputs) == 2 else DEFAULT_CLIP
        return _played(Session.open([inputs[0]], clip, method, fps=fps, checkpoint=checkpoint, device=device))
    clip = inputs[0]
    names = list(rigs) or [clip]
    if method is not None:
        if len(names) < 2:
            raise ReenactError(f"--method: expected a second --rig to retarget to, got {len(names)}")
        return _played(Session.open(names, clip, method, fps=fps))
    found = []
    for name in names:
        rig = load_rig(name)
        played = load_clip(clip, rig)
        found.append(Performance(rig, played if fps is None else resampled(played, fps)))
    return found


def pictures(
    played: Sequence[Performance], size: int, opengl: bool = False, frames: Iterable[int] | None = None
) -> Iterator[UInt8[np.ndarray, "H W 3"]]:
    """Frames with the rigs side by side, each `size` x `size` pixels; all of them unless `frames` says which.

    Raises:
        ReenactError: The clips differ in length, or a rig's face is not found.
        ValueError: OpenGL is asked for and cannot draw.
    """
    lengths = {len(each.clip) for each in played}
    if len(lengths) != 1 or 0 in lengths:
        raise ReenactError(f"render: expected clips of one length, got {', '.join(map(str, sorted(lengths)))} frames")
    portraits = [Portrait.of(each.rig) for each in played]
    draw = _opengl if opengl else _own
    chosen = torch.tensor(list(range(lengths.pop()) if frames is None else frames))
    for rows in chosen.split(_CHUNK):
        drawn = [draw(portrait, each.clip.weights[rows].float(), size) for portrait, each in zip(portraits, played)]
        whole = torch.cat(drawn, dim=3)  # (B, 3, H, W of all)
        yield from (whole.clamp(0, 1) * 255).round().byte().permute(0, 2, 3, 1).numpy()


def save_video(
    played: Sequence[Performance],
    out: Path,
    size: int = 512,
    opengl: bool = False,
    audio: Path | None = None,
    drawn: Callable[[int], None] = lambda _: None,
) -> None:
    """Writes the performances by the suffix: .mp4 (H.264), .gif, or none for a folder of PNGs.

    Args:
        played: Of `performances`.
        out: A file, or a folder that is not there yet or is empty.
        size: Height and width of each rig in pixels.
        opengl: Draw through pyrender, which is faster for large pictures.
        audio: A .wav for the .mp4; the shorter of both ends it.
        drawn: Told how many frames are done.

    Raises:
        ReenactError: Another suffix, a rate that a .gif does not have, what writes .mp4 is not installed, or OpenGL is
            missing.
        OSError: It cannot be written.
    """
    suffix, fps = out.suffix.lower(), played[0].clip.fps
    check_out(out, audio)
    if suffix == ".gif" and fps > GIF_RATE:
        raise ReenactError(f"{out}: a .gif has at most {GIF_RATE} frames per second, got {fps:g}; add --fps 30")
    try:
        frames = _counted(pictures(played, size, opengl), drawn)
        if suffix == ".mp4":
            _save_mp4(frames, out, (size * len(played), size), fps, len(played[0].clip), audio)
        elif suffix == ".gif":
            _save_gif(frames, out, fps, _palette(played, size))
        else:
            _save_folder(frames, out)
    except ValueError as error:
        if isinstance(error, ReenactError) or not str(error).startswith("OpenGL:"):
            raise
        raise ReenactError(f"--opengl: {error}") from None


def check_out(out: Path, audio: Path | None = None) -> None:
    """Refuses what cannot be written, before the work whose result it should hold.

    Raises:
        ReenactError: Another suffix, a folder that holds something, sound for something else than .mp4 or that is no
            .wav, or imageio-ffmpeg is missing.
        FileNotFoundError: The folder of the file is missing.
    """
    suffix = out.suffix.lower()
    if suffix not in SUFFIXES:
        raise ReenactError(f"{out}: expected .mp4, .gif, or a folder for pictures, got {suffix}")
    if not out.absolute().parent.is_dir():
        raise MissingError(f"{out}: the folder {out.parent} does not exist; make it first")
    if suffix and out.is_dir():
        raise ReenactError(f"{out}: expected a file to write, got a folder; name a file in it")
    if not suffix and out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ReenactError(f"{out}: already holds something, and nothing is overwritten; name another folder")
    if suffix == ".mp4":
        try:
            import imageio_ffmpeg  # noqa: F401
        except ModuleNotFoundError:
            raise ReenactError(
                f"{out}: expected imageio-ffmpeg to write .mp4, got none; pip install 'reenact[video]', or write a .gif"
            ) from None
    if audio is not None:
        if suffix != ".mp4":
            raise ReenactError(f"--audio: expected an .mp4 to go with it, got {suffix or 'a folder'}")
        try:
            with wave.open(str(audio)) as sound:
                sound.getnframes()
        except (wave.Error, EOFError) as error:
            raise ReenactError(f"{audio}: expected a .wav, got something else ({error or 'no content'})") from None


def _played(session: Session) -> list[Performance]:
    found = []
    for key, rig in session.rigs.items():
        pieces = session.track(key, session.first_method.get(key, "clip"))
        older = None if key == session.source else session.older
        found.append(Performance(rig, Clip(rig.names, torch.cat(list(pieces)), session.clip.fps), older))
    return found


def _own(portrait: Portrait, weights: Tensor, size: int) -> Tensor:
    with torch.no_grad():
        return portrait.render(portrait.rig.vertices(weights), size)["color"]


def _opengl(portrait: Portrait, weights: Tensor, size: int) -> Tensor:
    rig = portrait.rig
    return render_opengl(
        portrait.scale * rig.vertices(weights) + portrait.position,
        rig.faces,
        portrait.camera,
        portrait.light,
        height=size,
        width=size,
        colors=rig.colors,
        texture=rig.texture,
        uv=rig.uv,
        uv_faces=rig.uv_faces,
        background=BACKGROUND,
    )


def _counted(frames: Iterator[np.ndarray], drawn: Callable[[int], None]) -> Iterator[np.ndarray]:
    for count, frame in enumerate(frames, start=1):
        yield frame
        drawn(count)


def _save_mp4(
    frames: Iterator[np.ndarray], out: Path, size: tuple[int, int], fps: float, count: int, audio: Path | None
) -> None:
    import imageio_ffmpeg

    width, height = (side + side % 2 for side in size)  # H.264 halves its colours: sides must be even
    with replacing(out) as path:
        writer = imageio_ffmpeg.write_frames(
            str(path),
            (width, height),
            fps=fps,
            quality=8,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-f", "mp4", "-movflags", "+faststart", *(["-shortest"] if audio else [])],
            audio_path=None if audio is None else str(audio),
            audio_codec=None if audio is None else "aac",
        )
        try:
            writer.send(None)
            for frame in frames:
                padded = np.pad(frame, ((0, height - size[1]), (0, width - size[0]), (0, 0)), mode="edge")
                writer.send(np.ascontiguousarray(padded))
        finally:
            writer.close()
        # ffmpeg reports a full disk only in its log: count what is there before it gets its name.
        try:
            there = imageio_ffmpeg.count_frames_and_secs(str(path))[0]
        except RuntimeError:  # it cannot even read it
            there = 0
        if there < count and audio is None:
            raise OSError(f"{out}: expected {count} frames, ffmpeg wrote {there}; is the disk full?")


def _save_gif(frames: Iterator[np.ndarray], out: Path, fps: float, palette: Image.Image) -> None:
    # A .gif counts hundredths of a second: frames take turns, so that the whole keeps its length.
    ends = (100 * np.arange(1, 1 + 10**6) / fps).round().astype(int)

    def quantized(frame: np.ndarray) -> Image.Image:
        return Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)

    images = [quantized(frame) for frame in frames]
    durations = 10 * np.diff(ends[: len(images)], prepend=0)
    with replacing(out) as path:
        images[0].save(path, format="GIF", save_all=True, append_images=images[1:], duration=durations.tolist(), loop=0)


def _palette(played: Sequence[Performance], size: int) -> Image.Image:
    """256 colours for all frames: with colours of their own, frames would flicker."""
    count = len(played[0].clip)
    chosen = np.unique(np.linspace(0, count - 1, min(count, _COLORS_FROM)).round().astype(int)).tolist()
    sheet = np.concatenate(list(pictures(played, min(size, 160), frames=chosen)))
    return Image.fromarray(sheet).quantize(256, method=Image.Quantize.MEDIANCUT)


def _save_folder(frames: Iterator[np.ndarray], out: Path) -> None:
    with tempfile.TemporaryDirectory(prefix=f".{out.name[:50]}-", dir=out.absolute().parent) as unfinished:
        whole = Path(unfinished) / "pictures"
        whole.mkdir()
        for number, frame in enumerate(frames):
            Image.fromarray(frame).save(whole / f"{number:06d}.png")
        if out.is_dir():
            out.rmdir()  # empty, as was checked
        whole.replace(out)
