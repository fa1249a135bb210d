"""The control process around the core: loop, clock, streams, requests and skill worker."""
