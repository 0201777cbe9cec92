"""Formations before they fly: shapes, graphs, distances, assignment and point files."""
