"""Films: side by side, one above another, as files, and as pictures that move inside a notebook.

A notebook's film is an animated PNG. JupyterLab removes the source of a ``<video>`` from a notebook
that it does not trust, as from any that was executed elsewhere; it shows a picture.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from tsmlib.storage.files import write_bytes

if TYPE_CHECKING:
    from IPython.display import Image

Form = Literal["PNG", "GIF", "WEBP"]
ANIMATED: dict[str, Form] = {".png": "PNG", ".gif": "GIF", ".webp": "WEBP"}


def side_by_side(films: Mapping[str, np.ndarray]) -> np.ndarray:
    """Films as one, each below its label; a shorter one waits on its last frame.

    Args:
        films: label -> frames (T, H, W, 3) uint8, all of one height.

    Returns:
        Frames (T, H + strip, W1 + W2 + ..., 3).

    Raises:
        ValueError: no film, or films of different heights.
    """
    films = {label: _frames(label, film) for label, film in films.items()}
    heights = {label: film.shape[1] for label, film in films.items()}
    if len(set(heights.values())) != 1:
        found = ", ".join(f"{label} {pixels}" for label, pixels in heights.items()) or "no film"
        raise ValueError(
            f"films of one height are expected, found pixels: {found}; render all at one height"
        )
    length, height = max(map(len, films.values())), max(20, max(heights.values()) // 14)
    parts = []
    for label, film in films.items():
        banner = Figure(figsize=(film.shape[2] / 100, height / 100), dpi=100, facecolor="white")
        banner.text(
            0.5, 0.45, label, ha="center", va="center", fontsize=0.5 * height, family="DejaVu Sans"
        )
        canvas = FigureCanvasAgg(banner)
        canvas.draw()
        strip = np.asarray(canvas.buffer_rgba())[..., :3]
        above = np.broadcast_to(strip, (length, *strip.shape))
        parts.append(np.concatenate([above, _waiting(film, length)], axis=1))
    return np.concatenate(parts, axis=2)


def stacked(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Two films as one; the shorter one waits on its last frame.

    Args:
        above: frames (T1, H1, W, 3) uint8.
        below: frames (T2, H2, W, 3) uint8.

    Returns:
        Frames (T, H1 + H2, W, 3).

    Raises:
        ValueError: films of different widths.
    """
    above, below = _frames("above", above), _frames("below", below)
    if above.shape[2] != below.shape[2]:
        raise ValueError(
            f"above is {above.shape[2]} pixels wide and below {below.shape[2]}; render both at one "
            "width"
        )
    length = max(len(above), len(below))
    return np.concatenate([_waiting(above, length), _waiting(below, length)], axis=1)


def save_video(frames: np.ndarray, path: str | Path, fps: int = 25) -> Path:
    """Write a film: .mp4, or a picture that moves, .png, .gif or .webp.

    Args:
        frames: (T, H, W, 3) uint8; an mp4 of odd sizes repeats a row or column.
        path: the file.
        fps: frames per second.

    Returns:
        The path.

    Raises:
        ValueError: another ending, or something else than frames.
        OSError: ffmpeg could not write the file.
    """
    frames, path = _frames("frames", frames), Path(path)
    if path.suffix in ANIMATED:
        write_bytes(path, animation(frames, fps, form=ANIMATED[path.suffix]))
        return path
    if path.suffix != ".mp4":
        raise ValueError(f"video file {path} must end in .mp4, {', '.join(ANIMATED)}")
    try:
        import imageio.v2 as imageio  # only an mp4 needs it
        from imageio_ffmpeg import count_frames_and_secs
    except ImportError as error:
        raise OSError(
            f"an mp4 needs ffmpeg: pip install imageio-ffmpeg, or name {path.stem}.webp instead"
        ) from error
    rows, columns = frames.shape[1] % 2, frames.shape[2] % 2  # browsers play only even sizes
    even = np.pad(frames, ((0, 0), (0, rows), (0, columns), (0, 0)), mode="edge")
    # One thread, so that the bytes are the same again.
    options = [
        "-preset",
        "veryfast",
        "-threads",
        "1",
        "-fflags",
        "+bitexact",
        "-movflags",
        "+faststart",
    ]
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
            if count_frames_and_secs(str(made))[0] != len(even):  # ffmpeg hides a full disk
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
    form: Form = "PNG",
    width: int = 960,
    colours: int = 96,
    hold: float = 0.0,
) -> bytes:
    """A film as a picture that moves, again and again.

    Args:
        frames: (T, H, W, 3) uint8.
        fps: frames per second.
        form: PNG, GIF or WEBP.
        width: wider frames are made smaller, in pixels.
        colours: of a PNG or GIF, all frames alike, which keeps the file small.
        hold: seconds that the last frame stays longer.

    Returns:
        The bytes of the file.

    Raises:
        ValueError: something else than frames.
    """
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in _frames("frames", frames)]
    if (across := pictures[0].width) > width:
        size = width, round(pictures[0].height * width / across)
        pictures = [picture.resize(size, Image.Resampling.LANCZOS) for picture in pictures]
    options: dict[str, int] = {"quality": 70, "method": 4} if form == "WEBP" else {}
    if form != "WEBP":
        some = [np.asarray(picture) for picture in pictures[:: -(-len(pictures) // 8)]]
        palette = Image.fromarray(np.concatenate(some)).quantize(colours, dither=Image.Dither.NONE)
        pictures = [
            picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures
        ]
    written = BytesIO()
    times = [1000 / fps] * (len(pictures) - 1) + [1000 / fps + 1000 * hold]
    pictures[0].save(
        written, form, save_all=True, append_images=pictures[1:], duration=times, loop=0, **options
    )
    return written.getvalue()


def embed(frames: np.ndarray, fps: int = 25) -> Image:
    """A film for the end of a notebook cell.

    Args:
        frames: (T, H, W, 3) uint8.
        fps: frames per second.

    Returns:
        A picture that moves.
    """
    from IPython.display import Image

    return Image(data=animation(frames, fps), format="png")


def _frames(name: str, frames: np.ndarray) -> np.ndarray:
    frames = np.asarray(frames)
    if frames.dtype != np.uint8 or frames.ndim != 4 or frames.shape[3] != 3 or 0 in frames.shape:
        raise ValueError(
            f"{name} is {frames.dtype} {frames.shape}; expected uint8 (T, H, W, 3) with at least "
            "one frame"
        )
    return frames


def _waiting(film: np.ndarray, length: int) -> np.ndarray:
    """``film`` with its last frame repeated until it has ``length`` frames."""
    return film[np.minimum(np.arange(length), len(film) - 1)]
