"""data/ and notebooks/ in a wheel, where ``tsmlib.pretrained`` looks."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildPackage(build_py):
    """The package, and in it as ``_shipped`` what lies beside it in a checkout."""

    def run(self) -> None:
        super().run()
        if self.editable_mode:
            return
        shipped = Path(self.build_lib) / "tsmlib" / "_shipped"
        shutil.rmtree(shipped, ignore_errors=True)  # of an earlier build
        for name in ("data", "notebooks"):
            shutil.copytree(name, shipped / name, ignore=shutil.ignore_patterns(".*"))


setup(cmdclass={"build_py": BuildPackage})
