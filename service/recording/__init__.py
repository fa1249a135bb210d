"""The scribe process and its files: recordings (MCAP) written, read and replayed."""
