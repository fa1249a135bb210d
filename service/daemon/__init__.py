"""The control process around the core: its clock, its channels, its requests, and the process that
computes for them.
"""
