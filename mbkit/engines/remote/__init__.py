"""Engines of other versions than the installed ones: each in an environment of its own, behind the protocol."""
