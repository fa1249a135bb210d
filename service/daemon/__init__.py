"""The control process around the core: clock, channels, requests, and their skill worker."""
