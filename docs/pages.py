"""Sphinx extension of this site: pages of notebooks with their outputs, and formulas as MathML.

Browsers show MathML by themselves, so no page loads a script from elsewhere.
"""

import os
import re
import shutil
from pathlib import Path
from typing import NoReturn

import nbformat
from docutils import nodes
from math_core import LatexToMathML
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

from reproduction.runner import is_executed

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
MATHML = LatexToMathML(fancy_error=False)  # LatexError ends the build


def escape(
    app: object, what: str, name: str, documented: object, options: object, lines: list[str]
) -> None:
    """Stars and bars in docstrings are mathematics here, not markup. Sphinx's own signature."""
    for i, line in enumerate(lines):
        parts = re.split(r"(``.+?``)", line)
        parts[::2] = [re.sub(r"([*|])", r"\\\1", part) for part in parts[::2]]
        lines[i] = "".join(parts)


def anchor(title: str) -> str:
    """Anchor of a heading as Jupyter makes it, so that a link into a notebook works in both."""
    return title.strip().replace(" ", "-")


def linked(text: str) -> str:
    """Links to notebooks as links to their pages, and to what is no page as its path."""
    text = re.sub(r"\[[^\]]+\]\((?:\.\./)+(benchmarks/[^)]+)\)", r"`\1`", text)
    return re.sub(r"\]\((?:\.\./)+notebooks/", "](/notebooks/", text)


def copy_notebooks() -> None:
    """docs/notebooks/ anew: as the run of $TSM_DOCS_RUN executed them, or as they are stored."""
    target, run = HERE / "notebooks", os.environ.get("TSM_DOCS_RUN") or "runs/laptop/seed0"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir()
    for path in sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb")):
        nbformat.write(page_of(path, ROOT / run / path.name), target / path.name)


def page_of(stored: Path, executed: Path) -> nbformat.NotebookNode:
    """A notebook with the outputs of ``executed`` where that is of the notebook as it is now."""
    notebook, said = nbformat.read(stored, 4), "Not executed for this page"
    if executed.exists():
        if is_executed(stored, executed):
            notebook, said = (
                nbformat.read(executed, 4),
                f"As executed in `{os.path.relpath(executed.parent, ROOT)}`",
            )
        else:
            said += f": `{os.path.relpath(executed, ROOT)}` is of another version of it"
    heading = ""
    for cell in notebook.cells:
        if cell.cell_type == "code":  # what a picture is read out as
            cell.metadata["mystnb"] = {"image": {"alt": f"Picture: {heading}"}}
        else:
            heading = [heading, *re.findall(r"^#+ (?:\d+\. )?(.+)", cell.source, re.M)][-1]
            cell.source = linked(
                cell.source.replace("](../docs/", "](../").replace("../figures/", "../../figures/")
            )
    notebook.cells = [
        cell
        for cell in notebook.cells
        if "injected-parameters" not in cell.metadata.get("tags", [])
    ]
    command = f"`python -m tsmlib run {stored.stem.partition('_')[2]}`, then `make docs`"
    notebook.cells.insert(
        1, nbformat.v4.new_markdown_cell(f"*{said}. Your own run here: {command}.*")
    )
    return notebook


def inline_formula(page: HTML5Translator, node: nodes.math) -> NoReturn:
    """A formula within a sentence. Sphinx's own signature."""
    page.body.append(MATHML.convert_with_local_state(node.astext(), displaystyle=False))
    raise nodes.SkipNode


def display_formula(page: HTML5Translator, node: nodes.math_block) -> NoReturn:
    """A formula on a line of its own, with its number where it has one."""
    tex = node.astext()
    if r"\tag" in tex:
        tex = rf"\begin{{equation}}{tex}\end{{equation}}"
    shown = MATHML.convert_with_local_state(tex, displaystyle=True)
    page.body.append(f'<div class="math" style="margin: 1em 0; overflow-x: auto">{shown}</div>\n')
    raise nodes.SkipNode


def read(app: Sphinx, name: str, source: list[str]) -> None:
    """Sphinx's event source-read."""
    source[0] = linked(source[0])


def copy_explorer(app: Sphinx, failed: Exception | None) -> None:
    """Sphinx's event build-finished: the page of the explorer, or how to build it."""
    built, target = ROOT / "explorer" / "dist", Path(app.outdir) / "explorer"
    shutil.rmtree(target, ignore_errors=True)
    if (built / "index.html").exists():
        shutil.copytree(built, target)
    else:
        target.mkdir(parents=True)
        said = "The explorer was not built with this documentation; build both: make explorer docs"
        (target / "index.html").write_text(
            f"<!doctype html><title>tsmlib explorer</title><p>{said}</p>"
        )


def setup(app: Sphinx) -> dict[str, bool]:
    copy_notebooks()
    app.add_html_math_renderer("mathml", (inline_formula, None), (display_formula, None))
    app.connect("source-read", read)
    app.connect("autodoc-process-docstring", escape, priority=400)  # before napoleon
    app.connect("build-finished", copy_explorer)
    return {"parallel_read_safe": True}
