"""The scribe: a process that records each tick and feeds the live view."""
