"""Criteria by which `learn` chooses hyper-parameters: left-out errors, or the likelihood."""
