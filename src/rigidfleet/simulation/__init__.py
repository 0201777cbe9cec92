"""Fly missions: one at a time, step by step, or many at once."""
