"""What lies beside the package in a checkout, in its wheel, where ``tsmlib.shipped`` looks."""

import hashlib
import json
import re
import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

# All of data/ but this is in the wheel tsmlib-models, which release.py makes.
CORE = re.compile(r"data/tasks/.*|data/pretrained/\w+/(rtsm|prior|egocentric)\.safetensors")


class BuildPackage(build_py):
    """The package, and in it as ``_shipped`` tasks, notebooks and the models of the first pages."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        shipped, elsewhere = Path(self.build_lib) / "tsmlib" / "_shipped", {}
        shutil.rmtree(shipped, ignore_errors=True)  # of an earlier build
        shutil.copytree("notebooks", shipped / "notebooks", ignore=shutil.ignore_patterns(".*"))
        for path in sorted(path for path in Path("data").rglob("*") if path.is_file()):
            name = path.as_posix()
            if any(part.startswith(".") for part in path.parts):
                continue
            if CORE.fullmatch(name):
                (shipped / path).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, shipped / path)
            else:
                elsewhere[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        (shipped / "digests.json").write_text(json.dumps(elsewhere, indent=1, sort_keys=True))


setup(cmdclass={"build_py": BuildPackage})
