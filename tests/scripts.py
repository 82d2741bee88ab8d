"""Scripts of benchmarks/, run as a person runs them but in this process, which has imported torch already."""

from __future__ import annotations

import io
import runpy
import sys
from contextlib import redirect_stdout
from pathlib import Path
from unittest.mock import patch


def run_script(path: Path, *options: str) -> str:
    """What the script prints. Its folder has to be on sys.path."""
    printed = io.StringIO()
    with patch.object(sys, "argv", [str(path), *options]), redirect_stdout(printed):
        runpy.run_path(str(path), run_name="__main__")
    return printed.getvalue()
