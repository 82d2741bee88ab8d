"""The reason beside a verdict is what the rows that ship say, and is none that waits for another verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from tsmlib.storage import tables as tables_storage
from tsmlib.study import pages, publish
from tsmlib.study.claims import evaluate, ledger
from tsmlib.study.claims.claim import REPLICATED
from tsmlib.study.claims.evaluate import state_of
from tsmlib.study.results.prediction import TRIMMED
from tsmlib.study.results.table import by_seed, select
from tsmlib.study.zoo import OURS, PAPERS


def effects_of(verdicts: Mapping[str, evaluate.Verdict], name: str, reading: str = "") -> list[evaluate.Effect]:
    return [effect for effect in verdicts[name].effects[reading] if not effect.check.premise]


def states_of(effects: list[evaluate.Effect], *words: str) -> set[str]:
    """The states of those checks that name all these words."""
    found = {effect.state for effect in effects if all(word in effect.check.text for word in words)}
    assert found, words
    return found


def ratio_of_errors(step: int, env: str) -> float:
    """The mean logarithm, over seeds, of TSM's error over the one-step model's."""
    rows = select(tables_storage.load(evaluate.RESULTS / "03_predict.csv"), env=env, metric="nrmse", subset="",
                  execution="open loop", steps_ahead=step)  # fmt: skip
    wide = by_seed(rows[rows["model"].isin(["tsm", "onestep"])])
    return float(np.log(wide["tsm"] / wide["onestep"]).mean())


def mean_of(name: str, **where: object) -> float:
    """The mean of the rows of a table of data/results that have these values."""
    found = select(tables_storage.load(evaluate.RESULTS / f"{name}.csv"), **where)
    assert len(found), where
    return float(found["value"].mean())


def still_rising() -> bool:
    """Whether the mean returns of PPO and TRPO rose over the last fifth of their steps of pushing."""
    free = select(tables_storage.load(evaluate.RESULTS / "model_free.csv"), env="tsm/ReacherPush-v1",
                  metric="return_true", model=["ppo", "trpo"])  # fmt: skip
    curves = free.groupby(["model", "env_steps"])["value"].mean().unstack(0)
    late = curves[curves.index >= 0.8 * curves.index.max()]
    return curves.index.max() == 1_000_000 and bool((late.diff().dropna() > 0).all(axis=None))


OBSTACLE, BY = "tsm/ReacherObstacle-v0", dict(shared="A1b one shared variance")
REASONS: dict[str, Callable[[Mapping[str, evaluate.Verdict]], bool]] = {  # claim -> what its reason says of the rows
    "C02": lambda v: (
        "holds" not in states_of(effects_of(v, "C02", BY["shared"]), "ll_shared")
        and states_of(effects_of(v, "C02"), "nrmse", "Reacher)") == {"open"}
        and all(states_of(effects_of(v, "C02"), "nrmse", f"steps_ahead {step}, {arm}") == {"fails"}
                for step in (20, 50) for arm in ("ReacherObstacle", "ReacherPush"))
    ),
    "C03": lambda v: all(
        ratio_of_errors(1, env) > -ratio_of_errors(50, env) for env in ("tsm/ReacherPush-v1", "tsm/Reacher-v0")
    ),
    "C05": lambda v: states_of(effects_of(v, "C05"), "coverage", "> ") == {"fails"},
    "C06": lambda v: (
        set().union(*(states_of(effects_of(v, "C06"), arm) for arm in ("ReacherPush", "noise", "delay"))) == {"holds"}
        and [effect.state for effect in effects_of(v, "C06") if "Obstacle" in effect.check.text]
        == ["holds", "open", "open"]
    ),
    "C08": lambda v: any(v[name].word != REPLICATED for name in ("C12", "C16", "C51", "C53")),
    "C10": lambda v: (
        10 * effects_of(v, "C10")[0].value < 4 * (effects_of(v, "C10")[0].value - effects_of(v, "C10")[1].value)
        and 4 * (effects_of(v, "C10", BY["shared"])[0].value - effects_of(v, "C10", BY["shared"])[1].value)
        < effects_of(v, "C10", BY["shared"])[0].value
    ),
    "C12": lambda v: (
        states_of(effects_of(v, "C12"), "torque_novelty") == {"holds"}
        and ["torque_fast" in effect.check.text and "Push" in effect.check.text for effect in effects_of(v, "C12")
             if effect.state == "fails"] == [True]
    ),
    "C15": lambda v: [e.value for e in effects_of(v, "C15") if "Reacher)" in e.check.text] == [0, 0],
    "C18": lambda v: (
        abs(effects_of(v, "C18", BY["shared"])[1].value) < 0.1 * abs(effects_of(v, "C18")[1].value)
    ),
    "C20": lambda v: [effect.value > 0.2 for effect in effects_of(v, "C20")[1::2]] == [True, True],
    "C24": lambda v: (
        effects_of(v, "C24")[1].state == "fails" and state_of(v["C24"].effects[BY["shared"]]) == "open"
    ),
    "C26": lambda v: "holds" not in states_of(effects_of(v, "C26", BY["shared"]), "ll_shared"),
    "C27": lambda v: "fails" in states_of(effects_of(v, "C27", BY["shared"]), "ll_shared"),
    "C28": lambda v: states_of(effects_of(v, "C28"), "range") == {"fails"},
    "C29": lambda v: (
        "holds" not in {e.state for e in effects_of(v, "C29") if "Reacher)" in e.check.text and "2 *" in e.check.text}
        and {"holds"}
        == {e.state for e in effects_of(v, "C29") if "Push)" in e.check.text and "2 *" not in e.check.text}
        and [e.state for e in effects_of(v, "C29") if "Push)" in e.check.text and "2 *" in e.check.text][1:]
        == ["open", "open"]
    ),
    "C31": lambda v: [effect.state for effect in effects_of(v, "C31")][2:] == ["fails", "holds"],
    "C34": lambda v: [effect.state for effect in effects_of(v, "C34")][1:] == ["holds", "holds", "fails"],
    "C36": lambda v: still_rising(),
    "C40": lambda v: (
        states_of(effects_of(v, "C40"), "onestep") == {"holds"}
        and {e.state for e in effects_of(v, "C40")
             if "multistep" in e.check.text and "noise" in e.check.text and "0.25" in e.check.text} == {"open"}
        and {e.state for e in effects_of(v, "C40")
             if "multistep" in e.check.text and "noise" in e.check.text and "0.25" not in e.check.text} == {"holds"}
        and {e.state for e in effects_of(v, "C40")
             if "lstm" in e.check.text and "delay" in e.check.text and "0.25" not in e.check.text} == {"open"}
    ),
    "C41": lambda v: [e.state for e in effects_of(v, "C41")] == ["fails", "holds", "holds", "holds"],
    "C42": lambda v: all(
        mean_of("06_robustness", metric="success50", model="onestep", **arm) < 0.2
        and 0.3 < mean_of("06_robustness", metric="success50", model="multistep", **arm) < 0.6
        and abs(mean_of("06_robustness", metric="success50", model="lstm", **arm)
                - mean_of("06_robustness", metric="success50", model="tsm", search_space="latent", **arm)) < 0.05
        for arm in ({"noise": 0.25, "delay": None}, {"noise": None, "delay": 5})
    ),
    "C43": lambda v: (
        [e.state for e in effects_of(v, "C43")][1::3] == ["holds", "open"] and effects_of(v, "C43")[3].state == "holds"
    ),
    "C46": lambda v: all(
        mean_of("04_latent", metric=metric, model="tsm", env=OBSTACLE, execution="segments", subset="") <= most
        for metric, most in (("kl", 0.1), ("active_units", 0))
    ),
    "C47": lambda v: effects_of(v, "C47")[1].value < 0.2,
    "C48": lambda v: effects_of(v, "C48")[0].value < 0.1,
    "C50": lambda v: (
        [e.state for e in effects_of(v, "C50")][:3] == ["holds", "holds", "fails"]
        and 0.3 < effects_of(v, "C50")[2].value < 0.4
    ),
    "C51": lambda v: all(
        mean_of("07_action_prior", metric="auc", model="prior", env=env, subset=drawn) > 0.9
        for env in ("tsm/Reacher-v0", "tsm/ReacherPush-v1") for drawn in ("sampled", "reconstructed")
    ),
    "C52": lambda v: [e.value <= 1 for e in effects_of(v, "C52") if "change_ratio" in e.check.text] == [True, True],
}  # fmt: skip
UNMEASURED = {"C17", "C33", "C38", "C44"}  # reasons that name a choice or a cause, and no rows


def test_the_reason_beside_a_verdict_is_what_the_shipped_rows_say() -> None:
    verdicts = {verdict.claim.id: verdict for verdict in pages.shipped_verdicts(PAPERS)}
    given = {name for name, verdict in verdicts.items() if verdict.word in verdict.claim.why}
    assert given == set(REASONS) | UNMEASURED
    assert [name for name, holds in REASONS.items() if not holds(verdicts)] == []


def test_no_reason_waits_for_a_verdict_that_is_not_given() -> None:
    stored = tables_storage.load(evaluate.RESULTS / "08_claims.csv")
    words = dict(stored[stored["model"] == PAPERS][["claim", "verdict"]].itertuples(index=False, name=None))
    assert {(c.id, word) for c in ledger.claims() for word in c.why if words[c.id] != word} == set()


def test_readme_says_of_the_own_likelihood_of_pushing_what_the_rows_do() -> None:
    said = "Its own likelihood at pushing: lowest of the five; without 5 % of episodes, highest."
    assert said in publish.README.read_text()
    rows = select(tables_storage.load(evaluate.RESULTS / "03_predict.csv"), env="tsm/ReacherPush-v1", metric="ll_own",
                  execution="open loop", model=[OURS, PAPERS, "onestep", "multistep", "lstm"])  # fmt: skip
    assert select(rows, subset="").groupby("model")["value"].mean().idxmin() == OURS
    assert select(rows, subset=TRIMMED).groupby("model")["value"].mean().idxmax() == OURS
