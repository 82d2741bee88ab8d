"""Draw README's small pictures: ``python docs/thumbnails.py`` after ``make docs``.

figures/notebooks/NN_name.webp is a picture of the executed notebook; figures/push.webp is
the last frame of the film push.mp4 of README's example, where it was run in this folder.
"""

from __future__ import annotations

import base64
from io import BytesIO
from pathlib import Path

import nbformat
from PIL import Image

from reproduction.runner import notebooks
from reproduction.runs import Run
from tsmlib.storage.files import write_bytes

FIGURES = Path(__file__).resolve().parents[1] / "figures"
WIDTH = 320
SHOWN = {"00": 1, "02": 1, "04": 2, "06": 2, "11": 1}  # which picture; the first of the others


def main() -> None:
    for path in notebooks().values():
        copy = nbformat.read(Run().folder / path.name, 4)
        outputs = [output for cell in copy.cells for output in cell.get("outputs", ())]
        pictures = [x.data["image/png"] for x in outputs if "image/png" in x.get("data", {})]
        picture = Image.open(BytesIO(base64.b64decode(pictures[SHOWN.get(path.stem[:2], 0)])))
        picture.seek(getattr(picture, "n_frames", 1) - 1)
        write_bytes(FIGURES / "notebooks" / f"{path.stem}.webp", small(picture.convert("RGB")))
    if (film := Path("push.mp4")).exists():
        import imageio.v3 as imageio

        write_bytes(FIGURES / "push.webp", small(Image.fromarray(imageio.imread(film)[-1]), 640))


def small(picture: Image.Image, width: int = WIDTH) -> bytes:
    """A picture at most ``width`` wide, on white."""
    picture.thumbnail((width, width))
    written = BytesIO()
    picture.save(written, "WEBP", quality=60, method=6)
    return written.getvalue()


if __name__ == "__main__":
    main()
