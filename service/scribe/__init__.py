"""The scribe: a process that records each tick and draws it in Rerun."""
