"""Trajectories that other programs made: their files, read as piecewise polynomials of each vehicle."""
