"""Check a mission before the flight."""
