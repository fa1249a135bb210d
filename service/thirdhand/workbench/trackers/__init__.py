"""Hands and their trackers: headset, mouse, camera, calibration, and capture of demonstrations."""
