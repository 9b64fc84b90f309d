"""Equations as text, LaTeX and Python source."""
