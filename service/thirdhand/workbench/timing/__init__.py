"""Measurements of the loop, beside an empty loop."""
