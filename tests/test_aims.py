"""Aims of the study beside what rows say."""

from __future__ import annotations

import pandas as pd

from tsmlib.storage import tables
from tsmlib.study import pages
from tsmlib.study.results import aims
from tsmlib.study.results.planning import PUSH
from tsmlib.study.runs import ROOT
from tsmlib.study.zoo import OURS

SCORE = dict(env=PUSH, metric=aims.ENERGY, execution="open loop", planner="none", subset="", scale="paper")


def scores(values: dict[tuple[str, int], float]) -> pd.DataFrame:
    """Energy scores 10 steps ahead: model and seed -> value."""
    return tables.frame([
        SCORE | dict(model=model, seed=seed, steps_ahead=10, value=value) for (model, seed), value in values.items()
    ])  # fmt: skip


def test_a_score_is_held_against_the_model_that_is_hardest_to_be_ahead_of() -> None:
    rows = scores({(OURS, 0): 1.0, ("lstm", 0): 4.0, ("tsm", 0): 2.0})
    assert aims._over_others(rows, PUSH, 10) == (0.5, "tsm", 0)


def test_ratios_of_scores_are_paired_by_seed_so_that_a_model_of_one_seed_is_held_against_that_seed_alone() -> None:
    rows = scores({(OURS, 0): 1.0, (OURS, 1): 9.0, ("pets", 0): 2.0, ("lstm", 0): 4.0, ("lstm", 1): 36.0})
    assert aims._over_others(rows, PUSH, 10) == (0.5, "pets", 1)


def test_nothing_is_reached_by_what_was_not_measured() -> None:
    none = tables.frame([])
    found = aims.aims(none, none, none, none)
    assert not found["reached"].any()
    assert set(found["measured"]) == {"not measured"}


def test_of_exploration_nothing_is_reached_without_rows_either() -> None:
    none = tables.frame([])
    found = aims.of_exploration(none, none)
    assert not found["reached"].any()
    assert set(found["measured"]) == {"not measured"}


def test_aims_of_exploration_are_held_against_the_lower_end_of_an_interval_over_seeds() -> None:
    row = dict(env=PUSH, execution="closed loop", planner="cem", model=OURS, scale="paper", n=1, subset="")
    gained = {("own plans", 0): 0.1, ("own plans", 1): 0.5, ("no new episodes", 0): 0.1, ("no new episodes", 1): 0.1}
    rows = [
        row | dict(metric="success", configuration=data, iteration=k, env_steps=100 * k, seed=seed, value=value + more)
        for (data, k), value in gained.items() for seed, more in ((0, 0.0), (1, 0.2 * k * (data == "own plans")))
    ]  # fmt: skip
    rows += [
        row | dict(metric="return_true", configuration="own plans", iteration=k, env_steps=300 + 300 * k, seed=0,
                   value=-k)
        for k in (0, 1)
    ]  # fmt: skip
    free = tables.frame([
        dict(env=PUSH, model=model, planner="policy", execution="policy", metric="return_true", env_steps=1000, seed=0,
             value=end, subset="", scale="paper", n=1)
        for model, end in (("ppo", 0.0), ("sac", 5.0))
    ])  # fmt: skip
    found = aims.of_exploration(tables.frame(rows), free)["measured"].tolist()
    mean, half = aims.interval([40.0, 60.0])
    assert found[:2] == [f"{mean - half:.1f}"] * 2
    assert found[2:5] == ["30.0%", "not measured", "inf%"]


def test_what_is_said_of_gaps_is_of_their_means_over_seeds_target_by_target() -> None:
    row = dict(env=PUSH, planner="cem", search_space="latent", execution="open loop", scale="paper", n=1)
    sizes = {OURS: [1.0, *[0.0] * 9], "lstm": [1.0] * 10}
    rows = tables.frame([
        row | dict(model=model, seed=seed, target=i, metric=metric, value=-3.0 + (metric == "return_predicted") * gap)
        for model, gaps in sizes.items() for seed in (0, 1) for i, gap in enumerate(gaps)
        for metric in ("return_true", "return_predicted")
    ])  # fmt: skip
    said = aims.gap_told(rows)
    assert "the 5 largest of `rtsm` are 100% of its 0.10 m" in said
    assert "the medians are 0.00 and 1.00 m" in said
    assert aims.gap_told(rows[rows["model"] == OURS]) == ""
    fewer = rows[(rows["model"] == OURS) | (rows["target"] < 5)]
    assert "the 5 largest of `rtsm` are 100% of its 0.20 m" in aims.gap_told(fewer)  # of the targets that both have


def test_of_two_policies_inside_a_model_the_better_one_counts() -> None:
    row = dict(env=PUSH, task="push", execution="policy", planner="policy", subset="", scale="paper", n=1, seed=0)
    ends = {(OURS, "latent"): -9.0, ("tsm", "latent"): -8.0, ("tsm", "direct"): -12.0, ("ppo", ""): -10.0}
    rows = tables.frame([
        row | dict(model=model, search_space=space, copy=0, metric=metric, value=value)
        | ({"iteration": 880} if space else {"env_steps": 1_000_000})
        for (model, space), end in ends.items()
        for metric, value in {"return_true": end, "seconds": 1.0, "samples": 5.0, "train_seconds": 1.0}.items()
    ])  # fmt: skip
    (_, _, _, inside, _), (_, _, _, free, _) = aims._of_policies(rows)
    assert (inside, free) == (-1.0, 1.0)


def test_the_sentence_names_every_aim_that_was_missed_with_what_was_found_and_no_other() -> None:
    found = aims.table.thresholds([
        ("one", "at most", 1.0, 2.0, "{:.0f}"), ("two", "at least", 1.0, 2.0, "{:.0f}"),
        ("three", "at least", 3.0, 2.0, "{:.0f}"),
    ])  # fmt: skip
    said = aims.missed(found)
    assert "2 of 3" in said
    assert "one 2 (≤ 1); three 2 (≥ 3)" in said
    assert "two" not in said
    assert aims.missed(found[found["reached"]]) == ""


def test_the_first_paragraph_of_the_readme_says_what_was_missed() -> None:
    text = (ROOT / "README.md").read_text()
    assert text.index(pages.readme_aims()) < text.index("## Start")
