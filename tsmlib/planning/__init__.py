"""Trajectory optimisation: search spaces, predictors, planners, tasks, execution (section 4)."""
