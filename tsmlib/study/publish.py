"""Publishing: a paper-scale run copied into data/ and figures/, and the results in README and docs/ written from it."""

import shutil
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import nbformat
import pandas as pd

from tsmlib import figures, study
from tsmlib.envs import imperfect
from tsmlib.envs.spec import DELAY, ENV_IDS, MUJOCO_IDS, NOISE, EnvSpec
from tsmlib.storage import files, manifest
from tsmlib.storage import tables as tables_storage
from tsmlib.storage.files import writer_lock
from tsmlib.study import drawings, needed, notebooks, pages, runs, zoo
from tsmlib.study.claims import evaluate
from tsmlib.study.claims import report as claims_report
from tsmlib.study.claims.query import WEAK_MOTORS
from tsmlib.study.comparison import published
from tsmlib.study.drawings import Drawing
from tsmlib.study.notebooks import require
from tsmlib.study.results import exploration, table
from tsmlib.study.results import policies as policies_results
from tsmlib.study.results.planning import PUSH, REACH
from tsmlib.study.runs import FIGURES, RESULTS, ROOT, Notebook, Run, RunError
from tsmlib.study.tasks import load_task
from tsmlib.study.zoo import OURS, PAPERS

README = ROOT / "README.md"
RESULTS_PAGE, CLAIMS_PAGE = ROOT / "docs" / "results.md", ROOT / "docs" / "claims.md"
FULL_PAGE = ROOT / "docs" / "claims_in_full.md"  # claim by claim
SHIPPED = "shipped"  # tag of a notebook's cells that need no rows and no models but those that ship
ASKED = {  # parameters for these cells: without the plain arm, and plans for few targets
    "04_latent": {"env": f"tsm/ReacherObstacle-v0,{PUSH}"}, "07_action_prior": {"n_targets": "20"},
}  # fmt: skip
MARKS = ("<!-- results -->", "<!-- end of results -->")
FURTHER = {  # table -> the notebook that writes it beside its own
    "03_ablation": "03_predict", "03_samples": "03_predict", "05_control_rows": "05_control",
    "07_starts": "07_action_prior",
}  # fmt: skip
AIM_MARKS = ("<!-- aims -->", "<!-- end of aims -->")
CLAIM_MARKS = ("<!-- claims -->", "<!-- end of claims -->")
POOLED = (
    "03_predict",
    "04_latent",
    "06_robustness",
    "07_action_prior",
    "09_your_own",
    "10_explore",
)  # notebooks whose tables can be published alone


def publish(run: Run) -> None:
    """Copy a run's models, oracle plans, tables and figures into data/ and figures/; rewrite what is said of them.

    Tables have the rows of the other seeds beside this run as well; published rows that no run has anew stay. Raises
    RunError, before anything is written, unless the notebooks ran to their end and their results are as they left them.
    """
    for notebook in ("01_collect", "02_train", "05_control", *POOLED):
        require(run, notebook)
    tables = pooled(run)
    with writer_lock(RESULTS.parent, "publish", wait=True):
        for source, pattern, target in (
            (run.models, "*/*.safetensors", run.shipped),
            (run.folder("plans"), "*-oracle-*.safetensors", RESULTS),
            (run.figures, "*.*", FIGURES),
        ):
            for path in sorted(source.glob(pattern)):
                if _ships(path):
                    copy = target / path.relative_to(source)
                    copy.parent.mkdir(parents=True, exist_ok=True)
                    files.write_bytes(copy, path.read_bytes())
        _ship(tables)
    publish_claims()


def publish_table(run: Run, notebook: str) -> None:
    """Copy the tables of one notebook of POOLED, with all their seeds, into data/; rewrite what is said of the
    results. Published rows that no run has anew stay."""
    require(run, notebook)
    tables = pooled(run, [notebook])
    with writer_lock(RESULTS.parent, f"publish {notebook}", wait=True):
        _ship(tables)
    publish_claims()


def _ship(tables: Mapping[str, pd.DataFrame]) -> None:
    """Put rows of runs into the published tables, in place of those about the same; say what is new and what stays."""
    for name, rows in tables.items():
        path, before = RESULTS / f"{name}.csv", _shipped(name, rows)
        stay = table.others(before, rows)
        tables_storage.ship(path, tables_storage.frame(pd.concat([stay, rows])))
        gone = before.drop(stay.index)
        print(f"{name}: {_counted(rows)} rows of runs in place of {_counted(gone)} that shipped; {_counted(stay)} stay")
    manifest.write_manifest(RESULTS.parent)


def _shipped(name: str, rows: pd.DataFrame) -> pd.DataFrame:
    """The published table of a name; without rows, but with the columns of ``rows``, where there is none."""
    path = RESULTS / f"{name}.csv"
    return tables_storage.load(path) if tables_storage.stored(path) else rows[:0]


def _counted(rows: pd.DataFrame) -> str:
    """How many rows there are, and of which training seeds."""
    seeds = sorted(set(rows["seed"].dropna()))
    return f"{len(rows):,}" + f" (seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds))})" * bool(seeds)


def _ships(path: Path) -> bool:
    """Not checkpoints, nor models that only a table needs: of the paper's choices, of the map of imperfect arms, and
    ensembles, which are large, of the pymunk arm."""
    arms = {imperfect(arm, **how) for arm in ENV_IDS for how in ({}, {"noise": NOISE}, {"delay": DELAY})}
    table_only = path.stem in zoo.words("choice") or path.parent.name not in {EnvSpec.parse(arm).name for arm in arms}
    table_only = table_only or (path.stem.startswith("ensemble") and path.parent.name.startswith("Pymunk"))
    return ".checkpoint" not in path.name and not (path.parents[1].name == "models" and table_only)


def pooled(run: Run, made_by: Collection[str] = ()) -> dict[str, pd.DataFrame]:
    """Table -> the rows of this run and of every seed beside it.

    RunError where one did not come to its end, or rows are of fewer targets or episodes than those that ship.
    made_by: notebooks; by default all but that of the claims, which are judged anew.
    """
    word = {notebook.stem: notebook.name for notebook in runs.notebooks().values()}
    found = dict[str, pd.DataFrame]()
    for path in sorted(run.metrics.glob("*.csv")):
        notebook = FURTHER.get(path.stem, path.stem)
        if notebook in (made_by or word.keys() - {"08_claims"}):
            own = replace(run, notebook=notebook)
            found[path.stem] = rows = study.pooled_rows(own, tables_storage.load(path), path.stem)
            for what, (n, before) in table.of_fewer(_shipped(path.stem, rows), rows).items():
                told = [f"{name} {value}" for name, value in zip(table.REPLACED_TOGETHER, what, strict=True) if value]
                raise RunError(
                    f"{path.stem} has rows of {n} targets or episodes, expected the {before} that ship, for "
                    f"{', '.join(told)}. Make them of as many (python -m tsmlib run {word[notebook]}, with that scale "
                    "and seed, and no smaller parameters), or, to publish these alone, delete "
                    f"{RESULTS / path.name} first"
                )
    return found


def publish_claims() -> None:
    """Judge every claim from the tables that ship, and write README, docs/results.md, docs/claims.md and
    docs/claims_in_full.md. Idempotent."""
    with writer_lock(RESULTS.parent, "claims and pages", wait=True):  # rows that they are of stay as they are
        compress()
        papers, ours = pages.shipped_verdicts(PAPERS), pages.shipped_verdicts(OURS)
        rows = evaluate.as_rows(papers + ours, scale="paper")
        tables_storage.ship(RESULTS / "08_claims.csv", rows, extra=evaluate.EXTRA)
        manifest.write_manifest(ROOT / "data")
        between(README, AIM_MARKS, pages.readme_aims())
        between(README, MARKS, pages.readme_results())
        between(RESULTS_PAGE, MARKS, pages.results_page())
        between(README, CLAIM_MARKS, pages.readme_claims(papers, ours))
        between(CLAIMS_PAGE, CLAIM_MARKS, pages.claims_page(papers, ours))
        between(FULL_PAGE, CLAIM_MARKS, pages.full_page(papers, ours))
        draw_claims(papers)


def draw_claims(papers: list[evaluate.Verdict]) -> list[Path]:
    """The figure of all claims, and one of the checks of each. Returns their files."""
    figure = figures.claim_margins(claims_report.margins(papers))
    found = [*figures.save(figures.stamp(figure, "Rows: published; the paper's model"), FIGURES / "claims")]
    for verdict in papers:
        if checks := claims_report.drawn_checks(verdict):
            path = FIGURES / "claims" / f"{verdict.claim.id}.svg"
            found.append(figures.save_svg(figures.claim_checks(checks), path))
    return found


def compress() -> None:
    """Compress the large tables that are not yet. StoreError where one is there in both forms."""
    for path in filter(tables_storage.stored, sorted(RESULTS.glob("*.csv"))):
        tables_storage.ship_bytes(path, manifest.read_text(path).encode())


def between(page: Path, marks: tuple[str, str], written: str) -> None:
    """Put ``written`` between two marks of a page."""
    text = page.read_text()
    if any(text.count(mark) != 1 for mark in marks):
        raise RunError(f"{page} does not hold {' and '.join(marks)} once each; restore it: git checkout -- {page}")
    before, _, rest = text.partition(marks[0])
    after = rest.partition(marks[1])[2]
    files.write_bytes(page, "\n".join([before + marks[0], "", written, "", marks[1] + after]).encode())


# Figures -------------------------------------------------------------------------------------------------------------


def publish_figures() -> list[Path]:
    """Draw again every figure of figures/ that is a function of the rows, or in a few minutes of the models, that ship.

    Returns the others, which stay as they are: they are of a whole run at scale paper, or of a benchmark.
    """
    drawn = set[Path]()
    for figure, stem, rows in drawings_of_rows():
        figures.stamp(figure, table.stamp(rows, figure=True))
        drawn |= set(figures.save(figure, FIGURES / stem))
    drawn |= set(draw_claims(pages.shipped_verdicts(PAPERS)))
    with TemporaryDirectory() as folder:
        for notebook in runs.notebooks().values():
            for path in drawn_by_cells(notebook, Path(folder)):
                drawn.add(FIGURES / path.name)
                files.write_bytes(FIGURES / path.name, path.read_bytes())
    return sorted(path for path in set(FIGURES.glob("*.*")) - drawn if path.suffix != ".pdf")


def drawn_by_cells(notebook: Notebook, folder: Path) -> list[Path]:
    """The figures of those cells of a notebook that are tagged SHIPPED, executed in ``folder`` at scale paper: nothing
    is trained for them, since they need no model but those that ship."""
    cut = nbformat.read(notebook.path, 4)
    cut.cells = [cell for cell in cut.cells if {"parameters", SHIPPED} & set(cell.metadata.get("tags", ()))]
    if not any(SHIPPED in cell.metadata["tags"] for cell in cut.cells):
        return []
    copy = Notebook(notebook.name, folder / notebook.path.name)
    nbformat.write(cut, copy.path)
    given = {"run_dir": str(folder)} | ASKED.get(notebook.path.stem, {})
    execution = notebooks.prepare(copy, scale="paper", given=given)
    shutil.copytree(execution.run.shipped, execution.run.models, dirs_exist_ok=True)
    notebooks.execute(execution)
    return sorted(execution.run.figures.iterdir())


def drawings_of_rows() -> Iterator[Drawing]:
    """Every figure of the tables in data/results, as the run at scale paper draws it whose rows they are."""
    predict, codes, control, by_target, imperfect, explored = (
        published(name).assign(source=table.YOURS)
        for name in ("03_predict", "04_latent", "05_control", "05_control_rows", "06_robustness", "10_explore")
    )
    tasks = [load_task(env) for env in (REACH, PUSH)]
    yield drawings.figure5(predict, MUJOCO_IDS)
    yield from drawings.horizon(predict, MUJOCO_IDS)
    yield from drawings.differences(predict, MUJOCO_IDS, OURS)
    yield drawings.calibration(predict, MUJOCO_IDS)
    yield drawings.code_use(codes, [env for env in MUJOCO_IDS if env in set(codes["env"])])
    yield drawings.figure6(control, by_target, tasks)
    yield drawings.predicted_and_executed(by_target, tasks)
    yield drawings.closed_loop(control, by_target, tasks[-1])
    free = published("model_free").assign(source=table.YOURS)
    yield drawings.figure7(tables_storage.frame(pd.concat([control, policies_results.gradients(free)])), control)
    asked = needed.robustness(Run("06_robustness", "paper", 0, ROOT))
    words = [word for word in zoo.words("dynamics", "ablation") if word in set(imperfect["model"])]
    yield drawings.filtering(imperfect, asked.worlds["noise"], words)
    yield from drawings.figure8(imperfect, drawings.floors(tasks[0]))
    yield from drawings.advantage_map(imperfect, predict, asked.subject, asked.rivals, asked.noises, asked.delays)
    for env, titles in exploration.DRAWN.items():
        yield from drawings.rounds(explored, env, titles, free, control)
    yield from drawings.ways(explored, WEAK_MOTORS.env)
    yield from drawings.shares_left(explored)
    yield from drawings.gains(explored)
