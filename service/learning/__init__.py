"""From demonstrations to a skill, from that to one through taught via-points, and its file."""
