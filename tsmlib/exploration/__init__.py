"""A model and a prior that collect the data they learn from (section 6)."""
