"""Modelled and recorded people: their movements, and the judgement of skills on them."""
