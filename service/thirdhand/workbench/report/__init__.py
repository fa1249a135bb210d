"""Reports on recordings: spans, faults, approaches, visits; as text, tables and a page."""
