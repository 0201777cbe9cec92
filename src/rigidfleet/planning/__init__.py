"""What is known of a flight before it: each phase's plan, its references, disturbances and tolerances."""
