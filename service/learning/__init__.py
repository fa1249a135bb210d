"""From demonstrations to a skill, from a skill to one that goes through taught via-points, and the
skill's file.
"""
