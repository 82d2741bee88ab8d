"""Comparisons find what is there, and the ledger says what the paper says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from reproduction.claims import judge, ledger
from reproduction.claims.judge import Comparison, compare
from reproduction.tables import RESULTS, frame
from tsmlib import zoo

ARM = "tsm/ReacherPush-v1"
ONE = Comparison("t", "energy_score_noise", "tsm", "lstm", "ReacherPush", "better")
COST = Comparison("t", "return_true", "tsm-latent-cem", "lstm-latent-cem", "ReacherPush", "better")
CLAIMS = ledger.claims()


def planted(
    effect: float, *, seeds: int = 5, units: int = 100, noise: float = 0.1, draw: int = 0
) -> Callable[[str], pd.DataFrame]:
    """A world in which the first model's score is ``effect`` below the second's, which is 1."""
    random = np.random.default_rng(draw)
    hard = random.normal(size=units)  # targets that are the same for all
    rows = [
        {"env": ARM, "model": word, "metric": "energy_score_noise", "value": value}
        | {"seed": seed, "target": i, "execution": "open loop"}
        for seed in range(seeds)
        for word, mean in (("tsm", 1 - effect), ("lstm", 1.0))
        for i, value in enumerate(mean + hard + noise * random.normal(size=units))
    ]
    return lambda name: frame(rows)


@pytest.mark.parametrize(
    ("effect", "word"), [(0.2, "better"), (-0.2, "worse"), (0.0, "level")], ids=str
)
def test_what_is_planted_is_found(effect: float, word: str) -> None:
    found = compare(ONE, planted(effect))
    assert found.word == word
    assert found.low <= -effect <= found.high
    assert (found.seeds, found.units) == (5, 100)
    assert (found.ahead > 0.5) == (effect > 0.01 or found.ahead > 0.5)


def test_an_effect_that_does_not_matter_is_level_and_one_that_is_not_sure_is_open() -> None:
    assert compare(ONE, planted(0.02, noise=0.05)).word == "level"
    assert compare(ONE, planted(0.1, seeds=2, units=4, noise=3.0)).word == "open"
    assert compare(ONE, lambda name: planted(0.1)(name).iloc[:0]).word == "missing"


def test_swapped_models_swap_every_finding() -> None:
    tables = planted(0.2)
    found, swapped = compare(ONE, tables), compare(replace(ONE, a="lstm", b="tsm"), tables)
    assert (found.word, swapped.word) == ("better", "worse")
    assert found.difference == pytest.approx(-swapped.difference)
    assert found.ahead == pytest.approx(1 - swapped.ahead)


@pytest.mark.parametrize(("effect", "most", "word"), [(0.0, 0.05, "better"), (0.3, 1.0, "better")])
def test_a_finding_is_seldom_wrong(effect: float, most: float, word: str) -> None:
    """In forty worlds without an effect hardly any is called better, with one nearly all."""
    worlds = [planted(effect, seeds=3, units=20, draw=i) for i in range(40)]
    share = [compare(ONE, world).word for world in worlds].count(word) / len(worlds)
    assert share <= most
    assert effect == 0 or share >= 0.95


def test_the_interval_covers_what_seeds_and_targets_vary() -> None:
    """Two random effects, seeds and targets: 95 % intervals hold the mean in about 95 of 100."""
    inside, random = 0, np.random.default_rng(1)
    for _ in range(200):
        seeds, units = random.normal(size=(10, 1)), random.normal(size=(1, 40))
        low, high = judge.interval(seeds + units + random.normal(size=(10, 40)), draws=400)
        inside += low <= 0 <= high
    assert 0.86 <= inside / 200 <= 0.99
    assert all(np.isnan(judge.interval(np.ones((1, 1)))))


def test_the_gap_is_the_size_of_predicted_minus_executed() -> None:
    rows = [
        {"env": ARM, "model": word, "search_space": "latent", "planner": "cem", "seed": 0}
        | {"execution": "open loop", "metric": metric, "value": value, "target": i}
        for word, off in (("tsm", 0.1), ("lstm", -1.0))
        for metric, value in (("return_true", -5.0), ("return_predicted", -5.0 + off))
        for i in range(3)
    ]
    oracle = [dict(rows[0], model="oracle", metric="return_true", value=-4.0)]
    found = compare(replace(COST, measure="gap"), lambda name: frame([*rows, *oracle]))
    assert found.difference == pytest.approx(0.1 - 1.0)
    assert found.smallest == pytest.approx(0.02 * 4.0)
    assert found.word == "better"


@pytest.mark.parametrize(
    ("value", "expect", "holds"),
    [(0.3, "at most", True), (0.7, "at most", False), (0.7, "at least", True)],
)
def test_a_number_is_held_against_a_bound(value: float, expect: str, holds: bool) -> None:
    rows = [
        {"env": ARM, "model": "tsm", "metric": "kl", "value": value + 0.01 * seed, "seed": seed}
        for seed in range(3)
    ]
    one = Comparison("t", "kl", "tsm", 0.5, "ReacherPush", expect)
    assert compare(one, lambda name: frame(rows)).holds is holds


def test_what_is_learned_counts_as_it_ends_and_copies_are_one() -> None:
    rows = [
        {"env": ARM, "model": word, "search_space": "direct", "planner": "policy", "seed": seed}
        | {"execution": "policy", "metric": "success50", "value": end * i / 4, "iteration": i}
        | {"copy": copy}
        for word, end in (("tsm", 0.8), ("lstm", 0.2))
        for seed in range(3)
        for copy in range(2)
        for i in range(5)
    ]
    one = Comparison("t", "success50", "tsm-direct-policy", "lstm-direct-policy", "ReacherPush", "")
    assert compare(one, lambda name: frame(rows)).difference == pytest.approx(0.6)


# The ledger -----------------------------------------------------------------------------------


def test_the_ledger_has_all_claims_and_each_can_fail() -> None:
    assert [claim.id for claim in CLAIMS] == [f"C{i:02}" for i in range(1, 55)]
    for claim in CLAIMS:
        assert claim.says.endswith(".")
        assert claim.place
        assert bool(claim.comparisons) != bool(claim.definition or claim.untested), claim.id
    assert sum(claim.headline for claim in CLAIMS) == 21


def test_every_comparison_names_models_arms_and_expectations_that_there_are() -> None:
    expectations = {"better", "worse", "level", "not worse", "not better", "at most", "at least"}
    known = {*zoo.ZOO, *zoo.LOOKS, "none"}
    for claim in CLAIMS:
        for one in (*claim.comparisons, *claim.control):
            assert one.expect in expectations, claim.id
            assert one.on.partition("-")[0] in judge.PLACES
            for side in (one.a, one.b):
                assert not isinstance(side, str) or side.partition("-")[0] in known, side
            numbers = one.expect in ("at most", "at least")
            assert numbers == (not isinstance(one.b, str)), claim.id


def test_a_comparison_with_an_unknown_field_is_refused() -> None:
    with pytest.raises(ValueError, match="has no colour"):
        ledger._expanded([{"table": "t", "colour": "red"}])


def test_what_was_found_is_said_by_places() -> None:
    tables = planted(0.2)
    both = replace(ONE, on="Reacher")  # of which there are no rows
    claim = ledger.Claim("C99", "here", "", "It is so.", comparisons=(ONE, both))
    verdict = ledger.judge(claim, tables)
    assert verdict.word == "holds in part"
    assert verdict.found == "Holds on pushing, open on reaching (1 of 2)."
    assert ledger.judge(replace(claim, comparisons=(ONE,)), tables).word == "holds"
    wrong = replace(ONE, expect="worse")
    assert ledger.judge(replace(claim, comparisons=(wrong,)), tables).word == "does not hold"


def test_a_claim_whose_control_fails_is_not_testable() -> None:
    control = replace(ONE, expect="worse")
    claim = ledger.Claim("C99", "here", "", "So.", comparisons=(ONE,), control=(control,))
    assert ledger.judge(claim, planted(0.2)).word == "not testable"


def test_the_published_findings_are_those_of_the_published_tables() -> None:
    """A part of them is judged again; each line of the table is a comparison of the ledger."""
    table = pd.read_csv(RESULTS / "08_claims.csv")
    assert len(table) == sum(len(c.comparisons) + len(c.control) for c in CLAIMS)
    chosen = [claim for claim in CLAIMS if claim.id in ("C07", "C27", "C46", "C51")]
    again = ledger.as_table([ledger.judge(claim) for claim in chosen])
    stored = table[table["claim"].isin(again["claim"])]
    assert list(stored["found"]) == list(again["found"])
    assert np.allclose(stored["difference"], again["difference"], rtol=1e-3)


def test_the_page_has_a_line_for_each_claim_and_names_no_nan() -> None:
    verdicts = list(map(partial(ledger.judge, tables=planted(0.2)), CLAIMS[:5]))
    text = ledger.page(verdicts)
    assert all(f"{claim.id}" in text for claim in CLAIMS[:5])
    assert "nan" not in text
    assert "The paper's claims" in text
