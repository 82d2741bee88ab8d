"""Placeholder."""
handler = None
