"""What several packages share and users do not need."""
