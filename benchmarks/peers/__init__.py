"""What else would fly a formation: one module a peer, each with `peer()`, which raises `AbsentError`."""
