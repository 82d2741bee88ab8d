"""A film moves in JupyterLab, in a notebook that it does not trust."""

from __future__ import annotations

import base64
import json
import os
import shutil
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest

from tsmlib import plots

BROWSER, DRIVER = (
    shutil.which("chromium") or shutil.which("google-chrome"),
    shutil.which("chromedriver"),
)

pytestmark = pytest.mark.skipif(
    not (BROWSER and DRIVER), reason="neither Chromium nor its driver is installed"
)
pytest.importorskip("jupyterlab")


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@contextmanager
def process(command: list[str], answers: str, **options: Any) -> Iterator[None]:
    """A server, from when ``answers`` does to the end of the block."""
    server = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **options
    )
    try:
        wait_for(lambda: urllib.request.urlopen(answers, timeout=30).status == 200)
        yield
    finally:
        server.kill()
        server.wait(60)


def wait_for(what: Callable[[], Any], seconds: float = 600) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with suppress(OSError):
            if found := what():
                return found
        time.sleep(0.2)
    raise AssertionError("it did not come")


class Page:
    """A page in a browser without a window, by the WebDriver protocol."""

    def __init__(self, driver: str, folder: Path) -> None:
        flags = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--disable-background-networking",
            "--window-size=1440,900",
            f"--user-data-dir={folder}",
        ]
        asked = {"browserName": "chrome", "goog:chromeOptions": {"binary": BROWSER, "args": flags}}
        self.session = driver + "/session"
        self.session += "/" + self.ask("", capabilities={"alwaysMatch": asked})["sessionId"]

    def ask(self, path: str, **body: Any) -> Any:
        data, kind = json.dumps(body).encode(), {"Content-Type": "application/json"}
        with urllib.request.urlopen(
            urllib.request.Request(self.session + path, data, kind), timeout=300
        ) as answer:
            return json.load(answer)["value"]

    def script(self, text: str) -> Any:
        return self.ask("/execute/sync", script=text, args=[])

    def picture(self, selector: str) -> bytes:
        """What one element looks like."""
        (element,) = self.script(f"return document.querySelector('{selector}')").values()
        with urllib.request.urlopen(
            f"{self.session}/element/{element}/screenshot", timeout=300
        ) as answer:
            return base64.b64decode(json.load(answer)["value"])


def write_notebook(path: Path) -> None:
    """A notebook that somebody else executed: a film, and the same as markup with a video."""
    frames = np.zeros((30, 60, 80, 3), np.uint8)
    for step in range(30):
        frames[step, :, 2 * step : 2 * step + 20] = 250
    video = base64.b64encode(
        plots.save_video(frames, path.with_suffix(".mp4")).read_bytes()
    ).decode()
    source = f'<source src="data:video/mp4;base64,{video}" type="video/mp4">'
    data = {"image/png": base64.b64encode(plots.embed(frames, fps=10).data).decode()}
    markup = {"text/html": f"<video controls>{source}</video>"}
    cell = nbformat.v4.new_code_cell("1", execution_count=1)
    cell.outputs = [nbformat.v4.new_output("display_data", each) for each in (data, markup)]
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), path)


def test_a_film_moves_in_a_notebook_that_is_not_trusted(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    write_notebook(tmp_path / "film.ipynb")
    lab, driver = (f"http://127.0.0.1:{free_port()}" for _ in range(2))
    places = {f"JUPYTER_{kind}_DIR": str(tmp_path / kind) for kind in ("DATA", "CONFIG", "RUNTIME")}
    settings = [
        f"--ServerApp.port={lab.rpartition(':')[2]}",
        "--ServerApp.ip=127.0.0.1",
        "--IdentityProvider.token=",
        f"--ServerApp.root_dir={tmp_path}",
        "--allow-root",
        "--no-browser",
    ]
    with (
        process(
            [sys.executable, "-m", "jupyterlab", *settings],
            lab + "/api",
            env={**os.environ, **places},
        ),
        process([str(DRIVER), f"--port={driver.rpartition(':')[2]}"], driver + "/status"),
    ):
        page = Page(driver, tmp_path / "profile")
        page.ask("/url", url=lab + "/lab/tree/film.ipynb")
        area = "document.querySelector('.jp-OutputArea')"
        assert (
            wait_for(lambda: page.script(f"return {area}?.querySelector('img')?.naturalWidth"))
            == 80
        )
        wait_for(lambda: page.script(f"return {area}.querySelector('video') !== null"))
        source = page.script(
            f"return {area}.querySelector('video source')?.getAttribute('src') ?? ''"
        )
        assert source == ""  # the notebook is not trusted
        shown = ".jp-OutputArea img"
        assert wait_for(lambda: page.picture(shown) != page.picture(shown), seconds=30)
        urllib.request.urlopen(urllib.request.Request(page.session, method="DELETE"), timeout=60)
