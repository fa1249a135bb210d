"""Demonstrations on disk: captured, listed, trimmed, and read from recordings of others."""
