"""What a person reads: README is short, each block of Python in it and in docs/ runs, results are those of the rows."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat
import pytest
import yaml

import tsmlib
from tsmlib.storage import tables
from reproduction import pages, publish
from reproduction.runs import ROOT

README, DOCS = ROOT / "README.md", ROOT / "docs"
BUILT = DOCS / "_build" / "html"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
LOADED = re.compile(
    r"<(?:script|link|img|iframe|source)\b[^>]*\b(?:src|href)=[\"'](?:https?:)?//[^>]*>"
)
WRITTEN = [page for page in sorted(DOCS.rglob("*.md")) if "_build" not in page.parts]
OPTIONAL = {
    "mbrl_lib": "mbrl.models",
    "own_data": "minari",
}  # page -> what its program needs that may be missing
COMMAND = re.compile(r"\bpython ((?:-m tsmlib|benchmarks/)[^`\n]*)")
COMMANDING = [
    README,
    ROOT / "CONTRIBUTING.md",
    *WRITTEN,
    *sorted((ROOT / "benchmarks").glob("*/README.md")),
]
PAGES = [
    page for page in WRITTEN if BLOCK.search(page.read_text()) and page.stem != "own_data"
]  # which has its own test


def run(page: Path, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """The Python blocks of a page as one program, in an empty folder: the names that it leaves."""
    monkeypatch.chdir(folder)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    names: dict[str, Any] = {"__name__": page.stem}
    exec(compile("\n".join(BLOCK.findall(page.read_text())), str(page), "exec"), names)
    return names


def test_the_page_on_reproducing_has_a_command_for_every_table_that_ships() -> None:
    (block,) = re.findall(
        r"^rows=.*?^```", (DOCS / "reproducing.md").read_text(), re.DOTALL | re.MULTILINE
    )
    shipped = {path.name.partition(".")[0] for path in publish.RESULTS.glob("*.csv*")}
    assert not [name for name in sorted(shipped) if not re.search(rf"\b{name}\b", block)]


def test_the_readme_is_a_screen_and_a_half() -> None:
    assert len(README.read_text().splitlines()) <= 120
    assert README.stat().st_size <= 8000


def test_the_plans_in_the_readme_are_far_better_than_doing_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = run(README, tmp_path, monkeypatch)
    predicted = -names["plan"].predicted_return.mean()
    cost, nothing = (-names[name].executed_return.mean() for name in ("trial", "idle"))
    assert cost <= 0.6 * nothing
    assert (
        abs(cost - predicted) <= 0.1 * cost
    )  # as predicted by samples that had no part in choosing the plan
    assert (tmp_path / "reach.mp4").stat().st_size > 1000
    first, _ = BLOCK.findall(README.read_text())
    exec(
        first[first.index("past, space =") :], names
    )  # again, for the other target by the other model
    cost, nothing = (-names[name].executed_return.mean() for name in ("trial", "idle"))
    assert cost <= 0.6 * nothing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_program_of_a_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(OPTIONAL.get(page.stem, "tsmlib"))
    run(page, tmp_path, monkeypatch)


def test_a_plan_made_from_logs_alone_takes_the_cart_to_its_goal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(OPTIONAL["own_data"])
    names = run(DOCS / "howto" / "own_data.md", tmp_path, monkeypatch)
    place, speed = names["past"].states[0, -1].tolist()
    for force in names["plan"].actions[0, :, 0].tolist():  # the cart of the page's data
        speed += 0.1 * force
        place += 0.05 * speed
    assert abs(place - 0.2) < 0.05


@pytest.mark.parametrize(
    "page",
    [
        README,
        *sorted(DOCS.glob("[!_]*.md")),
        *sorted(DOCS.glob("[!_]*/*.md")),
        ROOT / "CONTRIBUTING.md",
    ],
    ids=str,
)
def test_a_page_names_commands_and_files_that_exist(page: Path) -> None:
    text, makefile = page.read_text(), (ROOT / "Makefile").read_text()
    for target in re.findall(r"(?:^|`)make (\w+)", text, re.MULTILINE):
        assert re.search(rf"^(\w+ )*{target}( \w+)*:", makefile, re.MULTILINE), target
    for name in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (page.parent / name).exists(), name


@pytest.mark.parametrize("page", COMMANDING, ids=str)
def test_a_command_of_a_page_is_a_script_that_has_its_options(page: Path) -> None:
    text = re.sub(
        r"(?<!`)`[^`]+`(?!`)", lambda code: code[0].replace("\n", " "), page.read_text()
    )  # unwrapped
    lines = text.replace("\\\n", " ").splitlines()
    for command in [found for line in lines for found in COMMAND.findall(line)]:
        script, *words = re.split(" -- | #", command)[0].split()
        path = ROOT / ("tsmlib/__main__.py" if script == "-m" else script.rstrip('"'))
        assert path.is_file(), command
        options = path.read_text() + (ROOT / "benchmarks/_rounds.py").read_text()
        for word in words:
            assert not word.startswith("--") or f'"{word}"' in options, command
        if script == "-m" and words[1:]:
            assert f'"{words[1]}"' in options, command


@pytest.mark.parametrize("asked", ["own environment", "own robot", "fine-tune", "cluster"])
def test_a_search_finds_a_how_to(asked: str) -> None:
    words = asked.replace("fine-tune", "fine-tun").split()
    titles = [page.read_text().partition("\n")[0].lower() for page in (DOCS / "howto").glob("*.md")]
    assert any(all(word in title for word in words) for title in titles)


def test_written_results_are_those_of_the_shipped_tables() -> None:
    again = "what is written of the results is not what data/results says; run: python -m tsmlib publish --claims"
    assert pages.readme_results() in README.read_text(), again
    assert pages.results_page() in publish.RESULTS_PAGE.read_text(), again


@pytest.mark.skipif(not BUILT.exists(), reason="make docs was not run")
def test_a_built_page_loads_nothing_from_elsewhere() -> None:
    found = {page.name: LOADED.findall(page.read_text()) for page in BUILT.rglob("*.html")}
    assert "segments.html" in found
    assert not {name: loaded for name, loaded in found.items() if loaded}


def test_templates_and_workflow_are_yaml() -> None:
    files = sorted((ROOT / ".github").rglob("*.yml"))
    assert len(files) >= 4
    for path in files:
        assert yaml.safe_load(path.read_text()), path


def test_every_public_name_has_an_entry_in_the_reference() -> None:
    listed = set(re.findall(r"^   (\w+)$", (DOCS / "api" / "index.md").read_text(), re.MULTILINE))
    assert listed == {name for name in tsmlib.__all__ if not name.startswith("_")}


def test_a_notebook_is_shown_as_it_was_executed_unless_it_has_changed_since(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("math_core")
    monkeypatch.syspath_prepend(DOCS)
    from pages import page_of

    stored, executed = ROOT / "notebooks" / "08_claims.ipynb", tmp_path / "08_claims.ipynb"
    assert "Not executed for this page" in page_of(stored, executed).cells[1].source
    own = nbformat.read(stored, 4)
    cells = [cell for cell in own.cells if cell.cell_type == "code"]
    cells[1].outputs = [nbformat.v4.new_output("stream", text="what came out")]
    nbformat.write(own, executed)
    shown = page_of(stored, executed)
    assert "As executed in" in shown.cells[1].source
    assert "what came out" in str(shown)
    cells[1].source += "\nmore"
    nbformat.write(own, executed)
    shown = page_of(stored, executed)
    assert "is of another version" in shown.cells[1].source
    assert "what came out" not in str(shown)


@pytest.mark.parametrize(
    "path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem
)
def test_no_notebook_links_to_a_local_picture(path: Path) -> None:
    cells = [cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown"]
    assert not re.findall(r"!\[[^\]]*\]\((?!https:)[^)]+\)", "\n".join(cells))


@pytest.mark.parametrize(
    "page", sorted((DOCS / "explanation").glob("*.md")), ids=lambda page: page.stem
)
def test_the_equation_that_a_piece_of_code_is_stands_above_it(page: Path) -> None:
    above = re.split(r"^```\{literalinclude\}[^`]*^```\n", page.read_text(), flags=re.MULTILINE)[
        :-1
    ]
    for text in above:
        assert "$$" in text.rpartition("\n## ")[2] or not text.strip(), (
            text
        )  # or it shares the one before


def test_gradients_over_codes_leave_smaller_gaps_and_return_less_as_the_page_on_the_prior_says() -> (
    None
):
    rows = tables.load(ROOT / "data" / "results" / "05_control.csv")
    rows = rows[
        (rows["planner"] == "adam") & (rows["execution"] == "open loop") & rows["iteration"].isna()
    ]
    found = rows.pivot_table(
        index=["env", "model"], columns=["metric", "search_space"], values="value"
    )
    found = found[["gap_absolute", "return_true"]].dropna()
    assert len(found) >= 7  # the baselines' plans of reaching are direct alone
    assert (found["gap_absolute"]["latent"] < found["gap_absolute"]["direct"]).all()
    assert (found["return_true"]["latent"] < found["return_true"]["direct"]).all()


def test_codes_tell_futures_apart_where_the_object_is_hit_and_not_where_it_is_missed_as_their_page_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missed, hit = run(DOCS / "explanation" / "codes.md", tmp_path, monkeypatch)["spread"]
    assert missed.max() < 0.5  # cm
    assert hit.min() > 1.0


def test_by_the_cross_entropy_method_both_search_spaces_return_about_the_same_as_that_page_says() -> (
    None
):
    rows = tables.load(ROOT / "data" / "results" / "05_control.csv")
    rows = rows[
        (rows["planner"] == "cem") & (rows["execution"] == "open loop") & rows["iteration"].isna()
    ]
    found = rows[rows["metric"] == "return_true"].pivot_table(
        index=["env", "model"], columns="search_space", values="value"
    )
    apart = (found["latent"] / found["direct"] - 1).abs().dropna()
    assert len(apart) > 10
    assert (apart < 0.04).all()
