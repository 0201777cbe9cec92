"""Multipliers of large formations: sparse factorisations and when they apply."""
