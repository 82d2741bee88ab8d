"""The ledger says what rows say: planted effects are found, planted nulls are not, and wrong rows are refused."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scripts import load_script, run_script

from tsmlib import plots as figures
from tsmlib.statistics import Estimate, holm, interval, random_effects
from tsmlib.storage import files, manifest
from tsmlib.storage import tables as tables_storage
from reproduction import pages, publish
from reproduction.claims import evaluate, ledger, report
from reproduction.claims.claim import (
    DEFINITIONAL,
    DEPENDENT,
    FAILED,
    INCONCLUSIVE,
    REPLICATED,
    UNTESTABLE,
    VERDICTS,
    Claim,
)
from reproduction.claims.evaluate import Tables
from reproduction.claims.query import (
    ADAM,
    LAP,
    LIKELIHOODS,
    LSTM,
    ONE_STEP,
    REACHER,
    TSM,
    Check,
    Checks,
    Model,
    Query,
    Term,
    between,
    constant,
    log,
)
from reproduction.claims.shown import FIGURE5
from reproduction.runs import NOTEBOOKS, ROOT, RunError, resolve
from tsmlib.zoo import OURS, PAPERS

Rows = list[dict[str, Any]]


def claim(rule: Callable[[Query], Checks], **about: Any) -> Claim:
    return Claim("X1", "here", FIGURE5, "it", **about)(rule)


def superiority(*rivals: Model, of: float = 0.0) -> Claim:
    """TSM has a higher likelihood than each rival."""

    def rule(q: Query) -> Checks:
        for rival in rivals:
            yield q.ll(TSM, REACHER) - q.ll(rival, REACHER) > of

    return claim(rule)


def returns(rule: Callable[[Query], Check]) -> Claim:
    return claim(lambda q: iter([rule(q)]))


def frames(**tables: Rows) -> Tables:
    return Tables(
        {name.removeprefix("of_"): tables_storage.frame(rows) for name, rows in tables.items()}
    )


def score(model: str, seed: int, value: float, **columns: Any) -> dict[str, Any]:
    row = dict(
        env="tsm/Reacher-v0",
        model=model,
        metric="ll_paper",
        execution="open loop",
        seed=seed,
        value=value,
    )
    return row | {"scale": "paper"} | columns


def study(**models: Any) -> Tables:
    """One value per seed and model."""
    return frames(
        of_03_predict=[
            score(m, k, float(v)) for m, values in models.items() for k, v in enumerate(values)
        ]
    )


class Planted(Tables):
    """A value per seed and model, whatever is asked of it."""

    def __init__(self, **models: np.ndarray) -> None:
        self.models = models

    def ask(self, term: Term) -> pd.DataFrame:
        return pd.DataFrame({-1: self.models[term.model]})


def share(
    rule: Claim, word: str, effect: float, *, n: int = 10, noise: str = "normal", studies: int = 400
) -> float:
    """How many of the studies, of which each has n seeds and an effect in standard deviations, are given ``word``."""
    rng = np.random.default_rng(0)
    draw = {
        "normal": rng.standard_normal,
        "uniform": lambda size: rng.uniform(-(3**0.5), 3**0.5, size),
    }[noise]
    given = [
        evaluate.judge(rule, Planted(tsm=common + effect + draw(n), lstm=common)).word
        for common in 5 * rng.standard_normal((studies, n))
    ]
    return given.count(word) / studies


# Verdicts ------------------------------------------------------------------------------------------------------------


def test_planted_effects_are_found() -> None:
    better = superiority(LSTM)
    assert share(better, REPLICATED, 2.0) >= 0.95
    assert share(better, FAILED, -2.0) >= 0.95


@pytest.mark.parametrize("noise", ["normal", "uniform"])
@pytest.mark.parametrize("n", [3, 10])
def test_planted_nulls_are_not_replicated(noise: str, n: int) -> None:
    better = superiority(LSTM, of=1.0)
    assert share(better, REPLICATED, 1.0, n=n, noise=noise) <= 0.05
    alike = claim(lambda q: between(-1, q.ll(TSM, REACHER) - q.ll(LSTM, REACHER), 1))
    assert share(alike, REPLICATED, 1.0, n=n, noise=noise) <= 0.07  # its level is 5 %
    assert share(alike, REPLICATED, 0.0, n=60) >= 0.95


def test_many_checks_do_not_make_a_failure_likely_by_chance() -> None:
    rng, failed = np.random.default_rng(0), {1: 0, 8: 0}
    for n_checks in failed:
        rivals = [Model(f"rival{i}") for i in range(n_checks)]
        level = superiority(*rivals)
        for _ in range(300):
            rows = Planted(
                tsm=np.zeros(10), **{rival.word: rng.standard_normal(10) for rival in rivals}
            )
            failed[n_checks] += evaluate.judge(level, rows).word == FAILED
    assert max(failed.values()) <= 0.05 * 300


def test_better_than_each_means_each() -> None:
    each = superiority(LSTM, ONE_STEP)
    rows = study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[3, 3.2, 3.1])
    verdict = evaluate.judge(each, rows)
    assert verdict.word == INCONCLUSIVE
    assert verdict.key.check.text == "ll_paper(tsm, Reacher) - ll_paper(onestep, Reacher) > 0"
    worse = evaluate.judge(
        each, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[5, 5.2, 5.1])
    )
    assert worse.word == FAILED
    assert "1 of 2 checks fail" in worse.why


SHARED: Mapping[str, Mapping[str, str]] = dict([*LIKELIHOODS.items()][:1])


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
def test_a_claim_that_turns_with_the_reading_depends_on_it(
    paper: int, fair: int, word: str
) -> None:
    rule = claim(lambda q: iter([q.ll(TSM, REACHER) > 0]), readings=SHARED)
    noise = [-0.2, 0.0, 0.2]
    rows = [score("tsm", k, paper + noise[k]) for k in range(3)]
    rows += [score("tsm", k, fair + noise[k], metric="ll_shared") for k in range(3)]
    verdict = evaluate.judge(rule, frames(of_03_predict=rows))
    assert verdict.word == word
    assert ("A1b one shared variance" in verdict.why) == (word == DEPENDENT)
    told = {1: "replicated", 0: "inconclusive", -1: "not replicated"}
    both = f"as the paper words it ({told[paper]}), or A1b one shared variance ({told[fair]})."
    assert (report.change(verdict) == f"to know which counts: {both}") == (word == DEPENDENT)


def test_an_inconclusive_claim_names_the_readings_under_which_it_fails() -> None:
    rule = claim(lambda q: iter([q.ll(TSM, REACHER) > 0]), readings=LIKELIHOODS)
    rows = [score("tsm", k, value) for k, value in enumerate((-1.0, 0.1, 1.0))]
    rows += [
        score("tsm", k, value, metric="ll_shared") for k, value in enumerate((-1.2, -1.1, -1.0))
    ]
    verdict = evaluate.judge(rule, frames(of_03_predict=rows))
    assert (verdict.word, verdict.failing_readings) == (
        INCONCLUSIVE,
        {"A1b one shared variance": 3},
    )
    assert "It fails under A1b one shared variance." in verdict.why
    assert "INCONCLUSIVE**; it fails under A1b one shared variance" in report.table(
        [verdict], [verdict]
    )


@pytest.mark.parametrize(("lstm", "word"), [(2.0, REPLICATED), (0.0, UNTESTABLE)])
def test_a_share_of_a_lead_that_is_not_there_is_no_margin(lstm: float, word: str) -> None:
    def rule(q: Query) -> Checks:
        lead = q.ll(LSTM, REACHER) - q.ll(ONE_STEP, REACHER)
        yield (lead > 0).assumed()
        yield from between(-0.25 * lead, q.ll(TSM, REACHER) - q.ll(LSTM, REACHER), 0.25 * lead)

    rows = study(tsm=[lstm, lstm + 0.01, lstm - 0.01], lstm=[lstm] * 3, onestep=[1.0, 1.01, 0.99])
    verdict = evaluate.judge(claim(rule), rows)
    assert verdict.word == word
    assert len(verdict.effects[""]) == (
        2 if word == REPLICATED else 3
    )  # a premise that holds is not a check
    assert ("A margin is a share of" in verdict.why) == (word == UNTESTABLE)
    assert report.change(verdict).startswith("a lead" if word == UNTESTABLE else "rows by which")
    assert ("not testable" in report.in_full(verdict, verdict)) == (word == UNTESTABLE)


def test_what_holds_by_definition_is_not_counted() -> None:
    rule = claim(lambda _: iter([constant(2.0) > 1]), definition="It is arithmetic.")
    verdict = evaluate.judge(rule, study(tsm=[1]))
    assert (verdict.word, verdict.why, verdict.key.n) == (
        DEFINITIONAL,
        "It is arithmetic.",
        "exact",
    )
    other = evaluate.judge(superiority(LSTM), study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1]))
    assert report.counts([verdict, other]).startswith(
        "of 1 claims 1 replicated, 0 reading-dependent"
    )


def test_a_claim_holds_only_if_those_that_it_depends_on_do() -> None:
    rests = Claim(
        "X2", "here", FIGURE5, "it", depends_on=(superiority(LSTM), superiority(ONE_STEP))
    )
    assert (
        evaluate.judge(
            rests, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[1, 1.2, 1.1])
        ).word
        == REPLICATED
    )
    assert (
        evaluate.judge(
            rests, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[5, 5.2, 5.1])
        ).word
        == FAILED
    )


def test_one_seed_has_no_interval() -> None:
    verdict = evaluate.judge(superiority(LSTM), study(tsm=[9], lstm=[1]))
    assert (verdict.word, verdict.key.n, verdict.key.low) == (INCONCLUSIVE, "1 seed", None)


def trials(seeds: int, n: int = 20) -> Rows:
    rng = np.random.default_rng(1)
    common = dict(
        metric="return_true",
        env="tsm/Reacher-v0",
        planner="cem",
        search_space="direct",
        horizon=50,
        execution="open loop",
        scale="paper",
    )
    return [
        dict(common, model=model, seed=seed, target=i, value=level + value)
        for model, level in (("tsm", 1.0), ("lstm", 0.0))
        for seed in range(seeds)
        for i, value in enumerate(rng.standard_normal(n))
    ]


def better_plans(q: Query) -> Check:
    return q.executed(TSM, REACHER) - q.executed(LSTM, REACHER) > 0


def test_seeds_and_targets_both_have_a_part_in_the_interval_and_with_one_seed_its_targets_alone() -> (
    None
):
    rule = returns(better_plans)
    key, several = (
        evaluate.judge(rule, frames(of_05_control_rows=(rows := trials(3)))).key,
        pd.DataFrame(rows),
    )
    assert key.n == "20 trials of 3 seeds"
    by_model = {
        m: own.pivot(index="seed", columns="target", values="value")
        for m, own in several.groupby("model")
    }
    found = random_effects(by_model["tsm"] - by_model["lstm"])
    np.testing.assert_allclose([key.value, key.low], [found.mean, found.mean - found.half()])
    rows = trials(1)
    values = {m: np.array([r["value"] for r in rows if r["model"] == m]) for m in ("tsm", "lstm")}
    mean, half = interval(values["tsm"] - values["lstm"])  # paired by target
    key = evaluate.judge(rule, frames(of_05_control_rows=rows)).key
    assert key.n == "20 trials of 1 seed"
    np.testing.assert_allclose([key.value, key.low, key.high], [mean, mean - half, mean + half])


def test_a_share_is_of_the_trials_for_which_it_is_true() -> None:
    rows = trials(2)
    wanted = np.mean([row["value"] <= 1 for row in rows if row["model"] == "tsm"])
    rule = returns(lambda q: (q.plans("return_true", TSM, REACHER) <= 1).share() > 0.5)
    key = evaluate.judge(rule, frames(of_05_control_rows=rows)).key
    assert key.value == pytest.approx(wanted)


def test_a_learning_curve_is_asked_for_its_end_or_its_average() -> None:
    common = dict(
        metric="return_true",
        env="tsm/Reacher-v0",
        planner="policy",
        search_space="latent",
        model="tsm",
        execution="policy",
        scale="paper",
        copy=0,
    )
    rows: Rows = [
        dict(common, seed=k, iteration=h, value=v + k)
        for k in (0, 1)
        for h, v in ((0, 1.0), (10, 2.0), (20, 6.0))
    ]
    rows += [
        dict(row, subset="early", iteration=5, value=9.0) for row in rows[:1]
    ]  # no record of the curve
    rule = returns(
        lambda q: (
            q.final(LAP, REACHER) - q.policy("return_true", LAP, REACHER, average=True).mean() > 0
        )
    )
    assert evaluate.judge(rule, frames(of_05_control=rows)).key.value == pytest.approx(3.0)
    with pytest.raises(evaluate.ClaimError, match="curves of different lengths"):
        evaluate.measure(rule.checks[""][0], frames(of_05_control=rows[:-2]))


def test_averages_of_learning_curves_are_over_the_places_that_all_have() -> None:
    common = dict(
        metric="return_true",
        env="tsm/Reacher-v0",
        planner="policy",
        execution="policy",
        scale="paper",
    )
    rows: Rows = [
        dict(
            common,
            copy=0,
            model=model,
            search_space=space,
            seed=k,
            iteration=h,
            value=-8 * 0.5 ** (h / 10) + k,
        )
        for model, space, places in (
            ("tsm", "latent", (0, 10, 20, 40)),
            ("lstm", "direct", (0, 40, 80, 120)),
        )
        for k in (0, 1)
        for h in places
    ]

    def rule(rows: Rows) -> evaluate.Effect:
        way = returns(
            lambda q: (
                q.policy("return_true", LAP, REACHER, average=True).mean()
                - q.policy("return_true", LSTM, REACHER, average=True).mean()
                > 0
            )
        )
        return evaluate.measure(way.checks[""][0], frames(of_05_control=rows))

    assert rule(rows).value == pytest.approx(
        0.0
    )  # they are one curve, of which one is recorded for longer
    with pytest.raises(evaluate.ClaimError, match="recorded at different places"):
        rule([row for row in rows if row["iteration"] != 40])


@pytest.mark.parametrize(("metric", "seeds"), [("samples_to_90", 3), ("env_samples_to_90", 0)])
def test_seeds_may_lack_what_a_curve_does_not_tell_and_nothing_else(
    metric: str, seeds: int
) -> None:
    common = dict(
        metric=metric,
        env="tsm/Reacher-v0",
        planner="policy",
        execution="policy",
        scale="paper",
        value=2.0,
    )
    rows: Rows = [
        dict(common, model=model, search_space=space, seed=k)
        for model, space, of in (
            ("tsm", "latent", (1, 2, 3)),
            ("ppo", "", range(5)),
            ("trpo", "", range(5)),
        )
        for k in of
    ]
    check = (replace(Query(), samples=metric).samples_ratio(REACHER)) < 3
    if seeds:
        assert evaluate.measure(check, frames(of_05_control=rows)).seeds == seeds
    else:
        with pytest.raises(evaluate.ClaimError, match=r"has seeds \[1, 2, 3\] of"):
            evaluate.measure(check, frames(of_05_control=rows))


def test_a_check_is_read_as_it_was_written() -> None:
    q = Query()
    tsm, lstm = q.ll(TSM, REACHER), q.ll(LSTM, REACHER)
    for check, said in (
        (tsm - (lstm - 2) * tsm > 0.5, "T - (L - 2) * T > 0.5"),
        ((tsm - lstm) - (lstm - tsm) <= lstm, "T - L - (L - T) - L <= 0"),
        (2 * log(tsm) / (tsm * lstm) < 1, "2 * log(T) / (T * L) < 1"),
        (-abs(tsm) >= 0, "-(abs(T)) >= 0"),
    ):
        assert (
            check.text.replace("ll_paper(tsm, Reacher)", "T").replace(
                "ll_paper(lstm, Reacher)", "L"
            )
            == said
        )


# Rows that are refused -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda rows: [row for row in rows if row["model"] == "tsm"],
            "no rows yet in 03_predict.csv of ll_paper",
        ),
        (
            lambda rows: rows[:-1],
            r"03_predict.csv has seeds \[0, 1, 2\] of ll_paper\(tsm, Reacher\), and \[0, 1\] of ll_paper\(lstm",
        ),
        (lambda rows: [*rows, rows[0]], "03_predict.csv has two rows for seed 0 of ll_paper"),
        (lambda rows: [*rows[:-1], {**rows[-1], "value": float("nan")}], "nan for seed 2"),
    ],
    ids=["missing", "of fewer seeds", "doubled", "not a number"],
)
def test_rows_are_refused_by_claim_file_and_remedy(change: Any, said: str) -> None:
    rule = superiority(LSTM)
    rows = [score(model, k, 1.0 + k) for model in ("tsm", "lstm") for k in range(3)]
    verdict = evaluate.judge(rule, frames(of_03_predict=change(rows)))
    assert verdict.word == UNTESTABLE
    assert re.search(said, verdict.why)
    assert verdict.why.startswith("X1: ")
    assert verdict.why.endswith("Run: python -m tsmlib run predict --scale paper")


def test_a_number_that_is_not_finite_is_refused() -> None:
    verdict = evaluate.judge(returns(lambda q: log(q.ll(TSM, REACHER)) > 0), study(tsm=[1, 2, -3]))
    assert verdict.word == UNTESTABLE
    assert "nan in seed 2" in verdict.why


def test_trials_that_do_not_match_are_refused() -> None:
    verdict = evaluate.judge(returns(better_plans), frames(of_05_control_rows=trials(1)[:-1]))
    assert verdict.word == UNTESTABLE
    assert "05_control.csv has different trials" in verdict.why


def test_what_fails_fails_whatever_else_is_missing() -> None:
    rule = superiority(LSTM, ONE_STEP)
    assert evaluate.judge(rule, study(tsm=[1, 1.1, 1.2], lstm=[3, 3.2, 3.1])).word == FAILED
    assert evaluate.judge(rule, study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1])).word == UNTESTABLE


# Stored verdicts -----------------------------------------------------------------------------------------------------


def test_a_changed_rule_makes_older_verdicts_void() -> None:
    rule = superiority(LSTM)
    changes = [
        superiority(LSTM, of=0.1),  # a margin
        superiority(ONE_STEP),  # what is compared
        claim(rule.rule, readings=LIKELIHOODS),
        claim(rule.rule, definition="It is so."),
        claim(rule.rule, depends_on=[superiority(ONE_STEP)]),
        returns(lambda q: q.ll(TSM, REACHER) - q.ll(LSTM, REACHER) > 0),  # the source
    ]
    assert all(other.sha256 != rule.sha256 for other in changes)
    elsewhere = claim(rule.rule, why={FAILED: "It is otherwise."}, headline=True)
    assert elsewhere.sha256 == rule.sha256


def test_what_is_written_and_what_is_stored_are_what_the_shipped_rows_say() -> None:
    papers, ours = pages.shipped_verdicts(PAPERS), pages.shipped_verdicts(OURS)
    again = "what is written of the claims is not what data/results says; run: python -m tsmlib publish --claims"
    assert pages.readme_claims(papers, ours) in publish.README.read_text(), again
    assert pages.claims_page(papers, ours) in publish.CLAIMS_PAGE.read_text(), again
    assert pages.full_page(papers, ours) in publish.FULL_PAGE.read_text(), again
    shipped = tables_storage.load(evaluate.RESULTS / "08_claims.csv")
    stored = set(
        shipped[["model", "claim", "verdict", "sha256"]].itertuples(index=False, name=None)
    )
    assert stored == {
        (v.claim.subject, v.claim.id, v.word, v.claim.sha256) for v in papers + ours
    }, again


def test_only_publishing_edits_what_ships() -> None:
    cells = json.loads((NOTEBOOKS / "08_claims.ipynb").read_text())["cells"]
    code = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    assert not re.search(r"publish[.(]|import.*publish", code)


def test_judging_draws_nothing() -> None:
    judged = "import sys, reproduction.claims.ledger, reproduction.claims.report; print('matplotlib.pyplot' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", judged], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "False"


# The ledger itself ---------------------------------------------------------------------------------------------------

LEDGER = ledger.claims()


def test_the_ledger_holds_every_claim_once_and_in_order() -> None:
    assert [c.id for c in LEDGER] == [f"C{i:02d}" for i in range(1, 55)]
    assert all(c.checks[""] and c.statement for c in LEDGER)
    assert sum(c.headline for c in LEDGER) == 21
    assert [c.id for c in LEDGER if c.definition] == ["C14", "C49"]
    assert set().union(*(c.why for c in LEDGER)) <= set(VERDICTS)


@pytest.mark.parametrize("claim", LEDGER, ids=lambda c: c.id)
def test_a_claim_quotes_the_paper_shortly_or_names_the_figure_it_is_read_off(claim: Claim) -> None:
    assert claim.quote or "figure" in claim.place
    assert len(claim.quote.split()) <= 30
    assert claim.quote.rstrip(".").lower() != claim.statement.rstrip(".").lower()
    assert "…" not in claim.quote
    assert claim.quote == claim.quote.strip()


def test_what_is_shown_as_a_quotation_is_the_papers_and_never_our_words() -> None:
    quoted = replace(superiority(LSTM), quote="it is better", place="section 1")
    assert report.quotation(quoted) == "> “it is better” (section 1)"
    assert report.quotation(replace(quoted, quote="", place="figure 6")) == "Read off figure 6."
    shown = set(re.findall(r"^> “(.*)” \(", publish.FULL_PAGE.read_text(), re.MULTILINE))
    assert shown == {c.quote for c in LEDGER if c.quote}
    pages_ = [path.read_text() for path in (publish.README, publish.CLAIMS_PAGE, publish.FULL_PAGE)]
    ours = [f"{mark}{c.statement.rstrip('.')}" for c in LEDGER for mark in ("“", '"', "> ")]
    assert not [words for words in ours for page in pages_ if words in page]


def test_the_page_says_how_often_simulated_verdicts_were_wrong() -> None:
    printed = run_script(ROOT / "benchmarks" / "verdicts" / "run.py", "--table")
    assert printed in publish.CLAIMS_PAGE.read_text(), (
        "put the output of benchmarks/verdicts/run.py --table there"
    )


def test_the_page_says_of_simulated_verdicts_what_the_worlds_do() -> None:
    module = load_script(ROOT / "benchmarks" / "verdicts" / "run.py", "verdicts_run")
    found = pd.read_csv(ROOT / "benchmarks" / "verdicts" / "worlds.csv")
    assert set(found["rows"]) == set(module.KINDS)
    false = found[(found["effect"] == 1) & (found["seeds"] >= 3)]
    decided = false[["replicated", "not replicated", "reading-dependent"]]
    wrongly, asked = (100 * decided.max()).to_dict(), ~false["rows"].str.contains("readings")
    page = publish.CLAIMS_PAGE.read_text().replace("\n", " ")
    assert (
        f"is called replicated in at most {wrongly['replicated']:g} % of studies, not replicated in at most "
        f"{wrongly['not replicated']:g} %, and one of the two in up to {100 * decided[asked].sum(axis=1).max():.0f} %"
    ) in page
    three = 100 * decided[(false["checks"] == 1) & ~asked].sum(axis=1)
    assert f"in all gets a decided verdict in {three.min():.0f} to {three.max():.0f} %" in page
    one = false[(false["checks"] == 1) & false["rows"].str.contains("readings")]
    assert (
        f"in {one['reading-dependent'].min():.0%} to {one['reading-dependent'].max():.0%}".replace(
            "%", ""
        )
        in page
    )
    told = found[
        (found["rows"] == "policies, 3 copies") & (found["seeds"] == 5) & (found["effect"] == 2)
    ]
    assert " and ".join(f"{100 * share:.0f} %" for share in told["replicated"]) in page


def test_what_simulated_checks_share_leaves_each_as_it_was() -> None:
    module = load_script(ROOT / "benchmarks" / "verdicts" / "run.py", "verdicts_run")
    values = module.drawn(np.zeros(2), 20_000, module.SCORES, np.random.default_rng(0), 0.5)[..., 0]
    assert np.allclose(values.std(1), module.SCORES.seed, rtol=0.02)
    assert np.corrcoef(values)[0, 1] == pytest.approx(0.5, abs=0.02)


@pytest.mark.parametrize("part", ["checks", "worlds"])
def test_no_verdict_is_simulated_without_a_study(
    part: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run_script(
            ROOT / "benchmarks" / "verdicts" / "run.py",
            part,
            "--studies",
            "0",
            "--out",
            str(tmp_path),
        )
    assert (
        "--studies 0: expected at least 1; the tables that ship are of 400"
        in capsys.readouterr().err
    )
    assert not list(tmp_path.iterdir())


def test_simulated_verdicts_are_written_once_all_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = load_script(ROOT / "benchmarks" / "verdicts" / "run.py", "verdicts_run")
    monkeypatch.setattr(
        module, "PARTS", {"checks": lambda *_: pd.DataFrame({"a": [1]}), "worlds": lambda *_: 1 / 0}
    )
    monkeypatch.setattr(sys, "argv", ["run.py", "--out", str(tmp_path)])
    with pytest.raises(ZeroDivisionError):
        module.main()
    assert not list(tmp_path.iterdir())


def test_the_power_of_ten_seeds_is_of_todays_rows() -> None:
    module = load_script(ROOT / "benchmarks" / "verdicts" / "run.py", "verdicts_run")
    columns = ["claim", "check", "seeds", "margin", "truth", "why"]
    stored, now = pd.read_csv(pages.POWER), module.checks(1, np.random.default_rng(0))
    again = "checks.csv is of other rows than data/results; run: python benchmarks/verdicts/run.py checks"
    assert stored[columns].equals(now[columns]), again
    assert np.allclose(stored["deviation"], now["deviation"].astype(float), rtol=0.01), again


def test_the_page_says_what_ten_seeds_would_find_as_the_table_does() -> None:
    stored = pd.read_csv(pages.POWER)
    page, once = publish.CLAIMS_PAGE.read_text(), stored.drop_duplicates("check")
    said = re.search(r"for the (\d+) checks with .*? Of these (\d+) are found in 95 % of", page)
    assert said
    assert [int(number) for number in said.groups()] == [len(once), sum(once["power"] >= 0.95)]
    twice = pd.concat([stored[:1], stored[:1].assign(claim="C99")])
    assert "for the 1 checks" in pages.power_of_ten_seeds(twice)
    few = pd.DataFrame(
        {"claim": ["C1", "C2", "C2"], "check": [*"abc"], "seeds": 3, "power": [1.0, 0.5, 0.1]}
    )
    few["why"] = "beyond"
    assert "for the 3 checks with 3 training seeds" in (told := pages.power_of_ten_seeds(few))
    assert told.endswith(
        "Of these 1 are found in 95 % of studies or more. The others are found in fewer: C2 (10 %, 50 %)."
    )
    assert "The others" not in pages.power_of_ten_seeds(few[:1])
    told = pages.power_of_ten_seeds(few.assign(why=["nearest", "midway", "midway"]))
    assert "for 1 that cannot be, as near as can be" in told
    assert "for 2 halves of tests of equivalence, midway" in told


def test_the_truth_of_a_simulated_check_is_one_that_there_can_be() -> None:
    stored = pd.read_csv(pages.POWER)
    shares = stored["check"].str.contains(r"^share\(|success|within_data|recall|coverage|auc\(")
    assert stored["truth"][shares].between(0, 1).all()
    assert (stored["truth"][stored["check"].str.contains(r"auc\(.*<=")] == 0.5).all()
    halves = stored[stored["why"] == "midway"].assign(
        number=stored["check"].str.rsplit(" ", n=2).str[0]
    )
    for _, pair in halves.groupby(["claim", "number"]):
        assert (
            pair["margin"].min()
            < pair["truth"].iloc[0]
            == pair["truth"].iloc[1]
            < pair["margin"].max()
        )


def test_a_claim_rests_on_the_fewest_seeds_of_any_check_and_says_which_have_no_rows() -> None:
    rule = claim(
        lambda q: iter(
            [q.ll(TSM, REACHER) > 0, q.ll(LSTM, REACHER) > 0, q.ll(ONE_STEP, REACHER) > 0]
        )
    )
    whole = evaluate.judge(rule, study(tsm=[-3, -3.1, -3.2], lstm=[1], onestep=[1, 1.1, 1.2]))
    assert (whole.word, whole.key.seeds, whole.seeds, whole.without_rows) == (FAILED, 3, 1, 0)
    assert report.counts([whole]).endswith("1 of the decided ones rests on one training seed")
    part = evaluate.judge(rule, study(tsm=[-3, -3.1, -3.2], onestep=[1, 1.1, 1.2]))
    assert (part.word, part.seeds, part.without_rows) == (FAILED, 3, 1)
    assert "rest on one" not in report.counts([part])
    assert "one of 3; 1 of 3 checks have no rows" in report.table([part], [part])
    assert "All of 3 checks have to hold; 1 of 3 checks have no rows." in report.in_full(part, part)
    lines = [
        [cell.strip() for cell in line.split("|")[1:4]]
        for line in report.seeds_table([whole, part]).splitlines()
    ]
    assert lines[2:] == [
        ["1", "1", "X1 (1 of 3 checks)"],
        ["3", "1", "X1 (1 of 3 checks have no rows)"],
    ]
    none = evaluate.judge(rule, study())
    told = report.seeds_told([whole, part, none])
    assert told == "Training seeds: 1 on 1, 1 on 3, 1 without rows; 1 lacks rows of some checks."
    assert report.seeds_told([whole]) == "Training seeds: 1 on 1."


def test_a_question_of_the_outlook_is_asked_of_our_model_and_has_published_rows() -> None:
    questions = ledger.questions()
    assert [c.id for c in questions] == ["Q1", "Q2", "Q3", "Q4", "Q5", "Q6", "Q7"]
    assert {c.subject for c in questions} == {"rtsm"}
    rows = evaluate.tables(questions)
    assert "NOT TESTABLE" not in {evaluate.judge(question, rows).word for question in questions}


@pytest.mark.parametrize("table", ["03_predict", "03_ablation", "05_control_rows"])
def test_a_table_that_cells_wrote_by_hand_judges_no_claim(table: str, tmp_path: Path) -> None:
    run = resolve("08_claims", scale="paper", run_dir=str(tmp_path))
    tables_storage.save(
        run.metrics / f"{table}.csv", [dict(metric="return_true", value=0.0, seed=0, scale="paper")]
    )
    with pytest.raises(RunError, match=f"{table[:3]}[a-z]* in .* is not run, expected complete"):
        evaluate.tables(LEDGER, run)


def test_a_run_of_one_model_replaces_its_published_rows_and_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluate, "RESULTS", tmp_path / "results")
    push = {"env": "tsm/ReacherPush-v1"}
    stay = [
        score("tsm", 0, 1.0, **push),
        score("onestep", 0, 1.0),
        score("onestep", 1, 1.0),
        score("tsm", 1, 1.0),
    ]
    go = [score("tsm", 0, 1.0), score("tsm", 0, 1.0, metric="nrmse")]
    tables_storage.save(tmp_path / "results" / "03_predict.csv", [*go, *stay])
    run = resolve("03_predict", scale="paper", run_dir=str(tmp_path))
    tables_storage.save(run.metrics / "03_predict.csv", [score("tsm", 0, 2.0)])
    manifest.write_json(run.dir / files.STATUS, {"03_predict": {"state": "complete"}})
    found = evaluate.tables([superiority(Model("onestep"))], run).rows["03_predict"]
    pd.testing.assert_frame_equal(
        found, tables_storage.frame([*stay, score("tsm", 0, 2.0)]), check_dtype=False
    )


@pytest.mark.parametrize("claim", [*LEDGER, *ledger.questions()], ids=lambda c: c.id)
def test_a_claim_points_to_a_section_and_a_figure_that_exist(claim: Claim) -> None:
    path = NOTEBOOKS / f"{claim.shown.notebook}.ipynb"
    cells = json.loads(path.read_text())["cells"]
    text = "".join(
        "".join(cell["source"]) + "\n" for cell in cells if cell["cell_type"] == "markdown"
    )
    headings = re.findall(r"^#+ (.*?)\s*$", text, re.MULTILINE)
    said = f"{claim.id}: the section in tsmlib/study/claims/shown.py is one of {headings}"
    assert not claim.shown.section or claim.shown.section in headings, said


def planted(check: Check, rng: np.random.Generator) -> Tables | None:
    """Rows of three seeds for which a check holds clearly; None where chance does not find any."""
    side = -1 if check.op[0] == "<" else 1
    for _ in range(400):
        base = {term: rng.uniform(0.1, 3) for term in check.number.terms}
        if side * (float(check.number.of(base)) - check.margin) > 0.3:
            break
    else:
        return None
    tables: dict[str, Rows] = {}
    for term, value in base.items():
        columns = (
            term.wanted
            | {"metric": term.metric, "model": term.model}
            | ({term.curve: 100} if term.curve else {})
        )
        for seed in range(3):
            row = columns | {"seed": seed, "value": value * (1 + 0.01 * rng.uniform())}
            rows = [dict(row, target=i) for i in range(4)] if term.trials else [row]
            tables.setdefault(term.table + "_rows" * term.trials, []).extend(rows)
    return frames(**tables)


def test_swapping_the_labels_of_two_models_turns_every_check_that_compares_them() -> None:
    rng, turned = np.random.default_rng(0), set()
    for c in LEDGER:
        for check in c.checks[""]:
            terms = check.number.terms
            rival = {term.model for term in terms} - {"tsm"}
            if len({term.model for term in terms}) != 2 or len(rival) != 1 or check.op == "==":
                continue
            if "correlation" in check.text or any(term.average for term in terms):
                continue
            rows = planted(check, rng)
            assert rows, check.text
            assert evaluate.measure(check, rows).state == "holds", check.text
            (other,) = rival
            swapped = evaluate.judge(c, rows.relabelled({"tsm": other, other: "tsm"}))
            effect = next(effect for effect in swapped.effects[""] if effect.check is check)
            assert effect.state in (("void",) if check.premise else ("fails", "missing")), (
                check.text
            )
            turned.add((c.id, effect.state))
    assert len({name for name, state in turned if state == "fails"}) >= 12
    assert {"C23", "C26", "C27", "C30", "C31", "C32", "C34"} <= {
        name for name, state in turned if state == "fails"
    }


def test_every_choice_that_the_paper_leaves_open_is_stated_once() -> None:
    page = (ROOT / "docs" / "deviations.md").read_text()
    assert re.findall(r"^\| (A\d+) \|", page, re.MULTILINE) == [f"A{i}" for i in range(1, 35)]


def test_a_reading_says_which_claims_it_turns() -> None:
    rule = claim(lambda q: iter([q.ll(TSM, REACHER) > 0]), readings=SHARED)
    rows = [score("tsm", k, 1.0 + k) for k in range(3)]
    for sign, said in ((1, ["", "X1"]), (-1, ["X1", ""])):
        fair = [score("tsm", k, sign * (1.0 + k), metric="ll_shared") for k in range(3)]
        lines = report.readings(
            [evaluate.judge(rule, frames(of_03_predict=rows + fair))]
        ).splitlines()
        assert [cell.strip() for cell in lines[-1].split("|")[1:-1]] == [
            "A1b one shared variance",
            *said,
        ]
    assert "A1b" not in report.readings([evaluate.judge(rule, frames(of_03_predict=rows))])


def test_the_figure_has_a_row_for_every_claim_with_rows() -> None:
    verdict = evaluate.judge(
        superiority(LSTM, ONE_STEP),
        study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1], onestep=[1, 1.2, 1.1]),
    )
    ax = figures.claim_margins(report.margins([verdict])).axes[0]
    assert [label.get_text() for label in ax.get_yticklabels()] == ["X1"]
    marks = [line.get_xdata()[0] for line in ax.lines if line.get_marker() == "o"]
    assert len(marks) == 2
    assert all(0 < x < 1 for x in marks)
    (ticks,) = [line.get_xdata() for line in ax.lines if line.get_marker() == "|"]
    assert len(ticks) == 3  # a training seed each
    assert all(0 < x <= 1 for x in ticks)
    nothing = report.margins([evaluate.judge(superiority(LSTM), Tables({}))])
    with pytest.raises(ValueError, match="no claim has rows"):
        figures.claim_margins(nothing)


def test_the_figure_says_what_is_claimed_and_what_an_open_mark_is() -> None:
    beyond, none = np.array([[0.5, 0.2, 0.8]]), np.array([[0.5, np.nan, np.nan]])
    rows = [("C1", "It holds.", "REPLICATED", "0.5, n = 3 seeds", beyond, np.array([0.4, 0.6]))]
    more = [*rows, ("C2", "", "INCONCLUSIVE", "1, n = 1 seed", none, none[0])]
    figures_of = [figures.claim_margins(part) for part in (rows, more)]
    named = [[text.get_text() for text in figure.legends[0].get_texts()] for figure in figures_of]
    assert [label.get_text() for label in figures_of[0].axes[0].get_yticklabels()] == [
        "C1  It holds."
    ]
    assert ["no interval: one training seed" in texts for texts in named] == [False, True]


def test_a_claim_in_full_shows_every_seed_of_every_check_and_each_reading() -> None:
    rule = claim(lambda q: iter([q.ll(TSM, REACHER) > 0, q.ll(TSM, REACHER) < 8]), readings=SHARED)
    rows = [score("tsm", k, 1.0 + 4 * k) for k in range(3)]
    fair = [score("tsm", k, -1.0 - 0.1 * k, metric="ll_shared") for k in range(3)]
    verdict = evaluate.judge(rule, frames(of_03_predict=rows + fair))
    text = report.in_full(verdict, verdict)
    assert "![Checks of X1](figures/claims/X1.svg)" in text
    cells = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in text.splitlines()
        if line.startswith("| ")
    ]
    assert [line[0] for line in cells[1:3]] == ["1", "2"]
    assert [line[2] for line in cells[1:3]] == ["> 0", "< 8"]
    assert all(line[3].startswith("5 [-") and line[4] == "open" for line in cells[1:3])
    drawn = report.drawn_checks(verdict)
    assert [(check.margin, check.side, check.seeds.tolist()) for check in drawn] == [
        (0, 1, [1.0, 5.0, 9.0]),
        (8, -1, [1.0, 5.0, 9.0]),
    ]
    read = [line[:2] for line in cells[3:]]
    assert read[1:] == [
        ["as the paper words it", "inconclusive"],
        ["A1b one shared variance", "not replicated"],
    ]
    assert "What would change it: about 10 training seeds that differ as these do" in text


def test_the_figure_of_a_claim_has_a_row_for_every_check_and_a_mark_for_every_seed() -> None:
    seeds, none = np.array([1.0, 5.0, 9.0]), np.full(3, np.nan)
    rows = [
        figures.DrawnCheck("holds", "5 [1, 9]", 0, 1, np.array([5.0, 1.0, 9.0]), seeds),
        figures.DrawnCheck("fails", "5 [1, 9]", 0, -1, np.array([5.0, 1.0, 9.0]), seeds),
        figures.DrawnCheck("missing", "no rows", 0, 1, none, none[:0]),
    ]
    ax = figures.claim_checks(rows).axes[0]
    places = [line.get_xdata().tolist() for line in ax.lines if line.get_marker() == "o"]
    assert places == [
        [1 / 9, 5 / 9, 1],
        [-1 / 9, -5 / 9, -1],
        [],
    ]  # what is claimed lies to the right
    words = [text.get_text() for text in ax.texts]
    assert {"1  holds", "2  fails", "3  missing", "no rows"} <= set(words)
    assert (words.count("-9"), words.count("9")) == (2, 2)  # the ends of both scales
    with pytest.raises(ValueError, match="no checks"):
        figures.claim_checks([])


def test_an_svg_file_has_the_same_bytes_on_any_day(tmp_path: Path) -> None:
    row = figures.DrawnCheck("holds", "5", 0, 1, np.array([5.0, 1.0, 9.0]), np.array([5.0]))
    files = [
        figures.save_svg(figures.claim_checks([row]), tmp_path / name)
        for name in ("a.svg", "b.svg")
    ]
    assert files[0].read_bytes() == files[1].read_bytes()
    assert b"Date" not in files[0].read_bytes()


def test_an_interval_that_is_no_95_percent_says_so() -> None:
    rule = claim(lambda q: iter([*between(0, q.ll(TSM, REACHER), 9), q.ll(TSM, REACHER) > 0]))
    rows = [score("tsm", k, 1.0 + k) for k in range(3)]
    texts = [
        effect.estimate for effect in evaluate.judge(rule, frames(of_03_predict=rows)).effects[""]
    ]
    assert ["(90 %)" in text for text in texts] == [True, True, False]


def test_the_claims_that_the_papers_planner_judges_otherwise_are_named() -> None:
    rule = claim(
        lambda q: iter([q.executed(TSM, REACHER) - q.executed(LSTM, REACHER) > 0]), readings=ADAM
    )
    about = dict(
        metric="return_true",
        env="tsm/Reacher-v0",
        search_space="direct",
        horizon=50,
        execution="open loop",
        scale="paper",
    )
    rows = [
        dict(
            about,
            planner=planner,
            model=model,
            seed=seed,
            target=target,
            value=value + 0.01 * seed + 0.001 * target,
        )
        for planner, lead in (("cem", 1.0), ("adam", -1.0))
        for model, value in (("tsm", lead), ("lstm", 0.0))
        for seed in range(3)
        for target in range(3)
    ]
    rows = [row | {"value": row["value"] * (1 + 0.1 * row["seed"])} for row in rows]
    verdict = evaluate.judge(rule, frames(of_05_control_rows=rows))
    assert verdict.claim.primary == "by CEM (A20)"
    assert report.by_papers_planner([verdict]).endswith(
        "in place of CEM (3 seeds): X1 not replicated."
    )
    same = evaluate.judge(superiority(LSTM), study(tsm=[3, 3.1, 3.2], lstm=[1, 1.2, 1.1]))
    assert (same.claim.primary, report.by_papers_planner([same])) == ("as the paper words it", "")


def test_seeds_to_decide_are_those_that_put_the_interval_beside_the_margin() -> None:
    rows = [score("tsm", k, 1.0 + 4 * k) for k in range(3)]
    (effect,) = evaluate.judge(
        claim(lambda q: iter([q.ll(TSM, REACHER) > 2])), frames(of_03_predict=rows)
    ).effects[""]
    n = report.seeds_to_decide(effect)
    for size, beside in ((n - 1, False), (n, True)):
        values = np.resize([-1.0, 1.0], size)
        values = 5 + 4 * (values - values.mean()) / values.std(ddof=1)
        mean, half = interval(values)
        assert (mean - half > 2) is bool(beside)


def test_seeds_to_decide_against_a_claim_are_those_that_holms_procedure_asks() -> None:
    rule = claim(lambda q: (q.ll(TSM, REACHER) > margin for margin in (0.5, -9)))

    def judged(size: int) -> evaluate.Verdict:
        values = np.resize([-1.0, 1.0], size)
        values = (values - values.mean()) / values.std(ddof=1)
        return evaluate.judge(
            rule, frames(of_03_predict=[score("tsm", k, value) for k, value in enumerate(values)])
        )

    open_yet = judged(8)
    (wrong, _) = open_yet.effects[""]
    n = report.seeds_to_decide(wrong, checks=2)
    assert n > report.seeds_to_decide(wrong)
    assert f"about {n} training seeds" in report.change(open_yet)
    assert ", by Holm's procedure over 2 checks." in report.change(open_yet)
    assert (judged(n - 1).word, judged(n).word) == (INCONCLUSIVE, FAILED)


@pytest.mark.parametrize(
    ("tsm", "said"),
    [
        (
            [3.0, 3.1, 3.2],
            "the interval of a check goes past its margin; the one nearest to it is 3.1 [",
        ),
        ([-3.0, -3.1, -3.2], "rows by which the check that fails does not; it is -3.1 ["),
        ([3.0], "another training seed"),
        ([], "rows, which are missing"),
    ],
)
def test_what_would_change_a_verdict_is_said(tsm: list[float], said: str) -> None:
    rule = claim(lambda q: iter([q.ll(TSM, REACHER) > 0]))
    verdict = evaluate.judge(
        rule, frames(of_03_predict=[score("tsm", k, value) for k, value in enumerate(tsm)])
    )
    assert said in report.change(verdict)


def test_two_random_effects_cover_the_mean_where_seeds_alone_do_not() -> None:
    rng, covered = np.random.default_rng(0), {"both": 0, "seeds": 0}
    for _ in range(400):
        values = (
            0.3 * rng.standard_normal((5, 1))
            + 2 * rng.standard_normal(20)
            + rng.standard_normal((5, 20))
        )
        both, (mean, half) = random_effects(values), interval(values.mean(1))
        covered["both"] += abs(both.mean) <= both.half()
        covered["seeds"] += abs(mean) <= half
    assert covered["both"] >= 0.93 * 400
    assert covered["seeds"] < 0.80 * 400


def test_trials_that_are_a_seeds_own_leave_the_means_of_seeds_to_decide() -> None:
    values = np.random.default_rng(0).standard_normal((5, 20))
    mean, half = interval(values.mean(1))
    own = random_effects(values, crossed=False)
    assert (own.mean, own.half()) == pytest.approx((mean, half))


@pytest.mark.parametrize("op", ["<", "<=", ">", ">="])
def test_a_mean_on_its_margin_is_no_evidence_against_a_check(op: Any) -> None:
    exact = evaluate.compared(Check(constant(0), op, 0.0), Estimate(0.0, 0.0, 2), "3 seeds")
    assert exact.p == 1
    wrong = 1.0 if op[0] == "<" else -1.0
    assert (
        evaluate.compared(Check(constant(0), op, 0.0), Estimate(wrong, 0.1, 2), "3 seeds").p < 0.01
    )


def test_holm_rejects_step_by_step_and_skips_what_was_not_measured() -> None:
    p_values, levels = (
        [0.01, np.nan, 0.04, 0.03, 0.005],
        [0.05] * 5,
    )  # 0.005 < 0.05 / 4, 0.01 < 0.05 / 3, 0.03 > 0.05 / 2
    assert holm(p_values, levels).tolist() == [True, False, False, False, True]
    assert holm([0.02, 0.03], [0.025, 0.10]).tolist() == [True, True]  # each against its own level
    assert not holm([], []).size


def test_intervals_are_those_of_students_t() -> None:
    for n, t95, t90 in (
        (3, 4.303, 2.920),
        (7, 2.447, 1.943),
        (10, 2.262, 1.833),
        (30, 2.045, 1.699),
    ):
        values = np.arange(n, dtype=float)
        error = values.std(ddof=1) / n**0.5
        assert interval(values)[1] / error == pytest.approx(t95, rel=1e-3)
        assert interval(values, 0.90)[1] / error == pytest.approx(t90, rel=1e-3)
