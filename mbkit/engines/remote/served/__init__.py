"""What runs beside another version of an engine: Python and NumPy, and nothing else of mbkit.

Each file stands alone. Where versions differ, the file looks for a function or tries a call; no file knows a version's
number.
"""
