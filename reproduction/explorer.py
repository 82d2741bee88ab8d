"""The explorer, a page in which a person plans and MuJoCo executes, served to this machine."""

from __future__ import annotations

import functools
import http.server
import io
import os
import webbrowser
from pathlib import Path
from typing import BinaryIO

from reproduction.runner import RunError
from tsmlib import shipped

PORT = 8765
TYPES = {".wasm": "application/wasm", ".js": "text/javascript", ".f32": "application/octet-stream"}
HEADERS = {
    "Cache-Control": "no-cache",  # a page that was built again is not mixed with the one before
    "X-Content-Type-Options": "nosniff",
    # MuJoCo's bindings are made at run time, hence unsafe-eval
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data:",
}


class Handler(http.server.SimpleHTTPRequestHandler):
    """Files of a folder with the types and headers that the page needs. Says nothing."""

    timeout = 30  # seconds that a connection may say nothing
    extensions_map = {**http.server.SimpleHTTPRequestHandler.extensions_map, **TYPES}  # noqa: RUF012

    def send_head(self) -> io.BytesIO | BinaryIO | None:
        """Answer this machine alone, with files of the folder and not with what links lead to."""
        host = self.headers.get("Host", "").rpartition(":")[0]
        path = self.translate_path(self.path)
        if host not in ("127.0.0.1", "localhost"):
            self.send_error(403)
        elif "\0" in path or os.path.realpath(path) != os.path.abspath(path):
            self.send_error(404)
        else:
            return super().send_head()
        return None

    def end_headers(self) -> None:
        for name, value in HEADERS.items():
            self.send_header(name, value)
        super().end_headers()

    def list_directory(self, path: object) -> None:
        self.send_error(404)

    def log_message(self, format: str, *arguments: object) -> None:
        pass


def page() -> Path:
    """The folder of the page; ValueError where tsmlib-models, which holds it, is not installed."""
    name = "explorer/dist"
    return shipped.more(name, []) if shipped.INSTALLED else shipped.ROOT / name


def server(folder: Path | None = None, *, port: int = PORT) -> http.server.ThreadingHTTPServer:
    """A server of the page on 127.0.0.1, not yet running; port 0 is any that is free.

    RunError where the page is not built, or the port is taken or none.
    """
    folder = folder or page()
    if not (folder / "index.html").exists() or not (folder / "manifest.json").exists():
        raise RunError(
            f"there is no page in {folder}; build it, which needs node and npm: make explorer"
        )
    try:
        return http.server.ThreadingHTTPServer(
            ("127.0.0.1", port), functools.partial(Handler, directory=str(folder))
        )
    except (OSError, OverflowError) as error:
        why = error.strerror if isinstance(error, OSError) else "ports are 0 to 65535"
        raise RunError(
            f"port {port} of 127.0.0.1 cannot be used ({why}); name another: --port 0"
        ) from error


def serve(*, port: int = PORT, browser: bool = False) -> None:
    """Serve the page until interrupted, and say where."""
    with server(port=port) as running:
        address = f"http://127.0.0.1:{running.server_port}/"
        print(f"{address}  (Ctrl-C ends it)", flush=True)
        if browser:
            webbrowser.open(address)
        running.serve_forever()
