"""Recordings and demonstrations: MCAP files, their replay, and the files that are shipped."""
