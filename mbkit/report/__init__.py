"""Results for people: tables on a terminal, figures, one HTML page.

Nothing is imported here: figures bring matplotlib, which a table does not need.
"""
