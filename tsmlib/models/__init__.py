"""Dynamics models and the action prior. No physics, no plots."""
