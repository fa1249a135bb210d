"""The scribe process and its files: recordings (MCAP) written, read and replayed, and what Rerun
draws of them.
"""
