"""Stage 7: joint commands that hold every limit, whatever is wanted."""
