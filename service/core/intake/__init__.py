"""Stage 1: samples of hands and arm, checked and filtered to a state at the tick."""
