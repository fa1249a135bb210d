"""Experiments on the service as processes: in real time, and with failing parts."""
