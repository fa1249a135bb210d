"""What a recording tells: spans, faults, approaches, visits; as text, tables and a page."""
