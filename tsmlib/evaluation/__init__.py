"""Scores and measures: arrays and models in, numbers out."""
