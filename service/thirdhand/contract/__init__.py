"""What a client in any language relies on: channels, messages and their bytes, requests.

Imports the standard library and msgspec only.
"""
