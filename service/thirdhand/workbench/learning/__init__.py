"""From demonstrations to a skill, its adaptation to via-points, and its file."""
