"""Stage 2: from the motion of two hands to where the tool should be, and how sure that is."""
