"""Figure 7 shows the executed and predicted returns of learned policies, and what they have cost."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from tsmlib.plots import Method, figure7
from tsmlib.plots.policies import AXES
from tsmlib.statistics import interval
from tsmlib.zoo import method

LATENT, DIRECT, RIVAL = method("tsm", "latent"), method("tsm", "direct"), method("lstm", "direct")
METHODS = (LATENT, DIRECT, method("rtsm", "latent"), method("onestep", "direct"), RIVAL)
PPO, TRPO, ZERO = method("ppo"), method("trpo"), method("zero")
FLOORS = {
    "reach": {
        method("oracle", "latent", "cem"): -4.2,
        method("oracle", "direct", "cem"): -4.1,
        ZERO: -12.0,
    }
}


def learned(k: int = 3, end: float = -4.5, samples: float = 50_000) -> dict[str, np.ndarray]:
    """Curves from -12 to ``end`` over 11 records; the model predicts 0.5 m more."""
    true = (
        end
        + (-12 - end) * np.exp(-np.arange(11.0))
        + 0.1 * np.random.default_rng(0).normal(size=(k, 11))
    )
    return {
        "return_true": true,
        "return_predicted": true + 0.5,
        "steps": 220_000.0 * np.arange(11),
        "samples": np.full(11, samples),
        "seconds": 400 + 100.0 * np.arange(11),
    }


def model_free(k: int = 3) -> dict[str, np.ndarray]:
    true = np.linspace(-12, -5, 26) + 0.1 * np.random.default_rng(1).normal(size=(k, 26))
    return {
        "return_true": true,
        "steps": np.linspace(0, 3e5, 26),
        "samples": np.linspace(0, 3e5, 26),
        "seconds": np.linspace(1e-5, 90, 26),
    }


def both_tasks() -> dict[str, dict[Method, dict[str, np.ndarray]]]:
    own = {policy: learned(end=-4.5 - i) for i, policy in enumerate(METHODS)}
    return {"reach": {**own, PPO: model_free(), TRPO: model_free()}, "push": dict(own)}


def lines(ax: Axes, method: Method) -> list[Any]:
    return [
        line for line in ax.lines if to_hex(line.get_color()).lower() == method.look.colour.lower()
    ]


def below(figure: Figure) -> str:
    return " ".join(ax.get_xlabel() for ax in figure.axes).replace("\n", " ")


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


EVERY: dict[str, Callable[[], Figure]] = {
    "two tasks": lambda: figure7(both_tasks(), FLOORS),
    "one task, steps": lambda: figure7({"reach": {LATENT: learned()}}, against=["steps"]),
    "one copy": lambda: figure7({"reach": {LATENT: learned(k=1)}}, FLOORS),
    "only model-free": lambda: figure7(
        {"push": {TRPO: model_free()}}, against=["samples", "seconds"]
    ),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", EVERY)
def test_figure_7_is_laid_out_without_warnings_and_not_left_open(name: str) -> None:
    figure = EVERY[name]()
    figure.draw_without_rendering()
    assert plt.get_fignums() == []
    assert min(text.get_fontsize() for text in figure.findobj(plt.Text) if text.get_text()) >= 6.5


def bars(ax: Axes, method: Method) -> list[np.ndarray]:
    """Both ends of each interval of a method that is drawn as a bar."""
    found = [part for part in ax.collections if isinstance(part, LineCollection)]
    return [
        part.get_segments()[0]
        for part in found
        if to_hex(part.get_color()[0]) == method.look.colour.lower()
    ]


def test_a_line_is_the_mean_and_its_end_stands_beside_the_axis_with_its_interval() -> None:
    given = learned()
    ax = figure7({"reach": {RIVAL: given}}).axes[0]
    true, end, predicted = lines(ax, RIVAL)
    np.testing.assert_allclose(true.get_ydata(), given["return_true"].mean(0))
    np.testing.assert_array_equal(true.get_xdata(), given["steps"])
    np.testing.assert_allclose(predicted.get_ydata(), given["return_predicted"].mean(0))
    assert predicted.is_dashed()
    assert not true.is_dashed()
    mean, half = interval(given["return_true"][:, -1])
    (bar,) = bars(ax, RIVAL)
    assert bar[:, 1].tolist() == pytest.approx([mean - half, mean + half])
    assert bar[0, 0] == end.get_xdata()[0] > given["steps"][-1]
    assert end.get_ydata().tolist() == pytest.approx([mean])
    assert [text.get_text() for text in ax.get_xticklabels()][-1] == "ends"


def test_the_legend_says_what_an_interval_is_over() -> None:
    figure = figure7({"reach": {RIVAL: learned(), PPO: model_free(k=4)}})
    assert "95 % interval over 3 copies of a policy, 4 seeds without a model" in legend(figure)
    seeds = {**learned(k=5), "seeds": np.array(5)}
    figure = figure7({"reach": {LATENT: seeds, RIVAL: learned(), PPO: model_free(k=4)}})
    said = "95 % interval over 5 training seeds, 3 copies of a policy, 4 seeds without a model"
    assert said in legend(figure)


def test_tasks_stand_side_by_side_and_share_the_scale_of_their_column() -> None:
    figure = figure7(both_tasks(), FLOORS)
    reach, push = figure.axes[0], figure.axes[1]
    assert [reach.get_title(loc="left"), push.get_title(loc="left")] == ["Reach", "Push"]
    for column in (figure.axes[::2], figure.axes[1::2]):
        assert len({ax.get_ylim() for ax in column}) == 1
        assert [ax.get_xlabel().split("\n")[0].split(";")[0] for ax in column] == list(
            AXES.values()
        )


def test_policies_of_a_data_set_stand_beside_the_axis_of_samples_and_a_model_free_run_is_a_line_on_it() -> (
    None
):
    given = learned(samples=50_000)
    ax = figure7(
        {"reach": {LATENT: given, RIVAL: learned(), PPO: model_free()}}, against=["samples"]
    ).axes[0]
    point, other = (
        lines(ax, LATENT)[0],
        lines(ax, RIVAL)[0],
    )  # then an arrow where an interval leaves the panel
    assert point.get_ydata().tolist() == [pytest.approx(given["return_true"][:, -1].mean())]
    assert len(lines(ax, PPO)[0].get_xdata()) == 26
    ticks = dict(
        zip([text.get_text() for text in ax.get_xticklabels()], ax.get_xticks(), strict=True)
    )
    assert 300_000 < point.get_xdata()[0] < ticks["models,\n50k steps"] < other.get_xdata()[0]
    assert (
        ax.spines["bottom"].get_bounds()[1] < point.get_xdata()[0]
    )  # where the axis counts no steps
    (data,) = [line for line in ax.lines if list(line.get_xdata()) == [50_000, 50_000]]
    assert list(data.get_ydata()) == [0, 1]
    (bar,) = bars(ax, PPO)
    assert bar[0, 0] < point.get_xdata()[0]


def test_a_model_free_run_is_drawn_against_steps_of_the_environment_which_the_axis_says() -> None:
    figure = figure7({"reach": {LATENT: learned(), PPO: model_free()}})
    assert [bool(lines(ax, PPO)) for ax in figure.axes] == [True, True, True]
    assert "without a model, in the environment" in figure.axes[0].get_xlabel()
    assert "without a model" not in figure7({"reach": {LATENT: learned()}}).axes[0].get_xlabel()


def test_the_legend_names_each_model_once_and_what_filled_and_open_mean() -> None:
    figure = figure7({"reach": {LATENT: learned(), DIRECT: learned(end=-5), PPO: model_free()}})
    words = [
        "TSM",
        "PPO",
        "latent policy",
        "direct policy",
        "predicted return",
        "steps in the models' data",
        "95 % interval over 3 copies of a policy, 3 seeds without a model",
    ]
    assert legend(figure) == words


def test_seconds_are_logarithmic_and_leave_out_what_was_before_the_first() -> None:
    ax = figure7({"reach": {LATENT: learned(), PPO: model_free()}}, against=["seconds"]).axes[0]
    assert ax.get_xscale() == "log"
    curve, own = lines(ax, PPO)[0], lines(ax, LATENT)[0]
    assert len(curve.get_xdata()) == 25
    assert own.get_xdata()[0] == 400
    low, high = ax.get_xlim()
    assert low < 3.6 < 1400 < high


def test_a_policy_through_the_prior_is_filled_and_one_of_torques_open() -> None:
    ax = figure7({"reach": {LATENT: learned(), DIRECT: learned(end=-6)}}, against=["steps"]).axes[0]
    curves = [
        line for line in lines(ax, LATENT) if len(line.get_xdata()) > 1 and not line.is_dashed()
    ]
    assert [to_hex(line.get_markerfacecolor()).upper() for line in curves] == [
        LATENT.look.colour,
        "#FFFFFF",
    ]


def test_references_are_lines_and_of_several_oracles_the_one_that_tables_divide_by() -> None:
    figure = figure7({"reach": {LATENT: learned()}}, FLOORS, against=["steps"])
    flat = {
        line.get_ydata()[0]
        for line in figure.axes[0].lines
        if list(line.get_ydata()) == [line.get_ydata()[0]] * 2
    }
    assert flat == {-4.2, -12.0}
    assert "oracle" in legend(figure)
    assert "zero torque" not in legend(figure)  # far below, and in words


def test_a_policy_that_fails_far_off_does_not_squeeze_the_others_and_is_told_in_words() -> None:
    rows = {policy: learned() for policy in METHODS} | {
        method("multistep", "direct"): learned(end=-900.0)
    }
    figure = figure7({"reach": rows}, against=["steps"])
    assert figure.axes[0].get_ylim()[0] > -50
    assert "multi-step, direct to −900" in below(figure)
    off = {
        LATENT: learned(end=-14),
        RIVAL: learned(end=-15),
        method("multistep", "direct"): learned(end=-33),
    }
    levels = {"push": {method("oracle", "latent", "cem"): -8.4, ZERO: -17.4}}
    figure = figure7({"push": off}, levels, against=["steps"])
    assert "multi-step, direct to −33" in below(figure)
    assert (
        figure.axes[0].get_ylim()[0] > -22
    )  # -33 is more than half as far below doing nothing as the oracle is above


def test_where_curves_begin_is_said_and_the_axis_shows_their_ends() -> None:
    figure = figure7(
        {"reach": {LATENT: learned(), RIVAL: learned(end=-5)}}, FLOORS, against=["steps"]
    )
    low, high = figure.axes[0].get_ylim()
    assert -7 < low < -5 < -4.2 < high
    assert re.search("outside: curves begin at −1[12].*, zero torque −12", below(figure))


def test_the_references_of_one_task_do_not_stretch_the_scale_of_another() -> None:
    rows = {"reach": {LATENT: learned()}, "push": {LATENT: learned(end=-9)}}
    alone = figure7({"reach": rows["reach"]}, {"reach": FLOORS["reach"]}).axes[0].get_ylim()
    assert figure7(rows, FLOORS | {"push": {ZERO: -40.0}}).axes[0].get_ylim() == alone


def test_environment_steps_are_told_in_thousands() -> None:
    ax = figure7({"reach": {PPO: model_free()}}, against=["samples"]).axes[0]
    assert ax.xaxis.get_major_formatter()(300_000) == "300k"
    assert ax.get_xlim()[1] > 310_000


def test_policies_of_yours_are_diamonds() -> None:
    mine = learned(k=1, end=-4.6)
    figure = figure7(
        {"reach": {LATENT: learned()}}, FLOORS, against=["steps"], yours={"reach": {LATENT: mine}}
    )
    (own,) = (line for line in figure.axes[0].lines if line.get_marker() == "D")
    assert own.get_ydata()[-1] == pytest.approx(mine["return_true"][0, -1])
    assert "yours" in legend(figure)


def wrong(**changed: Any) -> dict[str, Any]:
    return {"reach": {LATENT: learned() | changed}}


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: figure7({}), "nothing to draw"),
        (
            lambda: figure7(wrong(return_true=np.full((3, 11), np.nan))),
            "reach, TSM, latent, return_true: 33 of 33",
        ),
        (lambda: figure7(wrong(return_predicted=np.zeros((2, 11)))), r"expected \(3, 11\)"),
        (lambda: figure7(wrong(steps=np.arange(10))), r"expected \(11\)"),
        (lambda: figure7(wrong(seconds=-np.arange(11))), "seconds go backwards"),
        (lambda: figure7(wrong(), against=["energy"]), "energy"),
        (lambda: figure7(wrong(), {"push": {ZERO: -8.6}}), "push"),
    ],
)
def test_input_that_cannot_be_drawn_is_refused_in_words(
    call: Callable[[], Figure], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        call()
    assert plt.get_fignums() == []
