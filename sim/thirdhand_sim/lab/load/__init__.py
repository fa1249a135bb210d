"""The service as processes of its own: in real time, and when parts of it fail."""
