"""Films of an arm: side by side and one above another, as files, and as pictures that move inside a notebook.

A notebook's film is an animated PNG. JupyterLab removes the source of a ``<video>`` from a notebook that it does not
trust, as from any that was executed elsewhere, and GitHub shows none; both show a picture.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tsmlib.storage.files import write_bytes

if TYPE_CHECKING:
    from IPython.display import Image


ANIMATED = {".png": "PNG", ".gif": "GIF", ".webp": "WEBP"}


def _frames(field: str, frames: np.ndarray) -> np.ndarray:
    frames = np.asarray(frames)
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or 0 in frames.shape:
        raise ValueError(
            f"{field} is {frames.dtype} {frames.shape}, expected uint8 (T, H, W, 3) with at least one frame"
        )
    return frames


def side_by_side(films: Mapping[str, np.ndarray]) -> np.ndarray:
    """Films as one, (T, H + strip, W1 + W2 + ..., 3), its label above each; a shorter one waits on its last frame."""
    films = {label: _frames(label, film) for label, film in films.items()}
    if (
        len(heights := {label: film.shape[1] for label, film in films.items()}) == 0
        or len({*heights.values()}) > 1
    ):
        found = ", ".join(f"{label} {pixels}" for label, pixels in heights.items()) or "no film"
        raise ValueError(
            f"films of one height are expected, found pixels: {found}; render all at one height"
        )
    length, height = max(map(len, films.values())), max(20, max(heights.values()) // 14)
    parts = []
    for label, film in films.items():
        held = _waiting(film, length)
        banner = Figure(figsize=(film.shape[2] / 100, height / 100), dpi=100, facecolor="white")
        banner.text(
            0.5, 0.45, label, ha="center", va="center", fontsize=0.5 * height, family="DejaVu Sans"
        )
        canvas = FigureCanvasAgg(banner)
        canvas.draw()
        strip = np.asarray(canvas.buffer_rgba())[..., :3]
        parts.append(np.concatenate([np.broadcast_to(strip, (length, *strip.shape)), held], axis=1))
    return np.concatenate(parts, axis=2)


def stacked(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Two films as one, (T, H1 + H2, W, 3); the shorter one waits on its last frame."""
    above, below = _frames("above", above), _frames("below", below)
    if above.shape[2] != below.shape[2]:
        raise ValueError(
            f"above is {above.shape[2]} pixels wide and below {below.shape[2]}; render both at one width"
        )
    length = max(len(above), len(below))
    return np.concatenate([_waiting(above, length), _waiting(below, length)], axis=1)


def _waiting(film: np.ndarray, length: int) -> np.ndarray:
    """``film`` with its last frame repeated until it has ``length`` frames."""
    return film[np.minimum(np.arange(length), len(film) - 1)]


def save_video(frames: np.ndarray, path: str | Path, fps: int = 25) -> Path:
    """Write ``frames`` (T, H, W, 3) uint8 to ``path``: .mp4, or a picture that moves, .png, .gif or .webp.

    An mp4's odd sizes get one repeated row or column, since browsers play only even ones.
    """
    frames, path = _frames("frames", frames), Path(path)
    if path.suffix in ANIMATED:
        write_bytes(path, animation(frames, fps, form=ANIMATED[path.suffix]))
        return path
    if path.suffix != ".mp4":
        raise ValueError(f"video file {path} must end in .mp4, {', '.join(ANIMATED)}")
    import imageio.v2 as imageio  # an mp4 is no figure: only who writes one needs it
    from imageio_ffmpeg import count_frames_and_secs

    even = np.pad(
        frames, ((0, 0), (0, frames.shape[1] % 2), (0, frames.shape[2] % 2), (0, 0)), mode="edge"
    )
    options = [
        "-threads",
        "1",
        "-fflags",
        "+bitexact",
        "-movflags",
        "+faststart",
    ]  # one thread: the same bytes again
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "film.mp4"
        try:
            imageio.mimwrite(
                made,
                list(even),
                fps=fps,
                codec="libx264",
                quality=7,
                macro_block_size=1,
                pixelformat="yuv420p",
                output_params=options,
            )
            if count_frames_and_secs(str(made))[0] != len(
                even
            ):  # ffmpeg says nothing of a full disk
                raise OSError("frames are missing")
        except (OSError, RuntimeError) as error:
            reason = str(error).partition("\n")[0]
            raise OSError(
                f"ffmpeg could not make {path}: {reason}. Make room in {tempfile.gettempdir()}."
            ) from error
        write_bytes(path, made.read_bytes())
    return path


def animation(
    frames: np.ndarray,
    fps: int = 25,
    *,
    form: str = "PNG",
    width: int = 960,
    colours: int = 96,
    hold: float = 0.0,
) -> bytes:
    """``frames`` (T, H, W, 3) uint8 as a picture that moves, again and again.

    form: PNG, GIF or WEBP. width: wider frames are made smaller, in pixels. colours: of a PNG or GIF, all frames alike,
    which makes them as small as a film is; a WEBP has any. hold: seconds that the last frame stays longer.
    """
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in _frames("frames", frames)]
    if (across := pictures[0].width) > width:
        size = width, round(pictures[0].height * width / across)
        pictures = [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    options: dict[str, int] = {"quality": 70, "method": 4} if form == "WEBP" else {}
    if form != "WEBP":
        some = np.concatenate(
            [np.asarray(picture) for picture in pictures[:: -(-len(pictures) // 8)]]
        )
        palette = Image.fromarray(some).quantize(colours, dither=Image.Dither.NONE)
        pictures = [
            picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
        ]
    written = BytesIO()
    times = [1000 / fps] * (len(pictures) - 1) + [1000 / fps + 1000 * hold]
    pictures[0].save(
        written, form, save_all=True, append_images=pictures[1:], duration=times, loop=0, **options
    )
    return written.getvalue()


def embed(film: str | Path | np.ndarray, fps: int = 25) -> Image:
    """A film for the end of a notebook cell, as a picture that moves: frames (T, H, W, 3), or an mp4 file."""
    from IPython.display import Image

    return Image(
        data=animation(film if isinstance(film, np.ndarray) else _read(Path(film)), fps),
        format="png",
    )


def _read(path: Path) -> np.ndarray:
    """The frames of an mp4 file."""
    import imageio.v2 as imageio

    if not path.is_file():
        raise FileNotFoundError(
            f"no film at {path}; write it with figures.save_video(frames, path) first"
        )
    return np.stack(imageio.mimread(path, memtest=False))
