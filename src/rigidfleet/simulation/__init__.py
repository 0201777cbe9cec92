"""Fly missions: one after the other, step by step, or many at once."""
