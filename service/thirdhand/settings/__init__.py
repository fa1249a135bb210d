"""A cell's configuration and network, the description of its arm, and the colours of drawings."""
