"""What Rerun draws of a cell: its frames, its surroundings, its skill."""
