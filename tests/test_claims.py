"""The ledger says what rows say: planted effects are found, planted nulls are not, and wrong rows are refused."""

from __future__ import annotations

import ast
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tsmlib.statistics import interval
from tsmlib.storage import tables as tables_storage
from tsmlib.study import publish
from tsmlib.study.claims import evaluate, report
from tsmlib.study.claims import figure as claims_figure
from tsmlib.study.claims.evaluate import DEPENDENT, FAILED, INCONCLUSIVE, REPLICATED, UNTESTABLE, Tables
from tsmlib.study.runs import NOTEBOOKS, ROOT

HEAD = """
[words]
score = { file = "03_predict", metric = "ll_paper", condition = "clean", horizon = "" }
plan = { file = "05_control", metric = "return_true", condition = "clean", horizon = 50 }
learnt = { file = "05_policies", metric = "return_true", condition = "learning", horizon = "last" }
average = { horizon = "average" }
tsm = { model = "tsm" }
lstm = { model = "lstm" }
onestep = { model = "onestep" }

[made_by]
03_predict = "make predict"
05_control = "make control"
05_policies = "make policies"
"""
ENTRY = '[[claim]]\nid = "X1"\nplace = "here"\nstatement = "It is."\nstatistic = "it"\nnotebook = "03_predict"\n'


def claim(tmp_path: Path, *lines: str, head: str = HEAD, **options: Any) -> evaluate.Claim:
    """A ledger of one claim, read as the real one is."""
    path = tmp_path / "ledger.toml"
    path.write_text(head + ENTRY + "\n".join(lines))
    return evaluate.read(path, **options)[0]


def score(model: str, seed: int, value: float, **columns: Any) -> dict[str, Any]:
    row = dict(model=model, metric="ll_paper", condition="clean", horizon="", seed=seed, value=value, scale="paper")
    return row | columns


def study(**models: Any) -> Tables:
    """One value per seed and model."""
    return Tables({"03_predict": [score(m, k, float(v)) for m, values in models.items() for k, v in enumerate(values)]})


def share(
    rule: evaluate.Claim, word: str, effect: float, *, n: int = 10, noise: str = "normal", studies: int = 400
) -> float:
    """How many of the studies, of which each has n seeds and an effect in standard deviations, are given ``word``."""
    rng = np.random.default_rng(0)
    draw = {"normal": rng.standard_normal, "uniform": lambda size: rng.uniform(-(3**0.5), 3**0.5, size)}[noise]
    given = [evaluate.judge(rule, study(tsm=common + effect + draw(n), lstm=common)).word
             for common in 5 * rng.standard_normal((studies, n))]  # fmt: skip
    return given.count(word) / studies


# Verdicts ------------------------------------------------------------------------------------------------------------


def test_planted_effects_are_found(tmp_path: Path) -> None:
    better = claim(tmp_path, 'where = "score"', 'rule = ["tsm - lstm > 0"]')
    assert share(better, REPLICATED, 2.0) >= 0.95
    assert share(better, FAILED, -2.0) >= 0.95


@pytest.mark.parametrize("noise", ["normal", "uniform"])
@pytest.mark.parametrize("n", [3, 10])
def test_planted_nulls_are_not_replicated(tmp_path: Path, noise: str, n: int) -> None:
    better = claim(tmp_path, 'where = "score"', 'rule = ["tsm - lstm > 1"]')
    assert share(better, REPLICATED, 1.0, n=n, noise=noise) <= 0.05
    alike = claim(tmp_path, 'where = "score"', 'rule = ["-1 < tsm - lstm < 1"]')
    assert share(alike, REPLICATED, 1.0, n=n, noise=noise) <= 0.07  # its level is 5 %
    assert share(alike, REPLICATED, 0.0, n=60) >= 0.95


def test_better_than_each_means_each(tmp_path: Path) -> None:
    each = claim(tmp_path, 'where = "score"', 'each.rival = ["lstm", "onestep"]', 'rule = ["tsm - rival > 0"]')
    rows = study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[3, 3.2, 3.1])
    verdict = evaluate.judge(each, rows)
    assert verdict.word == INCONCLUSIVE
    assert verdict.key.check.text == "tsm - onestep > 0"
    worse = evaluate.judge(each, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[5, 5.2, 5.1]))
    assert worse.word == FAILED
    assert "1 of 2 checks fail" in worse.why


@pytest.mark.parametrize(
    ("paper", "fair", "word"),
    [
        (1, 1, REPLICATED),
        (1, -1, DEPENDENT),
        (-1, 1, DEPENDENT),
        (-1, -1, FAILED),
        (0, 1, DEPENDENT),
        (0, 0, INCONCLUSIVE),
    ],
)
def test_a_claim_that_turns_with_the_reading_depends_on_it(tmp_path: Path, paper: int, fair: int, word: str) -> None:
    rule = claim(tmp_path, 'where = "score"', 'rule = ["tsm > 0"]', 'readings."A1b shared" = { metric = "ll_shared" }')
    noise = [-0.2, 0.0, 0.2]
    rows = [score("tsm", k, paper + noise[k]) for k in range(3)]
    rows += [score("tsm", k, fair + noise[k], metric="ll_shared") for k in range(3)]
    verdict = evaluate.judge(rule, Tables({"03_predict": rows}))
    assert verdict.word == word
    assert ("A1b shared" in verdict.why) == (word == DEPENDENT)


def test_one_seed_has_no_interval(tmp_path: Path) -> None:
    verdict = evaluate.judge(claim(tmp_path, 'where = "score"', 'rule = ["tsm - lstm > 0"]'), study(tsm=[9], lstm=[1]))
    assert (verdict.word, verdict.key.n, verdict.key.low) == (INCONCLUSIVE, "1 seed", None)


def trials(seeds: int, n: int = 20) -> dict[str, list[dict[str, Any]]]:
    rng = np.random.default_rng(1)
    common = dict(metric="return_true", condition="clean", horizon=50, scale="paper")
    return {"05_control_rows": [
        dict(common, model=model, seed=seed, target=i, value=level + value)
        for model, level in (("tsm", 1.0), ("lstm", 0.0))
        for seed in range(seeds)
        for i, value in enumerate(rng.standard_normal(n))
    ]}  # fmt: skip


def test_trials_are_averaged_inside_a_seed_and_counted_only_where_there_is_one(tmp_path: Path) -> None:
    rule = claim(tmp_path, 'where = "plan"', 'rule = ["mean(tsm) - mean(lstm) > 0"]')
    rows = trials(3)
    assert evaluate.judge(rule, Tables(rows)).key.n == "3 seeds"
    rows = trials(1)
    values = {m: np.array([r["value"] for r in rows["05_control_rows"] if r["model"] == m]) for m in ("tsm", "lstm")}
    mean, half = interval(values["tsm"] - values["lstm"])  # paired by target
    key = evaluate.judge(rule, Tables(rows)).key
    assert key.n == "20 trials of 1 seed"
    np.testing.assert_allclose([key.value, key.low, key.high], [mean, mean - half, mean + half])


def test_a_share_is_of_the_trials_for_which_it_is_true(tmp_path: Path) -> None:
    rows = trials(2)
    wanted = np.mean([row["value"] <= 1 for row in rows["05_control_rows"] if row["model"] == "tsm"])
    key = evaluate.judge(claim(tmp_path, 'where = "plan"', 'rule = ["share(tsm <= 1) > 0.5"]'), Tables(rows)).key
    assert key.value == pytest.approx(wanted)


def test_a_learning_curve_is_asked_for_its_end_or_its_average(tmp_path: Path) -> None:
    common = dict(metric="return_true", condition="learning", model="tsm", scale="paper", copy=0)
    rows = [dict(common, seed=k, horizon=h, value=v + k) for k in (0, 1) for h, v in ((0, 1.0), (10, 2.0), (20, 6.0))]
    end = claim(tmp_path, 'where = "learnt"', 'rule = ["mean(tsm) - mean(tsm[average]) > 0"]')
    assert evaluate.judge(end, Tables({"05_policies": rows})).key.value == pytest.approx(3.0)
    with pytest.raises(evaluate.ClaimError, match="curves of different lengths"):
        evaluate.measure(end.readings[""][0], Tables({"05_policies": rows[:-1]}))


# Rows that are refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda rows: [row for row in rows if row["model"] == "tsm"], "no rows yet in 03_predict.csv of ll_paper"),
        (lambda rows: rows[:-1], r"03_predict.csv has seeds \[0, 1, 2\] of tsm, and \[0, 1\] of lstm"),
        (lambda rows: [*rows, rows[0]], "03_predict.csv has two rows for seed 0 of ll_paper"),
        (lambda rows: [*rows[:-1], {**rows[-1], "value": float("nan")}], "nan in seed 2"),
    ],
    ids=["missing", "of fewer seeds", "doubled", "not a number"],
)
def test_rows_are_refused_by_claim_file_and_remedy(tmp_path: Path, change: Any, said: str) -> None:
    rule = claim(tmp_path, 'where = "score"', 'rule = ["tsm - lstm > 0"]')
    rows = [score(model, k, 1.0 + k) for model in ("tsm", "lstm") for k in range(3)]
    verdict = evaluate.judge(rule, Tables({"03_predict": change(rows)}))
    assert verdict.word == UNTESTABLE
    assert re.search(said, verdict.why)
    assert verdict.why.startswith("X1: ")
    assert verdict.why.endswith("Run: make predict")


def test_trials_that_do_not_match_are_refused(tmp_path: Path) -> None:
    rows = trials(1)["05_control_rows"][:-1]
    verdict = evaluate.judge(
        claim(tmp_path, 'where = "plan"', 'rule = ["mean(tsm) - mean(lstm) > 0"]'), Tables({"05_control_rows": rows})
    )
    assert verdict.word == UNTESTABLE
    assert "05_control.csv has different trials" in verdict.why


def test_what_fails_fails_whatever_else_is_missing(tmp_path: Path) -> None:
    rule = claim(tmp_path, 'where = "score"', 'each.rival = ["lstm", "onestep"]', 'rule = ["tsm - rival > 0"]')
    assert evaluate.judge(rule, study(tsm=[1, 1.1, 1.2], lstm=[3, 3.2, 3.1])).word == FAILED
    assert evaluate.judge(rule, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1])).word == UNTESTABLE


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ('where = "score"\nrule = ["tsm - gru > 0"]', "nothing is called 'gru'"),
        ('where = "score"\nrule = ["tsm - lstm"]', "is no inequality"),
        ('where = ""\nrule = ["tsm > 0"]', "names no metric or no file"),
        ('where = "score"\nrule = ["mean(tsm) - tsm > 0"]', "asked for by trial and as a mean"),
        ('where = "score"\nrule = ["__import__(tsm) > 0"]', "nothing is called '__import__'"),
        ('rule = []\nmargin = 3', "margin"),
    ],
)  # fmt: skip
def test_a_claim_that_cannot_be_read_is_named(tmp_path: Path, line: str, said: str) -> None:
    with pytest.raises(evaluate.ClaimError, match=rf"ledger.toml, X1: .*{said}"):
        claim(tmp_path, line)


# Stored verdicts -----------------------------------------------------------------------------------------------------


def test_a_changed_rule_makes_older_verdicts_void(tmp_path: Path) -> None:
    lines = ('where = "score"', 'rule = ["tsm - lstm > 0"]')
    rule, rows = claim(tmp_path, *lines), study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1])
    path = tmp_path / "08_claims.csv"
    stored = evaluate.as_rows([evaluate.judge(rule, rows)], model="tsm", scale="paper")
    tables_storage.save_table(path, stored, extra=evaluate.EXTRA)
    assert evaluate.load(path, [rule]) == {"X1": REPLICATED}
    changes = [
        dict(lines=(lines[0], 'rule = ["tsm - lstm > 0.1"]')),
        dict(lines=(lines[0], 'rule = ["tsm - lstm >= 0"]')),
        dict(lines=(*lines, 'readings.fair = { metric = "ll_shared" }')),
        dict(
            lines=lines, head=HEAD.replace('condition = "clean", horizon = ""', 'condition = "contact", horizon = ""')
        ),
    ]
    for change in changes:
        other = claim(tmp_path, *change.pop("lines"), **change)
        with pytest.raises(
            evaluate.ClaimError, match=r"08_claims.csv: the rule of X1 has changed.*python -m tsmlib run claims"
        ):
            evaluate.load(path, [other])
    reworded = claim(tmp_path, *lines, 'section = "Elsewhere"')
    assert evaluate.load(path, [reworded]) == {"X1": REPLICATED}


def test_the_readme_and_what_is_stored_are_what_the_shipped_rows_say() -> None:
    papers, ours = (publish.shipped_verdicts(model) for model in (evaluate.PAPERS, evaluate.OURS))
    again = "the claims in README are not those of data/results; run: python -m tsmlib run claims"
    assert publish.readme_claims(papers, ours) in (ROOT / "README.md").read_text(), again
    for model, verdicts in ((evaluate.PAPERS, papers), (evaluate.OURS, ours)):
        ledger = [verdict.claim for verdict in verdicts]
        stored = evaluate.load(evaluate.RESULTS / "08_claims.csv", ledger, model=model)
        assert stored == {verdict.claim.id: verdict.word for verdict in verdicts}, again


# The ledger itself ---------------------------------------------------------------------------------------------------

LEDGER = evaluate.read()


def test_the_ledger_holds_every_claim_once_and_in_order() -> None:
    assert [c.id for c in LEDGER] == [f"C{i:02d}" for i in range(1, 55)]
    assert all(c.readings[""] for c in LEDGER)
    assert sum(c.headline for c in LEDGER) == 21
    assert set().union(*(c.why for c in LEDGER)) <= set(evaluate.VERDICTS)


@pytest.mark.parametrize("claim", LEDGER, ids=lambda c: c.id)
def test_a_claim_points_to_a_section_and_a_figure_that_exist(claim: evaluate.Claim) -> None:
    path = NOTEBOOKS / f"{claim.notebook}.ipynb"
    if not path.exists():
        pytest.skip(f"{claim.notebook} is not there yet")
    cells = json.loads(path.read_text())["cells"]
    text = "".join("".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "markdown")
    headings = re.findall(r"^#+ (.*?)\s*$", text, re.MULTILINE)
    assert not claim.section or claim.section in headings, f"{claim.id} in claims.toml: section is one of {headings}"


def planted(check: evaluate.Check, rng: np.random.Generator) -> Tables | None:
    """Rows of three seeds for which a check holds clearly; None where chance does not find any."""
    tree = ast.parse(check.expression, mode="eval").body
    side = -1 if check.op[0] == "<" else 1
    for _ in range(400):
        base = {term: rng.uniform(0.1, 3) for term in check.queries}
        if side * (float(evaluate._number(tree, base)) - check.margin) > 0.3:
            break
    else:
        return None
    tables: dict[str, list[dict[str, Any]]] = {}
    for term, query in check.queries.items():
        columns = {c: v for c, v in query.items() if c not in ("file", "trials")}
        columns["horizon"] = 100 if columns.get("horizon") in ("last", "average") else columns.get("horizon", "")
        for seed in range(3):
            row = columns | {"seed": seed, "value": base[term] * (1 + 0.01 * rng.uniform())}
            rows = [dict(row, target=i) for i in range(4)] if query["trials"] else [row]
            tables.setdefault(query["file"] + "_rows" * query["trials"], []).extend(rows)
    return Tables(tables)


def test_swapping_the_labels_of_two_models_turns_every_check_that_compares_them() -> None:
    rng, turned = np.random.default_rng(0), set()
    for c in LEDGER:
        for check in c.readings[""]:
            models = {query["model"] for query in check.queries.values()}
            rival = models - {"tsm"}
            if len(models) != 2 or len(rival) != 1 or check.op == "==" or re.search("corr|average", check.expression):
                continue
            rows = planted(check, rng)
            assert rows, check.text
            assert evaluate.measure(check, rows).state == "holds", check.text
            (other,) = rival
            swapped = evaluate.judge(c, rows.relabelled({"tsm": other, other: "tsm"}))
            effect = next(effect for effect in swapped.effects[""] if effect.check == check)
            assert effect.state in ("fails", "missing"), check.text
            turned.add((c.id, effect.state))
    assert len({name for name, state in turned if state == "fails"}) >= 12
    assert {"C23", "C26", "C27", "C30", "C31", "C32", "C34"} <= {name for name, state in turned if state == "fails"}


def test_every_choice_that_the_paper_leaves_open_is_stated_once() -> None:
    entries = tomllib.loads(report.CHOICES.read_text())["choice"]
    assert [entry["id"] for entry in entries] == [f"A{i}" for i in range(1, 32)]
    assert all(set(entry) == {"id", "open", "chosen", "why", "otherwise"} for entry in entries)
    named = {reading.split()[0] for c in LEDGER for reading in c.readings if re.match(r"A\d", reading)}
    assert {re.sub(r"\D+$", "", name) for name in named} <= {entry["id"] for entry in entries}


def test_a_choice_says_which_claims_it_turns(tmp_path: Path) -> None:
    rule = claim(tmp_path, 'where = "score"', 'rule = ["tsm > 0"]', 'readings."A1b shared" = { metric = "ll_shared" }')
    rows = [score("tsm", k, 1.0 + k) for k in range(3)]
    for sign, said in ((1, "not X1"), (-1, "turns X1")):
        fair = [score("tsm", k, sign * (1.0 + k), metric="ll_shared") for k in range(3)]
        lines = report.choices([evaluate.judge(rule, Tables({"03_predict": rows + fair}))]).splitlines()
        assert lines[2].endswith(f"| {said} |")
        assert all(line.endswith("|  |") for line in lines[3:])


def test_the_figure_has_a_row_for_every_claim_with_rows(tmp_path: Path) -> None:
    rule = claim(tmp_path, 'where = "score"', 'each.rival = ["lstm", "onestep"]', 'rule = ["tsm - rival > 0"]')
    verdict = evaluate.judge(rule, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[1, 1.2, 1.1]))
    ax = claims_figure.effects([verdict]).axes[0]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["X1"]
    marks = [line.get_xdata()[0] for line in ax.lines if line.get_marker() == "o"]
    assert len(marks) == 2
    assert all(0 < x < 1 for x in marks)
    with pytest.raises(ValueError, match="no claim has rows"):
        claims_figure.effects([evaluate.judge(rule, Tables({}))])


def test_intervals_are_those_of_students_t() -> None:
    for n, t95, t90 in ((3, 4.303, 2.920), (7, 2.447, 1.943), (10, 2.262, 1.833), (30, 2.045, 1.699)):
        values = np.arange(n, dtype=float)
        error = values.std(ddof=1) / n**0.5
        assert interval(values)[1] / error == pytest.approx(t95, rel=1e-3)
        assert interval(values, 0.90)[1] / error == pytest.approx(t90, rel=1e-3)
