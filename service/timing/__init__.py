"""Measurements of the loop: beside an empty loop, under loads, over a long time."""
