"""Stage 5: from the target to a setpoint that the arm can follow and that can always stop."""
