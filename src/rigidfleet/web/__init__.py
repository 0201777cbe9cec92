"""Pages for a browser: the replay of a flight and a live flight."""
