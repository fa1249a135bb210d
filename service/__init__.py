"""The daemon that turns live hand poses into safe joint commands, and everything a client of it
imports.
"""
