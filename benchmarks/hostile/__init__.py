"""Attacks with real processes on this machine; `attacks.py` runs them."""
