"""Sections and figures of the notebooks in which the numbers of claims are shown."""

from typing import NamedTuple


class Shown(NamedTuple):
    """A notebook, a heading in it and a figure of it, the last two as far as there are any."""

    notebook: str
    section: str = ""
    figure: str = ""


DATA, WORKSPACE, TRAINING = (
    Shown("01_collect"),
    Shown("01_collect", figure="01_workspace"),
    Shown("02_train"),
)
RANGE = Shown("03_predict", "What the numbers rest on", "03_horizon")
HORIZON = Shown("03_predict", "Against the horizon", "03_horizon")
CALIBRATION = Shown("03_predict", "After contact", "03_calibration")
CHANGES = Shown("03_predict", "The paper's choices, one at a time")
FIGURE5 = Shown("03_predict", "Figure 5", "figure5")
CODES_USED = Shown("04_latent", "Is the code used?", "04_use")
SPREAD = Shown("04_latent", "Does the spread tell the error?", "04_spread_error")
WALK = Shown("04_latent", "One code, one future", "04_walk_ReacherPush")
FIGURE9 = Shown("04_latent", "Which contacts are foretold", "figure9")
PROBLEM = Shown("05_control", "The problem", "figure3")
CAUSES = Shown("05_control", "Is it the model, the planner or the prior?", "05_plan_actions")
ITERATIONS = Shown("05_control", "More optimisation, more exploitation?")
VIOLATIONS = Shown("05_control", "Physical violations in predicted rollouts")
FIGURE6 = Shown("05_control", "Figure 6: predicted and executed returns", "figure6")
FIGURE7 = Shown("05_control", "Figure 7: policies", "figure7")
ROBUSTNESS, FIGURE8 = Shown("06_robustness"), Shown("06_robustness", figure="figure8")
ACTION_PRIOR, FIGURE10 = (
    Shown("07_action_prior"),
    Shown("07_action_prior", "Action statistics", "figure10"),
)
ROUNDS = Shown("10_explore", "3. What the rounds bring")
PUSHED = Shown("10_explore", "5. The same with an arm that pushes")
ADAPTED = Shown("10_explore", "7. Zero-shot, fine-tuned, from scratch")
