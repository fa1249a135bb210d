"""Rivals of the service: other predictions of the tool, and other followers of a target."""
