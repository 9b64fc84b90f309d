"""Motions whose truth is known: exact ones, and references on which two runs agree."""
