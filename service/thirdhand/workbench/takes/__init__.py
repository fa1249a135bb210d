"""Takes: demonstrations as they are captured, and recordings of other systems."""
