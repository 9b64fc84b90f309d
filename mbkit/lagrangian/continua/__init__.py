"""Strings and beams on paper: Hamilton's principle of one-dimensional continua, and assumed modes."""
