"""Rows of each notebook, and tables and panels made of them."""
