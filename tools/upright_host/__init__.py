"""Upright's host side: the `upright` command and what it is made of."""

__version__ = "0.1.0"
