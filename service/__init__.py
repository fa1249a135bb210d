"""The daemon that turns live hand poses into safe joint commands, and what its clients import."""
