"""Calibration of a tracker: its pose in frame `base`, from a hand at the arm's tool."""
