"""The problem that a primitive solves: its reference database and its hyper-parameters."""
