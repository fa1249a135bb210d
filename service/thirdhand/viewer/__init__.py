"""The Rerun scene of a cell: its frames, its surroundings, its skill."""
