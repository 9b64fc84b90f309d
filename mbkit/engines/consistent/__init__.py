"""States that constraints allow."""
