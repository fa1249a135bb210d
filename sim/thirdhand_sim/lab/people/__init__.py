"""Modelled and recorded people: their movements, and what is judged of a skill on them."""
