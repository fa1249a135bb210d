"""What a running cell does with what was learned: skill files, via-points, corrections."""
