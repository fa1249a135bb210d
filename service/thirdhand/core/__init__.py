"""From a tick's inbox to its frame: no clock, no input or output, no thread."""
