"""Blocks of fixed steps in machine code, of many states side by side."""
