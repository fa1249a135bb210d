"""Stage 4: how fast the parts of the arm may approach hands, things and each other."""
