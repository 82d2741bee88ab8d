"""Policies learned inside a model (section 4.3)."""
