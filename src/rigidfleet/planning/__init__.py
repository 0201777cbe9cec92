"""What is computed before a flight: the plan of each phase, its references, disturbances and tolerances."""
