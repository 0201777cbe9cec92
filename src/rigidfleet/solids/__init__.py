"""Solid shapes in space, their motion, and the one distance to them that plan, monitor and verdict use.

`records` describes solids as arrays, `distance` measures, `outline` gives surfaces to draw.
"""
