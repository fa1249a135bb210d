"""The hands' side: demonstrations captured from live trackers."""
