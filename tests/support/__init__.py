"""Code that tests of several modules share, imported as `support.<module>`; no test imports
another.
"""
